"""Tests of every rule: declarations, storage in files, and rejected inputs."""

import numpy as np
import pytest

from tests.training.lod.tree.trees import random_leaves, tree_of
from training.errors import LodgsError
from training.lod.rule import Control, Rule, all_controls, collect_facts, distances, find_rule, rules
from training.lod.selection import BundleSelector, resolve_controls, select, select_levels
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level

RULES = sorted(rules())
WITH_FACTS = [name for name in RULES if rules()[name].scene_facts or rules()[name].level_facts]


def splats(count: int, seed: int, columns: tuple[str, ...]) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(0, 4, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=rng.normal(-2, 0.5, (count, 3)).astype(np.float32),
        opacity_logits=rng.normal(0, 2, count).astype(np.float32),
        sh=rng.normal(size=(count, 4, 3)).astype(np.float32),
        extras={name: rng.uniform(0.2, 2, count).astype(np.float32) for name in columns if name != "opacity"},
    )


def bundle_of(name: str) -> Bundle:
    rule, rng = rules()[name], np.random.default_rng(3)
    count = 4 if rule.cumulative or rule.level_facts else 1
    levels = [
        Level(n, splats(30 * n, n, rule.columns), {fact: rng.uniform(0.5, 6) for fact in rule.level_facts})
        for n in range(1, count + 1)
    ]
    facts = {fact: rng.uniform(2, 6) for fact in rule.scene_facts}
    return Bundle("any", levels, name, facts, cumulative=rule.cumulative)


@pytest.mark.parametrize("name", RULES)
def test_declarations_are_complete(name):
    rule = rules()[name]
    assert rule.name == name and find_rule(name) is rule
    for control in rule.controls:
        assert control.low <= control.default <= control.high
        assert control.label and control.about and not control.about.endswith(".")
        assert all_controls()[control.name].integer == control.integer


@pytest.mark.parametrize("name", RULES)
def test_files_preserve_rule_facts_and_selection(name, tmp_path):
    bundle = bundle_of(name)
    control = rules()[name].controls[0]
    bundle.controls = {control.name: control.low + 0.125}
    write_bundle(tmp_path / "b.ply", bundle)
    write_folder(tmp_path / "folder", bundle)
    values = resolve_controls(bundle, {})
    assert values[control.name] == control.low + 0.125
    for reread in (read_bundle(tmp_path / "b.ply"), read_folder(tmp_path / "folder")):
        assert (reread.rule, reread.facts, reread.controls) == (name, bundle.facts, bundle.controls)
        assert [level.facts for level in reread.levels] == [level.facts for level in bundle.levels]
        for position in ((0, 0, 0), (9, 0, 0), (500, 0, 0)):
            first = select_levels(bundle, np.array(position), 3.0, values)
            second = select_levels(reread, np.array(position), 3.0, resolve_controls(reread, {}))
            for a, b in zip(first, second, strict=True):
                np.testing.assert_array_equal(a.splats.means, b.splats.means)
                np.testing.assert_array_equal(a.weights, b.weights)


def any_values(rule: Rule, rng: np.random.Generator) -> dict[str, float]:
    values = {}
    for control in rule.controls:
        low, high = (control.low, min(control.high, 4)) if control.integer else control.soft or (1, 4)
        value = rng.uniform(low, high)
        values[control.name] = round(value) if control.integer else value
    if "first" in values:
        values["first"], values["last"] = sorted((values["first"], values["last"]))
    return values


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("seed", range(5))
def test_selection_equals_the_rule_bit_for_bit(name, seed):
    """BundleSelector, select and the rule evaluated level by level agree."""
    bundle, rule, rng = bundle_of(name), rules()[name], np.random.default_rng(seed)
    choice, levels = BundleSelector(bundle), [(level.number, level.facts) for level in bundle.levels]
    for _ in range(10):
        position, focal = rng.normal(0, 6, 3), rng.uniform(0.5, 9)
        values = resolve_controls(bundle, any_values(rule, rng))
        expected = []
        for level in bundle.levels:
            columns = {n: level.splats.extras[n] for n in rule.columns if n != "opacity"}
            columns["opacity"] = 1 / (1 + np.exp(-level.splats.opacity_logits))
            facts = collect_facts(rule, bundle.facts, levels, level.number)
            expected.append(
                rule.weights(level.splats.means, np.float32(position), focal, columns, facts, values)
            )
        weights = np.concatenate(expected)
        np.testing.assert_array_equal(choice.weights(position, focal, values), weights)
        copied, its_weights = select(bundle, position, focal, values)
        selected = weights > 0
        for name_of in ("means", "sh", "log_scales"):
            np.testing.assert_array_equal(getattr(copied, name_of), getattr(choice.splats, name_of)[selected])
        np.testing.assert_array_equal(
            np.ones(len(copied)) if its_weights is None else its_weights, weights[selected]
        )


@pytest.mark.parametrize("name", RULES)
def test_splats_outside_the_band_have_no_weight(name):
    """With the columns of each splat, with maxima over all splats, and without columns."""
    rule, rng = rules()[name], np.random.default_rng(8)
    bundle = bundle_of(name) if rule.complete else tree_of(random_leaves(60, rng))
    levels = [(level.number, level.facts) for level in bundle.levels]
    for _ in range(60):
        position, focal = rng.normal(0, 6, 3).astype(np.float32), rng.uniform(0.5, 9)
        values = resolve_controls(bundle, any_values(rule, rng))
        for level in bundle.levels:
            columns = {n: level.splats.extras[n] for n in rule.columns if n != "opacity"}
            columns["opacity"] = 1 / (1 + np.exp(-level.splats.opacity_logits))
            facts = collect_facts(rule, bundle.facts, levels, level.number)
            weighted = rule.weights(level.splats.means, position, focal, columns, facts, values) > 0
            distance = distances(level.splats.means, position)
            of_all = {n: column.max(keepdims=True) for n, column in columns.items()}
            for highest in (columns, of_all, {}):
                near, far = rule.distance_band(focal, facts, values, highest)
                assert (near <= distance[weighted] * 1.00001).all()
                assert (distance * 0.99999 < far)[weighted].all()


def test_distances_match_float64():
    rng = np.random.default_rng(1)
    means, position = rng.normal(0, 50, (1000, 3)).astype(np.float32), rng.normal(0, 50, 3).astype(np.float32)
    exact = np.linalg.norm(means.astype(np.float64) - position.astype(np.float64), axis=1)
    result = distances(means, position)
    assert result.dtype == np.float32 and distances(means[:0], position).shape == (0,)
    np.testing.assert_allclose(result, exact, rtol=3e-7)
    np.testing.assert_array_equal(distances(np.asfortranarray(means), position), result)


@pytest.mark.parametrize("name", RULES)
def test_controls_of_other_rules_are_rejected(name):
    bundle, own_controls = bundle_of(name), {control.name for control in rules()[name].controls}
    for foreign in all_controls().keys() - own_controls | {"nonsense"}:
        with pytest.raises(LodgsError, match=f"Cannot set '{foreign}': the rule '{name}' has no such"):
            resolve_controls(bundle, {foreign: 1})


@pytest.mark.parametrize("name", WITH_FACTS)
def test_missing_facts_are_reported(name):
    bundle = bundle_of(name)
    rule = rules()[name]
    bundle.facts = {}
    for level in bundle.levels:
        level.facts = {}
    with pytest.raises(LodgsError, match="facts are missing or invalid"):
        select(bundle, np.zeros(3), 100.0, rule.defaults([level.number for level in bundle.levels]))


@pytest.mark.parametrize("name", WITH_FACTS)
@pytest.mark.parametrize("value", [-1.0, float("nan"), "4 m", None, 10**400])
def test_invalid_facts_are_reported(name, value):
    bundle = bundle_of(name)
    rule = rules()[name]
    bundle.facts = dict.fromkeys(bundle.facts, value)
    bundle.levels[-1].facts = dict.fromkeys(bundle.levels[-1].facts, value)
    with pytest.raises(LodgsError, match="facts are missing or invalid"):
        select(bundle, np.zeros(3), 100.0, rule.defaults([level.number for level in bundle.levels]))


@pytest.mark.parametrize("rule, message", [("telepathy", "rule 'telepathy'"), ("", "by distance")])
def test_missing_and_unknown_rules_are_reported(rule, message):
    with pytest.raises(LodgsError, match=message):
        resolve_controls(Bundle("any", [Level(1, splats(3, 0, ()))], rule), {})


@pytest.mark.parametrize("value", [0.5, 3, -1, float("nan"), float("inf"), 10**400, "2", None])
def test_invalid_control_values_are_rejected(value):
    control = Control("turns", 1, 0, 2, "Turns", "How many", integer=True)
    with pytest.raises(LodgsError, match=r"turns = .* is invalid. Use a whole number from 0 to 2."):
        control.validate(value)


def test_facts_include_neighbouring_levels():
    levels = [(1, {"s_min": 4.0}), (3, {"s_min": 2.0}), (7, {"s_min": 0.0})]
    result = collect_facts(rules()["bands"], {}, levels, 3)
    assert result == {
        "level": 3, "finer": 7, "coarser": 1, "levels": 7, "s_min": 2.0, "coarser_s_min": 4.0,
    }  # fmt: skip


@pytest.mark.parametrize("name", RULES)
def test_contradicting_bundles_are_rejected(name):
    bundle = bundle_of(name)
    bundle.cumulative = not bundle.cumulative
    with pytest.raises(LodgsError, match=f"rule '{name}': levels .* but must"):
        resolve_controls(bundle, {})
    with pytest.raises(LodgsError, match="export it again"):
        BundleSelector(bundle)
