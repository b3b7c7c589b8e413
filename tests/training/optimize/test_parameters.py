"""Tests of parameter declarations and of values from jobs."""

import re
from dataclasses import dataclass, fields

import pytest

from training.errors import LodgsError
from training.methods import METHODS, PRESETS, method_info
from training.optimize.parameters import Parameters, override
from training.settings import setting


@dataclass(frozen=True)
class ExampleParameters(Parameters):
    levels: int = setting(3, "Levels.", low=1, high=4)
    shares: tuple[float, ...] = setting((0.5, 0.5, 0.5), "Shares.", above=0, high=1)
    depth: float = setting(-1.0, "Depth.", low=-2, high=3, unit="m")
    kind: str = setting("near", "Kind.", choices=("near", "far"))
    fast: bool = setting(False, "Fast.")


@pytest.mark.parametrize("method", METHODS.values(), ids=lambda method: method.name)
def test_parameters_have_help_and_presets_are_valid(method):
    names = [f.name for f in fields(method.parameters)]
    assert all(f.metadata["about"].endswith(".") for f in fields(method.parameters))
    assert set(method.panel_parameters) <= set(names)
    assert list(method.presets) == list(PRESETS)
    for values in method.presets.values():
        assert type(values) is method.parameters
        assert override(values, {}) == values and values.total_steps > 0
        for f in fields(values):
            assert type(getattr(values, f.name)) is type(f.default)


@pytest.mark.parametrize("method", METHODS.values(), ids=lambda method: method.name)
def test_tooltips_of_the_panel_name_only_its_parameters(method):
    about = {f.name: f.metadata["about"] for f in fields(method.parameters)}
    named = {word for name in method.panel_parameters for word in re.findall(r"'(\w+)'", about[name])}
    assert named & about.keys() <= set(method.panel_parameters)


def test_all_methods_declare_the_share_of_reduced_images_once():
    declared = [f for method in METHODS.values() for f in fields(method.parameters) if f.name == "far_share"]
    assert len(declared) == len(METHODS) and len(set(map(id, declared))) == 1


def test_method_numbers_are_unique_and_stable():
    numbers = {name: method.number for name, method in METHODS.items()}
    assert len(set(numbers.values())) == len(numbers)
    assert list(numbers)[:4] == ["flod", "octree", "octree_neural", "3dgs"]
    assert [numbers[name] for name in list(numbers)[:4]] == [0, 1, 2, 3], ".blend files store the numbers"


def test_unknown_methods_and_presets_are_rejected():
    with pytest.raises(LodgsError, match=r"Unknown method: 'nerf'.*flod, octree"):
        method_info("nerf")
    with pytest.raises(LodgsError, match=r"Unknown preset: 'fast'.*draft, standard, paper"):
        method_info("flod").preset("fast")


def test_override_converts_values_and_ignores_none():
    overrides = {"levels": 2, "shares": [0.25, 1], "depth": 2, "kind": "far", "fast": True, "steps": None}
    result = override(ExampleParameters(), overrides)
    assert result == ExampleParameters(levels=2, shares=(0.25, 1.0), depth=2.0, kind="far", fast=True)
    assert type(result.depth) is float and type(result.shares[1]) is float
    assert override(ExampleParameters(), {"steps": [70]}).steps == 70
    assert override(ExampleParameters(), {"levels": 4}).shares == (0.5,) * 4


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"levels": 5}, r"levels = 5 is invalid. Use a whole number of at least 1 and at most 4"),
        ({"levels": 2.0}, r"levels = 2.0 is invalid. Use a whole number"),
        ({"shares": [0, 1, 1]}, r"shares = 0 is invalid. Use a number above 0 and at most 1"),
        ({"shares": [1, 1]}, "2 entries for 3 levels"),
        ({"depth": -3}, r"depth = -3 is invalid. Use a number of at least -2 and at most 3"),
        ({"depth": float("nan")}, "depth = nan"),
        ({"depth": "deep"}, "depth = 'deep'"),
        ({"depth": [1, 2]}, r"depth = \[1, 2\]"),
        ({"kind": "middle"}, r"kind = 'middle' is invalid. Use one of: near, far"),
        ({"kind": 3}, "kind = 3"),
        ({"fast": 1}, r"fast = 1 is invalid. Use true or false"),
        ({"steps": True}, "steps = True"),
        ({"slow": 1}, r"unknown parameter 'slow'.*steps, .*fast"),
    ],
)
def test_invalid_values_are_rejected_with_valid_ones(values, message):
    with pytest.raises(LodgsError, match=message):
        override(ExampleParameters(), values)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_paper_presets_disable_additions_to_the_papers(method):
    paper, draft = method.preset("paper"), method.preset("draft")
    assert (paper.free_depth, paper.largest, paper.lr_exposure) == (0, 0, 0)
    assert draft.free_depth > 0 and draft.largest > 0
    assert getattr(paper, "first_resolution", 1) == 1
