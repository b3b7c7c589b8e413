"""Lookup of a model's image names as files inside the scene's folder. numpy only."""

from __future__ import annotations

import os
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from urllib.parse import unquote

from ..errors import LodgsError
from ..files import is_file, raise_system_problem
from .images import IMAGE_SUFFIXES

UNREADABLE_SUFFIXES = (
    ".heic", ".heif", ".avif", ".jxl", ".jp2", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2",
    ".pef", ".gif",
)  # fmt: skip
"""Suffixes of photos that LODGS does not read, lower case. Users convert them and keep the model's names."""
MASK_SUFFIXES = (".png", *(suffix for suffix in IMAGE_SUFFIXES if suffix != ".png"))
"""Suffixes of masks, preferred ones first."""
NO_PHOTOS = ".", "mask", "depth", "normal", "conf", "sparse"
"""First letters of folders without photos, lower case."""
MAX_FOLDERS = 20_000
"""Maximum number of folders searched for files."""
_COMMON_NAMES = ("images", "input", "image", "rgb", "photos")


class ImageFiles:
    """Files of an image folder by the names that a model uses.

    Args:
        folder: folder of the photos. It and its files may be links to other folders.
        names: names of all photos. One that is unique without its folder matches a photo in another folder.

    Attributes:
        renamed: names that only match a file with another folder, suffix or case, with that file.
    """

    def __init__(self, folder: Path, names: Iterable[str] = ()) -> None:
        self._folder = folder
        self._names = {_normalized(name.replace("\\", "/")) for name in names}
        self._base_names = Counter(map(_base_stem, self._names))
        self._by_normal_name: dict[str, Path] | None = None
        self._by_stem: dict[str, list[Path]] = {}
        self._by_base_stem: dict[str, list[Path]] = {}
        self.renamed: dict[str, Path] = {}

    def find(self, name: str) -> Path | None:
        """Return the file with this name, or None.

        Other Unicode forms (macOS), backslashes (Windows) and escapes of URLs match, too. So does another
        case, else another suffix, else another folder, if only one file has it; see ``renamed``.

        Raises:
            LodgsError: if the name is not UTF-8 or leaves the folder. ``what`` continues a sentence such as
                "Skipped <name>:".
        """
        relative = relative_image_path(name)
        exists = is_file(self._folder / name)
        if exists and relative.suffix.lower() not in UNREADABLE_SUFFIXES:
            return self._folder / name
        if self._by_normal_name is None:
            self._by_normal_name = self._index()
        if not exists:
            for spelling in (str(relative), str(relative_image_path(unquote(name)))):
                if (file := self._by_normal_name.get(_normalized(spelling))) is not None:
                    return file
        matches = [path for path in self._by_stem.get(_stem(str(relative)), []) if self._is_free(path)]
        if not matches and self._base_names[_base_stem(name)] == 1:
            matches = [path for path in self._by_base_stem.get(_base_stem(name), []) if self._is_free(path)]
        same_suffix = [path for path in matches if path.suffix.lower() == relative.suffix.lower()] or matches
        if len(same_suffix) == 1:
            self.renamed[name] = same_suffix[0]
            return same_suffix[0]
        return self._folder / name if exists else None

    def _is_free(self, path: Path) -> bool:
        """Return whether no name states a file."""
        return _normalized(path.relative_to(self._folder).as_posix()) not in self._names

    def _index(self) -> dict[str, Path]:
        """Return the files by normalised name, and collect the images by stem."""
        files = walk_files(self._folder, onerror=raise_system_problem)
        by_name = {_normalized(path.relative_to(self._folder).as_posix()): path for path in files}
        for name, path in by_name.items():
            if _is_image(path):
                self._by_stem.setdefault(_stem(name), []).append(path)
                if not any(part.lower().startswith(NO_PHOTOS) for part in name.split("/")):
                    self._by_base_stem.setdefault(_base_stem(name), []).append(path)
        return by_name


class SidecarFiles:
    """Masks or depth maps of photos, named as COLMAP, nerfstudio or Metashape does, in any case.

    Args:
        folder: folder of the files; it may not exist.
        kind: word that may follow the photo's name, such as "mask".
        suffixes: accepted suffixes, preferred ones first.
        beside: the folder is that of the photos, so that names need the word.
    """

    def __init__(self, folder: Path, kind: str, *suffixes: str, beside: bool = False) -> None:
        self.folder = folder
        self._beside = beside
        self._kinds = f"_{kind}", f".{kind}"
        self._suffixes = suffixes
        self._exists = folder.is_dir()
        self._by_folded_name: dict[str, Path] | None = None

    def find(self, name: str) -> Path | None:
        """Return the file of a photo, or None.

        Photo ``a/b.jpg`` has ``a/b.jpg.png`` or ``a/b.png``, else ``a/b_mask.png`` or ``a/b.jpg.mask.png``.
        """
        if not self._exists:
            return None
        for suffix in () if self._beside else self._suffixes:
            for path in (self.folder / f"{name}{suffix}", (self.folder / name).with_suffix(suffix)):
                if is_file(path):
                    return path
        if self._by_folded_name is None:
            files = walk_files(self.folder, onerror=raise_system_problem)
            self._by_folded_name = {_folded(path.relative_to(self.folder).as_posix()): path for path in files}
        stem = os.path.splitext(name)[0]
        kinds = self._kinds if self._beside else ("", *self._kinds)
        starts = [start + kind for kind in kinds for start in (name, stem)]
        names = [_folded(start + suffix) for start in starts for suffix in self._suffixes]
        return next((self._by_folded_name[key] for key in names if key in self._by_folded_name), None)

    def mismatch_warning(self, name: str) -> str:
        """Return a warning about files without a photo, or "" if the folder is empty.

        Args:
            name: a photo, whose file name serves as an example.
        """
        if self._beside or not (
            self._exists and any(not is_clutter(path.name) for path in walk_files(self.folder))
        ):
            return ""
        file = name + self._suffixes[0]
        return f"No file in {self.folder} matches a photo: the file of {name} must be named {file}."


def relative_image_path(name: str) -> PurePosixPath:
    """Return an image name as a path relative to the image folder, on every operating system.

    Raises:
        LodgsError: the name is not UTF-8 or leaves the folder.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    windows_path = PureWindowsPath(name)
    has_drive = windows_path.drive and os.name == "nt"  # elsewhere, file names may contain colons
    if path.is_absolute() or has_drive or windows_path.root or ".." in path.parts:
        raise LodgsError("its name points outside the image folder.")
    try:
        name.encode()
    except UnicodeEncodeError:
        raise LodgsError("its name is not UTF-8.") from None
    return path


def find_image_folder(folder: Path, model: Path, names: Sequence[str]) -> tuple[Path, int]:
    """Return the folder in or around the scene that contains the most image names of the model.

    Returns:
        The folder, and the number of names that it contains. Other suffixes (``a.png`` for ``a.jpg``) count
        if no folder has a name as it is.
    """
    roots = [folder, *(parent for parent in model.parents if folder in parent.parents)]
    if "sparse" in (folder.name, folder.parent.name):  # the user chose the model; the scene is its parent
        roots += folder.parents[: 1 if folder.name == "sparse" else 2]
    elif folder == model:
        roots.append(folder.parent)
    candidates = []
    for root in roots:
        candidates += [*(root / name for name in _COMMON_NAMES), *sorted(root.glob("images*")), root]
    names = [name for name in names if _is_inside(name)]
    counts = [sum(is_file(candidate / name) for name in names) for candidate in candidates]
    if not any(counts):
        counts = [len(_stems(names) & _stems(_file_names(candidate))) for candidate in candidates]
    return candidates[counts.index(max(counts))], max(counts)


def _file_names(folder: Path) -> list[str]:
    """Return the names of the images in a folder and its subfolders, relative to it."""
    return [path.relative_to(folder).as_posix() for path in walk_files(folder) if _is_image(path)]


def find_moved_images(folder: Path, names: Iterable[str]) -> Path | None:
    """Return the only folder below a scene that has most of the model's image names, or None.

    Names match with any suffix and case. If each folder has other ones of the names, their common parent is
    returned.

    Raises:
        LodgsError: several folders have the same number of names.
    """
    parts_by_stem: dict[str, list[tuple[str, ...]]] = {}
    for name in filter(_is_inside, names):
        *parents, stem = PurePosixPath(_stem(name)).parts
        parts_by_stem.setdefault(stem, []).append(tuple(parents))
    matches: dict[Path, set[str]] = {}
    for path in filter(_is_image, walk_files(folder, NO_PHOTOS)):
        parents = _normalized(path.parent.as_posix()).casefold().split("/")
        for parts in parts_by_stem.get(_stem(path.name), []):
            if not parts or tuple(parents[-len(parts) :]) == parts:
                matches.setdefault(path.parents[len(parts)], set()).add("/".join((*parts, _stem(path.name))))
    counts = {place: len(matched) for place, matched in matches.items()}
    total = len(set().union(*matches.values()))
    if len(matches) > 1 and sum(counts.values()) == total:
        return Path(os.path.commonpath(matches))
    best = [place for place, count in counts.items() if count == max(counts.values())]
    if len(best) > 1:
        raise LodgsError(
            f"Cannot choose the photos of {folder}: {best[0]} and {best[1]} have the same names.",
            "Choose the image folder, or rename it to images.",
        )
    return best[0] if best else None


def walk_files(
    folder: Path, skip: tuple[str, ...] = (), onerror: Callable[[OSError], None] | None = None
) -> Iterator[Path]:
    """Yield the files in a folder and its subfolders, also behind links, sorted by folder and name.

    Each folder is visited once, and at most MAX_FOLDERS are; links to parent folders are not followed.

    Args:
        skip: first letters of folders to skip, lower case.
        onerror: called with the error of a folder that cannot be read.
    """
    visited = {str(parent) for parent in Path(os.path.realpath(folder)).parents}
    limit = len(visited) + MAX_FOLDERS
    for parent, folders, names in os.walk(folder, onerror=onerror, followlinks=True):
        real = os.path.realpath(parent)
        if real in visited or len(visited) >= limit:
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(entry for entry in folders if not (skip and entry.lower().startswith(skip)))
        yield from (Path(parent, name) for name in sorted(names))


def is_clutter(name: str) -> bool:
    """Return True for names of files that macOS and Windows add to folders."""
    return name.startswith(".") or name.lower() in ("thumbs.db", "desktop.ini")


def _is_image(path: Path) -> bool:
    return path.name.lower().endswith((*IMAGE_SUFFIXES, ".exr"))


def _stems(names: Iterable[str]) -> set[str]:
    return {_stem(name) for name in names}


def _stem(name: str) -> str:
    """Return a name for comparison without its suffix and without regard to case."""
    return _folded(os.path.splitext(str(PurePosixPath(name.replace("\\", "/"))))[0])


def _base_stem(name: str) -> str:
    """Return a name for comparison without its folder and suffix and without regard to case."""
    return _stem(name).rpartition("/")[2]


def _folded(name: str) -> str:
    return _normalized(name).casefold()


def _is_inside(name: str) -> bool:
    try:
        return bool(relative_image_path(name))
    except LodgsError:
        return False


def _normalized(name: str) -> str:
    return unicodedata.normalize("NFC", name)
