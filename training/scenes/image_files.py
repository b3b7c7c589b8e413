"""Which files a model's image names mean: found within the scene's folder, or not at all. numpy only."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from ..errors import LodgsError

_USUAL = ("images", "input", "image", "rgb", "photos")


class ImageFiles:
    """The files of an image folder, by the names that a model gives them.

    Args:
        folder: of the photographs, a link or not.
        scene: where links in that folder may lead besides.
    """

    def __init__(self, folder: Path, scene: Path) -> None:
        self._folder = folder
        self._within = [Path(os.path.realpath(place)) for place in (folder, scene)]
        self._normal: dict[str, Path] | None = None

    def find(self, name: str) -> Path | None:
        """The file of that name, or None; other Unicode forms (macOS) and backslashes (Windows) find it too.

        Raises:
            LodgsError: the name is no text or leads out of the folder, or the file is a link that leads out;
                ``what`` goes on after "it is left out:".
        """
        relative = relative_image_path(name)
        found = self._folder / name
        if not os.path.isfile(found):  # not Path.is_file, which raises for names too long
            if self._normal is None:
                files = (Path(where) / file for where, _, names in os.walk(self._folder) for file in names)
                self._normal = {_normal(file.relative_to(self._folder).as_posix()): file for file in files}
            found = self._normal.get(_normal(str(relative)))
        if found is not None:
            real = Path(os.path.realpath(found))
            if not any(real.is_relative_to(place) for place in self._within):
                raise LodgsError("it is a link that leads out of the scene's folder.")
        return found


class SidecarFiles:
    """What belongs to photographs, masks or depth maps, as COLMAP and nerfstudio name it.

    Args:
        folder: it need not be there.
        suffixes: of its files, the first one first.
    """

    def __init__(self, folder: Path, *suffixes: str) -> None:
        self.folder, self._suffixes = folder, suffixes
        self._there = folder.is_dir()

    def find(self, name: str) -> Path | None:
        """That of a photograph: of ``a/b.jpg`` ``a/b.jpg.png``, or ``a/b.png``; None where there is none."""
        if not self._there:
            return None
        for suffix in self._suffixes:
            for path in (self.folder / f"{name}{suffix}", (self.folder / name).with_suffix(suffix)):
                if path.is_file():
                    return path
        return None

    def misnamed(self, name: str) -> str:
        """A sentence of files that belong to no photograph, of which this is one; "" where there are none."""
        if not (self._there and any(path.is_file() for path in self.folder.rglob("*"))):
            return ""
        file = name + self._suffixes[0]
        return f"{self.folder} holds nothing for these photographs: of {name} it would be {file}."


def relative_image_path(name: str) -> PurePosixPath:
    """An image's name as a path in the folder of the images, on every system.

    Raises:
        LodgsError: the name is no text, or leads out of a folder.
    """
    path, there = PurePosixPath(name.replace("\\", "/")), PureWindowsPath(name)
    if path.is_absolute() or there.drive or there.root or ".." in path.parts:
        raise LodgsError("its name leads out of the image folder.")
    try:
        name.encode()
    except UnicodeEncodeError:
        raise LodgsError("its name is not UTF-8.") from None
    return path


def find_image_folder(folder: Path, model: Path, names: Sequence[str]) -> Path:
    """The folder where most of the model's names are files, looked for around the model in the scene."""
    roots = [folder, *(parent for parent in model.parents if folder in parent.parents)]
    if "sparse" in (folder.name, folder.parent.name):  # only the model was chosen: the scene is around it
        roots += folder.parents[: 1 if folder.name == "sparse" else 2]
    elif folder == model:
        roots.append(folder.parent)
    places = []
    for root in roots:
        places += [*(root / name for name in _USUAL), *sorted(root.glob("images*")), root]
    names = [name for name in names if _is_inside(name)]
    counts = [sum(os.path.isfile(place / name) for name in names) for place in places]
    return places[counts.index(max(counts))]


def _is_inside(name: str) -> bool:
    try:
        return bool(relative_image_path(name))
    except LodgsError:
        return False


def _normal(name: str) -> str:
    return unicodedata.normalize("NFC", name)
