"""Georeferences: from scenes to bundles, plain PLYs, placements and 3D Tiles."""

import json

import numpy as np
import pytest

from tests.training.splats.test_formats import random_splats
from training.editing.export import export_levels
from training.editing.placement import transform_bundle
from training.errors import LodgsError
from training.methods import create, resolve_parameters
from training.optimize.training_data import TrainingData
from training.scenes.colmap import read_scene
from training.splats.bundle import read_bundle, write_bundle
from training.splats.dialects import comments_from_meta
from training.splats.formats import open_as_ply
from training.splats.georeference import (
    ECEF,
    FILE,
    Georeference,
    local_tangent_plane,
    write_georeference,
)
from training.splats.levels import MAX_LEVELS, Bundle, Level
from training.splats.ply import write_ply
from training.splats.portable_levels import PortableLevels
from training.splats.similarity import Similarity
from training.splats.tiles import write_tiles

LATITUDE, LONGITUDE = 53 + 48 / 60 + 33.82 / 3600, 2 + 7 / 60 + 46.38 / 3600
GEOCENTRIC = 3771793.968, 140253.342, 5124304.349
"""Example of EPSG guidance note 7-2 in metres, at a height of 73 m."""


def test_local_tangent_plane_matches_the_published_example():
    georeference = local_tangent_plane(LATITUDE, LONGITUDE, 73.0)
    np.testing.assert_allclose(georeference.matrix[:3, 3], GEOCENTRIC, atol=1e-3)
    far = np.linalg.solve(local_tangent_plane(55.0, 5.0, 200.0).matrix, [*GEOCENTRIC, 1.0])
    np.testing.assert_allclose(far[:3], (-189013.869, -128642.040, -4220.171), atol=2e-3)


@pytest.mark.parametrize(
    "values",
    [[], {}, {"crs": 3}, {"crs": ""}, {"crs": "x" * 10_000}, {"crs": ECEF, "matrix": 4},
     {"crs": ECEF, "matrix": np.zeros((4, 4)).tolist()}, {"crs": ECEF, "matrix": [["a"] * 4] * 4},
     {"crs": ECEF, "matrix": np.full((4, 4), np.nan).tolist()},
     {"crs": ECEF, "matrix": np.diag([1.0, 1, 0, 1]).tolist()}],
)  # fmt: skip
def test_invalid_values_are_rejected(values):
    with pytest.raises(ValueError):
        Georeference.from_json(values)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scaled_files_are_readable(tmp_path, scale):
    levels = [Level(number, random_splats(9), {"s_min": 2.0 - number}) for number in (1, 2)]
    bundle = Bundle("flod", levels, "bands", meta={"georeference": {"crs": ECEF}})
    write_bundle(tmp_path / "a.ply", transform_bundle(bundle, Similarity(np.eye(3), scale, np.zeros(3))))
    place = read_bundle(tmp_path / "a.ply").georeference
    np.testing.assert_allclose(place.matrix, np.diag([1 / scale] * 3 + [1]))


def test_damaged_file_is_a_warning_of_the_scene(tiny_scene, tmp_path):
    assert read_scene(tiny_scene).georeference is None
    copy = tmp_path / "copy"
    copy.mkdir()
    for entry in tiny_scene.iterdir():
        (copy / entry.name).symlink_to(entry)
    (copy / FILE).write_text("{")
    scene = read_scene(copy)
    assert scene.georeference is None and any(
        "Ignored the place on Earth" in warning for warning in scene.warnings
    )
    (copy / FILE).unlink()
    (copy / "site.prj").write_text('PROJCS["WGS 84 / UTM zone 31N",\n  AUTHORITY["EPSG","32631"]]')
    georeference = read_scene(copy).georeference
    assert georeference.crs.startswith("PROJCS[") and np.array_equal(georeference.matrix, np.eye(4))
    write_georeference(copy, Georeference("EPSG:32631", np.diag([2.0, 2.0, 2.0, 1.0])))
    assert read_scene(copy).georeference.crs == "EPSG:32631"
    data = TrainingData(read_scene(copy), test_every=4)
    method = create("3dgs", data, resolve_parameters("3dgs", "draft", {"steps": 2}), 0, "cpu")
    assert Bundle("", [], meta=method.meta()).georeference.matrix[0, 0] == 2


def test_every_system_of_a_scene_fits_into_the_header(tiny_scene, tmp_path):
    """Costs of LODGE's levels, the most levels of a job and the longest system are in one header."""
    for entry in tiny_scene.iterdir():
        (tmp_path / entry.name).symlink_to(entry)
    (tmp_path / "site.prj").write_text(f'COMPD_CS["{"x" * 1521}"]')
    assert read_scene(tmp_path).georeference is None
    assert any("takes 1,537 bytes" in warning for warning in read_scene(tmp_path).warnings)
    (tmp_path / "site.prj").write_text(f'COMPD_CS["{"x" * 1520}"]')
    place = read_scene(tmp_path).georeference
    assert place is not None
    costs = [{"level": n, "distances": [12.34] * 9, "costs": [123.4] * 9, "before": 123.4} for n in range(4)]
    turned = Similarity.from_angles((10, 20, 30), 1.1, (1 / 3, 2 / 3, 3)).matrix
    meta = {"view": turned[:2, :3].tolist(), "up_rotation": turned[:3, :3].tolist(), "costs": costs}
    meta["georeference"] = place.after(turned).to_json()
    levels = [Level(n, random_splats(2), {"d_l": n / 7}) for n in range(1, MAX_LEVELS + 1)]
    write_bundle(tmp_path / "bundle.ply", Bundle("lodge", levels, "chunks", meta=meta))


@pytest.fixture
def bundle():
    georeference = local_tangent_plane(LATITUDE, LONGITUDE, 73.0)
    meta = {"origin": [100.0, -50.0, 10.0], "georeference": georeference.to_json()}
    return Bundle("", [Level(1, random_splats(30))], meta=meta)


def on_earth(bundle: Bundle) -> np.ndarray:
    means = bundle.levels[-1].splats.means.astype(np.float64)
    return means @ bundle.georeference.matrix[:3, :3].T + bundle.georeference.matrix[:3, 3]


def test_files_and_placements_keep_the_place(bundle, tmp_path):
    expected = on_earth(bundle)
    east_north_up = bundle.levels[0].splats.means + np.array(bundle.meta["origin"])
    distances = np.linalg.norm(expected - GEOCENTRIC, axis=1)
    assert distances == pytest.approx(np.linalg.norm(east_north_up, axis=1), abs=1e-3)
    write_bundle(tmp_path / "bundle.ply", bundle)
    np.testing.assert_array_equal(on_earth(read_bundle(tmp_path / "bundle.ply")), expected)
    rotated = transform_bundle(bundle, Similarity.from_angles((10, 20, 30), 0.5, (1, 2, 3)))
    assert not rotated.origin.any()
    np.testing.assert_allclose(on_earth(rotated), expected, atol=1e-4)


def test_tiles_are_placed_on_the_globe(bundle, tmp_path):
    write_tiles(tmp_path / "tiles", PortableLevels(bundle))
    root = json.loads((tmp_path / "tiles" / "tileset.json").read_text())["root"]
    matrix = np.array(root["transform"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(matrix @ [0, 0, 0, 1], bundle.georeference.matrix @ [0, 0, 0, 1], atol=1e-6)


def test_hostile_georeference_of_a_bundle_is_one_message(bundle, tmp_path):
    bundle.meta["georeference"] = {"crs": ECEF, "matrix": [[1e400] * 4] * 4}
    with pytest.raises((LodgsError, ValueError)):
        write_bundle(tmp_path / "bundle.ply", bundle)
        read_bundle(tmp_path / "bundle.ply")


def test_plain_ply_keeps_the_georeference(bundle, tmp_path):
    write_ply(tmp_path / "plain.ply", bundle.levels[0].splats, comments_from_meta(bundle.meta))
    np.testing.assert_array_equal(on_earth(read_bundle(tmp_path / "plain.ply")), on_earth(bundle))


def test_long_coordinate_system_leaves_files_readable(bundle, tmp_path):
    """The header of a bundle has room for 1.5 KB."""
    bundle.meta["georeference"]["crs"] = f'PROJCS["{"x" * 6000}"]'
    export_levels(tmp_path / "levels.glb", bundle)
    write_ply(tmp_path / "plain.ply", bundle.levels[0].splats, comments_from_meta(bundle.meta))
    for name in ("levels.glb", "plain.ply"):
        with open_as_ply(tmp_path / name) as copy:
            levels = read_bundle(copy)
        np.testing.assert_array_equal(levels.levels[0].splats.means, bundle.levels[0].splats.means)
        assert levels.georeference is None
        write_bundle(tmp_path / "bundle.ply", levels)


@pytest.mark.parametrize("suffix", [".glb", ".usdc"])
def test_level_formats_keep_the_georeference(bundle, tmp_path, suffix):
    path = tmp_path / f"levels{suffix}"
    export_levels(path, bundle)
    with open_as_ply(path) as copy:
        np.testing.assert_allclose(on_earth(read_bundle(copy)), on_earth(bundle), atol=1e-4)
