"""Tests of the cache of cuts."""

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.optimize.out_of_core.cut_cache import INDEX_BYTES, SLOT_BYTES, CutCache
from training.optimize.out_of_core.row_file import TABLE_BYTES, RowFile, RowLayout

LAYOUT = RowLayout({"values": (4,)})
GROUPS, SIZE = 20, 30
"""Group g has the rows from SIZE * g. Cuts are prefixes, longer for shorter distances."""
BLOCK = 7
ROW, TABLE = (
    4 * LAYOUT.width + SLOT_BYTES,
    INDEX_BYTES * GROUPS * SIZE + TABLE_BYTES * -(-GROUPS * SIZE // BLOCK),
)


def fill(rows):
    values = np.random.default_rng(0).random((GROUPS * SIZE, 4), np.float32)
    rows.append(torch.from_numpy(values))
    return rows, values


def cut_for(groups: np.ndarray, distances: np.ndarray):
    """Return a function that cuts prefixes, as in a sequential point tree, and its requested groups."""
    requested = []

    def cut(missing: np.ndarray):
        requested.extend(groups[missing].tolist())
        counts = np.clip(SIZE / distances[missing], 1, SIZE).astype(int)
        parts = [SIZE * g + np.arange(n) for g, n in zip(groups[missing].tolist(), counts, strict=True)]
        return np.concatenate(parts), counts

    return cut, requested


@pytest.fixture
def stored(tmp_path):
    return fill(RowFile(tmp_path, LAYOUT, block=BLOCK))


@pytest.mark.parametrize("room", [140, 200, 1000])
def test_acquire_returns_the_latest_records(stored, room):
    """Compare with an array over random views. Rows are in the order of the cuts."""
    rows, truth = stored
    cache = CutCache(rows, GROUPS, room * ROW + TABLE, flush_interval=17)
    assert cache.capacity == min(room, GROUPS * SIZE)
    rng, peak = np.random.default_rng(1), 0
    cuts: dict[int, tuple[float, int]] = {}
    for step in range(150):
        groups = rng.permutation(GROUPS)[: rng.integers(1, 5)]
        distances = rng.uniform(1, 8, len(groups))
        cut, requested = cut_for(groups, distances)
        slots = cache.acquire(groups, distances, cut)
        expected = []
        for group, distance in zip(groups.tolist(), distances, strict=True):
            if group in cuts and 0.77 * cuts[group][0] <= distance <= 2 * cuts[group][0]:
                if room == 1000:
                    assert group not in requested
            elif room == 1000:
                assert group in requested
            if group in requested:
                cuts[group] = distance, int(np.clip(SIZE / distance, 1, SIZE))
            expected.append(SIZE * group + np.arange(cuts[group][1]))
        expected = np.concatenate(expected)
        np.testing.assert_array_equal(cache.rows_at(slots), expected)
        records = cache.get(slots)
        np.testing.assert_array_equal(records, truth[expected])
        changes = rng.random(len(slots)) < 0.7
        changed = records[torch.from_numpy(changes)] + 1
        cache.put(slots[changes], changed)
        truth[expected[changes]] = changed
        cache.end_step(step)
        if step % 17 == 16:
            cuts.clear()
            assert not cache._cuts
        peak = max(peak, len(cache))
        assert len(cache) <= room
        assert sum(len(cut) for cut in cache._cuts.values()) == cache._cut_rows <= len(cache)
    assert peak > min(room, 250) * 0.7
    assert cache.loaded > GROUPS * SIZE if room < 1000 else cache.loaded <= GROUPS * SIZE
    cache.evict_all()
    np.testing.assert_array_equal(rows.read(np.arange(GROUPS * SIZE)), truth)


def test_least_recently_used_cuts_are_released_first(stored):
    rows, _ = stored
    cache = CutCache(rows, GROUPS, 5 * SIZE * ROW + TABLE, keep_share=1.0)

    def acquire(*groups: int) -> list[int]:
        index = np.array(groups)
        cut, requested = cut_for(index, np.ones(len(index)))
        cache.acquire(index, np.ones(len(index)), cut)
        return requested

    for group in range(5):
        assert acquire(group) == [group]
    assert acquire(0) == []
    assert acquire(7) == [7]  # releases 1
    assert acquire(0, 2, 3, 4, 7) == []
    assert acquire(1) == [1]  # all were used in the same step: releases the first
    assert acquire(2, 3, 4, 7, 1) == []
    with pytest.raises(LodgsError, match=r"needs 180 splats, .* holds 150"):
        acquire(0, 1, 2, 3, 4, 5)
    assert acquire(2, 3, 4, 7, 1) == [], "a rejected request changes nothing"
    cache = CutCache(rows, GROUPS, 5 * SIZE * ROW + TABLE, keep_share=0.5)
    for group in range(6):
        acquire(group)
    assert cache._cut_rows == 2 * SIZE < len(cache)


def test_cut_at_another_distance_loads_only_new_rows(stored):
    rows, truth = stored
    cache = CutCache(rows, GROUPS, 300 * ROW + TABLE)
    group = np.array([3])

    def acquire(distance: float) -> tuple[np.ndarray, bool]:
        cut, requested = cut_for(group, np.array([distance]))
        return cache.acquire(group, np.array([distance]), cut), bool(requested)

    slots, _ = acquire(4.0)
    assert len(slots) == 7 and cache.loaded == 7
    cache.put(slots, cache.get(slots) * 2)
    for distance, recut in ((4.0, False), (8.0, False), (3.09, False), (3.0, True)):
        assert acquire(distance)[1] is recut
    assert len(cache) == 10 and cache.loaded == 10, "the seven changed rows stayed"
    slots, _ = acquire(20.0)
    assert len(slots) == 1 and len(cache) == 10, "rows without a cut stay cached"
    np.testing.assert_array_equal(cache.get(slots), 2 * truth[90:91])
    cache.release_cuts()
    slots, recut = acquire(4.0)
    assert recut and cache.loaded == 10
    np.testing.assert_array_equal(cache.get(slots), 2 * truth[90:97])
    cache.write_back()
    np.testing.assert_array_equal(rows.read(SIZE * 3 + np.arange(7)), 2 * truth[90:97])


def test_duplicate_rows_are_rejected(stored):
    rows, _ = stored
    cache = CutCache(rows, GROUPS, 300 * ROW + TABLE)
    groups = np.array([0, 1])
    invalid = [([1, 2, 3, 3], [2, 2]), ([1, 2, 1], [2, 1])]
    for chosen, counts in invalid:
        with pytest.raises(ValueError, match="duplicate row"):
            cache.acquire(groups, np.ones(2), lambda _, c=chosen, n=counts: (np.array(c), np.array(n)))
    cache = CutCache(rows, GROUPS, 300 * ROW + TABLE)
    cache.acquire(groups[:1], np.ones(1), lambda _: (np.array([5, 6]), np.array([2])))
    with pytest.raises(ValueError, match="duplicate row"):
        cache.acquire(groups[1:], np.ones(1), lambda _: (np.array([6]), np.array([1])))
    assert len(cache.acquire(groups[:0], np.ones(0), lambda _: (np.array([6]), np.array([1])))) == 0


def test_resumed_run_is_bit_identical(tmp_path):
    """Steps depend on the cached cuts, so the checkpoint includes them."""

    def steps(cache: CutCache, first: int, last: int) -> list[np.ndarray]:
        results = []
        for step in range(first, last):
            rng = np.random.default_rng(step)
            groups = rng.permutation(GROUPS)[:3]
            distances = rng.uniform(1, 6, 3)
            slots = cache.acquire(groups, distances, cut_for(groups, distances)[0])
            results.append(cache.get(slots).numpy().copy())
            cache.put(slots, cache.get(slots) * 1.1 + step)
            cache.end_step(step)
        return results

    def fresh(name: str) -> CutCache:
        (tmp_path / name).mkdir(exist_ok=True)
        rows, _ = fill(RowFile(tmp_path / name, LAYOUT, block=BLOCK))
        return CutCache(rows, GROUPS, 130 * ROW + TABLE, flush_interval=40)

    truth = steps(fresh("whole"), 0, 60)
    cache = fresh("parts")
    results = steps(cache, 0, 23)
    state = cache.state_dict()
    steps(cache, 23, 31)  # not saved, lost
    cache.rows.close()
    cache = fresh("parts")
    cache.load_state_dict(state)
    results += steps(cache, 23, 60)
    assert all(np.array_equal(a, b) for a, b in zip(truth, results, strict=True))
    small = CutCache(fill(RowFile(tmp_path, LAYOUT, block=BLOCK))[0], GROUPS, 5 * ROW)
    state["rows"] = small.rows.state_dict()
    small.load_state_dict(state)  # too small for the saved cuts
    assert not len(small)
    with pytest.raises(LodgsError, match="at least 1 MB"):
        steps(small, 23, 24)


def test_all_cuts_are_computed_again_if_finer_ones_do_not_fit(stored):
    rows, _ = stored
    cache = CutCache(rows, GROUPS, 80 * ROW + TABLE)
    for distance, count in ((1.0, 60), (1.9, 60), (1.9, 75)):
        groups = np.arange(2 if count == 60 else 5)
        distances = np.full(len(groups), distance)
        slots = cache.acquire(groups, distances, cut_for(groups, distances)[0])
        assert len(slots) == count  # 30 per group at 1, 15 per group at 1.9
