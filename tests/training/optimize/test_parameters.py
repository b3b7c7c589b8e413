"""What every method declares of its parameters, and values that a job gives them."""

from dataclasses import dataclass, fields

import pytest

from training.errors import LodgsError
from training.methods import METHODS, PRESETS, method_info
from training.optimize.parameters import Parameters, override, parameter


@dataclass(frozen=True)
class Made(Parameters):
    levels: int = parameter(3, "Levels.", low=1, high=4)
    shares: tuple[float, ...] = parameter((0.5, 0.5, 0.5), "Shares.", above=0, high=1)
    depth: float = parameter(-1.0, "Depth.", low=-2, high=3, unit="m")
    kind: str = parameter("near", "Kind.", choices=("near", "far"))
    fast: bool = parameter(False, "Fast.")


@pytest.mark.parametrize("method", METHODS.values(), ids=lambda method: method.name)
def test_every_parameter_says_what_it_is_and_every_preset_is_possible(method):
    names = [f.name for f in fields(method.parameters)]
    assert all(f.metadata["about"].endswith(".") for f in fields(method.parameters))
    assert set(method.panel_parameters) <= set(names)
    assert list(method.presets) == list(PRESETS)
    for values in method.presets.values():
        assert type(values) is method.parameters
        assert override(values, {}) == values and values.total_steps > 0
        for f in fields(values):  # and of the type that the field has
            assert type(getattr(values, f.name)) is type(f.default)


def test_methods_have_a_number_each_and_those_that_were_there_keep_theirs():
    numbers = {name: method.number for name, method in METHODS.items()}
    assert len(set(numbers.values())) == len(numbers)
    assert list(numbers)[:4] == ["flod", "octree", "octree_neural", "3dgs"]
    assert [numbers[name] for name in list(numbers)[:4]] == [0, 1, 2, 3], "a .blend stores them"


def test_methods_and_presets_that_do_not_exist_are_named():
    with pytest.raises(LodgsError, match=r"no method 'nerf'.*flod, octree"):
        method_info("nerf")
    with pytest.raises(LodgsError, match=r"no preset 'fast'.*draft, standard, paper"):
        method_info("flod").preset("fast")


def test_values_of_every_kind_are_taken_and_none_leaves_one_as_it_is():
    given = {"levels": 2, "shares": [0.25, 1], "depth": 2, "kind": "far", "fast": True, "steps": None}
    made = override(Made(), given)
    assert made == Made(levels=2, shares=(0.25, 1.0), depth=2.0, kind="far", fast=True)
    assert type(made.depth) is float and type(made.shares[1]) is float
    assert override(Made(), {"steps": [70]}).steps == 70
    assert override(Made(), {"levels": 4}).shares == (0.5,) * 4


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"levels": 5}, r"levels = 5 is not possible. Give a whole number of at least 1 and at most 4"),
        ({"levels": 2.0}, r"levels = 2.0 is not possible. Give a whole number"),
        ({"shares": [0, 1, 1]}, r"shares = 0 is not possible. Give a number above 0 and at most 1"),
        ({"shares": [1, 1]}, "2 entries for 3 levels"),
        ({"depth": -3}, r"depth = -3 is not possible. Give a number of at least -2 and at most 3"),
        ({"depth": float("nan")}, "depth = nan"),
        ({"depth": "deep"}, "depth = 'deep'"),
        ({"depth": [1, 2]}, r"depth = \[1, 2\]"),
        ({"kind": "middle"}, r"kind = 'middle' is not possible. Give one of: near, far"),
        ({"kind": 3}, "kind = 3"),
        ({"fast": 1}, r"fast = 1 is not possible. Give true or false"),
        ({"steps": True}, "steps = True"),
        ({"slow": 1}, r"unknown parameter 'slow'.*steps, .*fast"),
    ],
)
def test_what_is_not_possible_is_said_with_what_is(values, said):
    with pytest.raises(LodgsError, match=said):
        override(Made(), values)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_presets_of_the_papers_leave_out_what_is_in_no_paper(method):
    paper, draft = method.preset("paper"), method.preset("draft")
    assert (paper.free_depth, paper.largest, paper.lr_exposure) == (0, 0, 0)
    assert draft.free_depth > 0 and draft.largest > 0
    assert getattr(paper, "first_resolution", 1) == 1
