"""Matryoshka's rule: budgets by counting, distances by hand, order after removals."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from training.editing.cleaning import keep_splats
from training.editing.export import export_levels
from training.editing.portable import portable_levels
from training.lod.rule import Rule, rules
from training.lod.selection import resolve_controls, select_levels
from training.splats.bundle import read_bundle, write_bundle
from training.splats.formats import open_as_ply
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply

PREFIX = rules()["prefix"]
FACTS = {"share": 0.25, "share_focal": 100.0, "splats": 1000.0, "level": 1, "levels": 1}


def ordered(counts=(120, 380, 500)) -> Bundle:
    """Return a bundle of random splats in order, in levels of these counts."""
    rng, total = np.random.default_rng(0), sum(counts)
    splats = Splats(
        rng.normal(0, 4, (total, 3)).astype(np.float32), np.ones((total, 4), np.float32),
        np.full((total, 3), -3, np.float32), np.zeros(total, np.float32), np.zeros((total, 1, 3), np.float32),
        {
            "prefix_rank": np.arange(total, dtype=np.float32),
            "view_distance": rng.uniform(3, 9, total).astype(np.float32),
        },
    )  # fmt: skip
    ends = np.cumsum(counts)
    slices = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
    levels = [Level(number, splats.select(rows)) for number, rows in enumerate(slices, 1)]
    facts = {"share": 1e6, "share_focal": 100.0, "splats": float(total)}
    return Bundle("matryoshka", levels, "prefix", facts, cumulative=True)


def selected_ranks(bundle: Bundle, **changes) -> list[int]:
    selected = select_levels(bundle, np.zeros(3), 100.0, resolve_controls(bundle, changes))
    return np.concatenate([level.splats.extras["prefix_rank"] for level in selected]).astype(int).tolist()


@pytest.mark.parametrize("count", [1, 119, 120, 121, 777, 1000, 5000])
def test_budget_draws_exactly_the_first_splats(count):
    assert selected_ranks(ordered(), at_most=count) == list(range(min(count, 1000)))
    assert selected_ranks(ordered(), at_most=0) == list(range(1000))


@pytest.mark.parametrize(
    ("distance", "focal", "scale", "length"),
    [(8, 100, 1, 250), (16, 100, 1, 62.5), (16, 200, 1, 250), (8, 100, 2, 62.5), (4, 100, 1, 1000),
     (1, 100, 1, 1000), (0, 100, 1, 1000)],
)  # fmt: skip
def test_prefix_length_falls_with_the_square_of_distance(distance, focal, scale, length):
    """A quarter of the splats at the view distance of 8; by hand elsewhere."""
    means = np.tile(np.float32([0, distance, 0]), (1000, 1))
    columns = {
        "prefix_rank": np.arange(1000, dtype=np.float32),
        "view_distance": np.full(1000, 8, np.float32),
    }
    values = {"at_most": 0, "distance_scale": scale}
    weights = PREFIX.weights(means, np.zeros(3), focal, columns, FACTS, values)
    np.testing.assert_array_equal(weights, columns["prefix_rank"] < length)


def test_small_camera_moves_change_few_splats():
    """A move of 1 % of the distance changes at most about 2 % of the drawn splats."""
    rng = np.random.default_rng(3)
    means = rng.normal(0, 1, (20_000, 3)).astype(np.float32)
    columns = {
        "prefix_rank": np.arange(20_000, dtype=np.float32),
        "view_distance": np.full(20_000, 12, np.float32),
    }
    facts = FACTS | {"splats": 20_000.0}
    drawn = [
        PREFIX.weights(means, np.float32([distance, 0, 0]), 100.0, columns, facts, PREFIX.defaults([1]))
        for distance in (12.0, 12.12, 12.2412)
    ]
    for near, far in pairwise(drawn):
        assert 0 < (near != far).sum() < 0.025 * near.sum() and not (far > near).any()


def test_coarser_values_draw_subsets():
    bundle = ordered()
    bundle.facts["share"] = 0.5
    values, counts = resolve_controls(bundle, {}), []
    for _ in range(8):
        levels = select_levels(bundle, np.zeros(3), 100.0, values)
        counts.append(sum(len(level.splats) for level in levels))
        values = PREFIX.coarser(values, [1, 2, 3])
    assert counts == sorted(counts, reverse=True) and counts[-1] < counts[0] / 4


def test_removals_keep_the_order_and_exact_budgets():
    bundle, rng = ordered(), np.random.default_rng(1)
    masks = {level.number: rng.random(len(level.splats)) < 0.6 for level in bundle.levels}
    means = np.concatenate([level.splats.means[masks[level.number]] for level in bundle.levels])
    cleaned = keep_splats(bundle, masks)
    selected = select_levels(cleaned, np.zeros(3), 100.0, resolve_controls(cleaned, {"at_most": 200}))
    np.testing.assert_array_equal(np.concatenate([level.splats.means for level in selected]), means[:200])


def test_shuffled_rows_give_the_same_selection():
    """Programs may sort rows; the rule reads the column."""
    bundle, rng = ordered(), np.random.default_rng(2)
    shuffled = [Level(x.number, x.splats.select(rng.permutation(len(x.splats)))) for x in bundle.levels]
    shuffled_bundle = Bundle("matryoshka", shuffled, "prefix", bundle.facts, cumulative=True)
    assert sorted(selected_ranks(shuffled_bundle, at_most=333)) == list(range(333))


def test_rows_of_the_bundle_are_in_order(tmp_path):
    """Any program that keeps the first rows of the file has a level."""
    bundle = ordered()
    write_bundle(tmp_path / "a.ply", bundle)
    means = np.concatenate([level.splats.means for level in bundle.levels])
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").means, means)
    assert [len(level.splats) for level in read_bundle(tmp_path / "a.ply").levels] == [120, 380, 500]


@pytest.mark.parametrize(("controls", "counts"), [({}, [500, 2000, 8000]), ({"at_most": 6000}, [1500, 6000])])
def test_other_programs_get_the_splats_with_the_longest_reach(controls, counts):
    """A level is used if no other splats are visible, at one distance from the camera."""
    bundle = replace(ordered((800, 3200, 4000)), controls=controls)
    bundle.facts["share"] = 0.25
    levels, notes = portable_levels(bundle)
    assert [len(level.rows) for level in levels.bundle.levels] == counts
    assert "single splats" in notes[0] and not levels.bundle.cumulative
    assert np.isfinite(levels.distances).all() and levels.distances[-1] == 0
    for level, distance in zip(levels.bundle.levels[:-1], levels.distances[:-1], strict=True):
        for factor, more in ((0.999, True), (1.001, False)):
            at = np.float32([distance * factor, 0, 0])
            moved = [replace(one, splats=moved_to(one.splats, at)) for one in bundle.levels]
            selected = select_levels(
                replace(bundle, levels=moved), np.zeros(3), levels.focal, resolve_controls(bundle, {})
            )
            assert (sum(len(one.splats) for one in selected) > len(level.rows)) is more


def moved_to(splats: Splats, position: np.ndarray) -> Splats:
    return replace(splats, means=np.zeros_like(splats.means) + position)


@pytest.mark.parametrize("ending", ["glb", "usdc"])
def test_levels_for_other_programs_are_written(tmp_path, ending):
    if ending == "usdc":
        pytest.importorskip("pxr.UsdLod", reason="usd-core is not installed")
    export_levels(tmp_path / f"a.{ending}", ordered((800, 3200, 4000)))
    with open_as_ply(tmp_path / f"a.{ending}") as path:
        assert [len(level.rows) for level in read_bundle(path).levels] == [500, 2000, 8000]


def test_levels_that_are_never_used_are_left_out(monkeypatch):
    """Rules of plug-ins may state no distances."""
    monkeypatch.setattr(type(PREFIX), "nested_levels", Rule.nested_levels)
    levels, _ = portable_levels(ordered())
    assert [len(level.rows) for level in levels.bundle.levels] == [1000] and levels.distances == (0.0,)
