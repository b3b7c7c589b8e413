"""A scene in UTM coordinates comes back from every format at its place."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from tests.training.splats.test_formats import random_splats
from tests.training.splats.test_gltf import read_parts
from training.editing.edit import Outputs, edit
from training.editing.export import FileOptions
from training.splats.bundle import read_bundle, write_bundle
from training.splats.formats import FORMATS, find_format, open_as_ply
from training.splats.level_folder import read_folder
from training.splats.levels import Bundle, Level
from training.splats.map_projection import UtmZone
from training.splats.spz import unpack_spz

ORIGIN = 450_000.0, 5_411_900.0, 120.0
EXTENT = 200.0
CRS = "EPSG:32631"


@pytest.fixture
def source(tmp_path):
    """Return a bundle of two levels in UTM coordinates, z up."""
    levels = []
    for number, count in ((1, 60), (2, 300)):
        splats = random_splats(count, 1, number)
        splats.means[:] = np.random.default_rng(number).uniform(-EXTENT, EXTENT, (count, 3))
        levels.append(Level(number, splats, {"s_min": 0.1 * (2 - number)}))
    meta = {
        "origin": list(ORIGIN), "up_rotation": np.eye(3).tolist(), "focal_px": 500.0,
        "georeference": {"crs": CRS, "matrix": np.eye(4).tolist()},
    }  # fmt: skip
    write_bundle(tmp_path / "in.ply", Bundle("flod", levels, "bands", meta=meta))
    return tmp_path / "in.ply"


def places(path: Path) -> tuple[np.ndarray, str | None]:
    """Return the finest positions (N, 3) of a file, and the system that it states.

    A file without georeference, or without even an origin, keeps positions relative to the local origin.
    """
    with open_as_ply(path) as plain:
        bundle = read_folder(plain) if plain.is_dir() else read_bundle(plain)
    means, place = bundle.levels[-1].splats.means.astype(np.float64), bundle.georeference
    if place is None:
        return means + ORIGIN, None
    return means @ place.matrix[:3, :3].T + place.matrix[:3, 3], place.crs


def globe_places(folder: Path) -> np.ndarray:
    """Return the geocentric positions (N, 3) of the finest tiles."""
    document = json.loads((folder / "tileset.json").read_text("utf-8"))
    transform = np.array(document["root"]["transform"]).reshape(4, 4).T
    positions = []
    for path in folder.glob("*_level2.glb"):
        description, data = read_parts(path)
        node = np.array(description["nodes"][0]["matrix"]).reshape(4, 4).T
        z_up = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
        means = unpack_spz(data, 1000)[0].means.astype(np.float64)
        positions.append((transform @ z_up @ node @ np.column_stack([means, np.ones(len(means))]).T).T[:, :3])
    return np.concatenate(positions)


# option of edit, name, the options that place it, whether the file states the system, precision in metres
EXPORTS = [
    ("out", "out.ply", {}, True, 1e-3),
    ("folder", "folder", {}, True, 1e-3),
    ("plain", "a.ply", {}, True, 1e-3),
    ("plain", "b.ply", {"original_place": True}, True, 1e-3),
    ("plain", "a.splat", {}, False, 1e-3),
    ("plain", "a.spz", {}, False, 1e-3),
    ("plain", "a.sog", {}, False, 0.03),
    ("plain", "a.compressed.ply", {}, True, 0.3),
    ("levels", "a.glb", {}, True, 1e-3),
    ("levels", "b.glb", {"original_place": True}, True, 1e-3),
    ("levels", "a.usdc", {}, True, 1e-3),
    ("levels", "b.usdz", {"original_place": True}, True, 1e-3),
    ("streamed", "web", {}, False, 0.03),
    ("tiles", "tiles", {}, True, 1e-3),
]


def test_declared_formats_are_those_that_state_the_system():
    stated = {kind.suffix for kind in FORMATS if kind.georeferenced}
    files = {find_format(Path(name)).suffix: states for _, name, _, states, _ in EXPORTS if "." in name}
    assert files == {kind.suffix: kind.suffix in stated for kind in FORMATS if kind.readable}


@pytest.mark.parametrize(("option", "name", "options", "stated", "precision"), EXPORTS)
def test_scene_keeps_its_place(source, tmp_path, option, name, options, stated, precision):
    if ".usd" in name:
        pytest.importorskip("pxr.UsdLod", reason="usd-core is not installed")
    path = tmp_path / name
    outputs = Outputs(**{option: [path] if option in ("plain", "levels") else path})
    edit(source, outputs, options=FileOptions(**options))
    expected = read_bundle(source).levels[-1].splats.means.astype(np.float64) + ORIGIN
    if option == "tiles":
        actual, expected = globe_places(path), UtmZone.from_crs(CRS).to_ecef(expected)
    else:
        actual, crs = places(path)
        assert crs == (CRS if stated else None)
    assert len(actual) == len(expected)
    distances, matches = KDTree(actual).query(expected)
    assert distances.max() < precision and len(set(matches)) == len(matches)
