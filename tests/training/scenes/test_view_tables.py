"""Views as bundle tables: lossless storage, transforms, damaged tables."""

from dataclasses import replace

import numpy as np
import pytest

from training.editing.cleaning import Cleaning, clean_bundle
from training.editing.placement import transform_bundle
from training.errors import LodgsError
from training.lod.crop import Crop
from training.scenes.cameras import Camera, look_at
from training.scenes.view_tables import NAMES, VIEWS, make_view_tables, read_view_tables
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level
from training.splats.similarity import Similarity

POSE = [f"w2c_{row}{column}" for row in range(3) for column in range(4)]


def cameras(count=3):
    rng = np.random.default_rng(0)
    return [
        Camera(
            f"a/{number} é.jpg", 640, 480 + number, 500.5, 501.25, 320.5, 240.25,
            look_at(rng.normal(size=3) * 4, rng.normal(size=3), (0, -1, 0.1)),
        )
        for number in range(count)
    ]  # fmt: skip


def bundle_of(views, count=50):
    rng = np.random.default_rng(1)
    splats = Splats(
        rng.normal(size=(count, 3)).astype(np.float32), rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(size=(count, 3)).astype(np.float32) - 3, rng.normal(size=count).astype(np.float32),
        rng.normal(size=(count, 16, 3)).astype(np.float32),
    )  # fmt: skip
    levels = [Level(number, splats.select(slice(0, 10 * number))) for number in range(1, 6)]
    return Bundle("3dgs", levels, tables=make_view_tables(views, 0.25, {views[1].name}))


def check(bundle, views, near=0.25):
    cameras, depth, held_out = read_view_tables(bundle.tables)
    assert depth == near and held_out == {views[1].name}
    for camera, view in zip(cameras, views, strict=True):
        assert replace(camera, world_to_camera=None) == replace(view, world_to_camera=None)
        assert np.array_equal(camera.world_to_camera, view.world_to_camera)


@pytest.mark.parametrize("count", [3, 400])
def test_views_are_stored_bit_by_bit_with_a_small_header(tmp_path, count):
    views = cameras(count)
    write_bundle(tmp_path / "b.ply", bundle_of(views))
    check(read_bundle(tmp_path / "b.ply"), views)
    assert (tmp_path / "b.ply").read_bytes().index(b"end_header\n") < 10 * 1024
    write_folder(tmp_path / "f", bundle_of(views))
    check(read_folder(tmp_path / "f"), views)


def test_views_of_transformed_scene_keep_their_images():
    views, rng = cameras(), np.random.default_rng(2)
    placement = Similarity.from_angles((20, 40, 60), 2.5, (1, -2, 3))
    moved, near, _ = read_view_tables(transform_bundle(bundle_of(views), placement).tables)
    assert near == 0.625
    points = rng.normal(size=(20, 3))
    for original, transformed in zip(views, moved, strict=True):
        pixels, depths = original.project(points)
        assert np.allclose(transformed.project(placement.transform_points(points))[0], pixels, atol=1e-8)
        assert np.allclose(transformed.project(placement.transform_points(points))[1], 2.5 * depths)


def test_cleaning_keeps_views_for_unknown_rules():
    bundle = replace(bundle_of(cameras()), rule="of a newer version")
    cleaned = clean_bundle(bundle, Cleaning((Crop.sphere((0, 0, 0), 1.0, False),)))
    check(cleaned, cameras())


@pytest.mark.parametrize("name", ["names", "missing column", "pose"])
def test_damaged_tables_are_rejected(name):
    tables = make_view_tables(cameras(), 0.1)
    if name == "names":
        tables[NAMES] = {"utf8": tables[NAMES]["utf8"][:5]}
    elif name == "missing column":
        del tables[VIEWS][POSE[3]]
    else:
        tables[VIEWS][POSE[0]] = np.full(3, np.nan)
    with pytest.raises(LodgsError):
        read_view_tables(tables)


def test_bundle_without_tables_has_no_views():
    assert read_view_tables({}) == ([], 0.0, set())
    assert make_view_tables([], 0.0) == {}
