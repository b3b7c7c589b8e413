"""What a resident bundle draws is what selection and rasterizer give, whatever was left out on the way."""

import numpy as np
import pytest
import torch

from training.lod.blocks import SIZE
from training.lod.rules.chunks import member_columns
from training.lod.selection import complete, select, settings
from training.rasterize import Gaussians, rasterize
from training.rasterize.resident import Resident
from training.scenes.cameras import Camera, look_at
from training.splats.bundle import Bundle, Level
from training.splats.gaussians import Splats

NEAR = 0.1
EYES = [(0, 0, 0), (1.0, 0.4, 0), (1.9, 0, 0.2), (4.2, 1, 0), (0, 2.2, 0), (30, 0, 0)]
CENTRES = np.float32([[0, 0, 0], [2, 0, 0], [4, 0, 0]])


def level(number: int, count: int, facts: dict, **columns) -> Level:
    rng = np.random.default_rng(number)
    means = (rng.uniform(-12, 12, (count, 3)) * (1, 1, 0.2)).astype(np.float32)
    return Level(
        number,
        Splats(
            means, rng.normal(size=(count, 4)).astype(np.float32),
            rng.normal(-2.5, 0.5, (count, 3)).astype(np.float32), rng.normal(0, 2, count).astype(np.float32),
            rng.normal(0, 0.5, (count, 4, 3)).astype(np.float32), columns,
        ),
        facts,
    )  # fmt: skip


def bundle(rule: str) -> Bundle:
    rng, counts = np.random.default_rng(9), {1: 2 * SIZE, 2: 4 * SIZE + 100, 3: 9 * SIZE + 1}
    match rule:
        case "bands":
            facts = {1: {"s_min": 0.05}, 2: {"s_min": 0.02}, 3: {"s_min": 0.0}}
            return Bundle("flod", [level(n, counts[n], facts[n]) for n in counts], rule)
        case "octree":
            bias = {n: rng.normal(0, 0.5, counts[n]).astype(np.float32) for n in counts}
            levels = [level(n, counts[n], {}, lod_bias=bias[n]) for n in counts]
            return Bundle("octree", levels, rule, {"d_max": 9.0, "d_max_focal": 60.0}, cumulative=True)
        case "decay":
            sigma = np.abs(rng.normal(0.5, 0.2, counts[3])).astype(np.float32)
            only = level(1, counts[3], {}, sigma_d=sigma)
            return Bundle("clod", [only], rule, {"reference": 0.0, "tau": 0.01})
    d_l = {1: 9.0, 2: 4.0, 3: 0.0}
    levels = [
        level(n, counts[n], {"d_l": d_l[n]}, **member_columns(rng.random((3, counts[n])) < 0.3))
        for n in counts
    ]
    table = dict(zip("xyz", CENTRES.T, strict=True)) | {"radius": np.float32([2, 2, 2])}
    return Bundle("lodge", levels, "chunks", tables={"chunks": table})


def views():
    for eye in EYES:
        for target in ((6, 2, 0), (-6, 1, 0.5)):
            yield Camera(
                "", 64, 48, 60.0, 62.0, 30.0, 25.0,
                look_at(np.array(eye, float), np.array(target, float), (0, 0, 1)),
            )  # fmt: skip


@pytest.mark.parametrize(
    ("rule", "given"),
    [
        ("bands", {}), ("bands", {"gamma": 2.0, "last": 2}), ("octree", {}), ("octree", {"fade": 0}),
        ("decay", {}), ("decay", {"at_most": 900}), ("chunks", {}), ("chunks", {"fade": 0}),
        ("chunks", {"chunks": 0, "distance_scale": 0.6}),
    ],
)  # fmt: skip
def test_pictures_are_those_of_what_is_selected(rule, given):
    shown, most = bundle(rule), 0
    values, resident = settings(shown, given), Resident(shown, "cpu")
    for camera in views():
        ours = resident.draw(camera, values, near=NEAR)
        splats, weights = select(shown, camera.center, camera.focal, values)
        weights = None if weights is None else torch.from_numpy(weights)
        theirs = rasterize(Gaussians.of(splats), camera, weights=weights, near=NEAR, backend="cpu")
        # of equally deep splats another may come first
        torch.testing.assert_close(ours.image, theirs.image, atol=2e-5, rtol=1e-5)
        assert int((ours.radii > 0).sum()) == int((theirs.radii > 0).sum())
        most = max(most, int((ours.radii > 0).sum()))
    assert most > 100


@pytest.mark.parametrize("rule", ["bands", "octree"])
def test_a_level_is_drawn_with_all_that_belongs_to_it(rule):
    shown, camera = bundle(rule), next(views())
    resident = Resident(shown, "cpu")
    for number in (1, 3):
        one = next(level for level in shown.levels if level.number == number)
        whole = rasterize(Gaussians.of(complete(shown, one)), camera, near=NEAR, backend="cpu").image
        torch.testing.assert_close(resident.draw_level(number, camera, near=NEAR).image, whole)


def test_only_what_a_region_can_show_is_loaded():
    shown = bundle("chunks")
    resident, values = Resident(shown, "cpu"), settings(shown, {})
    total = sum(len(level.splats) for level in shown.levels)
    assert resident.loaded == total
    loaded = {}
    for eye in ((0.0, 0, 0), (0.6, 0, 0), (30.0, 0, 0), (0.0, 0, 0)):
        camera = Camera(
            "", 64, 48, 60.0, 60.0, 32.0, 24.0, look_at(np.array(eye), np.array([9.0, 0, 0]), (0, 0, 1))
        )
        resident.draw(camera, values, near=NEAR)
        loaded[eye] = resident.loaded
    in_first, in_second = (
        np.concatenate([x.splats.extras["chunks_0"].astype(int) >> bit & 1 for x in shown.levels]) > 0
        for bit in (0, 1)
    )
    assert loaded == {
        (0.0, 0, 0): in_first.sum(),
        (0.6, 0, 0): (in_first | in_second).sum(),
        (30.0, 0, 0): total,
    }
