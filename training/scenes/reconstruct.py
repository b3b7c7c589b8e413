"""From photographs alone to a COLMAP scene: where each was taken, by COLMAP through pycolmap.

out/  images/    the photographs, links or copies; WebP, which pycolmap does not read, as PNG
      sparse/0/  the model
      masks/     of the photographs, where there are some: the same in training
      colmap/    what COLMAP knows of them, from which it goes on; pairs.png, which photographs show the same
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

from ..errors import LodgsError
from ..files import atomic_write, check_folder, link_or_copy
from . import pycolmap_process
from .colmap import MASKS, exclusion_messages, find_models
from .image_files import SidecarFiles
from .images import IMAGE_SUFFIXES, check_mask, image_size, load_image, write_png

PRESETS = {"draft": (1000, 2048), "standard": (1600, 4096)}
"""Pixels of the longer side in which features are looked for, and at most so many of a photograph."""
LENSES = "one", "folder", "each"
"""One lens took all photographs, all of a folder, or each its own."""
SETTINGS = "settings.json"
"""What marks the folder of what COLMAP knows as ours, and says how it was found."""
FEWEST = 3
"""Photographs that make a scene."""
STAGES = {
    "features": "Features of photograph",
    "vocabulary": "Learning what the photographs show",
    "pairs": "Pairs compared:",
    "cameras": "Photographs placed:",
}

_WEBP = ".webp"
_UNREAD = (
    ".heic", ".heif", ".avif", ".jxl", ".jp2", ".bmp", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf",
    ".rw2", ".pef",
)  # fmt: skip
"""How names of photographs end that are not read, in lower case."""
_TABLES = {"features": "descriptors", "pairs": "two_view_geometries"}
"""Of COLMAP's database, which have a row for each that is done."""
_LOOKS = 0.5

Tell = Callable[[str, int, int], object]
"""Is told what is done, how far it is, and of how much."""


@dataclass(frozen=True)
class ReconstructionResult:
    """What came of it.

    Attributes:
        folder: of the COLMAP scene.
        photographs: how many were tried.
        placed: names of those that found their place.
        points: how many there are.
        error: mean reprojection error in pixels of the photographs.
        words: how it went, and what to do about it.
        left_out: files that could not be tried, and why.
    """

    folder: Path
    photographs: int
    placed: list[str]
    points: int
    error: float
    words: str
    left_out: list[str]


def reconstruct(
    photos: Path,
    out: Path,
    *,
    preset: str = "draft",
    ordered: bool = False,
    lens: str = "",
    masks: Path | None = None,
    tell: Tell = lambda what, done, of: None,
) -> ReconstructionResult:
    """Finds cameras and points of photographs, and writes the scene. Given again, it goes on where it was.

    Args:
        photos: their folder; folders in it, too.
        out: the scene's folder.
        preset: a name in PRESETS.
        ordered: whether names follow the way that was walked, as frames of a video do: then neighbours are
            compared, which takes less time.
        lens: of LENSES; "": one, if all have the same size, else each its own.
        masks: folder of pictures that are black where a photograph is not to be looked at: of ``a/b.jpg``
            named ``a/b.jpg.png``, or ``a/b.png``.

    Raises:
        LodgsError: there are too few photographs, too few overlap, or something could not be written.
    """
    photos, out = Path(os.path.abspath(photos)), Path(os.path.abspath(out))
    masks = None if masks is None else Path(os.path.abspath(masks))
    ours = [out / "colmap", out / "sparse", out / MASKS]
    if not photos.is_relative_to(out):
        ours.append(out / "images")
    names, left_out, sizes = _photographs(photos, [*ours, *([masks] if masks else [])])
    if len(names) < FEWEST:
        raise LodgsError(
            f"{photos} holds {len(names)} photographs that can be read; a scene takes {FEWEST}."
            + "".join(f" {sentence}" for sentence in exclusion_messages(left_out)[:1]),
            "Choose the folder of the photographs.",
        )
    work = out / "colmap"
    if not (work / SETTINGS).is_file():  # what is there is somebody's
        if out.is_dir() and find_models(out):
            raise LodgsError(f"{out} holds a COLMAP scene already.", "Choose another folder.")
        if work.exists():
            raise LodgsError(
                f"{out} holds a folder {work.name} of somebody else's.", "Choose another folder."
            )
    size, features = PRESETS[preset]
    settings = {
        "size": size, "features": features,
        "lens": lens or ("one" if len(sizes) == 1 else "each"), "masks": str(masks or ""),
    }  # fmt: skip
    found: dict = {}
    progress = _Progress(work / "database.db", tell)

    def hear(said: dict) -> None:
        if "result" in said:
            found.update(said["result"])
        else:
            progress.begin(said["stage"], said["done"], said["of"])

    try:
        _begin(work, settings)
        images, given = out / "images", names
        if photos.is_relative_to(out):
            images = photos
        else:
            names = [_taken_over(photos, name, images) for name in given]
        asked = settings | {
            "photos": str(images), "names": names, "ordered": ordered, "work": str(work),
            "masks": str(_link_masks(masks, photos, dict(zip(given, names, strict=True)), out)) if masks else "",
        }  # fmt: skip
        with progress:
            problem = pycolmap_process.run_program("sfm", asked, work, hear)
        if problem:
            raise LodgsError(
                f"COLMAP has ended without a scene: {problem}", "Do it again: it goes on where it was."
            )
        with atomic_write(work / "pairs.png") as temporary:
            write_png(temporary, draw_pairs(names, found["pairs"], found["placed"]))
        if len(found["placed"]) < FEWEST:
            what, remedy = _nothing(names, found, work)
            raise LodgsError(" ".join([what, *exclusion_messages(left_out)]), remedy)
        (out / "sparse").mkdir(exist_ok=True)
        shutil.rmtree(out / "sparse" / "0", ignore_errors=True)
        os.replace(work / "model", out / "sparse" / "0")
        shutil.rmtree(work / "models", ignore_errors=True)
    except OSError as error:
        raise LodgsError(
            f"The scene {out} could not be written: {error.strerror or error}.",
            "Free some space there or choose another folder.",
        ) from error
    words = _words(names, found)
    return ReconstructionResult(
        out, len(names), found["placed"], found["points"], found["error"], words, exclusion_messages(left_out)
    )


def draw_pairs(names: Sequence[str], pairs: Sequence[Sequence], placed: Sequence[str]) -> np.ndarray:
    """Which photographs show the same, (S, S, 3) uint8: a row and a column of each, by name.

    A square is as bright as the logarithm of the number of features that two have in common, and what has
    found no place is red.
    """
    place = {name: number for number, name in enumerate(names)}
    common = np.zeros((len(names), len(names)))
    for one, other, count in pairs:
        if one in place and other in place:
            common[place[one], place[other]] = common[place[other], place[one]] = count
    light = np.log1p(common) / max(np.log1p(common.max(initial=0)), 1)
    there = np.isin(names, list(placed))
    np.fill_diagonal(light, 1)
    codes = np.repeat((40 + 215 * light)[..., None], 3, axis=2)
    codes[~there[:, None] | ~there[None, :]] *= (1, 0.25, 0.25)
    each = max(720 // len(names), 1)
    return np.repeat(np.repeat(codes.astype(np.uint8), each, axis=0), each, axis=1)


class _Progress:
    """Tells how far the program is, meanwhile: COLMAP's functions tell nobody, but its database grows.

    It is read from here: two copies of SQLite in one process break each other's locks.
    """

    def __init__(self, database: Path, tell: Tell) -> None:
        self._address, self._tell = f"{database.as_uri()}?mode=ro", tell
        self._stage, self._of, self._over = "", 0, threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def begin(self, stage: str, done: int, of: int) -> None:
        self._stage, self._of = stage, of
        self._tell(STAGES[stage], done, of)

    def _look(self) -> None:
        before: tuple[str, int] = "", 0
        while not self._over.wait(_LOOKS):
            stage, of = self._stage, self._of
            if stage not in _TABLES:
                continue
            try:
                with closing(sqlite3.connect(self._address, uri=True)) as database:
                    done = database.execute(f"select count(*) from {_TABLES[stage]}").fetchone()[0]
            except sqlite3.Error:  # not there yet
                continue
            if (stage, done) != before and stage == self._stage:
                self._tell(STAGES[stage], min(done, of), of)
                before = stage, done


def _photographs(
    photos: Path, others: Sequence[Path]
) -> tuple[list[str], list[tuple[str, str]], set[tuple[int, int]]]:
    """Names of what can be read, by name; other pictures and why not; and the sizes that there are.

    Args:
        others: folders of pictures that are no photographs.
    """
    remedy = "Choose the folder of the photographs; of a video make one: blender --command lodgs frames."
    check_folder(photos, remedy)
    names, left_out, sizes = [], [], set()
    files = [
        path
        for path in sorted(photos.rglob("*"))
        if not any(part.startswith(".") for part in path.relative_to(photos).parts)
        and not any(path.is_relative_to(other) for other in others)
    ]
    taken = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    taken = taken or [path for path in files if path.suffix.lower() == ".exr"]  # else they are depth maps
    known = {path.with_suffix("") for path in taken}
    for path in files:
        if path.suffix.lower() in _UNREAD and path.with_suffix("") not in known:
            kind = path.suffix[1:].upper()
            left_out.append((path.relative_to(photos).as_posix(), f"{kind} is not read. Make JPEGs of them."))
    for path in taken:
        name = path.relative_to(photos).as_posix()
        try:
            sizes.add(image_size(path))
            name.encode()
        except UnicodeEncodeError:
            left_out.append((name, "its name is not UTF-8."))
        except LodgsError as error:
            left_out.append((name, error.what))
        else:
            names.append(name)
    return names, left_out, sizes


def _taken_over(photos: Path, name: str, images: Path) -> str:
    """Puts a photograph into the scene's folder; its name there."""
    if not name.lower().endswith(_WEBP):
        link_or_copy(photos / name, images / name)
        return name
    name_there = f"{name}.png"
    if not (images / name_there).exists():
        width, height = image_size(photos / name)
        codes = np.rint(255 * load_image(photos / name, width, height)).astype(np.uint8)
        with atomic_write(images / name_there) as temporary:
            write_png(temporary, codes)
    return name_there


def _begin(work: Path, settings: Mapping[str, object]) -> None:
    """What was found with other settings is of no use."""
    file, text = work / SETTINGS, json.dumps(settings)
    if file.is_file() and file.read_text(encoding="utf-8") != text:
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    with atomic_write(file) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _link_masks(masks: Path, photos: Path, names: Mapping[str, str], out: Path) -> Path:
    """A folder of masks of photographs as COLMAP names them, whose names there are by those that they had."""
    there = out / MASKS
    for given, name in names.items():
        found = SidecarFiles(masks, ".png").find(given)
        if found is not None:
            check_mask(found, *image_size(photos / given))
            link_or_copy(found, there / f"{name}.png")
    if not there.is_dir():
        first = next(iter(names))
        raise LodgsError(f"{masks} holds no mask of these photographs.", f"That of {first} is {first}.png.")
    return there


def _words(names: Sequence[str], found: Mapping) -> str:
    placed, count = set(found["placed"]), len(names)
    if len(placed) == count:
        return f"All {count} photographs found their place."
    inside, outside = _edge(names, found["pairs"], placed)
    return (
        f"{len(placed)} of {count} photographs found their place: too little overlap between "
        f"{inside} and {outside}. Take some between them, or do without the others."
    )


def _nothing(names: Sequence[str], found: Mapping, work: Path) -> tuple[str, str]:
    bare = [name for name in names if found["features"].get(name, 0) < 100]
    if len(bare) > len(names) / 2:
        return (
            f"{len(bare)} of {len(names)} photographs show hardly anything that could be recognised.",
            "Take sharp photographs of things with texture.",
        )
    return (
        f"None of the {len(names)} photographs found its place: no {FEWEST} of them overlap enough.",
        f"Take photographs a step apart that share two thirds. {work / 'pairs.png'} shows which share some.",
    )


def _edge(names: Sequence[str], pairs: Sequence[Sequence], placed: set[str]) -> tuple[str, str]:
    """Of what has a place and what has none the two that have the most in common, or that are neighbours."""
    across = [
        (count, one, other) if one in placed else (count, other, one)
        for one, other, count in pairs
        if (one in placed) != (other in placed)
    ]
    if across:
        _, inside, outside = max(across)
        return inside, outside
    one, other = next((a, b) for a, b in pairwise(names) if (a in placed) != (b in placed))
    return (one, other) if one in placed else (other, one)
