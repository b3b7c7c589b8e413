"""Queries that select splats of loaded sets by a rule, bit for bit."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from training.editing.look import Look, looks_as_dicts
from training.errors import LodgsError
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


def query_of(name: str, position, **values) -> LodQuery:
    """Return a query that selects about half of the splats around the origin."""
    rule = rules()[name]
    facts = dict.fromkeys(fact_names(rule), 1.0) | {"level": 2, "finer": NO_FINER, "coarser": 1, "levels": 2}
    facts |= {"s_min": 0.3, "coarser_s_min": 0.8, "d_max": 2.5, "tau": 0.01, "d_l": 0.0, "coarser_d_l": 1.0}
    facts |= {"splats": COUNT}
    facts = {fact: float(facts[fact]) for fact in fact_names(rule)}
    settings = rule.defaults([1, 2]) | values
    return LodQuery(
        name,
        tuple(map(float, position)),
        1.0,
        tuple(facts.items()),
        tuple(settings.items()),
        TABLES.get(name, ()),
    )


@pytest.fixture
def splats(make_splats) -> Splats:
    """Random splats with the columns of all rules."""
    rng = np.random.default_rng(7)
    columns = {"lod_bias": rng.uniform(-1, 1, COUNT), "sigma_d": rng.uniform(0, 1.5, COUNT)}
    columns |= {"prefix_rank": rng.permutation(COUNT), "view_distance": rng.uniform(0.3, 1.5, COUNT)}
    columns |= {"node_size": rng.uniform(0, 0.08, COUNT), "parent_size": rng.uniform(0, 0.3, COUNT)}
    extras = {name: column.astype(np.float32) for name, column in columns.items()}
    return replace(make_splats(COUNT), extras=extras | member_columns(rng.random((3, COUNT)) < 0.4))


def rule_weights(query: LodQuery, splats: Splats) -> np.ndarray:
    """Return the rule's weights of all splats."""
    columns = {
        name: splats.extras.get(name, np.zeros(COUNT, np.float32)) for name in rules()[query.rule].columns
    }
    columns["opacity"] = 1 / (1 + np.exp(-splats.opacity_logits))
    return query.weights(splats.means, columns)


def set_weights(splat_set: SplatSet, query: LodQuery) -> np.ndarray:
    """Return the weights (N,) that a set selects."""
    weights = np.zeros(COUNT, np.float32)
    rows, row_weights = splat_set.select_visible(query)
    weights[rows] = row_weights
    return weights


@pytest.mark.parametrize("name", sorted(rules()))
def test_weights_match_the_rule(splats, name):
    splat_set = SplatSet(splats, np.full(COUNT, 0.5, np.float32), "cpu")
    for position in np.random.default_rng(3).uniform(-1, 4, (20, 3)):
        query = query_of(name, position)
        expected = rule_weights(query, splats)
        np.testing.assert_array_equal(set_weights(splat_set, query), expected * np.float32(0.5))
    drawn = (rule_weights(query_of(name, (0.5, 0, 0)), splats) > 0).mean()
    assert 0.1 < drawn < 0.9, f"adapt the facts of query_of: they draw {drawn:.0%} of the splats"


def test_only_splats_of_the_region_are_weighted(splats, monkeypatch):
    splat_set = SplatSet(splats, backend="cpu")
    weighted, regions = [], []
    rule = rules()["chunks"]
    weights, loaded = type(rule).weights, type(rule).visible_in_region

    def counted(self, means, *arguments):
        weighted.append(len(means))
        return weights(self, means, *arguments)

    def recorded(self, columns, region):
        regions.append(region)
        return loaded(self, columns, region)

    positions = [(x, 0.1, 0) for x in (0.1, 0.4, 0.6, 0.9, 2.2)]
    expected = [rule_weights(query_of("chunks", position), splats) for position in positions]
    monkeypatch.setattr(type(rule), "weights", counted)
    monkeypatch.setattr(type(rule), "visible_in_region", recorded)
    for position, position_weights in zip(positions, expected, strict=True):
        query = query_of("chunks", position)
        np.testing.assert_array_equal(set_weights(splat_set, query), position_weights)
        splat_set.select_visible(query)  # cached
    assert regions == [(0, 1)] and len(weighted) == len(positions)
    either = (splats.extras["chunks_0"].astype(int) & 3) > 0
    assert set(weighted) == {either.sum()} and either.sum() < COUNT


@pytest.mark.parametrize("separate", [False, True])
def test_image_equals_that_of_the_selected_splats(splats, make_splats, camera, separate):
    """Two sets of different SH degrees share one transform or not, and one of them is removed."""
    further = replace(make_splats(COUNT, 1, seed=5), extras=splats.extras)
    matrix = np.eye(4)
    matrix[:3, 3] = 0.2, 0.1, 0.3
    matrices = [np.eye(4), matrix] if separate else [np.diag([1.5, 1.5, 1.5, 1])] * 2
    sets = [SplatSet(x, backend="cpu") for x in (splats, further)]
    for position in ((9, 9, 9), (0, 0.7, 0), (0.5, 0, 0)):
        query = query_of("octree", position)
        weights = [set_weights(splat_set, query) for splat_set in sets]
        for numbers in ([0, 1], [1], [1, 0]):
            queried = [Instance(sets[i], matrices[i], i + 1, query=query) for i in numbers]
            selected = []
            for i in numbers:
                rows = weights[i] > 0
                subset = SplatSet((splats, further)[i].select(rows), weights[i][rows])
                selected.append(Instance(subset, matrices[i], i + 1))
            images = [draw(x, camera, depth=True, levels=True) for x in (queried, selected)]
            for plane, expected in zip(*(image.passes().values() for image in images), strict=True):
                np.testing.assert_array_equal(plane, expected)
    assert np.ptp(images[0].image) > 0.05


def test_concatenated_sets_share_memory(make_splats):
    sets = [SplatSet(make_splats(50, seed=seed)) for seed in range(3)]
    combined = sets[0].concatenated(sets[1:])
    assert sets[0].concatenated(sets[1:]) is combined
    begin = combined.means.data_ptr()
    assert [x.gaussians.means.data_ptr() - begin for x in sets] == [0, 600, 1200]
    assert torch.equal(
        sets[0].concatenated(sets[2:]).means, torch.cat([combined.means[:50], combined.means[100:]])
    )


def test_query_round_trips_as_json(camera):
    for name in rules():
        query = query_of(name, (0.1, -2, 3))
        item = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "query": query.as_dict()}
        request = {"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [item]}
        parsed = parse_request(request).sets[0].query
        assert parsed.as_dict() == query.as_dict()
        assert parsed.region() == query.region()
    crops = (Crop.sphere((1, 2, 3), 4), Crop.box((0, 0, 0), (1, 2, 3), True))
    for query in (query_of("bands", (0.1, -2, 3)), LodQuery.from_crops(())):
        query = replace(query, crops=crops)
        item = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "query": query.as_dict()}
        request = json.loads(
            json.dumps({"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [item]})
        )
        assert parse_request(request).sets[0].query == query


def test_looks_round_trip_as_json(camera):
    looks = ((None, Look(0.5, 5000, (1, 0.5, 0.2), 0.8, 0.9)), (Crop.sphere((1, 2, 3), 4), Look(opacity=0.1)))
    item = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "looks": looks_as_dicts(looks)}
    request = {"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [item]}
    assert parse_request(json.loads(json.dumps(request))).sets[0].looks == looks


NEUTRAL = {"exposure": 0, "temperature": 6500, "tint": [1, 1, 1], "saturation": 1, "opacity": 1}


@pytest.mark.parametrize(
    ("looks", "message"),
    [
        ("red", "Cannot read the request"), (["red"], "Cannot read the request"),
        ([{"look": {}}], "Cannot read the request"),
        ([{"look": NEUTRAL | {"tint": [1, 1]}}], "Cannot read the request"),
        ([{"look": NEUTRAL | {"contrast": 1}}], "Cannot read the request"),
        ([{"look": NEUTRAL, "crop": {"shape": "BOX"}}], "Cannot read the request"),
        ([{"look": NEUTRAL | {"saturation": 99}}], "saturation = 99"),
        ([{"look": NEUTRAL}] * 300, "Cannot read the request"),
    ],
)  # fmt: skip
def test_invalid_looks_raise_one_sentence(camera, looks, message):
    item = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "looks": looks}
    with pytest.raises(LodgsError, match=message):
        parse_request({"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [item]})


def too_low(values: dict) -> dict:
    return {"values": {name: -1e6 for name in values["values"]}}


@pytest.mark.parametrize(
    "change",
    [
        {"rule": "unknown"}, {"rule": None}, {"position": [0, 0]}, {"position": [0, 0, 1e20]},
        {"position": None},
        {"focal_px": "1"}, {"focal_px": None}, {"facts": {}}, {"facts": {"level": 1}}, {"facts": []},
        {"values": {"chunks": 1}}, {"tables": []}, {"tables": {"unknown": {}}}, {"tables": {"chunks": [1]}},
        {"tables": {"chunks": {"x": [1], "y": []}}}, {"tables": {"chunks": {"x": 1}}},
        {"tables": {"chunks": {"x": ["1"]}}}, {"tables": {"chunks": {"x": [0.0] * 5000}}},
        {"tables": {"chunks": {f"x{i}": [] for i in range(40)}}}, too_low,
        {"crops": 1}, {"crops": [1]}, {"crops": [{"shape": "CUBE", "to_local": [[0.0] * 4] * 3}]},
        {"crops": [{"shape": "BOX"}]}, {"crops": [{"shape": "BOX", "to_local": [[0.0] * 4] * 2}]},
        {"crops": [{"shape": "BOX", "to_local": [[0.0] * 3] * 3}]},
        {"crops": [{"shape": "BOX", "to_local": [[0.0, 0.0, 0.0, 1e40]] * 3}]},
        {"crops": [Crop.sphere((0, 0, 0), 1).as_dict()] * 300},
    ],
)  # fmt: skip
def test_invalid_queries_raise_one_sentence(camera, change):
    values = query_of("chunks", (0, 0, 0)).as_dict()
    values |= change(values) if callable(change) else change
    item = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "query": values}
    with pytest.raises(LodgsError, match="Cannot read the request"):
        parse_request({"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [item]})


@pytest.mark.parametrize("name", sorted(rules()))
def test_slider_limits_are_valid(camera, name):
    """0.01 in single precision is below 0.01."""
    for end in ("low", "high"):
        ends = {control.name: float(np.float32(getattr(control, end))) for control in rules()[name].controls}
        values = query_of(name, (0, 0, 0), **ends).as_dict()
        item = {"file": "s", "count": 1, "matrix": np.eye(4).tolist(), "level": 1, "query": values}
        request = {"frame": 1, "out": "o", "camera": camera_to_dict(camera, 0.1), "sets": [item]}
        assert parse_request(request).sets[0].query.as_dict() == values
