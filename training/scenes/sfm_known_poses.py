"""COLMAP's triangulation with known cameras as a program, see ``pycolmap_process``.

The cameras are fixed, so their epipolar geometry replaces COLMAP's random search for the geometry of a pair.
The result is therefore deterministic. Photos are requested from the parent process in small groups.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import pycolmap_process
from .fill_points import CellView, cell_colors, fill_cells
from .pycolmap_process import ask, send

if TYPE_CHECKING:
    import pycolmap

NEIGHBORS = *range(1, 11), 12, 16, 24, 32
"""Ranks of the photos matched with each photo. Higher ranks add wide baselines, as in videos."""
MAX_ANGLE = np.radians(60)
"""Maximum angle between the view directions of a pair."""
ANGLE_SCALE = np.radians(30)
"""Angle between view directions that counts as much as doubling the distance."""
DATABASE = "database.db"
"""File of the features and matches."""
GROUP = 8
"""Number of photos on disk at a time."""
MAX_RATIO = 0.8
"""Maximum ratio of the descriptor angles of the best and the second best match (Lowe 2004)."""
MAX_DESCRIPTOR_ANGLE = 0.7
"""Maximum angle between matching descriptors in radians, as in COLMAP."""
MAX_ERROR = 4.0
"""Maximum distance from the epipolar line, and reprojection error, in pixels of the reduced photos."""
MIN_MATCHES = 15
"""Minimum number of matches of a pair, as in COLMAP."""
_DESCRIPTOR_LENGTH = 512
"""Length of COLMAP's descriptors, which are stored as bytes."""
CACHED_PHOTOS = 64
"""Number of photos whose features are in memory."""


def _main() -> None:
    request = pycolmap_process.read_request()
    pycolmap_process.load_pycolmap().set_random_seed(0)
    work = Path(request["work"])
    deadline = time.monotonic() + request["seconds"]
    colors, cells, extracted = _extract(request, work, deadline - request["seconds"] / 2)
    matched = _match(work, deadline)
    reduced = _triangulate(work)
    deadline = time.monotonic() + request["seconds"] / 10  # also where features and matches took all time
    estimated = _estimate(reduced, cells, deadline) if reduced is not None else None
    result = _write(reduced, estimated, request, work, colors)
    send(result={**result, "features": len(colors), "in_time": extracted and matched})


def photo_name(number: int) -> str:
    """Return the file name of a photo by its number, from 1."""
    return f"{number:06}.png"


def photo_number(name: str) -> int:
    """Return the number of a photo, from 1."""
    return int(Path(name).stem)


def choose_pairs(centers: np.ndarray, directions: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs of views (lower index first) that probably overlap, the closest views of all photos first.

    Args:
        centers: (V, 3) camera positions.
        directions: (V, 3) unit view directions.
    """
    pairs: dict[tuple[int, int], int] = {}
    for view, (center, direction) in enumerate(zip(centers, directions, strict=True)):
        angle = np.arccos(np.clip(directions @ direction, -1, 1))
        cost = np.linalg.norm(centers - center, axis=1) * (1 + angle / ANGLE_SCALE)
        cost[(angle > MAX_ANGLE) | (np.arange(len(centers)) == view)] = np.inf
        order = np.argsort(cost, kind="stable")[: np.isfinite(cost).sum()]
        for rank in NEIGHBORS:
            if rank <= len(order):
                other = int(order[rank - 1])
                pair = min(view, other), max(view, other)
                pairs[pair] = min(rank, pairs.get(pair, rank))
    return sorted(pairs, key=lambda pair: (pairs[pair], pair))


def match_descriptors(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the mutual best matches (M, 2) of descriptors (N, 128) uint8 that pass the ratio test."""
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.int64)
    similarity = first.astype(np.float32) @ second.astype(np.float32).T  # exact: sums of integers below 2**24
    rows = np.arange(len(first))
    best = similarity.argmax(axis=1)
    nearest = similarity[rows, best]
    mutual = nearest == similarity.max(axis=0)[best]
    similarity[rows, best] = -1
    nearest_two = nearest, similarity.max(axis=1)
    angle, next_angle = (np.arccos(np.minimum(dot / _DESCRIPTOR_LENGTH**2, 1)) for dot in nearest_two)
    keep = mutual & (angle < MAX_RATIO * next_angle) & (angle < MAX_DESCRIPTOR_ANGLE)
    return np.stack([rows[keep], best[keep]], axis=1)


def epipolar_errors(first: np.ndarray, second: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Return Sampson's approximation (M,) of the distance to the epipolar geometry, in units of the rays.

    Args:
        first, second: (M, 2) rays of corresponding pixels, on the plane z = 1 of each camera.
        relative: (3, 4) transform from the first camera to the second one.
    """
    x, y, z = relative[:, 3] / np.linalg.norm(relative[:, 3]).clip(1e-30)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:, :3]
    first, second = (np.column_stack([rays, np.ones(len(rays))]) for rays in (first, second))
    lines, lines_back = first @ essential.T, second @ essential
    squares = (lines[:, :2] ** 2).sum(axis=1) + (lines_back[:, :2] ** 2).sum(axis=1)
    return np.abs((lines * second).sum(axis=1)) / np.sqrt(squares).clip(1e-30)


def _extract(
    request: dict, work: Path, deadline: float
) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray], bool]:
    """Extract the features of the photos.

    Returns:
        Colours (N, 3) uint8 of the features and colours of the cells by number of the photo, and False if
        time ran out.
    """
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    reader.mask_path = work / "masks"
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = request["features"]
    options.sift.first_octave = request["octave"]
    arguments = {"camera_mode": pycolmap.CameraMode.PER_IMAGE, "image_path": work / "photos"}
    pycolmap.Database.open(work / DATABASE).close()  # creates the file
    colors: dict[int, np.ndarray] = {}
    cells: dict[int, np.ndarray] = {}
    done, total = 0, len(request["scales"])
    for group in _groups(total):
        if time.monotonic() > deadline:
            return colors, cells, False
        send(stage="features", done=done, total=total)
        done += len(group)
        names = [photo_name(number) for number in ask(photos=group)["photos"]]
        if not names:
            continue
        # Images that are imported first have ids in this order, and not in the order in which threads finish.
        pycolmap.import_images(work / DATABASE, image_names=names, options=reader, **arguments)
        pycolmap.extract_features(
            work / DATABASE, image_names=names, reader_options=reader, extraction_options=options,
            device=pycolmap.Device.cpu, **arguments,
        )  # fmt: skip
        with pycolmap.Database.open(work / DATABASE) as database:
            for name in names:
                image = database.read_image_with_name(name)
                photo = pycolmap.Bitmap.read(work / "photos" / name, as_rgb=True)
                mask = pycolmap.Bitmap.read(work / "masks" / f"{name}.png", as_rgb=False)
                assert image is not None and photo is not None and mask is not None
                pixels = photo.to_array()
                cells[photo_number(name)] = cell_colors(pixels, mask.to_array() > 0)
                x, y = database.read_keypoints(image.image_id)[:, :2].astype(int).T
                height, width = pixels.shape[:2]
                colors[photo_number(name)] = pixels[y.clip(0, height - 1), x.clip(0, width - 1)]
                (work / "photos" / name).unlink()
                (work / "masks" / f"{name}.png").unlink()
    return colors, cells, True


def _groups(total: int) -> Iterator[list[int]]:
    """Yield groups of photo numbers. Each group is spread over the photos, in case that time runs out."""
    count = -(-total // GROUP)
    for first in range(1, count + 1):
        yield list(range(first, total + 1, count))


def _match(work: Path, deadline: float) -> bool:
    """Write the matches that agree with the known cameras; return False if time ran out."""
    import pycolmap

    model = pycolmap.Reconstruction(work / "poses")
    known_images = {image.name: image for image in model.images.values()}
    with pycolmap.Database.open(work / DATABASE) as database:
        images = database.read_all_images()
        for image in images:  # replace the cameras that feature extraction guessed
            camera = database.read_camera(image.camera_id)
            camera.model, camera.params = (
                known_images[image.name].camera.model,
                known_images[image.name].camera.params,
            )
            database.update_camera(camera)
        poses = np.array([known_images[image.name].cam_from_world().matrix() for image in images]).reshape(
            -1, 3, 4
        )

        @lru_cache(CACHED_PHOTOS)
        def features(view: int) -> tuple[np.ndarray, np.ndarray]:
            """Return the rays (N, 2) and descriptors (N, 128) of a view."""
            number = images[view].image_id
            pixels = database.read_keypoints(number)[:, :2].astype(np.float64)
            rays = known_images[images[view].name].camera.cam_from_img(pixels)
            return rays, database.read_descriptors(number).data

        centers = -np.einsum("vji,vj->vi", poses[:, :, :3], poses[:, :, 3])
        pairs = choose_pairs(centers, poses[:, 2, :3])
        for done, (first, second) in enumerate(pairs):
            if time.monotonic() > deadline:
                return False
            send(stage="pairs", done=done, total=len(pairs))
            (rays, descriptors), (other_rays, other_descriptors) = features(first), features(second)
            matches = match_descriptors(descriptors, other_descriptors)
            errors = epipolar_errors(
                rays[matches[:, 0]], other_rays[matches[:, 1]], relative_pose(poses[first], poses[second])
            )
            focal = min(
                known_images[images[view].name].camera.mean_focal_length() for view in (first, second)
            )
            matches = matches[errors * focal < MAX_ERROR]  # not rays outside of the lens, which are NaN
            if len(matches) >= MIN_MATCHES:
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = matches.astype(np.uint32)
                database.write_two_view_geometry(images[first].image_id, images[second].image_id, geometry)
    return True


def relative_pose(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the transform (3, 4) between two cameras of the given world-to-camera poses (3, 4)."""
    rotation = second[:, :3] @ first[:, :3].T
    return np.column_stack([rotation, second[:, 3] - rotation @ first[:, 3]])


def _triangulate(work: Path) -> pycolmap.Reconstruction | None:
    """Return the model with points of all matches and fixed cameras; None without matches."""
    import pycolmap

    send(stage="points", done=0, total=1)
    known_images = {image.name: image for image in pycolmap.Reconstruction(work / "poses").images.values()}
    model = pycolmap.Reconstruction()  # with the ids of the database
    with pycolmap.Database.open(work / DATABASE) as database:
        if not database.num_verified_image_pairs():
            return None
        for image in database.read_all_images():
            camera = database.read_camera(image.camera_id)
            model.add_camera_with_trivial_rig(camera)
            view = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(view, known_images[image.name].cam_from_world())
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1  # deterministic
    options.random_seed = 0
    options.extract_colors = False
    options.min_num_matches = MIN_MATCHES
    options.mapper.filter_max_reproj_error = MAX_ERROR
    (work / "triangulated").mkdir()
    return pycolmap.triangulate_points(
        model, work / DATABASE, work / "photos", work / "triangulated", options=options
    )


def _estimate(
    model: pycolmap.Reconstruction, cells: dict[int, np.ndarray], deadline: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) where photos have no triangulated ones, and their colours (N, 3) uint8."""
    indices = {point: index for index, point in enumerate(model.points3D)}
    positions = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    views = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        observed = [indices[point.point3D_id] for point in image.points2D if point.has_point3D()]
        pose, colors = image.cam_from_world().matrix(), cells[photo_number(image.name)]
        camera: Any = model.cameras[image.camera_id]
        views.append(CellView(camera, pose, colors, np.array(observed, int)))
    return fill_cells(
        views, positions, deadline, lambda done: send(stage="empty parts", done=done, total=len(views))
    )


def _write(
    reduced: pycolmap.Reconstruction | None,
    estimated: tuple[np.ndarray, np.ndarray] | None,
    request: dict,
    work: Path,
    colors: dict[int, np.ndarray],
) -> dict:
    """Write the points into the model of the photos at full size, and return their numbers.

    Points without observations are estimated.
    """
    import pycolmap

    model = pycolmap.Reconstruction(work / "full")
    if reduced is not None:
        numbers = {image.image_id: photo_number(image.name) for image in reduced.images.values()}
        for image in reduced.images.values():
            number = numbers[image.image_id]
            pixels = [point.xy * request["scales"][number - 1] for point in image.points2D]
            model.images[number].points2D = pycolmap.Point2DList(map(pycolmap.Point2D, pixels))
        for point in reduced.points3D.values():
            track, samples = pycolmap.Track(), []
            for element in point.track.elements:
                number = numbers[element.image_id]
                track.add_element(number, element.point2D_idx)
                samples.append(colors[number][element.point2D_idx])
            model.add_point3D(point.xyz, track, np.rint(np.mean(samples, axis=0)).astype(np.uint8))
        model.update_point_3d_errors()
    counts = {
        "points": model.num_points3D(),
        "photos": sum(image.num_points3D > 0 for image in model.images.values()),
        "error": model.compute_mean_reprojection_error() if model.num_points3D() else 0.0,
        "estimated": 0 if estimated is None else len(estimated[0]),
    }
    for position, color in zip(*(estimated or ((), ())), strict=True):
        model.add_point3D(position, pycolmap.Track(), color)
    if any(request["origin"]):  # an identity would change the last bits
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(request["origin"])))
    (work / "sparse").mkdir()
    model.write_binary(work / "sparse")
    for extra in ("rigs.bin", "frames.bin"):  # readers recreate trivial rigs
        (work / "sparse" / extra).unlink(missing_ok=True)
    return counts


if __name__ == "__main__":
    _main()
