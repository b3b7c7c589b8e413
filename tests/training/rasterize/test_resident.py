"""What a resident bundle draws is what selection and rasterizer give, whatever was left out on the way."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.editing.look import Look
from training.errors import LodgsError
from training.lod import on_disk
from training.lod.blocks import SIZE, spatial_order
from training.lod.partial_read import BLOCKS, block_table
from training.lod.query import LodQuery, SplatSelector
from training.lod.rule import HIDDEN, rules
from training.lod.rules.chunks import member_columns
from training.lod.selection import complete_splats, resolve_controls, select
from training.methods.tree.build import build
from training.rasterize import Gaussians, rasterize
from training.rasterize.resident import SORT_THRESHOLD, ResidentBundle, SplatSet
from training.scenes.cameras import Camera, look_at
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

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
    rng, counts = np.random.default_rng(9), {1: 2 * SIZE, 2: 17 * SIZE + 100, 3: 29 * SIZE + 1}
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
        case "cut":
            nodes, tree = build(level(2, counts[3], {}).splats)
            return Bundle("tree", tree.levels(nodes), rule)
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
        ("decay", {}), ("decay", {"at_most": 2900}), ("chunks", {}), ("chunks", {"fade": 0}),
        ("chunks", {"chunks": 0, "distance_scale": 0.6}), ("cut", {}), ("cut", {"pixels": 1.8}),
    ],
)  # fmt: skip
def test_pictures_are_those_of_what_is_selected(rule, given):
    shown, most = bundle(rule), 0
    values, resident = resolve_controls(shown, given), ResidentBundle(shown, "cpu")
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
    resident = ResidentBundle(shown, "cpu")
    for number in (1, 3):
        one = next(level for level in shown.levels if level.number == number)
        whole = rasterize(Gaussians.of(complete_splats(shown, one)), camera, near=NEAR, backend="cpu").image
        torch.testing.assert_close(resident.draw_level(number, camera, near=NEAR).image, whole)


@pytest.mark.parametrize("rule", ["bands", "octree", "cut"])
def test_of_a_large_file_a_camera_has_read_what_it_may_see(tmp_path, monkeypatch, rule):
    monkeypatch.setattr(on_disk, "_GAP", 1)
    monkeypatch.setattr(on_disk, "_AT_ONCE", 2 * SIZE)
    shown = bundle(rule)
    for each in shown.levels:  # a tree's are in an order already
        if rule != "cut":
            each.splats = each.splats.select(spatial_order(each.splats.means))
    shown.levels[-1].splats.means[700] = np.nan  # which is left out
    write_bundle(tmp_path / "bundle.ply", shown)
    shown = read_bundle(tmp_path / "bundle.ply")
    told, values, total = [], resolve_controls(shown, {}), sum(len(each.splats) for each in shown.levels)
    whole, part = (
        ResidentBundle(shown, "cpu"),
        ResidentBundle(tmp_path / "bundle.ply", "cpu", told.append, most=1000),
    )
    finest, loaded, read = shown.levels[-1].number, [], []
    for camera in views():
        for draw in (lambda one, c=camera: one.draw(c, values, near=NEAR),
                     lambda one, c=camera: one.draw_level(finest, c, near=NEAR)):  # fmt: skip
            ours, theirs = draw(part), draw(whole)
            torch.testing.assert_close(ours.image, theirs.image, atol=2e-5, rtol=1e-5)
            assert int((ours.radii > 0).sum()) == int((theirs.radii > 0).sum())
            loaded.append(part.loaded)
            read.append(part.bytes_read)
    assert min(loaded) < 0.9 * total and len(told) == 1 and "left out" in told[0]
    part.draw_level(finest, camera, near=NEAR)
    assert part.bytes_read == read[-1] > read[0] > 0  # what is there does


def indexed(path) -> Bundle:
    """A bundle of chunks, each with what is near it, in a file with a table of its blocks."""
    shown, levels = bundle("chunks"), []
    for each in shown.levels:
        splats = each.splats.select(spatial_order(each.splats.means))
        near = np.linalg.norm(splats.means - CENTRES[:, None], axis=2) < 7
        levels.append(replace(each, splats=replace(splats, extras=member_columns(near))))
    table = block_table(rules()["chunks"], {x.number: x.splats for x in levels})
    shown = replace(shown, levels=levels, tables={**shown.tables, BLOCKS: table})
    write_bundle(path, shown)
    return shown


def members(shown: Bundle, *chunks: int) -> int:
    bits = sum(1 << chunk for chunk in chunks)
    return sum(int((x.splats.extras["chunks_0"].astype(int) & bits > 0).sum()) for x in shown.levels)


def test_of_a_file_only_what_a_region_can_show_is_loaded_and_pictures_are_the_same_bits(tmp_path):
    shown = indexed(tmp_path / "bundle.ply")
    whole, part = ResidentBundle(shown, "cpu"), ResidentBundle(tmp_path / "bundle.ply", "cpu")
    values, total = resolve_controls(shown, {}), sum(len(level.splats) for level in shown.levels)
    assert part.loaded == part.bytes_read == 0
    loaded, read = [], []
    for eye in ((0.0, 0, 0), (0.1, 0, 0), (0.6, 0, 0), (30.0, 0, 0), (0.0, 0, 0)):
        for target in ((9.0, 0, 0), (-9.0, 3, 1)):
            pose = look_at(np.array(eye), np.array(target), (0, 0, 1))
            camera = Camera("", 64, 48, 60.0, 60.0, 32.0, 24.0, pose)
            ours, theirs = (each.draw(camera, values, near=NEAR) for each in (part, whole))
            assert torch.equal(ours.image, theirs.image) and torch.equal(ours.alpha, theirs.alpha)
            assert int((ours.radii > 0).sum()) == int((theirs.radii > 0).sum()) > 0
        loaded.append(part.loaded)
        read.append(part.bytes_read)
    assert loaded == [members(shown, 0), *[members(shown, 0, 1)] * 2, total, members(shown, 0)]
    assert whole.loaded == total and whole.bytes_read == 0
    steps = np.diff([0, *read])
    assert steps[0] == steps[4] < steps[1] < steps[3] and steps[2] == 0  # of (0, 1) nothing again


def test_of_a_file_a_level_is_read_alone(tmp_path):
    shown, camera = indexed(tmp_path / "bundle.ply"), next(views())
    part = ResidentBundle(tmp_path / "bundle.ply", "cpu")
    for level in shown.levels:
        picture = part.draw_level(level.number, camera, near=NEAR).image
        assert torch.equal(
            picture, ResidentBundle(shown, "cpu").draw_level(level.number, camera, near=NEAR).image
        )
        assert part.loaded == len(level.splats)
    with pytest.raises(LodgsError, match="Cannot draw level 7"):
        part.draw_level(7, camera)


def test_what_is_drawn_now_and_then_at_a_level_is_what_was(tmp_path):
    """Sets are joined anew where others are drawn together."""
    shown = bundle("octree")
    resident, values, camera = ResidentBundle(shown, "cpu"), resolve_controls(shown, {}), next(views())
    first = resident.draw(camera, values, near=NEAR).image
    resident.draw_level(2, camera, near=NEAR)
    assert torch.equal(resident.draw(camera, values, near=NEAR).image, first)


@pytest.mark.parametrize("rule", ["bands", "octree", "decay", "chunks"])
def test_nothing_with_a_weight_is_passed_over(rule):
    """Whatever is chosen for a camera, is all that has a weight among what it sees."""
    shown = bundle(rule)
    resident, values, passed = ResidentBundle(shown, "cpu"), resolve_controls(shown, {}), 0
    for camera in views():
        for level in shown.levels:
            splats, choice = resident.select_by_rule(camera, values)[level.number]
            ordered = level.splats
            if len(ordered) >= SORT_THRESHOLD:
                ordered = ordered.select(spatial_order(ordered.means))
            opacity, own = 1 / (1 + np.exp(-ordered.opacity_logits)), splats.gaussians
            weights = choice.weights(ordered.means, ordered.extras | {"opacity": opacity})
            everywhere, found = splats.select_visible(choice)
            np.testing.assert_array_equal(everywhere, np.flatnonzero(weights > 0))
            np.testing.assert_array_equal(found, weights[everywhere])
            some, found = splats.select_visible(choice, camera, NEAR)
            np.testing.assert_array_equal(found, weights[some])
            left_out = torch.from_numpy(np.setdiff1d(everywhere, some)).long()
            alone = rasterize(own.select(left_out), camera, near=NEAR, backend="cpu")
            assert not (alone.radii > 0).any()
            passed += len(left_out)
    assert passed


def test_within_a_band_nothing_is_asked_and_the_same_is_chosen(monkeypatch):
    """Of blocks that a band holds whole; what is hidden or cropped is looked at all the same."""
    shown, asked = bundle("bands"), []
    one = shown.levels[1].splats
    one = one.select(spatial_order(one.means))
    rule = rules()["bands"]
    real = type(rule).weights

    def counting(self, means, *rest):
        asked.append(len(means))
        return real(self, means, *rest)

    monkeypatch.setattr(type(rule), "weights", counting)
    chooser = SplatSelector(one.means, {}, one.log_scales)
    away = np.linalg.norm(one.means, axis=1)
    counts = []
    for s_min, coarser in ((0.0, 1e6), (0.0, 0.23), (0.02, 0.1), (0.3, 0.4)):
        facts = {"level": 2, "levels": 3, "finer": 3, "coarser": 1, "s_min": s_min, "coarser_s_min": coarser}
        values = {"gamma": 1.0, "first": 1, "last": 3}
        choice = LodQuery("bands", (0.0, 0.0, 0.0), 60.0, tuple(facts.items()), tuple(values.items()))
        expected = np.flatnonzero((away >= np.float32(60 * s_min)) & (away < np.float32(60 * coarser)))
        asked.clear()
        rows, weights = chooser.chosen(choice)
        np.testing.assert_array_equal(rows, expected)
        assert rows.dtype == np.int32 and (weights == 1).all() and weights.dtype == np.float32
        counts.append((sum(asked), len(expected)))
        hidden = SplatSelector(one.means, {HIDDEN: (one.means[:, 0] > 0).astype(np.float32)}, one.log_scales)
        rows, _ = hidden.chosen(replace(choice, crops=()))
        np.testing.assert_array_equal(rows, expected[one.means[expected, 0] <= 0])
    assert counts[0] == (0, len(one)) and 0 < counts[1][0] < 0.8 * counts[1][1] and counts[3] == (0, 0)


def test_a_crop_may_come_while_the_eye_stays_in_its_region():
    shown, camera = bundle("chunks"), next(views())
    everything = ResidentBundle(shown, "cpu").select_by_rule(camera, resolve_controls(shown, {}))
    for splats, choice in everything.values():
        before = splats.select_visible(choice)[0]
        np.testing.assert_array_equal(splats.select_visible(replace(choice, crops=()))[0], before)


@pytest.mark.parametrize("looked_first", [True, False])
def test_looks_change_what_is_seen_and_not_what_is_chosen(looked_first):
    shown = bundle("decay")
    own = shown.levels[0].splats
    camera, looks = next(views()), ((None, Look(opacity=0.2)),)
    _, choice = ResidentBundle(shown, "cpu").select_by_rule(camera, resolve_controls(shown, {}))[1]
    trained = {"opacity": 1 / (1 + np.exp(-own.opacity_logits)), **own.extras}
    truth = np.flatnonzero(choice.weights(own.means, trained) > 0)
    splats = SplatSet(own, backend="cpu", ordered=True)
    for one in (splats.with_looks(looks), splats) if looked_first else (splats, splats.with_looks(looks)):
        np.testing.assert_array_equal(one.select_visible(choice)[0], truth)
    assert 0 < len(truth) < len(own)
