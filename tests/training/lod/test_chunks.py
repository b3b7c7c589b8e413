"""LODGE's rule: Eq. 2 and Eq. 4 worked by hand."""

from itertools import pairwise

import numpy as np
import pytest

from training.lod.rule import NO_TABLES, facts_of, rules
from training.lod.rules.chunks import member_columns, members

CHUNKS = rules()["chunks"]
LEVELS = [(1, {"d_l": 20.0}), (2, {"d_l": 5.0}), (3, {"d_l": 0.0})]
AWAY = np.float32([0, 4.999, 5, 19.999, 20, 1e6])


def weights(number, levels=LEVELS, scale=1.0, focal_px=500.0):
    means = np.stack([AWAY + 1, 0 * AWAY, 0 * AWAY], axis=1)
    values = {"distance_scale": scale, "chunks": 1, "fade": 1}
    return CHUNKS.weights(
        means, np.array([1.0, 0, 0]), focal_px, {}, facts_of(CHUNKS, {}, levels, number), values
    ).tolist()


def test_each_distance_is_one_levels():
    assert weights(3) == [1, 1, 0, 0, 0, 0]
    assert weights(2) == [0, 0, 1, 1, 0, 0]
    assert weights(1) == [0, 0, 0, 0, 1, 1]


def test_what_lacks_its_neighbours_takes_over_their_distances():
    assert weights(2, LEVELS[1:]) == [0, 0, 1, 1, 1, 1]  # the coarsest that there is has no end
    assert weights(2, LEVELS[:2]) == [1, 1, 1, 1, 0, 0]  # the finest begins at the eye
    assert weights(1, [LEVELS[0], LEVELS[2]]) == [0, 0, 0, 0, 1, 1]
    assert weights(3, [LEVELS[0], LEVELS[2]]) == [1, 1, 1, 1, 0, 0]


def test_a_distance_scale_is_as_if_all_were_farther_away():
    assert weights(3, scale=0.1) == [1, 1, 1, 1, 1, 0]
    assert weights(1, scale=4.0) == [0, 0, 1, 1, 1, 1]
    eye = {"chunks": 0, "fade": 1}
    assert CHUNKS.coarser({"distance_scale": 2.0, **eye}, [1, 2, 3]) == {"distance_scale": 2.5, **eye}
    assert CHUNKS.coarser({"distance_scale": 90.0, **eye}, [1, 2, 3]) is None
    assert CHUNKS.coarser({"distance_scale": 1.0, "chunks": 1, "fade": 1}, [1, 2, 3]) == {
        "distance_scale": 1.0,
        **eye,
    }


def test_the_focal_length_does_not_count():
    assert weights(2, focal_px=50.0) == weights(2)
    assert CHUNKS.defaults([1, 2, 3]) == pytest.approx({"distance_scale": 1, "chunks": 1, "fade": 1})


TABLES = {"chunks": dict(zip("xyz", np.float32([[0, 10, 30], [0, 0, 0], [0, 0, 0]]), strict=True))}
TABLES["chunks"]["radius"] = np.float32([10, 10, 20])
SETS = np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1]], bool)
"""Which of four splats are in the set of which of three chunks."""


def chunk_weights(eye, tables=TABLES, **values):
    """Of the four splats, which stand in a row a hundred units away, as a middle level that is not shown
    there by distance."""
    means = np.float32([[0, 100, 0]] * 4)
    values = CHUNKS.defaults([1, 2, 3]) | values
    facts = facts_of(CHUNKS, {}, LEVELS, 2)
    columns = dict.fromkeys(CHUNKS.columns, np.zeros(4, np.float32)) | member_columns(SETS)
    return CHUNKS.weights(means, np.array(eye, float), 500.0, columns, facts, values, tables).tolist()


def test_two_nearest_chunks_fade_into_each_other():
    assert chunk_weights([0, 0, 0]) == [1, 1, 0, 0]
    assert chunk_weights([2.5, 0, 0]) == [0.75, 1, 0.25, 0]
    assert chunk_weights([2.5, 3, 0]) == [0.75, 1, 0.25, 0]  # the projection counts, not the distance
    assert chunk_weights([5, 0, 0]) == [0.5, 1, 0.5, 0]
    assert chunk_weights([-5, 0, 0]) == [1, 1, 0, 0]  # before the line: clipped
    assert chunk_weights([2.5, 0, 0], fade=0) == [1, 1, 0, 0]
    assert chunk_weights([7.5, 0, 0], fade=0) == [0, 1, 1, 0]


def test_without_chunks_the_eyes_own_distances_count():
    for found in (chunk_weights([0, 90, 0], chunks=0), chunk_weights([0, 90, 0], tables=NO_TABLES)):
        assert found == [1, 1, 1, 1]  # 10 away: the middle level's band
    empty = {"chunks": {name: column[:0] for name, column in TABLES["chunks"].items()}}
    assert chunk_weights([0, 90, 0], tables=empty) == [1, 1, 1, 1]


def test_beyond_a_chunks_radius_its_set_gives_way():
    assert chunk_weights([0, -10, 0]) == [1, 1, 0, 0]  # a hundred and ten from the splats: no middle level
    assert chunk_weights([0, -11.25, 0]) == [0.5, 0.5, 0, 0]
    assert chunk_weights([0, -12.5, 0]) == [0, 0, 0, 0]
    assert chunk_weights([0, 88, 0]) == [1, 1, 1, 1]
    assert chunk_weights([0, -10.1, 0], fade=0) == [0, 0, 0, 0]


def test_one_chunk_alone():
    one = {"chunks": {name: column[:1] for name, column in TABLES["chunks"].items()}}
    assert chunk_weights([5, 0, 0], tables=one) == [1, 1, 0, 0]
    assert chunk_weights([0, -11.25, 0], tables=one) == [0.5, 0.5, 0, 0]


def test_weights_do_not_jump_along_a_path():
    """The Lipschitz constant of Eq. 4 is one over the distance of two centres, here a tenth."""
    path = [chunk_weights([x, 1.0, 0]) for x in np.arange(-2, 35, 0.1)]
    assert max(np.abs(np.subtract(a, b)).max() for a, b in pairwise(path)) < 0.0101
    hard = [chunk_weights([x, 1.0, 0], fade=0) for x in np.arange(-2, 35, 0.1)]
    assert max(np.abs(np.subtract(a, b)).max() for a, b in pairwise(hard)) == 1


def test_a_third_chunk_takes_over_without_a_jump():
    """Centres at the corners of a rectangle: t is 0.3 to the right, 0.2 upwards and 0.274 to beyond."""
    corners = {"x": [0, 10, 0, 10], "y": [0, 0, 6, 6], "z": [0] * 4, "radius": [20] * 4}
    tables = {"chunks": {name: np.float32(column) for name, column in corners.items()}}

    def shares(x, y):
        return dict(CHUNKS.near_chunks(np.array([x, y, 0]), CHUNKS.defaults([1]), tables))

    s = 2 * (3 * 10 + 1.2 * 6) / 136 - 0.3
    assert shares(3.0, 1.2) == pytest.approx({0: 1 - (0.3 - s) / (1 - 2 * s), 1: (0.3 - s) / (1 - 2 * s)})
    across = [shares(3.0, y) for y in np.arange(0, 2.9, 0.02)]
    assert {chunk for found in across for chunk in found} == {0, 1, 2}
    for before, after in pairwise(across):
        assert all(abs(before.get(n, 0) - after.get(n, 0)) < 0.06 for n in range(4))


def test_what_a_region_loads_is_all_that_is_shown_in_it():
    columns = dict.fromkeys(CHUNKS.columns, np.zeros(4, np.float32)) | member_columns(SETS)
    values = CHUNKS.defaults([1, 2, 3])
    assert CHUNKS.region(np.zeros(3), values, TABLES) == (0,)
    assert CHUNKS.region(np.array([3.0, 0, 0]), values, TABLES) == (0, 1)
    assert CHUNKS.region(np.array([25.0, 0, 0]), values, TABLES) == (1, 2)
    assert CHUNKS.region(np.zeros(3), values | {"fade": 0}, TABLES) == (0,)
    assert CHUNKS.region(np.array([0, -11.0, 0]), values, TABLES) is None
    assert CHUNKS.region(np.zeros(3), values | {"chunks": 0}, TABLES) is None
    assert CHUNKS.loaded(columns, (0, 1)).tolist() == [True, True, True, False]


def test_the_bits_of_96_chunks_are_exact_in_single_precision():
    sets = np.random.default_rng(0).random((96, 50)) < 0.5
    columns = member_columns(sets)
    assert list(columns) == ["chunks_0", "chunks_1", "chunks_2", "chunks_3"]
    assert all(column.dtype == np.float32 for column in columns.values())
    for chunk, one in enumerate(sets):
        np.testing.assert_array_equal(members(columns, chunk), one)
    assert list(member_columns(sets[:24])) == ["chunks_0"]
    assert list(member_columns(sets[:25])) == ["chunks_0", "chunks_1"]
