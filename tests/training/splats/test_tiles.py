"""3D Tiles: nested boxes, geometric errors that select as the rule does, and every splat in one cell."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from tests.training.splats.level_files import UP, flod, read
from tests.training.splats.test_formats import random_splats
from tests.training.splats.test_gltf import read_parts
from training.editing.export import FileOptions, export_tiles
from training.errors import LodgsError
from training.splats import tiles
from training.splats.levels import Level
from training.splats.map_projection import UtmZone
from training.splats.spz import unpack_spz


@pytest.fixture
def bundle(monkeypatch):
    """Three levels with a far splat each, in cells of at most 100 splats."""
    monkeypatch.setattr(tiles, "MAX_TILE_SPLATS", 100)
    bundle = flod(0)
    for number, level in enumerate(bundle.levels, 1):
        level.splats = random_splats(100 * number, 0, number)
        level.splats.log_scales = level.splats.log_scales * 0 - 4
        level.splats.means[7] = (0, 0, 500)
    return bundle


def load(folder):
    return json.loads((folder / "tileset.json").read_text())


def walk(tile, parent=None):
    yield tile, parent
    for child in tile.get("children", []):
        yield from walk(child, tile)


def corners(tile):
    box = np.array(tile["boundingVolume"]["box"])
    half = np.abs(box[3:].reshape(3, 3)).sum(0)
    return box[:3] - half, box[:3] + half


def test_tileset_is_nested(tmp_path, bundle):
    export_tiles(tmp_path / "web", bundle)
    tileset = load(tmp_path / "web")
    assert tileset["asset"]["version"] == "1.1" and tileset["geometricError"] > 0
    uris = [tile["content"]["uri"] for tile, _ in walk(tileset["root"]) if "content" in tile]
    assert sorted([*uris, "tileset.json"]) == sorted(path.name for path in (tmp_path / "web").iterdir())
    for tile, parent in walk(tileset["root"]):
        assert tile["refine"] == "REPLACE"
        if parent is not None:
            assert tile["geometricError"] < parent["geometricError"]
            assert (corners(tile)[0] >= corners(parent)[0] - 1e-9).all()
            assert (corners(tile)[1] <= corners(parent)[1] + 1e-9).all()
        if not tile.get("children"):
            assert tile["geometricError"] == 0
    assert {path.name for path in tmp_path.iterdir()} == {"web"}


@pytest.mark.parametrize("antialias", [False, True])
def test_tiles_store_whether_splats_are_antialiased(tmp_path, bundle, antialias):
    """Splats whose filter is not baked keep it, as in other files."""
    bundle.meta["antialias"] = antialias
    export_tiles(tmp_path / "web", bundle, FileOptions(antialiased=True))
    for path in (tmp_path / "web").glob("*.glb"):
        assert unpack_spz(read_parts(path)[1], 1000)[1].get("antialias", False) == antialias


def test_each_splat_is_in_one_cell(tmp_path, bundle):
    export_tiles(tmp_path / "web", bundle)
    for level in bundle.levels:
        means = []
        for path in (tmp_path / "web").glob(f"*_level{level.number}.glb"):
            document, data = read_parts(path)
            means.append(unpack_spz(data, 1000)[0].means)
            attributes = document["meshes"][0]["primitives"][0]["attributes"]
            position = document["accessors"][attributes["POSITION"]]
            assert "bufferView" not in position and position["count"] == len(means[-1])
            assert level.number < 3 or len(means[-1]) <= 100
        means, expected = np.concatenate(means), level.splats.means
        assert len(means) == len(expected)
        distances, nearest = KDTree(means).query(expected)
        assert distances.max() < 1e-4 and len(set(nearest)) == len(means)


def test_far_splats_do_not_enlarge_other_cells(tmp_path, bundle):
    export_tiles(tmp_path / "web", bundle)
    cells = load(tmp_path / "web")["root"]["children"]
    sizes = sorted(float(np.max(corners(cell)[1] - corners(cell)[0])) for cell in cells)
    assert len(sizes) >= 4 and sizes[-2] < 20


def test_cesium_selects_the_level_of_the_rule(tmp_path, bundle):
    """Error on the screen, of Cesium's documentation: geometric error · focal length / distance."""
    export_tiles(tmp_path / "web", bundle)
    chain = load(tmp_path / "web")["root"]["children"][0]
    for distance, level in ((10, 3), (49, 3), (51, 2), (190, 2), (210, 1)):  # s_min · 500 px = 50 and 200
        tile = chain
        while tile["geometricError"] * 500 / distance > 16:
            (tile,) = tile["children"]
        assert tile["content"]["uri"].endswith(f"level{level}.glb"), distance


def test_contents_are_upright(tmp_path, bundle):
    """Viewers rotate the y axis of glTF to z."""
    export_tiles(tmp_path / "web", bundle)
    path = next((tmp_path / "web").glob("cell0_level3.glb"))
    reread = read(path).levels[-1].splats
    low, high = corners(load(tmp_path / "web")["root"])
    upright = reread.means @ np.array(UP).T
    assert (upright >= low).all() and (upright <= high).all()
    matrix = np.array(read_parts(path)[0]["nodes"][0]["matrix"]).reshape(4, 4).T[:3, :3]
    to_z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_allclose(to_z_up @ matrix, UP, atol=1e-12)


def test_earth_centred_scenes_are_placed_on_the_globe(tmp_path, bundle):
    origin = [4_201_000.0, 168_000.0, 4_780_000.0]
    bundle.meta["origin"] = origin
    export_tiles(tmp_path / "web", bundle)
    root = load(tmp_path / "web")["root"]
    transform = np.array(root["transform"]).reshape(4, 4).T
    np.testing.assert_array_equal(transform[:3, 3], origin)
    finest = bundle.levels[2].splats.means
    placed = corners(root)[0] + origin, corners(root)[1] + origin
    assert (finest + origin >= placed[0]).all() and (finest + origin <= placed[1]).all()
    bundle.meta["origin"] = [448_250.0, 5_411_900.0, 300.0]  # UTM coordinates are not geocentric
    export_tiles(tmp_path / "web", bundle)
    assert "transform" not in load(tmp_path / "web")["root"]
    bundle.meta["georeference"] = {"crs": "epsg:4978"}
    export_tiles(tmp_path / "web", bundle)
    assert "transform" in load(tmp_path / "web")["root"]


def test_splats_on_a_map_are_at_their_places_on_the_globe(tmp_path, bundle):
    """Positions far from the middle follow the Earth's curvature, here 0.9 m. A matrix turns the scene."""
    origin, turn = np.array([691_607.25, 5_334_783.5, 519.8]), np.eye(4)
    turn[:3, :3] = 2 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    bundle.meta |= {
        "origin": (np.linalg.inv(turn[:3, :3]) @ origin).tolist(),
        "georeference": {"crs": "EPSG:32632", "matrix": turn.tolist()},
    }
    for level in bundle.levels:
        level.splats.means[5] = (1200, -1200, 3)
    export_tiles(tmp_path / "web", bundle)
    transform = np.array(load(tmp_path / "web")["root"]["transform"]).reshape(4, 4).T
    places, expected = [], bundle.levels[2].splats.means.astype(np.float64)
    for path in (tmp_path / "web").glob("*_level3.glb"):
        means = unpack_spz(read_parts(path)[1], 1000)[0].means.astype(np.float64)
        places.append(means @ transform[:3, :3].T + transform[:3, 3])
    expected = UtmZone(32).to_ecef(expected @ turn[:3, :3].T + origin)
    distances, nearest = KDTree(np.concatenate(places)).query(expected)
    assert distances.max() < 1e-3 and len(set(nearest)) == len(expected)
    flat = np.linalg.norm(expected[5] - expected[0]) ** 2 / (2 * 6.378e6)
    assert 0.8 < flat < 1.0


@pytest.mark.parametrize("place", [(1e30, 0, 0), (3e8, 0, 0), (5e5, 1e9, 0), (5e5, 5e6, -6.4e6)])
def test_places_outside_of_the_map_are_refused(tmp_path, bundle, place):
    matrix = np.eye(4)
    matrix[:3, 3] = place
    bundle.meta["georeference"] = {"crs": "EPSG:32632", "matrix": matrix.tolist()}
    with pytest.raises(LodgsError, match=r"lies outside of the map EPSG:32632\. Correct"):
        export_tiles(tmp_path / "tiles", bundle)
    assert not (tmp_path / "tiles").exists()


def test_sky_beyond_the_horizon_stays_in_its_direction(tmp_path, bundle):
    matrix = np.eye(4)
    matrix[:3, 3] = (448_250.0, 5_411_900.0, 300.0)
    bundle.meta["georeference"] = {"crs": "EPSG:32632", "matrix": matrix.tolist()}
    far = np.array([[0, 0, 3e7], [2e9, 0, 0], [0, -1e11, 0]], np.float32)
    _, bend = tiles._earth_transform(bundle, np.zeros(3))
    np.testing.assert_array_equal(bend(far), far)
    bundle.levels[-1].splats.means[-3:] = far
    export_tiles(tmp_path / "tiles", bundle)  # bounds are finite


def test_other_files_are_not_replaced(tmp_path, bundle):
    (tmp_path / "mine.txt").write_text("")
    with pytest.raises(LodgsError, match="contains other files"):
        export_tiles(tmp_path, bundle)
    export_tiles(tmp_path / "web", bundle)
    export_tiles(tmp_path / "web", bundle)
    (tmp_path / "web" / "index.html").write_text("mine")
    with pytest.raises(LodgsError, match="contains other files"):
        export_tiles(tmp_path / "web", bundle)


def test_one_level_is_one_tile_per_cell(tmp_path, bundle):
    single = replace(bundle, levels=[Level(1, random_splats(50, 0))], rule="")
    export_tiles(tmp_path / "web", single)
    tileset = load(tmp_path / "web")
    assert all(tile["geometricError"] == 0 for tile, parent in walk(tileset["root"]) if parent)
