"""What holds of every rule: its declarations, its place in files, and what it refuses."""

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
def test_a_rule_declares_itself(name):
    rule = rules()[name]
    assert rule.name == name and find_rule(name) is rule
    for control in rule.controls:
        assert control.low <= control.default <= control.high
        assert control.label and control.about and not control.about.endswith(".")
        assert all_controls()[control.name].whole == control.whole


@pytest.mark.parametrize("name", RULES)
def test_files_give_back_the_rule_its_facts_and_the_same_choice(name, tmp_path):
    bundle = bundle_of(name)
    control = rules()[name].controls[0]
    bundle.controls = {control.name: control.low + 0.125}
    write_bundle(tmp_path / "b.ply", bundle)
    write_folder(tmp_path / "folder", bundle)
    values = resolve_controls(bundle, {})
    assert values[control.name] == control.low + 0.125
    for again in (read_bundle(tmp_path / "b.ply"), read_folder(tmp_path / "folder")):
        assert (again.rule, again.facts, again.controls) == (name, bundle.facts, bundle.controls)
        assert [level.facts for level in again.levels] == [level.facts for level in bundle.levels]
        for eye in ((0, 0, 0), (9, 0, 0), (500, 0, 0)):
            one = select_levels(bundle, np.array(eye), 3.0, values)
            other = select_levels(again, np.array(eye), 3.0, resolve_controls(again, {}))
            for a, b in zip(one, other, strict=True):
                np.testing.assert_array_equal(a.splats.means, b.splats.means)
                np.testing.assert_array_equal(a.weights, b.weights)


def any_values(rule: Rule, rng: np.random.Generator) -> dict[str, float]:
    given = {}
    for control in rule.controls:
        low, high = (control.low, min(control.high, 4)) if control.whole else control.soft or (1, 4)
        value = rng.uniform(low, high)
        given[control.name] = round(value) if control.whole else value
    if "first" in given:
        given["first"], given["last"] = sorted((given["first"], given["last"]))
    return given


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("seed", range(5))
def test_an_eye_is_shown_what_the_rule_gives_weight_bit_for_bit(name, seed):
    """One choice for many eyes, a copy for one eye, and the rule asked level by level are the same."""
    bundle, rule, rng = bundle_of(name), rules()[name], np.random.default_rng(seed)
    choice, levels = BundleSelector(bundle), [(level.number, level.facts) for level in bundle.levels]
    for _ in range(10):
        eye, focal = rng.normal(0, 6, 3), rng.uniform(0.5, 9)
        values = resolve_controls(bundle, any_values(rule, rng))
        expected = []
        for level in bundle.levels:
            columns = {n: level.splats.extras[n] for n in rule.columns if n != "opacity"}
            columns["opacity"] = 1 / (1 + np.exp(-level.splats.opacity_logits))
            facts = collect_facts(rule, bundle.facts, levels, level.number)
            expected.append(rule.weights(level.splats.means, np.float32(eye), focal, columns, facts, values))
        weights = np.concatenate(expected)
        np.testing.assert_array_equal(choice.weights(eye, focal, values), weights)
        copied, its_weights = select(bundle, eye, focal, values)
        shown = weights > 0
        for name_of in ("means", "sh", "log_scales"):
            np.testing.assert_array_equal(getattr(copied, name_of), getattr(choice.splats, name_of)[shown])
        np.testing.assert_array_equal(
            np.ones(len(copied)) if its_weights is None else its_weights, weights[shown]
        )


@pytest.mark.parametrize("name", RULES)
def test_nothing_outside_the_band_has_a_weight(name):
    """By the columns of each splat, by the highest of all, and where nobody knows them."""
    rule, rng = rules()[name], np.random.default_rng(8)
    bundle = bundle_of(name) if rule.complete else tree_of(random_leaves(60, rng))
    levels = [(level.number, level.facts) for level in bundle.levels]
    for _ in range(60):
        eye, focal = rng.normal(0, 6, 3).astype(np.float32), rng.uniform(0.5, 9)
        values = resolve_controls(bundle, any_values(rule, rng))
        for level in bundle.levels:
            columns = {n: level.splats.extras[n] for n in rule.columns if n != "opacity"}
            columns["opacity"] = 1 / (1 + np.exp(-level.splats.opacity_logits))
            facts = collect_facts(rule, bundle.facts, levels, level.number)
            weighted = rule.weights(level.splats.means, eye, focal, columns, facts, values) > 0
            away = distances(level.splats.means, eye)
            of_all = {n: column.max(keepdims=True) for n, column in columns.items()}
            for highest in (columns, of_all, {}):
                near, far = rule.distance_band(focal, facts, values, highest)
                assert (near <= away[weighted] * 1.00001).all()
                assert (away * 0.99999 < far)[weighted].all()


def test_distances_are_those_of_float64():
    rng = np.random.default_rng(1)
    means, eye = rng.normal(0, 50, (1000, 3)).astype(np.float32), rng.normal(0, 50, 3).astype(np.float32)
    exact = np.linalg.norm(means.astype(np.float64) - eye.astype(np.float64), axis=1)
    found = distances(means, eye)
    assert found.dtype == np.float32 and distances(means[:0], eye).shape == (0,)
    np.testing.assert_allclose(found, exact, rtol=3e-7)
    np.testing.assert_array_equal(distances(np.asfortranarray(means), eye), found)


@pytest.mark.parametrize("name", RULES)
def test_an_option_of_another_rule_is_a_sentence(name):
    bundle, own = bundle_of(name), {control.name for control in rules()[name].controls}
    for foreign in all_controls().keys() - own | {"nonsense"}:
        with pytest.raises(LodgsError, match=f"The rule '{name}' has no option '{foreign}'. It has: "):
            resolve_controls(bundle, {foreign: 1})


@pytest.mark.parametrize("name", WITH_FACTS)
def test_missing_facts_are_a_sentence(name):
    bundle = bundle_of(name)
    rule = rules()[name]
    bundle.facts = {}
    for level in bundle.levels:
        level.facts = {}
    with pytest.raises(LodgsError, match="its facts are incomplete"):
        select(bundle, np.zeros(3), 100.0, rule.defaults([level.number for level in bundle.levels]))


@pytest.mark.parametrize("name", WITH_FACTS)
@pytest.mark.parametrize("value", [-1.0, float("nan"), "4 m", None, 10**400])
def test_impossible_facts_are_a_sentence(name, value):
    bundle = bundle_of(name)
    rule = rules()[name]
    bundle.facts = dict.fromkeys(bundle.facts, value)
    bundle.levels[-1].facts = dict.fromkeys(bundle.levels[-1].facts, value)
    with pytest.raises(LodgsError, match="its facts are incomplete"):
        select(bundle, np.zeros(3), 100.0, rule.defaults([level.number for level in bundle.levels]))


@pytest.mark.parametrize("rule, said", [("telepathy", "rule 'telepathy', which"), ("", "not made for dist")])
def test_no_rule_and_an_unknown_one_are_sentences(rule, said):
    with pytest.raises(LodgsError, match=said):
        resolve_controls(Bundle("any", [Level(1, splats(3, 0, ()))], rule), {})


@pytest.mark.parametrize("value", [0.5, 3, -1, float("nan"), float("inf"), 10**400, "2", None])
def test_what_is_no_number_of_a_control_is_a_sentence(value):
    control = Control("turns", 1, 0, 2, "Turns", "How many", whole=True)
    with pytest.raises(LodgsError, match=r"turns = .* is not possible. Give a whole number from 0 to 2."):
        control.validate(value)


def test_facts_know_the_neighbours():
    levels = [(1, {"s_min": 4.0}), (3, {"s_min": 2.0}), (7, {"s_min": 0.0})]
    found = collect_facts(rules()["bands"], {}, levels, 3)
    assert found == {
        "level": 3, "finer": 7, "coarser": 1, "levels": 7, "s_min": 2.0, "coarser_s_min": 4.0,
    }  # fmt: skip


@pytest.mark.parametrize("name", RULES)
def test_levels_that_contradict_their_rule_are_refused(name):
    bundle = bundle_of(name)
    bundle.cumulative = not bundle.cumulative
    with pytest.raises(LodgsError, match=f"but by their rule '{name}' they"):
        resolve_controls(bundle, {})
    with pytest.raises(LodgsError, match="export it again"):
        BundleSelector(bundle)
