"""COLMAP scenes from photos alone: camera poses and points by COLMAP, through pycolmap.

out/  images/    photos, as links or copies; WebP, which pycolmap cannot read, as PNG
      sparse/0/  model
      masks/     masks of the photos, if any; training uses the same masks
      colmap/    COLMAP's intermediate results, used to resume; pairs.png, matches between photos
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..errors import LodgsError, SystemProblem, system_reason
from ..files import atomic_write, check_folder, is_file, link_or_copy
from . import pycolmap_process
from .colmap import MASKS, find_models
from .image_files import MASK_SUFFIXES, UNREADABLE_SUFFIXES, SidecarFiles
from .image_headers import image_size
from .images import IMAGE_SUFFIXES, check_mask, load_image, load_mask, write_png
from .view_selection import exclusion_messages

PRESETS = {"draft": (1000, 2048), "standard": (1600, 4096)}
"""Longer side in pixels for feature extraction, and maximum number of features per photo."""
LENSES = "one", "folder", "each"
"""Photos that share a lens: all, those of a folder, or none."""
SETTINGS = "settings.json"
"""File that marks the folder of intermediate results as ours, with the settings used."""
MIN_PHOTOS = 3
"""Minimum number of photos of a scene."""
MIN_FEATURES = 100
"""Number of features below which a photo counts as featureless."""
STAGES = {
    "features": "Extracting features of photo",
    "vocabulary": "Building the vocabulary tree",
    "pairs": "Comparing pair",
    "cameras": "Placing photo",
}

_WEBP = ".webp"
_TABLES = {"features": "descriptors", "pairs": "two_view_geometries"}
"""Tables of COLMAP's database with one row per completed item, by stage."""
_POLL_SECONDS = 0.5
_JOIN_SECONDS = 2.0

Report = Callable[[str, int, int], object]
"""Callback that receives the stage, the number of completed items and their total."""


@dataclass(frozen=True)
class ReconstructionResult:
    """A reconstructed scene.

    Attributes:
        folder: folder of the COLMAP scene.
        photos: number of photos used.
        placed: names of the photos with a reconstructed camera.
        points: number of points.
        error: mean reprojection error in pixels of the photos.
        summary: sentences about the result and possible improvements.
        excluded: a sentence for each unusable file.
    """

    folder: Path
    photos: int
    placed: list[str]
    points: int
    error: float
    summary: str
    excluded: list[str]


def reconstruct(
    photos: Path,
    out: Path,
    *,
    preset: str = "draft",
    ordered: bool = False,
    lens: str = "",
    masks: Path | None = None,
    report: Report = lambda stage, done, total: None,
) -> ReconstructionResult:
    """Reconstruct cameras and points from photos and write the scene. A repeated call resumes.

    Args:
        photos: folder of the photos, with subfolders.
        out: folder of the scene.
        preset: a key of PRESETS.
        ordered: True if the names follow the camera path, as for video frames; then only neighbouring photos
            are compared, which is faster.
        lens: one of LENSES; "" selects "one" if all photos have the same size, else "each".
        masks: folder of masks, black in ignored areas: ``a/b.jpg.png`` or ``a/b.png`` for ``a/b.jpg``.
        report: called with the progress.

    Raises:
        LodgsError: there are too few photos, too few overlap, or a file cannot be written.
    """
    photos, out = (Path(os.path.abspath(path)) for path in (photos, out))
    masks = None if masks is None else Path(os.path.abspath(masks))
    work = out / "colmap"
    other_folders = [work, out / "sparse", out / MASKS, *([masks] if masks else [])]
    if not photos.is_relative_to(out):
        other_folders.append(out / "images")
    names, excluded, sizes = _list_photos(photos, other_folders)
    _check_photos(photos, names, excluded)
    _check_output(out, work)
    size, features = PRESETS[preset]
    settings = {
        "size": size, "features": features,
        "lens": lens or ("one" if len(sizes) == 1 else "each"), "masks": str(masks or ""),
    }  # fmt: skip
    try:
        _start_work(work, settings)
        images, image_names, linked_masks = _link_inputs(photos, names, masks, out)
        request = settings | {
            "photos": str(images), "names": image_names, "ordered": ordered, "work": str(work),
            "masks": str(linked_masks or ""),
        }  # fmt: skip
        result = _run_colmap(request, work, report)
        if len(result["placed"]) < MIN_PHOTOS:
            problem, remedy = _explain_failure(image_names, result, work)
            raise LodgsError(" ".join([problem, *exclusion_messages(excluded)]), remedy)
        _install_model(work, out)
    except OSError as error:
        raise LodgsError(
            f"Cannot write scene {out}: {system_reason(error)}.",
            "Free disk space or choose another folder.",
        ) from error
    return ReconstructionResult(
        out, len(image_names), result["placed"], result["points"], result["error"],
        _summarize(image_names, result), exclusion_messages(excluded),
    )  # fmt: skip


def _link_inputs(
    photos: Path, names: list[str], masks: Path | None, out: Path
) -> tuple[Path, list[str], Path | None]:
    """Bring photos and masks into the scene; return their folders there and the photos' names."""
    images, image_names = photos, names
    if not photos.is_relative_to(out):
        images = out / "images"
        image_names = [_import_photo(photos, name, images) for name in names]
    if masks is None:
        return images, image_names, None
    masks = _link_masks(masks, photos, dict(zip(names, image_names, strict=True)), out)
    return images, image_names, masks


def draw_pairs(names: Sequence[str], pairs: Sequence[Sequence], placed: Sequence[str]) -> np.ndarray:
    """Draw a matrix of matches between photos, (S, S, 3) uint8, with a row and a column per photo.

    A square's brightness is the logarithm of the number of common features. Photos without a camera are red.
    """
    index = {name: number for number, name in enumerate(names)}
    matches = np.zeros((len(names), len(names)))
    for first, second, count in pairs:
        if first in index and second in index:
            matches[index[first], index[second]] = matches[index[second], index[first]] = count
    brightness = np.log1p(matches) / max(np.log1p(matches.max(initial=0)), 1)
    has_camera = np.isin(names, list(placed))
    np.fill_diagonal(brightness, 1)
    codes = np.repeat((40 + 215 * brightness)[..., None], 3, axis=2)
    codes[~has_camera[:, None] | ~has_camera[None, :]] *= (1, 0.25, 0.25)
    square = max(720 // len(names), 1)
    return np.repeat(np.repeat(codes.astype(np.uint8), square, axis=0), square, axis=1)


class _Progress:
    """Progress of COLMAP, polled from its database because its functions report none.

    This process polls, because two copies of SQLite in one process break each other's locks.
    """

    def __init__(self, database: Path, report: Report) -> None:
        self._address = f"{database.as_uri()}?mode=ro"
        self._report = report
        self._stage = ""
        self._total = 0
        self._finished = threading.Event()
        self._thread = threading.Thread(target=self._poll, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._finished.set()
        self._thread.join(_JOIN_SECONDS)  # the reader of a report may be stuck

    def begin(self, stage: str, done: int, total: int) -> None:
        self._stage = stage
        self._total = total
        self._report(STAGES[stage], done, total)

    def _poll(self) -> None:
        last: tuple[str, int] = "", 0
        while not self._finished.wait(_POLL_SECONDS):
            stage, total = self._stage, self._total
            if stage not in _TABLES:
                continue
            try:
                with closing(sqlite3.connect(self._address, uri=True)) as database:
                    done = database.execute(f"select count(*) from {_TABLES[stage]}").fetchone()[0]
            except sqlite3.Error:  # COLMAP has not created the table yet
                continue
            if (stage, done) != last and stage == self._stage:
                self._report(STAGES[stage], min(done, total), total)
                last = stage, done


def _list_photos(
    photos: Path, excluded_folders: Sequence[Path]
) -> tuple[list[str], list[tuple[str, str]], set[tuple[int, int]]]:
    """Return the names of readable photos, (name, reason) pairs of unusable images, and the photos' sizes.

    Args:
        excluded_folders: folders of images that are not photos.
    """
    remedy = "Choose a folder of photos. To extract frames of a video: blender --command lodgs frames."
    check_folder(photos, remedy)
    names, excluded, sizes = [], [], set()
    files = [
        path
        for path in sorted(photos.rglob("*"))
        if not any(part.startswith(".") for part in path.relative_to(photos).parts)
        and not any(path.is_relative_to(folder) for folder in excluded_folders)
    ]
    candidates = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    if not candidates:  # next to other photos, EXR files are depth maps
        candidates = [path for path in files if path.suffix.lower() == ".exr"]
    readable = {path.with_suffix("") for path in candidates}
    for path in files:
        if path.suffix.lower() in UNREADABLE_SUFFIXES and path.with_suffix("") not in readable:
            kind = path.suffix[1:].upper()
            excluded.append(
                (path.relative_to(photos).as_posix(), f"format {kind} is not supported. Convert it to JPEG.")
            )
    for path in candidates:
        name = path.relative_to(photos).as_posix()
        try:
            sizes.add(image_size(path))
            name.encode()
        except UnicodeEncodeError:
            excluded.append((name, "its name is not UTF-8."))
        except SystemProblem:
            raise
        except LodgsError as error:
            excluded.append((name, error.what))
        else:
            names.append(name)
    return names, excluded, sizes


def _check_photos(photos: Path, names: Sequence[str], excluded: Sequence[tuple[str, str]]) -> None:
    """Raise LodgsError if there are too few readable photos."""
    if len(names) < MIN_PHOTOS:
        raise LodgsError(
            f"Cannot reconstruct {photos}: found {len(names)} readable photos, need at least {MIN_PHOTOS}."
            + "".join(f" {message}" for message in exclusion_messages(excluded)[:1]),
            "Choose the folder of the photos.",
        )


def _check_output(out: Path, work: Path) -> None:
    """Raise LodgsError if the scene's folder contains a scene or files of another program."""
    if is_file(work / SETTINGS):
        return
    if out.is_dir() and find_models(out):
        raise LodgsError(f"Cannot write scene: {out} already holds a COLMAP scene.", "Choose another folder.")
    if work.exists():
        raise LodgsError(
            f"Cannot write scene: {out} holds a folder {work.name} of another program.",
            "Choose another folder.",
        )


def _import_photo(photos: Path, name: str, images: Path) -> str:
    """Link or convert a photo into the scene's image folder and return its image name."""
    if not name.lower().endswith(_WEBP):
        link_or_copy(photos / name, images / name)
        return name
    png_name = f"{name}.png"
    if not (images / png_name).exists():
        width, height = image_size(photos / name)
        codes = np.rint(255 * load_image(photos / name, width, height)).astype(np.uint8)
        with atomic_write(images / png_name) as temporary:
            write_png(temporary, codes)
    return png_name


def _start_work(work: Path, settings: Mapping[str, object]) -> None:
    """Create the folder of intermediate results, and discard those of other settings."""
    file = work / SETTINGS
    text = json.dumps(settings)
    if is_file(file) and file.read_text(encoding="utf-8") != text:
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    with atomic_write(file) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _link_masks(masks: Path, photos: Path, image_names: Mapping[str, str], out: Path) -> Path:
    """Link the masks into the scene under COLMAP's names and return their folder.

    COLMAP drops photos without a mask, so theirs are white.

    Args:
        image_names: image name by photo name.
    """
    folder = out / MASKS
    sidecars = SidecarFiles(masks, "mask", *MASK_SUFFIXES)
    files = {name: sidecars.find(name) for name in image_names}
    if not any(files.values()):
        first = next(iter(image_names))
        raise LodgsError(
            f"Cannot use masks: {masks} has no mask of these photos.",
            f"Name the mask of {first} {first}.png.",
        )
    for name, mask in files.items():
        size = image_size(photos / name)
        target = folder / f"{image_names[name]}.png"
        if mask is not None:
            check_mask(mask, *size)
        if mask is not None and mask.suffix.lower() == ".png":
            link_or_copy(mask, target)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.unlink(missing_ok=True)  # may be a link to a mask that was renamed
            white = np.ones(size[::-1], np.float32)
            codes = (255 * (white if mask is None else load_mask(mask, *size))).astype(np.uint8)
            write_png(target, np.repeat(codes[..., None], 3, axis=2))
    return folder


def _run_colmap(request: dict, work: Path, report: Report) -> dict:
    """Run structure from motion in a separate process, draw pairs.png and return the result."""
    result: dict = {}
    progress = _Progress(work / "database.db", report)

    def on_message(message: dict) -> None:
        if "result" in message:
            result.update(message["result"])
        else:
            progress.begin(message["stage"], message["done"], message["total"])

    with progress:
        problem = pycolmap_process.run_program("sfm", request, work, on_message)
    if problem:
        raise LodgsError(f"Cannot reconstruct the photos: COLMAP stopped: {problem}", "Try again to resume.")
    with atomic_write(work / "pairs.png") as temporary:
        write_png(temporary, draw_pairs(request["names"], result["pairs"], result["placed"]))
    return result


def _install_model(work: Path, out: Path) -> None:
    """Replace the scene's model by the new one."""
    (out / "sparse").mkdir(exist_ok=True)
    shutil.rmtree(out / "sparse" / "0", ignore_errors=True)
    os.replace(work / "model", out / "sparse" / "0")
    shutil.rmtree(work / "models", ignore_errors=True)


def _summarize(names: Sequence[str], result: Mapping) -> str:
    placed = set(result["placed"])
    if len(placed) == len(names):
        return f"All {len(names)} photos are placed."
    inside, outside = _weakest_link(names, result["pairs"], placed)
    return (
        f"{len(placed)} of {len(names)} photos are placed: {inside} and {outside} overlap too little. "
        "Take photos between them, or continue without the missing ones."
    )


def _explain_failure(names: Sequence[str], result: Mapping, work: Path) -> tuple[str, str]:
    """Return the reason why no scene was reconstructed, and a remedy."""
    featureless = [name for name in names if result["features"].get(name, 0) < MIN_FEATURES]
    if len(featureless) > len(names) / 2:
        return (
            f"Cannot reconstruct the photos: {len(featureless)} of {len(names)} have almost no features.",
            "Take sharp photos of textured objects.",
        )
    return (
        f"Cannot reconstruct the photos: no {MIN_PHOTOS} of the {len(names)} photos overlap enough.",
        "Take photos from close positions that share two thirds of the image. "
        f"{work / 'pairs.png'} shows the overlaps.",
    )


def _weakest_link(names: Sequence[str], pairs: Sequence[Sequence], placed: set[str]) -> tuple[str, str]:
    """Return the placed and the missing photo with the most common features, or else adjacent names."""
    links = [
        (count, first, second) if first in placed else (count, second, first)
        for first, second, count in pairs
        if (first in placed) != (second in placed)
    ]
    if links:
        _, inside, outside = max(links)
        return inside, outside
    first, second = next((a, b) for a, b in pairwise(names) if (a in placed) != (b in placed))
    return (first, second) if first in placed else (second, first)
