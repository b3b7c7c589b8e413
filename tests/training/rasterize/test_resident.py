"""Compare resident bundles with plain selection and rasterization, and test culling and partial reads."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.editing.look import Look
from training.errors import LodgsError
from training.lod import on_disk
from training.lod.blocks import BLOCKS, SIZE, block_table
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
from training.splats.morton import spatial_order

NEAR = 0.1
POSITIONS = [(0, 0, 0), (1.0, 0.4, 0), (1.9, 0, 0.2), (4.2, 1, 0), (0, 2.2, 0), (30, 0, 0)]
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
    for position in POSITIONS:
        for target in ((6, 2, 0), (-6, 1, 0.5)):
            yield Camera(
                "", 64, 48, 60.0, 62.0, 30.0, 25.0,
                look_at(np.array(position, float), np.array(target, float), (0, 0, 1)),
            )  # fmt: skip


@pytest.mark.parametrize(
    ("rule", "controls"),
    [
        ("bands", {}), ("bands", {"gamma": 2.0, "last": 2}), ("octree", {}), ("octree", {"fade": 0}),
        ("decay", {}), ("decay", {"at_most": 2900}), ("chunks", {}), ("chunks", {"fade": 0}),
        ("chunks", {"chunks": 0, "distance_scale": 0.6}), ("cut", {}), ("cut", {"pixels": 1.8}),
    ],
)  # fmt: skip
def test_images_match_selection_and_rasterization(rule, controls):
    source = bundle(rule)
    values = resolve_controls(source, controls)
    resident = ResidentBundle(source, "cpu")
    drawn_count = 0
    for camera in views():
        actual = resident.draw(camera, values, near=NEAR)
        splats, weights = select(source, camera.center, camera.focal, values)
        weights = None if weights is None else torch.from_numpy(weights)
        expected = rasterize(Gaussians.of(splats), camera, weights=weights, near=NEAR, backend="cpu")
        # splats of equal depth may have another order
        torch.testing.assert_close(actual.image, expected.image, atol=2e-5, rtol=1e-5)
        assert int((actual.radii > 0).sum()) == int((expected.radii > 0).sum())
        drawn_count = max(drawn_count, int((actual.radii > 0).sum()))
    assert drawn_count > 100


@pytest.mark.parametrize("rule", ["bands", "octree"])
def test_level_includes_coarser_cumulative_levels(rule):
    source, camera = bundle(rule), next(views())
    resident = ResidentBundle(source, "cpu")
    for number in (1, 3):
        single = next(level for level in source.levels if level.number == number)
        splats = Gaussians.of(complete_splats(source, single))
        expected = rasterize(splats, camera, near=NEAR, backend="cpu").image
        torch.testing.assert_close(resident.draw_level(number, camera, near=NEAR).image, expected)


@pytest.mark.parametrize("rule", ["bands", "octree", "cut"])
def test_large_files_are_read_by_visibility(tmp_path, monkeypatch, rule):
    monkeypatch.setattr(on_disk, "_GAP", 1)
    monkeypatch.setattr(on_disk, "_BATCH", 2 * SIZE)
    source = bundle(rule)
    for detail in source.levels:
        if rule != "cut":  # nodes of a tree are already ordered
            detail.splats = detail.splats.select(spatial_order(detail.splats.means))
    source.levels[-1].splats.means[700] = np.nan  # this splat is dropped
    write_bundle(tmp_path / "bundle.ply", source)
    source = read_bundle(tmp_path / "bundle.ply")
    warnings: list[str] = []
    values = resolve_controls(source, {})
    total = sum(len(detail.splats) for detail in source.levels)
    complete = ResidentBundle(source, "cpu")
    partial = ResidentBundle(tmp_path / "bundle.ply", "cpu", warnings.append, max_in_memory=1000)
    finest = source.levels[-1].number
    loaded, read = [], []
    for camera in views():
        for draw in (lambda resident, c=camera: resident.draw(c, values, near=NEAR),
                     lambda resident, c=camera: resident.draw_level(finest, c, near=NEAR)):  # fmt: skip
            ours, theirs = draw(partial), draw(complete)
            torch.testing.assert_close(ours.image, theirs.image, atol=2e-5, rtol=1e-5)
            assert int((ours.radii > 0).sum()) == int((theirs.radii > 0).sum())
            loaded.append(partial.loaded)
            read.append(partial.bytes_read)
    assert min(loaded) < 0.9 * total and len(warnings) == 1 and "1 splats" in warnings[0]
    partial.draw_level(finest, camera, near=NEAR)
    assert partial.bytes_read == read[-1] > read[0] > 0  # resident splats are not read again


def indexed(path) -> Bundle:
    """Write a bundle of chunks with a block table; chunks contain the splats near their centres."""
    source, levels = bundle("chunks"), []
    for detail in source.levels:
        splats = detail.splats.select(spatial_order(detail.splats.means))
        near = np.linalg.norm(splats.means - CENTRES[:, None], axis=2) < 7
        levels.append(replace(detail, splats=replace(splats, extras=member_columns(near))))
    table = block_table(rules()["chunks"].block_bounds, ((x.number, x.splats.extras) for x in levels))
    source = replace(source, levels=levels, tables={**source.tables, BLOCKS: table})
    write_bundle(path, source)
    return source


def member_count(source: Bundle, *chunks: int) -> int:
    bits = sum(1 << chunk for chunk in chunks)
    return sum(int((x.splats.extras["chunks_0"].astype(int) & bits > 0).sum()) for x in source.levels)


def test_only_the_region_is_loaded_and_images_are_bit_identical(tmp_path):
    source = indexed(tmp_path / "bundle.ply")
    complete, partial = ResidentBundle(source, "cpu"), ResidentBundle(tmp_path / "bundle.ply", "cpu")
    values = resolve_controls(source, {})
    total = sum(len(level.splats) for level in source.levels)
    assert partial.loaded == partial.bytes_read == 0
    loaded, read = [], []
    for position in ((0.0, 0, 0), (0.1, 0, 0), (0.6, 0, 0), (30.0, 0, 0), (0.0, 0, 0)):
        for target in ((9.0, 0, 0), (-9.0, 3, 1)):
            pose = look_at(np.array(position), np.array(target), (0, 0, 1))
            camera = Camera("", 64, 48, 60.0, 60.0, 32.0, 24.0, pose)
            ours, theirs = (resident.draw(camera, values, near=NEAR) for resident in (partial, complete))
            assert torch.equal(ours.image, theirs.image) and torch.equal(ours.alpha, theirs.alpha)
            assert int((ours.radii > 0).sum()) == int((theirs.radii > 0).sum()) > 0
        loaded.append(partial.loaded)
        read.append(partial.bytes_read)
    assert loaded == [
        member_count(source, 0),
        *[member_count(source, 0, 1)] * 2,
        total,
        member_count(source, 0),
    ]
    assert complete.loaded == total and complete.bytes_read == 0
    steps = np.diff([0, *read])
    assert (
        steps[0] == steps[4] < steps[1] < steps[3] and steps[2] == 0
    )  # the region of chunks 0 and 1 is read once


def test_single_levels_are_read_separately(tmp_path):
    source, camera = indexed(tmp_path / "bundle.ply"), next(views())
    partial = ResidentBundle(tmp_path / "bundle.ply", "cpu")
    for level in source.levels:
        image = partial.draw_level(level.number, camera, near=NEAR).image
        assert torch.equal(
            image, ResidentBundle(source, "cpu").draw_level(level.number, camera, near=NEAR).image
        )
        assert partial.loaded == len(level.splats)
    with pytest.raises(LodgsError, match="Cannot draw level 7"):
        partial.draw_level(7, camera)


def test_alternating_levels_and_rule_gives_the_same_image(tmp_path):
    """Sets are concatenated again if they are drawn in another combination."""
    source = bundle("octree")
    resident = ResidentBundle(source, "cpu")
    values = resolve_controls(source, {})
    camera = next(views())
    first = resident.draw(camera, values, near=NEAR).image
    resident.draw_level(2, camera, near=NEAR)
    assert torch.equal(resident.draw(camera, values, near=NEAR).image, first)


@pytest.mark.parametrize("rule", ["bands", "octree", "decay", "chunks"])
def test_culling_skips_only_invisible_splats(rule):
    source = bundle(rule)
    resident = ResidentBundle(source, "cpu")
    values = resolve_controls(source, {})
    culled_count = 0
    for camera in views():
        for level in source.levels:
            splats, query = resident.select_by_rule(camera, values)[level.number]
            ordered = level.splats
            if len(ordered) >= SORT_THRESHOLD:
                ordered = ordered.select(spatial_order(ordered.means))
            opacity, own = 1 / (1 + np.exp(-ordered.opacity_logits)), splats.gaussians
            weights = query.weights(ordered.means, ordered.extras | {"opacity": opacity})
            all_rows, row_weights = splats.select_visible(query)
            np.testing.assert_array_equal(all_rows, np.flatnonzero(weights > 0))
            np.testing.assert_array_equal(row_weights, weights[all_rows])
            rows, row_weights = splats.select_visible(query, camera, NEAR)
            np.testing.assert_array_equal(row_weights, weights[rows])
            culled = torch.from_numpy(np.setdiff1d(all_rows, rows)).long()
            rendering = rasterize(own.select(culled), camera, near=NEAR, backend="cpu")
            assert not (rendering.radii > 0).any()
            culled_count += len(culled)
    assert culled_count


def test_blocks_inside_a_band_skip_the_rule(monkeypatch):
    """The rule is evaluated only for blocks on a border of the band; hidden splats are still excluded."""
    evaluated: list[int] = []
    splats = bundle("bands").levels[1].splats
    splats = splats.select(spatial_order(splats.means))
    rule = rules()["bands"]
    real = type(rule).weights

    def counting(self, means, *arguments):
        evaluated.append(len(means))
        return real(self, means, *arguments)

    monkeypatch.setattr(type(rule), "weights", counting)
    selector = SplatSelector(splats.means, {}, splats.log_scales)
    distances = np.linalg.norm(splats.means, axis=1)
    counts = []
    for s_min, coarser in ((0.0, 1e6), (0.0, 0.23), (0.02, 0.1), (0.3, 0.4)):
        facts = {"level": 2, "levels": 3, "finer": 3, "coarser": 1, "s_min": s_min, "coarser_s_min": coarser}
        values = {"gamma": 1.0, "first": 1, "last": 3}
        query = LodQuery("bands", (0.0, 0.0, 0.0), 60.0, tuple(facts.items()), tuple(values.items()))
        expected = np.flatnonzero(
            (distances >= np.float32(60 * s_min)) & (distances < np.float32(60 * coarser))
        )
        evaluated.clear()
        rows, weights = selector.select(query)
        np.testing.assert_array_equal(rows, expected)
        assert rows.dtype == np.int32 and (weights == 1).all() and weights.dtype == np.float32
        counts.append((sum(evaluated), len(expected)))
        hidden = SplatSelector(
            splats.means, {HIDDEN: (splats.means[:, 0] > 0).astype(np.float32)}, splats.log_scales
        )
        rows, _ = hidden.select(replace(query, crops=()))
        np.testing.assert_array_equal(rows, expected[splats.means[expected, 0] <= 0])
    assert counts[0] == (0, len(splats)) and 0 < counts[1][0] < 0.8 * counts[1][1] and counts[3] == (0, 0)


def test_empty_crop_in_the_same_region_keeps_selection():
    source, camera = bundle("chunks"), next(views())
    levels = ResidentBundle(source, "cpu").select_by_rule(camera, resolve_controls(source, {}))
    for splats, query in levels.values():
        rows = splats.select_visible(query)[0]
        np.testing.assert_array_equal(splats.select_visible(replace(query, crops=()))[0], rows)


@pytest.mark.parametrize("looks_first", [True, False])
def test_looks_do_not_change_selection(looks_first):
    source = bundle("decay")
    own = source.levels[0].splats
    camera, looks = next(views()), ((None, Look(opacity=0.2)),)
    _, query = ResidentBundle(source, "cpu").select_by_rule(camera, resolve_controls(source, {}))[1]
    trained = {"opacity": 1 / (1 + np.exp(-own.opacity_logits)), **own.extras}
    truth = np.flatnonzero(query.weights(own.means, trained) > 0)
    splats = SplatSet(own, backend="cpu", ordered=True)
    changed = splats.with_looks(looks)
    for splat_set in (changed, splats) if looks_first else (splats, changed):
        np.testing.assert_array_equal(splat_set.select_visible(query)[0], truth)
    assert 0 < len(truth) < len(own)
