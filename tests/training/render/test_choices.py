"""What a frame shows of splats that stay: the picture of those that a rule chooses, to the bit."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from training.editing.look import Look, looks_as_dicts
from training.lod.crop import Crop
from training.lod.query import LodQuery
from training.lod.rule import NO_FINER, fact_names, rules
from training.lod.rules.chunks import TABLE, member_columns
from training.render.requests import parse_request
from training.render.scene import Instance, SplatSet, draw
from training.scenes.cameras import camera_to_dict
from training.splats.gaussians import Splats

COUNT = 400
CENTRES = np.float32([(0, 0, 0), (3, 0, 0), (0, 9, 0)])


def table(columns: dict) -> tuple:
    rows = {name: np.asarray(column, np.float32) for name, column in columns.items()}
    return ((TABLE, tuple((name, column.dtype.str, column.tobytes()) for name, column in rows.items())),)


TABLES = {"chunks": table(dict(zip("xyz", CENTRES.T, strict=True)) | {"radius": [3, 3, 6]})}


def choice_of(name: str, eye, **values) -> LodQuery:
    """A choice that shows about half of splats around the origin."""
    rule = rules()[name]
    facts = dict.fromkeys(fact_names(rule), 1.0) | {"level": 2, "finer": NO_FINER, "coarser": 1, "levels": 2}
    facts |= {"s_min": 0.3, "coarser_s_min": 0.8, "d_max": 2.5, "tau": 0.01, "d_l": 0.0, "coarser_d_l": 1.0}
    facts = {each: float(facts[each]) for each in fact_names(rule)}
    settings = rule.defaults([1, 2]) | values
    return LodQuery(
        name, tuple(map(float, eye)), 1.0, tuple(facts.items()), tuple(settings.items()), TABLES.get(name, ())
    )


@pytest.fixture
def splats(make_splats) -> Splats:
    """Splats with the columns of all rules."""
    rng = np.random.default_rng(7)
    columns = {"lod_bias": rng.uniform(-1, 1, COUNT), "sigma_d": rng.uniform(0, 1.5, COUNT)}
    columns |= {"node_size": rng.uniform(0, 0.08, COUNT), "parent_size": rng.uniform(0, 0.3, COUNT)}
    extras = {name: column.astype(np.float32) for name, column in columns.items()}
    return replace(make_splats(COUNT), extras=extras | member_columns(rng.random((3, COUNT)) < 0.4))


def by_rule(choice: LodQuery, splats: Splats) -> np.ndarray:
    """The rule's own weights."""
    columns = {
        name: splats.extras.get(name, np.zeros(COUNT, np.float32)) for name in rules()[choice.rule].columns
    }
    columns["opacity"] = 1 / (1 + np.exp(-splats.opacity_logits))
    return choice.weights(splats.means, columns)


def weights_of(held: SplatSet, choice: LodQuery) -> np.ndarray:
    """The weights (N,) of all."""
    weights = np.zeros(COUNT, np.float32)
    some, found = held.select_visible(choice)
    weights[some] = found
    return weights


@pytest.mark.parametrize("name", sorted(rules()))
def test_weights_are_the_rules(splats, name):
    held = SplatSet(splats, np.full(COUNT, 0.5, np.float32), "cpu")
    for eye in np.random.default_rng(3).uniform(-1, 4, (20, 3)):
        choice = choice_of(name, eye)
        wanted = by_rule(choice, splats)
        np.testing.assert_array_equal(weights_of(held, choice), wanted * np.float32(0.5))
    assert 0.1 < (by_rule(choice_of(name, (0.5, 0, 0)), splats) > 0).mean() < 0.9


def test_while_the_eye_stays_in_a_region_only_what_is_loaded_there_is_looked_at(splats, monkeypatch):
    held = SplatSet(splats, backend="cpu")
    looked_at, found = [], []
    rule = rules()["chunks"]
    weights, loaded = type(rule).weights, type(rule).visible_in_region

    def counted(self, means, *rest):
        looked_at.append(len(means))
        return weights(self, means, *rest)

    def once(self, columns, region):
        found.append(region)
        return loaded(self, columns, region)

    eyes = [(x, 0.1, 0) for x in (0.1, 0.4, 0.6, 0.9, 2.2)]
    wanted = [by_rule(choice_of("chunks", eye), splats) for eye in eyes]
    monkeypatch.setattr(type(rule), "weights", counted)
    monkeypatch.setattr(type(rule), "visible_in_region", once)
    for eye, weight in zip(eyes, wanted, strict=True):
        np.testing.assert_array_equal(weights_of(held, choice_of("chunks", eye)), weight)
        held.select_visible(choice_of("chunks", eye))  # the same frame again
    assert found == [(0, 1)] and len(looked_at) == len(eyes)
    either = (splats.extras["chunks_0"].astype(int) & 3) > 0
    assert set(looked_at) == {either.sum()} and either.sum() < COUNT


@pytest.mark.parametrize("apart", [False, True])
def test_the_picture_is_that_of_the_chosen_alone(splats, make_splats, camera, apart):
    """Of several sets, of different degrees, at one place and at several, also when one of them goes."""
    further = replace(make_splats(COUNT, 1, seed=5), extras=splats.extras)
    matrix = np.eye(4)
    matrix[:3, 3] = 0.2, 0.1, 0.3
    here = [np.diag([1.5, 1.5, 1.5, 1])] * 2 if not apart else [np.eye(4), matrix]
    sets = [SplatSet(each, backend="cpu") for each in (splats, further)]
    for eye in ((9, 9, 9), (0, 0.7, 0), (0.5, 0, 0)):
        choice = choice_of("octree", eye)
        weights = [weights_of(each, choice) for each in sets]
        for kept in ([0, 1], [1], [1, 0]):
            shown = [Instance(sets[i], here[i], i + 1, choice=choice) for i in kept]
            alone = []
            for i in kept:
                some = weights[i] > 0
                one = SplatSet((splats, further)[i].select(some), weights[i][some])
                alone.append(Instance(one, here[i], i + 1))
            pictures = [draw(each, camera, depth=True, levels=True) for each in (shown, alone)]
            for one, other in zip(*(picture.passes().values() for picture in pictures), strict=True):
                np.testing.assert_array_equal(one, other)
    assert np.ptp(pictures[0].image) > 0.05


def test_sets_that_stand_together_are_in_memory_once(make_splats):
    sets = [SplatSet(make_splats(50, seed=seed)) for seed in range(3)]
    whole = sets[0].concatenated(sets[1:])
    assert sets[0].concatenated(sets[1:]) is whole
    begin = whole.means.data_ptr()
    assert [each.gaussians.means.data_ptr() - begin for each in sets] == [0, 600, 1200]
    assert torch.equal(sets[0].concatenated(sets[2:]).means, torch.cat([whole.means[:50], whole.means[100:]]))


def test_a_choice_travels_as_json(camera):
    for name in rules():
        choice = choice_of(name, (0.1, -2, 3))
        one = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "choice": choice.as_dict()}
        asked = {"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [one]}
        found = parse_request(asked).sets[0].choice
        assert found.as_dict() == choice.as_dict()
        assert found.region() == choice.region()
    crops = (Crop.sphere((1, 2, 3), 4), Crop.box((0, 0, 0), (1, 2, 3), True))
    for choice in (choice_of("bands", (0.1, -2, 3)), LodQuery.from_crops(())):
        choice = replace(choice, crops=crops)
        one = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "choice": choice.as_dict()}
        asked = json.loads(
            json.dumps({"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [one]})
        )
        assert parse_request(asked).sets[0].choice == choice


def test_looks_travel_as_json(camera):
    looks = ((None, Look(0.5, 5000, (1, 0.5, 0.2), 0.8, 0.9)), (Crop.sphere((1, 2, 3), 4), Look(opacity=0.1)))
    one = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "looks": looks_as_dicts(looks)}
    asked = {"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [one]}
    assert parse_request(json.loads(json.dumps(asked))).sets[0].looks == looks


NEUTRAL = {"exposure": 0, "temperature": 6500, "tint": [1, 1, 1], "saturation": 1, "opacity": 1}


@pytest.mark.parametrize(
    ("looks", "said"),
    [
        ("red", "not valid"), (["red"], "not valid"), ([{"look": {}}], "not valid"),
        ([{"look": NEUTRAL | {"tint": [1, 1]}}], "not valid"),
        ([{"look": NEUTRAL | {"contrast": 1}}], "not valid"),
        ([{"look": NEUTRAL, "crop": {"shape": "BOX"}}], "not valid"),
        ([{"look": NEUTRAL | {"saturation": 99}}], "saturation of a look"),
        ([{"look": NEUTRAL}] * 300, "not valid"),
    ],
)  # fmt: skip
def test_impossible_looks_are_a_sentence(camera, looks, said):
    from training.errors import LodgsError

    one = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "looks": looks}
    with pytest.raises(LodgsError, match=said):
        parse_request({"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [one]})


def low(values: dict) -> dict:
    return {"values": {name: -1e6 for name in values["values"]}}


@pytest.mark.parametrize(
    "change",
    [
        {"rule": "unknown"}, {"rule": None}, {"eye": [0, 0]}, {"eye": [0, 0, 1e20]}, {"eye": None},
        {"focal_px": "1"}, {"focal_px": None}, {"facts": {}}, {"facts": {"level": 1}}, {"facts": []},
        {"values": {"chunks": 1}}, {"tables": []}, {"tables": {"others": {}}}, {"tables": {"chunks": [1]}},
        {"tables": {"chunks": {"x": [1], "y": []}}}, {"tables": {"chunks": {"x": 1}}},
        {"tables": {"chunks": {"x": ["1"]}}}, {"tables": {"chunks": {"x": [0.0] * 5000}}},
        {"tables": {"chunks": {f"x{i}": [] for i in range(40)}}}, low,
        {"crops": 1}, {"crops": [1]}, {"crops": [{"shape": "CUBE", "to_own": [[0.0] * 4] * 3}]},
        {"crops": [{"shape": "BOX"}]}, {"crops": [{"shape": "BOX", "to_own": [[0.0] * 4] * 2}]},
        {"crops": [{"shape": "BOX", "to_own": [[0.0] * 3] * 3}]},
        {"crops": [{"shape": "BOX", "to_own": [[0.0, 0.0, 0.0, 1e40]] * 3}]},
        {"crops": [Crop.sphere((0, 0, 0), 1).as_dict()] * 300},
    ],
)  # fmt: skip
def test_impossible_choices_are_a_sentence(camera, change):
    from training.errors import LodgsError

    choice = choice_of("chunks", (0, 0, 0)).as_dict()
    choice |= change(choice) if callable(change) else change
    one = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "choice": choice}
    with pytest.raises(LodgsError, match="is not valid"):
        parse_request({"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [one]})


@pytest.mark.parametrize("name", sorted(rules()))
def test_the_ends_of_sliders_are_possible(camera, name):
    """0.01 in single precision lies below 0.01."""
    for end in ("low", "high"):
        ends = {control.name: float(np.float32(getattr(control, end))) for control in rules()[name].controls}
        choice = choice_of(name, (0, 0, 0), **ends).as_dict()
        one = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "choice": choice}
        asked = {"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [one]}
        assert parse_request(asked).sets[0].choice.as_dict() == choice
