"""COLMAP's structure from motion as a program, see ``apart``: features, pairs, then cameras and points.

What is in the database already is not done again, so that whoever starts it once more goes on. Nothing is
downloaded: without the path of a vocabulary COLMAP fetches one, and ends the process where it cannot.
"""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from . import pycolmap_process
from .pycolmap_process import send

if TYPE_CHECKING:
    import pycolmap

GLOBAL_FROM = 100
"""Of more photographs the global mapper is tried first."""
GLOBAL_SHARE = 0.9
"""If it places fewer than this share of them, the incremental one is tried as well."""
EXHAUSTIVE = 80
"""Up to so many unordered photographs all pairs are compared; of more, each with those that look like it."""
ALIKE = 30
"""So many photographs that look like one are compared with it."""
OVERLAP = 10
"""Ordered photographs are compared with so many that follow, and with some at distances that double."""
_SAMPLED = 60_000
"""Descriptors that a vocabulary is made of, about."""


def _main() -> None:
    asked = pycolmap_process.read_request()
    pycolmap_process.load_pycolmap().set_random_seed(0)
    work = Path(asked["work"])
    database = work / "database.db"
    send(stage="features", done=0, of=len(asked["names"]))
    _extract(asked, database)
    _match(asked, work, database)
    best = _place(asked, work, database)
    shutil.rmtree(work / "model", ignore_errors=True)
    if best is not None:
        (work / "model").mkdir()
        best.write_binary(work / "model")
    _report(database, best)


def _extract(asked: dict, database: Path) -> None:
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    if asked["masks"]:
        reader.mask_path = asked["masks"]
    mode = {"one": "SINGLE", "folder": "PER_FOLDER", "each": "PER_IMAGE"}[asked["lens"]]
    if mode == "SINGLE" and database.exists():
        with closing(pycolmap.Database.open(database)) as known:
            if known.num_cameras():
                reader.existing_camera_id = min(camera.camera_id for camera in known.read_all_cameras())
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.sift.max_num_features = asked["size"], asked["features"]
    options.sift.first_octave = 0
    pycolmap.extract_features(
        database, asked["photos"], image_names=asked["names"], camera_mode=getattr(pycolmap.CameraMode, mode),
        reader_options=reader, extraction_options=options, device=pycolmap.Device.cpu,
    )  # fmt: skip


def _match(asked: dict, work: Path, database: Path) -> None:
    import pycolmap

    count, cpu = len(asked["names"]), pycolmap.Device.cpu
    if asked["ordered"]:
        options = pycolmap.SequentialPairingOptions()
        options.overlap = OVERLAP
        if count > 4 * OVERLAP:
            options.vocab_tree_path, options.loop_detection = _vocabulary(work, database), True
        send(stage="pairs", done=0, of=count * (OVERLAP + 4))
        pycolmap.match_sequential(database, pairing_options=options, device=cpu)
    elif count <= EXHAUSTIVE:
        send(stage="pairs", done=0, of=count * (count - 1) // 2)
        pycolmap.match_exhaustive(database, device=cpu)
    else:
        options = pycolmap.VocabTreePairingOptions()
        options.num_images, options.vocab_tree_path = ALIKE, _vocabulary(work, database)
        send(stage="pairs", done=0, of=count * ALIKE * 2 // 3)  # about: many are each other's
        pycolmap.match_vocabtree(database, pairing_options=options, device=cpu)


def _vocabulary(work: Path, database: Path) -> Path:
    """A vocabulary tree of these photographs' own descriptors, some 40 of them a word."""
    import pycolmap

    path = work / "vocabulary.bin"
    if path.exists():
        return path
    send(stage="vocabulary", done=0, of=1)
    rng, found = np.random.default_rng(0), []
    with closing(pycolmap.Database.open(database)) as known:
        images = known.read_all_images()
        for image in images:
            data = known.read_descriptors(image.image_id).data
            found.append(data[rng.permutation(len(data))[: _SAMPLED // len(images) + 1]])
    descriptors = np.concatenate(found).astype(np.float32)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = int(np.clip(len(descriptors) // 40, 1, 2048))
    index = pycolmap.VisualIndex.create(descriptors.shape[1], 64)
    index.build(
        options,
        pycolmap.FeatureDescriptorsFloat(type=pycolmap.FeatureExtractorType.SIFT, data=descriptors),
    )
    beside = path.with_suffix(".part")
    index.write(beside)
    beside.replace(path)
    return path


def _place(asked: dict, work: Path, database: Path) -> pycolmap.Reconstruction | None:
    """The model of the most photographs; None where there is none."""
    import pycolmap

    count, models = len(asked["names"]), work / "models"
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    send(stage="cameras", done=0, of=count)
    best = None
    if count > GLOBAL_FROM:
        options = pycolmap.GlobalPipelineOptions()
        options.image_names = asked["names"]
        found = pycolmap.global_mapping(database, asked["photos"], models, options)
        best = _largest(list(found.values()))
    if best is None or best.num_reg_images() < GLOBAL_SHARE * count:
        options = pycolmap.IncrementalPipelineOptions()
        options.image_names, options.min_model_size, options.random_seed = asked["names"], 3, 0
        placed = [2]

        def one_more() -> None:
            placed[0] = min(placed[0] + 1, count)
            send(stage="cameras", done=placed[0], of=count)

        found = pycolmap.incremental_mapping(
            database, asked["photos"], models, options, next_image_callback=one_more
        )
        best = _largest([*([best] if best else []), *found.values()])
    return best


def _largest(models: list[pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    return max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _report(database: Path, best: pycolmap.Reconstruction | None) -> None:
    """How many features each photograph has, how many each pair has in common, and what has a place."""
    import pycolmap

    with closing(pycolmap.Database.open(database)) as known:
        names = {image.image_id: image.name for image in known.read_all_images()}
        features = {name: known.num_keypoints_for_image(number) for number, name in names.items()}
        ids, counts = known.read_two_view_geometry_num_inliers()
    pairs = [pycolmap.pair_id_to_image_pair(pair) for pair in ids]
    common = [
        [names[one], names[other], inliers]
        for (one, other), inliers in zip(pairs, counts, strict=True)
        if inliers and one in names and other in names
    ]
    placed = [] if best is None else [best.images[number].name for number in best.reg_image_ids()]
    send(
        result={
            "features": features, "pairs": common, "placed": sorted(placed),
            "points": 0 if best is None else best.num_points3D(),
            "error": 0.0 if best is None else best.compute_mean_reprojection_error(),
        }
    )  # fmt: skip


if __name__ == "__main__":
    _main()
