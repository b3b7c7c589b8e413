"""COLMAP's structure from motion as a program, see ``pycolmap_process``: features, pairs, cameras and points.

Results in the database are reused, so a restarted program resumes. The program downloads nothing: without the
path of a vocabulary tree, COLMAP would download one and abort the process on failure.
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

MAX_INCREMENTAL_PHOTOS = 100
"""Maximum number of photos for the incremental mapper alone. Larger sets run the global mapper first."""
MIN_GLOBAL_SHARE = 0.9
"""Minimum share of photos that the global mapper must place. Otherwise the incremental mapper runs too."""
MAX_EXHAUSTIVE_PHOTOS = 80
"""Maximum number of unordered photos for comparing all pairs. Larger sets compare only similar photos."""
SIMILAR_PHOTOS = 30
"""Number of similar photos compared with each photo."""
SUBSEQUENT_PHOTOS = 10
"""Number of subsequent photos compared with each ordered photo, plus some at doubling distances."""
_VOCABULARY_SAMPLES = 60_000
"""Approximate number of descriptors used to build the vocabulary tree."""


def _main() -> None:
    request = pycolmap_process.read_request()
    pycolmap = pycolmap_process.load_pycolmap()
    pycolmap.set_random_seed(0)
    work = Path(request["work"])
    database = work / "database.db"
    # One connection stays open from before the first message, which starts the parent's polling: the first
    # connection to a database locks it for a moment, and COLMAP does not wait for locks.
    with closing(pycolmap.Database.open(database)):
        send(stage="features", done=0, total=len(request["names"]))
        _extract(request, database)
        _match(request, work, database)
        model = _map(request, work, database)
        shutil.rmtree(work / "model", ignore_errors=True)
        if model is not None:
            (work / "model").mkdir()
            model.write_binary(work / "model")
        _report(database, model)


def _extract(request: dict, database: Path) -> None:
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    if request["masks"]:
        reader.mask_path = request["masks"]
    mode = {"one": "SINGLE", "folder": "PER_FOLDER", "each": "PER_IMAGE"}[request["lens"]]
    if mode == "SINGLE":
        with closing(pycolmap.Database.open(database)) as existing:
            if existing.num_cameras():
                reader.existing_camera_id = min(camera.camera_id for camera in existing.read_all_cameras())
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = request["size"]
    options.sift.max_num_features = request["features"]
    options.sift.first_octave = 0
    pycolmap.extract_features(
        database, request["photos"], image_names=request["names"],
        camera_mode=getattr(pycolmap.CameraMode, mode), reader_options=reader,
        extraction_options=options, device=pycolmap.Device.cpu,
    )  # fmt: skip


def _match(request: dict, work: Path, database: Path) -> None:
    import pycolmap

    count = len(request["names"])
    cpu = pycolmap.Device.cpu
    if request["ordered"]:
        options = pycolmap.SequentialPairingOptions()
        options.overlap = SUBSEQUENT_PHOTOS
        if count > 4 * SUBSEQUENT_PHOTOS:
            options.vocab_tree_path = _build_vocabulary(work, database)
            options.loop_detection = True
        send(stage="pairs", done=0, total=count * (SUBSEQUENT_PHOTOS + 4))
        pycolmap.match_sequential(database, pairing_options=options, device=cpu)
    elif count <= MAX_EXHAUSTIVE_PHOTOS:
        send(stage="pairs", done=0, total=count * (count - 1) // 2)
        pycolmap.match_exhaustive(database, device=cpu)
    else:
        options = pycolmap.VocabTreePairingOptions()
        options.num_images = SIMILAR_PHOTOS
        options.vocab_tree_path = _build_vocabulary(work, database)
        # an estimate: many pairs are mutual
        send(stage="pairs", done=0, total=count * SIMILAR_PHOTOS * 2 // 3)
        pycolmap.match_vocabtree(database, pairing_options=options, device=cpu)


def _build_vocabulary(work: Path, database: Path) -> Path:
    """Build a vocabulary tree from the photos' own descriptors, about 40 per word, unless it exists."""
    import pycolmap

    path = work / "vocabulary.bin"
    if path.exists():
        return path
    send(stage="vocabulary", done=0, total=1)
    rng = np.random.default_rng(0)
    samples = []
    with closing(pycolmap.Database.open(database)) as features:
        images = features.read_all_images()
        for image in images:
            data = features.read_descriptors(image.image_id).data
            samples.append(data[rng.permutation(len(data))[: _VOCABULARY_SAMPLES // len(images) + 1]])
    descriptors = np.concatenate(samples).astype(np.float32)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = int(np.clip(len(descriptors) // 40, 1, 2048))
    index = pycolmap.VisualIndex.create(descriptors.shape[1], 64)
    index.build(
        options,
        pycolmap.FeatureDescriptorsFloat(type=pycolmap.FeatureExtractorType.SIFT, data=descriptors),
    )
    temporary = path.with_suffix(".part")
    index.write(temporary)
    temporary.replace(path)
    return path


def _map(request: dict, work: Path, database: Path) -> pycolmap.Reconstruction | None:
    """Return the model with the most photos, or None if there is no model."""
    import pycolmap

    count = len(request["names"])
    models = work / "models"
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    send(stage="cameras", done=0, total=count)
    best = None
    if count > MAX_INCREMENTAL_PHOTOS:
        options = pycolmap.GlobalPipelineOptions()
        options.image_names = request["names"]
        results = pycolmap.global_mapping(database, request["photos"], models, options)
        best = _largest(list(results.values()))
    if best is None or best.num_reg_images() < MIN_GLOBAL_SHARE * count:
        options = pycolmap.IncrementalPipelineOptions()
        options.image_names = request["names"]
        options.min_model_size = 3
        options.random_seed = 0
        placed = 2

        def report_placed() -> None:
            nonlocal placed
            placed = min(placed + 1, count)
            send(stage="cameras", done=placed, total=count)

        results = pycolmap.incremental_mapping(
            database, request["photos"], models, options, next_image_callback=report_placed
        )
        best = _largest([*([best] if best else []), *results.values()])
    return best


def _largest(models: list[pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    return max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _report(database: Path, model: pycolmap.Reconstruction | None) -> None:
    """Send the number of features per photo, the matches per pair, and the placed photos."""
    import pycolmap

    with closing(pycolmap.Database.open(database)) as results:
        names = {image.image_id: image.name for image in results.read_all_images()}
        features = {name: results.num_keypoints_for_image(number) for number, name in names.items()}
        ids, counts = results.read_two_view_geometry_num_inliers()
    pairs = [pycolmap.pair_id_to_image_pair(pair) for pair in ids]
    matches = [
        [names[first], names[second], inliers]
        for (first, second), inliers in zip(pairs, counts, strict=True)
        if inliers and first in names and second in names
    ]
    placed = [] if model is None else [model.images[number].name for number in model.reg_image_ids()]
    send(
        result={
            "features": features, "pairs": matches, "placed": sorted(placed),
            "points": 0 if model is None else model.num_points3D(),
            "error": 0.0 if model is None else model.compute_mean_reprojection_error(),
        }
    )  # fmt: skip


if __name__ == "__main__":
    _main()
