"""Groups of rows in fast memory: what is read was written last, and who was used least goes."""

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.optimize.out_of_core.cut_cache import INDEX_BYTES, SLOT_BYTES, CutCache
from training.optimize.out_of_core.row_file import TABLE_BYTES, RowFile, RowLayout

LAYOUT = RowLayout({"values": (4,)})
GROUPS, SIZE = 20, 30
"""Group g is the rows from SIZE * g; those of a cut are the first few, more for nearer ones."""
BLOCK = 7
ROW, TABLE = (
    4 * LAYOUT.width + SLOT_BYTES,
    INDEX_BYTES * GROUPS * SIZE + TABLE_BYTES * -(-GROUPS * SIZE // BLOCK),
)


def filled(rows):
    values = np.random.default_rng(0).random((GROUPS * SIZE, 4), np.float32)
    rows.append(torch.from_numpy(values))
    return rows, values


def cut_for(groups: np.ndarray, distances: np.ndarray):
    """As a binary search in a sequential point tree gives it: a prefix."""
    asked = []

    def cut(anew: np.ndarray):
        asked.extend(groups[anew].tolist())
        counts = np.clip(SIZE / distances[anew], 1, SIZE).astype(int)
        parts = [SIZE * g + np.arange(n) for g, n in zip(groups[anew].tolist(), counts, strict=True)]
        return np.concatenate(parts), counts

    return cut, asked


@pytest.fixture
def made(tmp_path):
    return filled(RowFile(tmp_path, LAYOUT, block=BLOCK))


@pytest.mark.parametrize("room", [140, 200, 1000])
def test_what_is_taken_is_what_was_put_last(made, room):
    """Against an array, over random views; the rows of each group in its cut's order."""
    rows, truth = made
    cache = CutCache(rows, GROUPS, room * ROW + TABLE, flush_interval=17)
    assert cache.capacity == min(room, GROUPS * SIZE)
    rng, most = np.random.default_rng(1), 0
    here: dict[int, tuple[float, int]] = {}
    for step in range(150):
        groups = rng.permutation(GROUPS)[: rng.integers(1, 5)]
        distances = rng.uniform(1, 8, len(groups))
        cut, asked = cut_for(groups, distances)
        places = cache.acquire(groups, distances, cut)
        expected = []
        for group, distance in zip(groups.tolist(), distances, strict=True):
            if group in here and 0.77 * here[group][0] <= distance <= 2 * here[group][0]:
                if room == 1000:
                    assert group not in asked
            elif room == 1000:
                assert group in asked
            if group in asked:
                here[group] = distance, int(np.clip(SIZE / distance, 1, SIZE))
            expected.append(SIZE * group + np.arange(here[group][1]))
        expected = np.concatenate(expected)
        np.testing.assert_array_equal(cache.rows_at(places), expected)
        records = cache.get(places)
        np.testing.assert_array_equal(records, truth[expected])
        some = rng.random(len(places)) < 0.7
        changed = records[torch.from_numpy(some)] + 1
        cache.put(places[some], changed)
        truth[expected[some]] = changed
        cache.end_step(step)
        if step % 17 == 16:
            here.clear()
            assert not cache._places
        most = max(most, len(cache))
        assert len(cache) <= room
        assert sum(len(each) for each in cache._places.values()) == cache._held <= len(cache)
    assert most > min(room, 250) * 0.7
    assert cache.loaded > GROUPS * SIZE if room < 1000 else cache.loaded <= GROUPS * SIZE
    cache.evict_all()
    np.testing.assert_array_equal(rows.read(np.arange(GROUPS * SIZE)), truth)


def test_the_least_recently_used_go_first_and_only_as_many_as_need_be(made):
    rows, _ = made
    cache = CutCache(rows, GROUPS, 5 * SIZE * ROW + TABLE, reduced=1.0)

    def take(*groups: int) -> list[int]:
        some = np.array(groups)
        cut, asked = cut_for(some, np.ones(len(some)))
        cache.acquire(some, np.ones(len(some)), cut)
        return asked

    for group in range(5):
        assert take(group) == [group]
    assert take(0) == []
    assert take(7) == [7]  # 1 goes
    assert take(0, 2, 3, 4, 7) == []
    assert take(1) == [1]  # all were used at once: the first goes
    assert take(2, 3, 4, 7, 1) == []
    with pytest.raises(LodgsError, match=r"needs 180 splats at once; .* room for 150"):
        take(0, 1, 2, 3, 4, 5)
    assert take(2, 3, 4, 7, 1) == [], "what is refused changes nothing"
    cache = CutCache(rows, GROUPS, 5 * SIZE * ROW + TABLE, reduced=0.5)
    for group in range(6):
        take(group)
    assert cache._held == 2 * SIZE < len(cache)


def test_a_cut_for_another_distance_brings_only_what_is_new(made):
    rows, truth = made
    cache = CutCache(rows, GROUPS, 300 * ROW + TABLE)
    one = np.array([3])

    def take(distance: float) -> tuple[np.ndarray, bool]:
        cut, asked = cut_for(one, np.array([distance]))
        return cache.acquire(one, np.array([distance]), cut), bool(asked)

    places, _ = take(4.0)
    assert len(places) == 7 and cache.loaded == 7
    cache.put(places, cache.get(places) * 2)
    for distance, again in ((4.0, False), (8.0, False), (3.09, False), (3.0, True)):
        assert take(distance)[1] is again
    assert len(cache) == 10 and cache.loaded == 10, "the seven stayed, changed as they are"
    places, _ = take(20.0)
    assert len(places) == 1 and len(cache) == 10, "what has left stays while there is room"
    np.testing.assert_array_equal(cache.get(places), 2 * truth[90:91])
    cache.release_cuts()
    places, again = take(4.0)
    assert again and cache.loaded == 10
    np.testing.assert_array_equal(cache.get(places), 2 * truth[90:97])
    cache.write_back()
    np.testing.assert_array_equal(rows.read(SIZE * 3 + np.arange(7)), 2 * truth[90:97])


def test_groups_share_no_rows(made):
    rows, _ = made
    cache = CutCache(rows, GROUPS, 300 * ROW + TABLE)
    two = np.array([0, 1])
    wrong = [([1, 2, 3, 3], [2, 2]), ([1, 2, 1], [2, 1])]
    for chosen, counts in wrong:
        with pytest.raises(ValueError, match="two groups, or in one twice"):
            cache.acquire(two, np.ones(2), lambda _, c=chosen, n=counts: (np.array(c), np.array(n)))
    cache = CutCache(rows, GROUPS, 300 * ROW + TABLE)
    cache.acquire(two[:1], np.ones(1), lambda _: (np.array([5, 6]), np.array([2])))
    with pytest.raises(ValueError, match="two groups"):
        cache.acquire(two[1:], np.ones(1), lambda _: (np.array([6]), np.array([1])))
    assert len(cache.acquire(two[:0], np.ones(0), lambda _: (np.array([6]), np.array([1])))) == 0


def test_a_resumed_run_has_the_same_bits(tmp_path):
    """What a step sees depends on what is here: that is told, too."""

    def steps(cache: CutCache, first: int, last: int) -> list[np.ndarray]:
        seen = []
        for step in range(first, last):
            rng = np.random.default_rng(step)
            groups = rng.permutation(GROUPS)[:3]
            distances = rng.uniform(1, 6, 3)
            places = cache.acquire(groups, distances, cut_for(groups, distances)[0])
            seen.append(cache.get(places).numpy().copy())
            cache.put(places, cache.get(places) * 1.1 + step)
            cache.end_step(step)
        return seen

    def fresh(name: str) -> CutCache:
        (tmp_path / name).mkdir(exist_ok=True)
        rows, _ = filled(RowFile(tmp_path / name, LAYOUT, block=BLOCK))
        return CutCache(rows, GROUPS, 130 * ROW + TABLE, flush_interval=40)

    truth = steps(fresh("whole"), 0, 60)
    cache = fresh("parts")
    seen = steps(cache, 0, 23)
    state = cache.state_dict()
    steps(cache, 23, 31)  # what was not saved and is lost
    cache.rows.close()  # pyright: ignore
    cache = fresh("parts")
    cache.load_state_dict(state)
    seen += steps(cache, 23, 60)
    assert all(np.array_equal(a, b) for a, b in zip(truth, seen, strict=True))
    small = CutCache(filled(RowFile(tmp_path, LAYOUT, block=BLOCK))[0], GROUPS, 5 * ROW)
    state["rows"] = small.rows.state_dict()
    small.load_state_dict(state)  # in which there is no room for what was here
    assert not len(small)
    with pytest.raises(LodgsError, match="at least 1 MB"):
        steps(small, 23, 24)


def test_where_finer_cuts_have_no_room_all_are_made_anew(made):
    rows, _ = made
    cache = CutCache(rows, GROUPS, 80 * ROW + TABLE)
    for distance, most in ((1.0, 60), (1.9, 60), (1.9, 75)):
        groups = np.arange(2 if most == 60 else 5)
        distances = np.full(len(groups), distance)
        places = cache.acquire(groups, distances, cut_for(groups, distances)[0])
        assert len(places) == most  # of 30 each at 1, of 15 each at 1.9
