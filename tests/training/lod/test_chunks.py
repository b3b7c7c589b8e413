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
    facts = collect_facts(CHUNKS, {}, LEVELS, 2)
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
    assert CHUNKS.visible_in_region(columns, (0, 1)).tolist() == [True, True, True, False]


def test_the_bits_of_96_chunks_are_exact_in_single_precision():
    sets = np.random.default_rng(0).random((96, 50)) < 0.5
    columns = member_columns(sets)
    assert list(columns) == ["chunks_0", "chunks_1", "chunks_2", "chunks_3"]
    assert all(column.dtype == np.float32 for column in columns.values())
    for chunk, one in enumerate(sets):
        np.testing.assert_array_equal(in_chunk(columns, chunk), one)
    assert list(member_columns(sets[:24])) == ["chunks_0"]
    assert list(member_columns(sets[:25])) == ["chunks_0", "chunks_1"]


def test_where_an_eye_is_in_words():
    def said(eye, tables=TABLES, **values):
        return CHUNKS.region_label(np.array(eye, float), CHUNKS.defaults([1]) | values, tables)

    assert said([2.5, 0, 0]) == "Chunks 0 and 1, 25 %"
    assert said([26.0, 0, 0]) == "Chunks 2 and 1, 15 %"  # the nearest first; t is 0.2, t' 2 / 15
    assert said([-3.0, 0, 0]) == said([2.5, 0, 0], fade=0) == "Chunk 0"
    assert said([0, -11.25, 0]) == "Chunk 0, 50 % outside"
    assert said([0, -50.0, 0]) == "Outside the chunks"
    assert said([2.5, 0, 0], NO_TABLES) == said([2.5, 0, 0], chunks=0) == ""


def test_controls_that_change_nothing_say_why():
    """And they do change nothing: weights stay whatever their values."""
    for eye in ([2.5, 3, 0], [0, -11.25, 0], [0, 88, 0]):
        for tables in (TABLES, NO_TABLES):
            for chunks in (0, 1):
                values = CHUNKS.defaults([1]) | {"chunks": chunks}
                idle = CHUNKS.inactive_controls(np.array(eye, float), values, tables)
                before = chunk_weights(eye, tables, **values)
                for name in idle:
                    for other in (0.02, 9.0) if name == "distance_scale" else (0, 1):
                        assert chunk_weights(eye, tables, **values | {name: other}) == before
                assert ("distance_scale" in idle) == (tables is TABLES and chunks == 1 and eye[1] == 3)
                assert ("fade" in idle) == (tables is NO_TABLES or chunks == 0)
                assert ("chunks" in idle) == (tables is NO_TABLES)


def test_places_belong_to_the_nearest_chunk():
    means = np.random.default_rng(0).normal(10, 15, (40_000, 3)).astype(np.float32)
    centres = np.stack([TABLES["chunks"][axis] for axis in "xyz"], axis=1)
    nearest = np.linalg.norm(means[:, None] - centres, axis=2).argmin(axis=1)
    assert (CHUNKS.parts(means, TABLES) == nearest + 1).mean() > 0.9999  # halfway, a bit decides
    assert not CHUNKS.parts(means, NO_TABLES).any()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda table: table.pop("radius"), "its table 'chunks' has no radius"),
        (lambda table: table.update(y=np.float32([0, np.nan, 0])), "out of range"),
        (lambda table: table.update({name: np.zeros(97) for name in table}), "97 chunks, of at most 96"),
    ],
)
def test_a_table_of_no_chunks_is_refused(change, says):
    table = dict(TABLES["chunks"])
    levels = [Level(number, NO_SPLATS, facts) for number, facts in LEVELS]
    bundle = Bundle("lodge", levels, "chunks", tables={"chunks": table})
    assert check_rule(bundle) is CHUNKS
    change(table)
    with pytest.raises(LodgsError, match=says):
        check_rule(bundle)
    bundle.tables = {"chunks": {}}
    assert check_rule(bundle) is CHUNKS
