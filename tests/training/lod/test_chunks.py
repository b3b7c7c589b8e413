"""LODGE's rule: Eq. 2 and Eq. 4 worked by hand."""

from itertools import pairwise

import numpy as np
import pytest

from training.errors import LodgsError
from training.lod.rule import NO_TABLES, collect_facts, rules
from training.lod.rules.chunks import in_chunk, member_columns
from training.lod.selection import check_rule
from training.splats.levels import NO_SPLATS, Bundle, Level

CHUNKS = rules()["chunks"]
LEVELS = [(1, {"d_l": 20.0}), (2, {"d_l": 5.0}), (3, {"d_l": 0.0})]
AWAY = np.float32([0, 4.999, 5, 19.999, 20, 1e6])


def weights(number, levels=LEVELS, scale=1.0, focal_px=500.0):
    means = np.stack([AWAY + 1, 0 * AWAY, 0 * AWAY], axis=1)
    values = {"distance_scale": scale, "chunks": 1, "fade": 1}
    return CHUNKS.weights(
        means, np.array([1.0, 0, 0]), focal_px, {}, collect_facts(CHUNKS, {}, levels, number), values
    ).tolist()


def test_each_distance_belongs_to_one_level():
    assert weights(3) == [1, 1, 0, 0, 0, 0]
    assert weights(2) == [0, 0, 1, 1, 0, 0]
    assert weights(1) == [0, 0, 0, 0, 1, 1]


def test_levels_extend_over_missing_neighbours():
    assert weights(2, LEVELS[1:]) == [0, 0, 1, 1, 1, 1]  # the coarsest level has no far end
    assert weights(2, LEVELS[:2]) == [1, 1, 1, 1, 0, 0]  # the finest level begins at the camera
    assert weights(1, [LEVELS[0], LEVELS[2]]) == [0, 0, 0, 0, 1, 1]
    assert weights(3, [LEVELS[0], LEVELS[2]]) == [1, 1, 1, 1, 0, 0]


def test_distance_scale_multiplies_distances():
    assert weights(3, scale=0.1) == [1, 1, 1, 1, 1, 0]
    assert weights(1, scale=4.0) == [0, 0, 1, 1, 1, 1]
    position = {"chunks": 0, "fade": 1}
    assert CHUNKS.coarser({"distance_scale": 2.0, **position}, [1, 2, 3]) == {
        "distance_scale": 2.5,
        **position,
    }
    assert CHUNKS.coarser({"distance_scale": 90.0, **position}, [1, 2, 3]) is None
    assert CHUNKS.coarser({"distance_scale": 1.0, "chunks": 1, "fade": 1}, [1, 2, 3]) == {
        "distance_scale": 1.0,
        **position,
    }


def test_focal_length_has_no_effect():
    assert weights(2, focal_px=50.0) == weights(2)
    assert CHUNKS.defaults([1, 2, 3]) == pytest.approx({"distance_scale": 1, "chunks": 1, "fade": 1})


TABLES = {"chunks": dict(zip("xyz", np.float32([[0, 10, 30], [0, 0, 0], [0, 0, 0]]), strict=True))}
TABLES["chunks"]["radius"] = np.float32([10, 10, 20])
SETS = np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1]], bool)
"""Sets of three chunks, as rows of four splats."""


def chunk_weights(position, tables=TABLES, **values):
    """Return the weights of four splats, 100 units away, in a middle level outside its distance band."""
    means = np.float32([[0, 100, 0]] * 4)
    values = CHUNKS.defaults([1, 2, 3]) | values
    facts = collect_facts(CHUNKS, {}, LEVELS, 2)
    columns = dict.fromkeys(CHUNKS.columns, np.zeros(4, np.float32)) | member_columns(SETS)
    return CHUNKS.weights(means, np.array(position, float), 500.0, columns, facts, values, tables).tolist()


def test_two_nearest_chunks_fade_into_each_other():
    assert chunk_weights([0, 0, 0]) == [1, 1, 0, 0]
    assert chunk_weights([2.5, 0, 0]) == [0.75, 1, 0.25, 0]
    assert chunk_weights([2.5, 3, 0]) == [0.75, 1, 0.25, 0]  # only the projection counts
    assert chunk_weights([5, 0, 0]) == [0.5, 1, 0.5, 0]
    assert chunk_weights([-5, 0, 0]) == [1, 1, 0, 0]  # the projection is clipped to the line
    assert chunk_weights([2.5, 0, 0], fade=0) == [1, 1, 0, 0]
    assert chunk_weights([7.5, 0, 0], fade=0) == [0, 1, 1, 0]


def test_without_chunks_camera_distances_apply():
    for result in (chunk_weights([0, 90, 0], chunks=0), chunk_weights([0, 90, 0], tables=NO_TABLES)):
        assert result == [1, 1, 1, 1]  # distance 10 is in the band of the middle level
    empty = {"chunks": {name: column[:0] for name, column in TABLES["chunks"].items()}}
    assert chunk_weights([0, 90, 0], tables=empty) == [1, 1, 1, 1]


def test_sets_fade_out_beyond_the_radius():
    # distance 110 from the splats is outside the band of the middle level
    assert chunk_weights([0, -10, 0]) == [1, 1, 0, 0]
    assert chunk_weights([0, -11.25, 0]) == [0.5, 0.5, 0, 0]
    assert chunk_weights([0, -12.5, 0]) == [0, 0, 0, 0]
    assert chunk_weights([0, 88, 0]) == [1, 1, 1, 1]
    assert chunk_weights([0, -10.1, 0], fade=0) == [0, 0, 0, 0]


def test_single_chunk():
    first = {"chunks": {name: column[:1] for name, column in TABLES["chunks"].items()}}
    assert chunk_weights([5, 0, 0], tables=first) == [1, 1, 0, 0]
    assert chunk_weights([0, -11.25, 0], tables=first) == [0.5, 0.5, 0, 0]


def test_weights_are_continuous_along_a_path():
    """The Lipschitz constant of Eq. 4 is the inverse distance of two centres, here 0.1."""
    path = [chunk_weights([x, 1.0, 0]) for x in np.arange(-2, 35, 0.1)]
    assert max(np.abs(np.subtract(a, b)).max() for a, b in pairwise(path)) < 0.0101
    hard = [chunk_weights([x, 1.0, 0], fade=0) for x in np.arange(-2, 35, 0.1)]
    assert max(np.abs(np.subtract(a, b)).max() for a, b in pairwise(hard)) == 1


def test_third_chunk_takes_over_continuously():
    """Centres at the corners of a rectangle: t is 0.3 to the right, 0.2 up and 0.274 diagonally."""
    corners = {"x": [0, 10, 0, 10], "y": [0, 0, 6, 6], "z": [0] * 4, "radius": [20] * 4}
    tables = {"chunks": {name: np.float32(column) for name, column in corners.items()}}

    def shares(x, y):
        return dict(CHUNKS.near_chunks(np.array([x, y, 0]), CHUNKS.defaults([1]), tables))

    s = 2 * (3 * 10 + 1.2 * 6) / 136 - 0.3
    assert shares(3.0, 1.2) == pytest.approx({0: 1 - (0.3 - s) / (1 - 2 * s), 1: (0.3 - s) / (1 - 2 * s)})
    across = [shares(3.0, y) for y in np.arange(0, 2.9, 0.02)]
    assert {chunk for result in across for chunk in result} == {0, 1, 2}
    for original, updated in pairwise(across):
        assert all(abs(original.get(n, 0) - updated.get(n, 0)) < 0.06 for n in range(4))


def test_region_contains_all_visible_splats():
    columns = dict.fromkeys(CHUNKS.columns, np.zeros(4, np.float32)) | member_columns(SETS)
    values = CHUNKS.defaults([1, 2, 3])
    assert CHUNKS.region(np.zeros(3), values, TABLES) == (0,)
    assert CHUNKS.region(np.array([3.0, 0, 0]), values, TABLES) == (0, 1)
    assert CHUNKS.region(np.array([25.0, 0, 0]), values, TABLES) == (1, 2)
    assert CHUNKS.region(np.zeros(3), values | {"fade": 0}, TABLES) == (0,)
    assert CHUNKS.region(np.array([0, -11.0, 0]), values, TABLES) is None
    assert CHUNKS.region(np.zeros(3), values | {"chunks": 0}, TABLES) is None
    assert CHUNKS.visible_in_region(columns, (0, 1)).tolist() == [True, True, True, False]


def test_bits_of_96_chunks_are_exact_in_float32():
    sets = np.random.default_rng(0).random((96, 50)) < 0.5
    columns = member_columns(sets)
    assert list(columns) == ["chunks_0", "chunks_1", "chunks_2", "chunks_3"]
    assert all(column.dtype == np.float32 for column in columns.values())
    for chunk, first in enumerate(sets):
        np.testing.assert_array_equal(in_chunk(columns, chunk), first)
    assert list(member_columns(sets[:24])) == ["chunks_0"]
    assert list(member_columns(sets[:25])) == ["chunks_0", "chunks_1"]


def test_region_labels():
    def label(position, tables=TABLES, **values):
        return CHUNKS.region_label(np.array(position, float), CHUNKS.defaults([1]) | values, tables)

    assert label([2.5, 0, 0]) == "Chunks 0 and 1, 25 %"
    assert label([26.0, 0, 0]) == "Chunks 2 and 1, 15 %"  # the nearest chunk first; t is 0.2, t' 2 / 15
    assert label([-3.0, 0, 0]) == label([2.5, 0, 0], fade=0) == "Chunk 0"
    assert label([0, -11.25, 0]) == "Chunk 0, 50 % outside"
    assert label([0, -50.0, 0]) == "Outside the chunks"
    assert label([2.5, 0, 0], NO_TABLES) == label([2.5, 0, 0], chunks=0) == ""


def test_inactive_controls_have_reasons():
    """Weights do not depend on the values of inactive controls."""
    for position in ([2.5, 3, 0], [0, -11.25, 0], [0, 88, 0]):
        for tables in (TABLES, NO_TABLES):
            for chunks in (0, 1):
                values = CHUNKS.defaults([1]) | {"chunks": chunks}
                idle = CHUNKS.inactive_controls(np.array(position, float), values, tables)
                original = chunk_weights(position, tables, **values)
                for name in idle:
                    for second in (0.02, 9.0) if name == "distance_scale" else (0, 1):
                        assert chunk_weights(position, tables, **values | {name: second}) == original
                assert ("distance_scale" in idle) == (tables is TABLES and chunks == 1 and position[1] == 3)
                assert ("fade" in idle) == (tables is NO_TABLES or chunks == 0)
                assert ("chunks" in idle) == (tables is NO_TABLES)


def test_positions_belong_to_the_nearest_chunk():
    means = np.random.default_rng(0).normal(10, 15, (40_000, 3)).astype(np.float32)
    centres = np.stack([TABLES["chunks"][axis] for axis in "xyz"], axis=1)
    nearest = np.linalg.norm(means[:, None] - centres, axis=2).argmin(axis=1)
    assert (CHUNKS.part_numbers(means, TABLES) == nearest + 1).mean() > 0.9999  # halfway, rounding decides
    assert not CHUNKS.part_numbers(means, NO_TABLES).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.pop("radius"), "its table 'chunks' has no radius"),
        (lambda table: table.update(y=np.float32([0, np.nan, 0])), "out of range"),
        (lambda table: table.update({name: np.zeros(97) for name in table}), "97 chunks, more than 96"),
    ],
)
def test_invalid_chunk_tables_are_rejected(change, message):
    table = dict(TABLES["chunks"])
    levels = [Level(number, NO_SPLATS, facts) for number, facts in LEVELS]
    bundle = Bundle("lodge", levels, "chunks", tables={"chunks": table})
    assert check_rule(bundle) is CHUNKS
    change(table)
    with pytest.raises(LodgsError, match=message):
        check_rule(bundle)
    bundle.tables = {"chunks": {}}
    assert check_rule(bundle) is CHUNKS
