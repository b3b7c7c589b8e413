"""COLMAP models and the photographs that belong to them. numpy only, so that Blender can read scenes.

File formats: https://colmap.github.io/format.html. rigs and frames of newer COLMAP versions are not needed:
images.bin and images.txt hold each view's own pose there too.
"""

from __future__ import annotations

import os
import struct
import unicodedata
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from ..errors import LodgsError
from .cameras import Camera
from .images import image_size
from .orientation import up_rotation

_DAMAGED = "Copy the model again, or write it anew with COLMAP's model_converter."


@dataclass(frozen=True)
class _Lens:
    """A COLMAP camera model: its parameters are focal length(s), cx, cy, then those of the distortion."""

    name: str
    parameters: int
    focals: int
    perspective: bool = True  # a pinhole when the distortion is zero; fisheyes never are


# By COLMAP's model id (colmap/src/colmap/sensor/models.h).
_LENSES = dict(
    enumerate(
        [
            _Lens("SIMPLE_PINHOLE", 3, 1),
            _Lens("PINHOLE", 4, 2),
            _Lens("SIMPLE_RADIAL", 4, 1),
            _Lens("RADIAL", 5, 1),
            _Lens("OPENCV", 8, 2),
            _Lens("OPENCV_FISHEYE", 8, 2, perspective=False),
            _Lens("FULL_OPENCV", 12, 2),
            _Lens("FOV", 5, 2),
            _Lens("SIMPLE_RADIAL_FISHEYE", 4, 1, perspective=False),
            _Lens("RADIAL_FISHEYE", 5, 1, perspective=False),
            _Lens("THIN_PRISM_FISHEYE", 12, 2, perspective=False),
            _Lens("RAD_TAN_THIN_PRISM_FISHEYE", 16, 2, perspective=False),
            _Lens("SIMPLE_DIVISION", 4, 1),
            _Lens("DIVISION", 5, 2),
            _Lens("SIMPLE_FISHEYE", 3, 1, perspective=False),
            _Lens("FISHEYE", 4, 2, perspective=False),
            _Lens("EUCM", 6, 2),
            _Lens("EQUIRECTANGULAR", 2, 0, perspective=False),
        ]
    )
)
_LENS_BY_NAME = {lens.name: lens for lens in _LENSES.values()}


@dataclass(frozen=True)
class _Intrinsics:
    """One record of cameras.bin or cameras.txt."""

    lens: _Lens
    width: int
    height: int
    parameters: np.ndarray

    @property
    def distorted(self) -> bool:
        distortion = self.parameters[self.lens.focals + 2 :]
        if self.lens.name == "EUCM":  # alpha, beta: a pinhole at alpha = 0, whatever beta
            distortion = distortion[:1]
        return not self.lens.perspective or bool(np.any(np.abs(distortion) > 1e-8))  # as COLMAP has it

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy."""
        fx, fy = self.parameters[0], self.parameters[self.lens.focals - 1]
        cx, cy = self.parameters[self.lens.focals : self.lens.focals + 2]
        return float(fx), float(fy), float(cx), float(cy)


@dataclass(frozen=True)
class _Pose:
    """One record of images.bin or images.txt, without its 2D points."""

    name: str
    camera_id: int
    world_to_camera: np.ndarray


@dataclass(frozen=True)
class Scene:
    """A COLMAP model with its photographs, in COLMAP's world.

    Attributes:
        folder, model, images_folder: where it was read.
        cameras: the views whose photograph can be used, sorted by name; their size is the photograph's.
        points: (P, 3) float32, possibly none.
        point_colors: (P, 3) uint8.
        distorted: names of views whose lens distorts; their cameras are the pinhole part of the lens.
        warnings: one sentence for each thing that was left out or is odd.
    """

    folder: Path
    model: Path
    images_folder: Path
    cameras: list[Camera]
    points: np.ndarray
    point_colors: np.ndarray
    distorted: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def split(self, test_every: int, validation: bool = False) -> tuple[list[Camera], list[Camera]]:
        """Training and held-out cameras: of every `test_every` by name the first is held out; 0: none is.

        Args:
            validation: leave those out altogether, and hold out the one in the middle between two of them.
        """
        if test_every <= 0:
            return list(self.cameras), []
        middle = test_every // 2 if validation else 0
        train = [camera for i, camera in enumerate(self.cameras) if i % test_every not in (0, middle)]
        return train, self.cameras[middle::test_every]

    @property
    def center(self) -> np.ndarray:
        """The mean of the cameras' eyes, (3,) float64."""
        return np.array([camera.center for camera in self.cameras]).mean(axis=0)

    def up_rotation(self) -> np.ndarray:
        """Rotation from this world to a z-up world, (3, 3) float64, see ``orientation.up_rotation``."""
        return up_rotation(self.cameras)

    def extent(self) -> float:
        """1.1 x the largest distance of a camera from the cameras' mean, in COLMAP units (as 3DGS has it).

        Where all cameras stand in one place, that is nothing to measure by: then the median depth.
        """
        centers = np.array([camera.center for camera in self.cameras])
        radius = float(np.linalg.norm(centers - self.center, axis=1).max())
        return 1.1 * radius if radius > 0 else self.median_depth()

    def median_depth(self) -> float:
        """The median over the cameras of the median depth of the points that each sees, in COLMAP units.

        A camera sees what lies in front of it and within its image. At most 50,000 points, evenly taken from
        the model's order, are looked at.

        Raises:
            LodgsError: no camera sees a point.
        """
        points = self.points[:: max(1, len(self.points) // 50_000)].astype(np.float64)
        medians = []
        for camera in self.cameras:
            depths = camera.view_space(points)[camera.sees(points), 2]
            if len(depths):
                medians.append(np.median(depths))
        if not medians:
            raise LodgsError(f"No camera of {self.model} sees a point.", "Reconstruct the scene with points.")
        return float(np.median(medians))

    def near(self) -> float:
        """The depth from which on splats are drawn, in COLMAP units: a hundredth of the median depth.

        Raises:
            LodgsError: as :meth:`median_depth`.
        """
        return 0.01 * self.median_depth()


def find_models(folder: Path) -> list[Path]:
    """Folders at or below `folder` that hold a COLMAP model (cameras and images, .bin or .txt).

    The model with the most registered images comes first; among equals the one nearest to `folder`, then by
    name. Looks four levels deep, which covers `sparse/`, `sparse/0` and `dense/0/sparse`.

    Raises:
        LodgsError: there is no such folder.
    """
    folder = _absolute(folder)
    if not folder.is_dir():
        raise LodgsError(f"There is no folder {folder}.", "Choose the folder of a COLMAP scene.")
    found = []
    for path, subfolders, _ in os.walk(folder):
        here = Path(path)
        depth = len(here.relative_to(folder).parts)
        subfolders[:] = sorted(name for name in subfolders if not name.startswith(".") and depth < 4)
        if _suffix(here):
            found.append((-_registered(here), depth, here.parts, here))
    return [entry[-1] for entry in sorted(found)]


def read_scene(folder: Path, model: Path | None = None, images: Path | None = None) -> Scene:
    """Read a COLMAP scene: cameras, points, and which photographs are there.

    Args:
        folder: the scene, or a model folder within it.
        model: the folder of the model; by default the largest one found.
        images: the folder of the photographs; by default `images/`, or another folder in or beside the scene
            where the model's names are found.

    Raises:
        LodgsError: there is no folder, model or photograph, or a file of the model is damaged.
    """
    folder = _absolute(folder)
    warnings: list[str] = []
    model = _largest_model(folder, warnings) if model is None else _absolute(model)
    suffix = _suffix(model)
    if not suffix:
        raise LodgsError(
            f"{model} holds no cameras and images files.", "Choose the folder of a COLMAP model."
        )
    read_cameras, read_images, read_points = _READERS[suffix]
    intrinsics = _read(model / f"cameras{suffix}", read_cameras)
    poses = sorted(_read(model / f"images{suffix}", read_images), key=lambda pose: pose.name)
    if not poses:
        raise LodgsError(f"{model} has no registered images.", "Choose a model that COLMAP has registered.")
    points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if (model / f"points3D{suffix}").is_file():
        points, colors = _read(model / f"points3D{suffix}", read_points)
    else:
        warnings.append(f"{model} has no points3D{suffix}: the scene has no points.")
    with np.errstate(over="ignore"):
        points = points.astype(np.float32)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        warnings.append(f"{int((~finite).sum())} points of {model} have no finite position and are left out.")

    images_folder = _absolute(images) if images is not None else _images_folder(folder, model, poses)
    if not images_folder.is_dir():
        raise LodgsError(
            f"There is no image folder {images_folder}.", "Choose the folder of the photographs."
        )
    cameras, distorted = [], []
    files = _Files(images_folder)
    for pose in poses:
        lens = intrinsics.get(pose.camera_id)
        if lens is None:
            raise LodgsError(
                f"{model / f'cameras{suffix}'} lacks camera {pose.camera_id}, which {pose.name} uses.",
                _DAMAGED,
            )
        try:
            camera = _camera(pose, lens, files)
        except LodgsError as error:
            warnings.append(f"{pose.name} is left out: {error.what}")
            continue
        cameras.append(camera)
        if lens.distorted:
            distorted.append(camera.name)
        if _reshaped(camera, lens):
            warnings.append(
                f"{pose.name} is {camera.width}x{camera.height}, of other proportions than the model's "
                f"{lens.width}x{lens.height}: make sure that it is neither turned nor cropped."
            )
    if not cameras:
        raise LodgsError(
            f"None of the {len(poses)} views in {model} has a usable photograph in {images_folder}.",
            "Choose the folder that holds the images under the names that the model uses.",
        )
    return Scene(
        folder=folder,
        model=model,
        images_folder=images_folder,
        cameras=cameras,
        points=points[finite],
        point_colors=colors[finite],
        distorted=distorted,
        warnings=warnings,
    )


def _absolute(path: Path | str) -> Path:
    """Whole, so that it means the same in another process; links are kept as they are."""
    return Path(os.path.abspath(path))


def _largest_model(folder: Path, warnings: list[str]) -> Path:
    """The first of `find_models`; models that hold fewer views are warned of."""
    models = find_models(folder)
    if not models:
        raise LodgsError(
            f"{folder} holds no COLMAP model.",
            "Choose a folder with sparse/0/cameras.bin, images.bin and points3D.bin (or .txt).",
        )
    views = [_registered(model) for model in models]
    for model, count in zip(models, views, strict=True):
        if count < views[0]:
            warnings.append(f"{model} is a smaller model of {count} views, not read.")
    return models[0]


def _reshaped(camera: Camera, lens: _Intrinsics) -> bool:
    """Whether a photograph has other proportions than the model says, beyond rounding to whole pixels."""
    stretch = camera.width * lens.height / (camera.height * lens.width)
    return bool(abs(np.log(stretch)) > 0.01 + 1 / min(camera.width, camera.height))


def _camera(pose: _Pose, lens: _Intrinsics, files: _Files) -> Camera:
    """The view at the size of its photograph; LodgsError where there is none that serves."""
    if not lens.lens.focals:
        raise LodgsError(f"its camera model {lens.lens.name} is a panorama, not a perspective view.")
    image = files.find(pose.name)
    width, height = image_size(image)
    fx, fy, cx, cy = lens.pinhole
    name = pose.name.replace("\\", "/")
    camera = Camera(name, lens.width, lens.height, fx, fy, cx, cy, pose.world_to_camera, image)
    return camera if (width, height) == (lens.width, lens.height) else camera.resized(width, height)


class _Files:
    """The files of an image folder, by the names that a model gives them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._normal: dict[str, Path] | None = None

    def find(self, name: str) -> Path:
        """The file of that name; other Unicode forms (macOS) and backslashes (Windows) find it too."""
        path = PurePosixPath(name.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts:
            raise LodgsError("its name leads out of the image folder.")
        if os.path.isfile(self._folder / name):  # not Path.is_file, which raises for names too long
            return self._folder / name
        if self._normal is None:
            files = (Path(where) / file for where, _, names in os.walk(self._folder) for file in names)
            self._normal = {_normal(file.relative_to(self._folder).as_posix()): file for file in files}
        found = self._normal.get(_normal(str(path)))
        if found is None:
            raise LodgsError(f"there is no such file in {self._folder}.")
        return found


def _normal(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def _images_folder(folder: Path, model: Path, poses: list[_Pose]) -> Path:
    """The folder where most of the model's names are files, looked for around the model in the scene."""
    roots = [folder, *(parent for parent in model.parents if folder in parent.parents)]
    if folder == model or folder.name == "sparse":  # only the model was chosen: the scene is around it
        roots += folder.parents[:2]
    places = []
    for root in roots:
        usual = [root / name for name in ("images", "input", "image", "rgb", "photos")]
        places += [*usual, *sorted(root.glob("images*")), root]
    counts = [sum(os.path.isfile(place / pose.name) for pose in poses) for place in places]
    return places[int(np.argmax(counts))]


def _suffix(folder: Path) -> str:
    """The form in which the folder holds a model, .bin before .txt, or an empty string."""
    for suffix in (".bin", ".txt"):
        if (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file():
            return suffix
    return ""


def _registered(model: Path) -> int:
    """How many images a model says or has; 0 where that cannot be read."""
    suffix = _suffix(model)
    path = model / f"images{suffix}"
    try:
        if suffix == ".bin":
            with path.open("rb") as file:
                return struct.unpack("<Q", file.read(8))[0]
        return len(_read(path, _images_txt))
    except (OSError, struct.error, LodgsError):
        return 0


def _read(path: Path, parse):
    """Parse a file of a model, or say that it is damaged."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LodgsError(f"{path} cannot be read: {error.strerror}.", "Check the folder.") from error
    try:
        return parse(data)
    except (ValueError, IndexError, KeyError, struct.error) as error:
        raise LodgsError(f"{path} is damaged or cut short ({error}).", _DAMAGED) from error


def _cameras_bin(data: bytes) -> dict[int, _Intrinsics]:
    (count,), at, cameras = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, at)
        lens = _LENSES.get(model_id)
        if lens is None:
            raise ValueError(f"camera model {model_id} is unknown")
        parameters = np.frombuffer(data, "<f8", lens.parameters, at + 24)
        at += 24 + 8 * lens.parameters
        cameras[camera_id] = _intrinsics(lens, width, height, parameters)
    return cameras


def _cameras_txt(data: bytes) -> dict[int, _Intrinsics]:
    cameras = {}
    for line in _lines(data):
        camera_id, model_name, width, height, *parameters = line.split()
        lens = _LENS_BY_NAME.get(model_name)
        if lens is None:
            raise ValueError(f"camera model {model_name} is unknown")
        cameras[int(camera_id)] = _intrinsics(lens, int(width), int(height), np.array(parameters, float))
    _expect(len(cameras), data, "cameras")
    return cameras


def _intrinsics(lens: _Lens, width: int, height: int, parameters: np.ndarray) -> _Intrinsics:
    if len(parameters) != lens.parameters:
        raise ValueError(f"{lens.name} has {lens.parameters} parameters, not {len(parameters)}")
    if width < 1 or height < 1 or not np.isfinite(parameters).all() or (parameters[: lens.focals] <= 0).any():
        raise ValueError("a camera has no size or focal length")
    return _Intrinsics(lens, width, height, parameters)


def _images_bin(data: bytes) -> list[_Pose]:
    (count,), at, poses = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end]
        (points2d,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points2d
        if at > len(data):
            raise ValueError(f"it ends within image {len(poses) + 1} of {count}")
        poses.append(_pose(name, camera_id, pose))
    return poses


def _images_txt(data: bytes) -> list[_Pose]:
    """Two lines an image, the second (its 2D points, possibly none) passed over."""
    poses, lines = [], iter(data.split(b"\n"))
    for line in lines:
        line = line.strip()
        if not line or line.startswith(b"#"):
            continue
        # NAME is everything after the ninth field: it may hold spaces.
        _, *pose, camera_id, name = line.split(maxsplit=9)
        next(lines, None)
        poses.append(_pose(name, int(camera_id), [float(number) for number in pose]))
    _expect(len(poses), data, "images")
    return poses


def _pose(name: bytes, camera_id: int, pose: list[float]) -> _Pose:
    """Rotation from a unit quaternion (w, x, y, z) and translation, both world to camera."""
    quaternion, translation = np.array(pose[:4]), np.array(pose[4:])
    norm = np.linalg.norm(quaternion)
    text = name.decode("utf-8", "surrogateescape")  # as the file system's names are decoded
    if not (np.isfinite(pose).all() and norm > 0):
        raise ValueError(f"image {text} has no pose")
    w, x, y, z = quaternion / norm
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    world_to_camera[:3, 3] = translation
    return _Pose(text, camera_id, world_to_camera)


# A record of points3D.bin, packed; `track` pairs of 4-byte integers follow it.
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
_TRACK_AT = 43


def _points_bin(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    (count,) = struct.unpack_from("<Q", data)
    body = np.frombuffer(data, np.uint8, offset=8)
    starts = _point_starts(body)
    if len(starts) != count:
        raise ValueError(f"it should hold {count} points")
    if not count:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    records = np.lib.stride_tricks.sliding_window_view(body, _POINT.itemsize)[starts].view(_POINT)[:, 0]
    return records["xyz"], records["rgb"]


def _point_starts(body: np.ndarray) -> np.ndarray:
    """Where the records of points3D.bin begin.

    Each record tells its own length, so that a straight reading would take one step of Python a point.
    Instead: a track length is a small number in 8 bytes, so a record can only begin where the right five
    bytes are zero (tracks below 2^24 views). Of these places all are dropped, again and again, that no other
    place leads to; what the first record does not reach has no beginning and soon goes. What remains is
    exactly the chain from the first record on.
    """
    zero = body == 0
    run = zero[:-1] & zero[1:]
    run = run[:-2] & run[2:]
    run = run[:-1] & zero[4 : len(run) + 3]
    starts = np.flatnonzero(run[_TRACK_AT + 3 :])
    low, middle, high = (body[starts + _TRACK_AT + byte].astype(np.int64) for byte in range(3))
    lengths = low + (middle << 8) + (high << 16)
    ends = starts + _POINT.itemsize + 8 * lengths
    inside = ends <= len(body)
    starts, ends = starts[inside], ends[inside]
    while True:
        reached = np.zeros(len(body) + 1, bool)
        reached[0] = True
        reached[ends] = True
        kept = reached[starts]
        if kept.all():
            break
        starts, ends = starts[kept], ends[kept]
    if len(body) and (not len(ends) or ends[-1] != len(body)):
        raise ValueError(f"it ends within point {len(starts) + 1}")
    return starts


def _points_txt(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    lines = _lines(data)
    _expect(len(lines), data, "points")
    if not lines:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    table = np.loadtxt(lines, usecols=range(1, 7), ndmin=2)
    return table[:, :3], table[:, 3:].astype(np.uint8)


def _lines(data: bytes) -> list[str]:
    """Lines that are neither blank nor comments."""
    lines = (line.strip() for line in data.decode("utf-8", "surrogateescape").split("\n"))
    return [line for line in lines if line and not line.startswith("#")]


def _expect(count: int, data: bytes, what: str) -> None:
    """COLMAP writes the number of records as a comment: fewer of them means that the file was cut."""
    for line in data[:1000].split(b"\n"):
        before, _, after = line.partition(b":")
        if before.strip() == f"# Number of {what}".encode():
            expected = int(after.split(b",")[0])
            if count < expected:
                raise ValueError(f"it should hold {expected} {what} and holds {count}")


_READERS = {
    ".bin": (_cameras_bin, _images_bin, _points_bin),
    ".txt": (_cameras_txt, _images_txt, _points_txt),
}
