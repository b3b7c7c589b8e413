"""Of a tree in a file what fits into a budget: complete cuts at any time, and the whole's where it fits."""

import time
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from tests.training.lod.tree.trees import random_leaves, tree_of
from training.errors import LodgsError
from training.lod import query as by_values
from training.lod.blocks import SIZE
from training.lod.partial_read import BLOCKS
from training.lod.rule import rules
from training.lod.rules.cut import ABOVE_ROOT
from training.lod.selection import BundleSelector, select
from training.lod.tree import paging
from training.lod.tree.pages import page_table, streaming_order
from training.lod.tree.paging import Pager, TreeFile, read_budgeted
from training.lod.tree.resident import ResidentTree
from training.scenes.cameras import Camera, look_at
from training.splats.bundle import read_bundle, write_bundle
from training.splats.levels import Bundle, Level

CUT = rules()["cut"]
FOCAL = 1000.0
LEAVES = 30_000


class Truth:
    """A whole tree: its nodes by their places, which none shares, and which is above which."""

    def __init__(self, bundle):
        self.bundle, self.choice = bundle, BundleSelector(bundle)
        splats = self.choice.splats
        self.node_at = {mean.tobytes(): node for node, mean in enumerate(splats.means)}
        assert len(self.node_at) == len(splats)
        parents = np.stack([splats.extras[f"parent_{axis}"] for axis in "xyz"], 1)
        root = splats.extras["parent_size"] == np.float32(ABOVE_ROOT)
        self.parents = np.array(
            [-1 if r else self.node_at[p.tobytes()] for p, r in zip(parents, root, strict=True)]
        )
        self.leaves = np.arange(len(bundle.levels[0].splats), len(splats))

    def cut(self, eye, pixels):
        return np.flatnonzero(self.choice.weights(np.float32(eye), FOCAL, {"pixels": pixels}))

    def nodes(self, means):
        return np.array([self.node_at[mean.tobytes()] for mean in means], int)

    def require_complete(self, drawn):
        """Of every leaf and the nodes above it exactly one is drawn."""
        assert len(set(drawn.tolist())) == len(drawn)
        there = np.zeros(len(self.parents) + 1, int)
        there[drawn] = 1
        above, found = self.leaves.copy(), np.zeros(len(self.leaves), int)
        while (above >= 0).any():
            found += there[above]
            above = np.where(above >= 0, self.parents[above], -1)
        assert (found == 1).all()


@pytest.fixture(scope="module")
def truth():
    return Truth(tree_of(random_leaves(LEAVES, np.random.default_rng(1), degree=1)))


@pytest.fixture(params=["by octaves", "by size", "with a table"])
def path(request, truth, tmp_path):
    bundle, tables = truth.bundle, {}
    if request.param != "by size":
        ordered = [level.splats.select(streaming_order(level.splats.extras)) for level in bundle.levels]
        bundle = replace(bundle, levels=[Level(1, ordered[0]), Level(2, ordered[1])])
    if request.param == "with a table":
        tables = {BLOCKS: page_table({level.number: level.splats.extras for level in bundle.levels})}
    file = tmp_path / f"{request.param}.ply"
    write_bundle(file, replace(bundle, tables=tables))
    return file


class Memory:
    """Takes over what comes."""

    def __init__(self, pager):
        self.means = np.zeros((pager.rows, 3), np.float32)
        self.columns = {name: np.zeros(pager.rows, np.float32) for name in CUT.columns}

    def take(self, update):
        for begin, splats in update.pages:
            rows = slice(begin, begin + len(splats))
            self.means[rows] = splats.means
            for name in CUT.columns[2:]:
                self.columns[name][rows] = splats.extras[name]
        self.columns["node_size"], self.columns["parent_size"] = update.sizes

    def shown(self, eye, pixels):
        """The means of what an eye is shown."""
        weights = CUT.weights(self.means, np.float32(eye), FOCAL, self.columns, {}, {"pixels": pixels})
        return self.means[weights > 0]


def come_in(pager, memory, eye, pixels):
    """All that an eye needs comes in, update by update."""
    while (update := pager.step(np.array(eye), max(FOCAL / pixels, 32))) is not None:
        memory.take(update)
        yield


EYES = [(0, 0, 3), (0.5, 0.2, 2), (-8, 8, 1), (7, -7, 0.5), (7, -6, 0.2), (60, 0, 20), (0, 0, 3)]


def test_with_room_for_all_it_is_the_whole_files_cut(truth, path):
    pager = Pager(path, 10**6)
    memory = Memory(pager)
    for eye in EYES:
        for pixels in (1.0, 4.0, 30.0):
            list(come_in(pager, memory, eye, pixels))
            drawn = truth.nodes(memory.shown(eye, pixels))
            np.testing.assert_array_equal(np.sort(drawn), truth.cut(eye, pixels))


@pytest.mark.parametrize("budget", [SIZE, 5000, 20_000])
def test_within_a_budget_cuts_are_complete_whatever_is_there(truth, path, budget, monkeypatch):
    """Also while pages come in, and from an eye that they are not for."""
    monkeypatch.setattr(paging, "PAGES_PER_UPDATE", 3)
    pager, equal = Pager(path, budget), 0
    memory = Memory(pager)
    assert pager.rows <= budget
    memory.take(pager.step(None, 0.0))  # nothing is there before
    for eye in EYES:
        for pixels in (30.0, 3.0):
            for number, _ in enumerate(come_in(pager, memory, eye, pixels)):
                assert pager.splats <= budget
                if number % 5 == 0:
                    for other in (eye, (3, 3, 1)):
                        truth.require_complete(truth.nodes(memory.shown(other, pixels)))
            drawn = truth.nodes(memory.shown(eye, pixels))
            truth.require_complete(drawn)
            needed = np.flatnonzero(pager._index.detail(np.array(eye)) < FOCAL / pixels * 1.001)
            if len(needed) <= budget // SIZE:
                equal += 1
                np.testing.assert_array_equal(np.sort(drawn), truth.cut(eye, pixels))
    assert equal or budget < 20_000 or path.stem == "by size"  # where pages are wide


def test_coarse_pages_come_first_and_those_of_no_use_for_longest_go_first(path):
    file = TreeFile(path)
    order = file.index().order(np.array([7, -7, 0.5]), 1000.0)
    sizes, place = file.index().parent_size[order], np.arange(len(order))
    assert np.corrcoef(np.log(np.minimum(sizes, 100)), place)[0, 1] < -0.5
    pager = Pager(path, 12 * SIZE)
    a, b, c = ((0, 0, 40), 300.0), ((9, 9, 1), 60.0), ((-9, -9, 1), 60.0)
    there = []
    for eye, pixels in (a, b, c, a, b):
        list(come_in(pager, Memory(pager), eye, pixels))
        there.append(set(np.flatnonzero(pager._slot_of >= 0)))
        assert len(there[-1]) <= 12 and pager.splats <= 12 * SIZE
        needed = pager.file.index().detail(np.array(eye)) < max(FOCAL / pixels, 32) * (1 + paging.ROUNDING)
        assert pager.short == (needed.sum() > 12)
    assert there[0] <= there[1]  # there was room


def test_a_thread_brings_in_what_is_asked_for(truth, path):
    pager = Pager(path, 10**6)
    memory, taken = Memory(pager), 0
    pager.start()
    try:
        for eye in EYES[:4]:
            pager.ask(np.array(eye), FOCAL)
            wanted, until = truth.cut(eye, 1.0), time.monotonic() + 60
            while not pager.idle and time.monotonic() < until:
                if (update := pager.take()) is not None:
                    memory.take(update)
                    taken += 1
                    truth.require_complete(truth.nodes(memory.shown(eye, 1.0)))
                time.sleep(0.01)
            np.testing.assert_array_equal(np.sort(truth.nodes(memory.shown(eye, 1.0))), wanted)
            assert taken == pager.arrived
    finally:
        pager.stop()
    assert not pager.problem


def test_a_thread_that_fails_says_why(path, monkeypatch):
    pager = Pager(path, 5000)
    monkeypatch.setattr(pager.file, "read", lambda pages: (_ for _ in ()).throw(OSError("the disk is gone")))
    pager.start()
    pager._thread.join(10)
    assert pager.problem == "the disk is gone"
    pager.stop()


@pytest.mark.parametrize("budget", [SIZE, 5000, 10**6])
def test_the_top_of_a_tree_is_a_smaller_tree(truth, path, budget, tmp_path):
    bundle, total = read_budgeted(path, budget)
    assert total == 2 * LEAVES - 1
    assert 0 < sum(len(level.splats) for level in bundle.levels) <= budget
    write_bundle(tmp_path / "small.ply", bundle)
    choice = BundleSelector(read_bundle(tmp_path / "small.ply"))
    for eye in EYES:
        for pixels in (1.0, 30.0):
            some = choice.weights(np.float32(eye), FOCAL, {"pixels": pixels}) > 0
            drawn = truth.nodes(choice.splats.means[some])
            truth.require_complete(drawn)
            if budget == 10**6:
                np.testing.assert_array_equal(np.sort(drawn), truth.cut(eye, pixels))
    finest = bundle.levels[-1].splats
    truth.require_complete(truth.nodes(finest.means))
    assert not finest.extras["node_size"].any() and set(finest.extras) == set(CUT.columns)


def test_what_one_eye_needs_is_read_for_it(truth, path):
    for eye in EYES[-2:]:
        k = FOCAL / 20
        part, _ = read_budgeted(path, 10**6, np.array(eye), k)
        assert sum(len(level.splats) for level in part.levels) < 1.8 * LEAVES
        splats, _ = select(part, np.array(eye), FOCAL, {"pixels": 20.0})
        np.testing.assert_array_equal(np.sort(truth.nodes(splats.means)), truth.cut(eye, 20.0))


def test_nodes_stand_for_what_is_missing():
    """Worked by hand: 0 above 1 and 2, 1 above 3 and 4, 3 above 5 and 6; and one that nothing leads to."""
    x = np.arange(8, dtype=np.float32)
    sizes = np.float32([8, 4, 0, 2, 0, 0, 0, 0])
    parents = np.array([-1, 0, 0, 1, 1, 3, 3, 3])
    columns = {
        "x": x, "y": 0 * x, "z": 0 * x, "node_size": sizes, "parent_x": x[parents],
        "parent_y": 0 * x, "parent_z": -0.0 * x, "parent_size": sizes[parents],
    }  # fmt: skip
    columns["parent_size"][0] = ABOVE_ROOT

    def found(*rows):
        here = ResidentTree({name: column[list(rows)] for name, column in columns.items()})
        return [np.array(rows)[each].tolist() for each in here.update(np.arange(len(rows)))]

    assert found(0, 1, 2, 3, 4, 5, 6) == [[0, 1, 3], [0, 1, 2, 3, 4, 5, 6]]
    assert found(6, 5, 4, 3, 2, 1, 0) == [[3, 1, 0], [6, 5, 4, 3, 2, 1, 0]]
    assert found(0, 1, 2, 3, 4, 5) == [[0, 1], [0, 1, 2, 3, 4]]
    assert found(0, 1, 3, 4, 5, 6) == [[1, 3], [0]]
    assert found(0, 1, 2, 3, 5, 6) == [[0, 3], [0, 1, 2]]
    assert found(1, 2, 3, 4, 5, 6) == [[1, 3], []]
    assert found(5, 6) == [[], []]
    assert found(0) == [[], [0]]
    assert found(0, 1, 2, 3, 4, 5, 6, 7) == [[0, 1], [0, 1, 2, 3, 4]]  # three children are none


def test_what_stands_follows_whatever_comes_and_goes(truth):
    """Against what walking up from each splat finds, whichever some places hold at a time."""
    rng, splats = np.random.default_rng(3), truth.choice.splats
    top = np.argsort(-splats.extras["parent_size"], kind="stable")[:600]  # of several ways few go far down
    whole = splats.extras | dict(zip("xyz", splats.means.T, strict=True))
    columns = {name: np.zeros(len(top), np.float32) for name in (*CUT.columns, *"xyz")}
    holds, here, most = np.full(len(top), -1), ResidentTree(columns), 0
    for _ in range(60):
        places = rng.permutation(len(top))[: rng.integers(1, 200)]
        free = np.setdiff1d(top, np.delete(holds, places))
        holds[places] = -1
        come = rng.permutation(free)[: len(places) - rng.integers(min(len(places), 9))]
        holds[places[: len(come)]] = come
        for name, column in columns.items():
            column[places] = 0
            column[places[: len(come)]] = whole[name][come]
        there = {node: place for place, node in enumerate(holds.tolist()) if node >= 0}
        children = Counter(truth.parents[node] for node in there)
        inner, reached = np.zeros((2, len(top)), bool)
        for node, place in there.items():
            inner[place] = children[node] == 2
            above = truth.parents[node]
            while above >= 0 and above in there and children[above] == 2:
                above = truth.parents[above]
            reached[place] = above < 0
        found = here.update(places)
        np.testing.assert_array_equal(found[0], inner)
        np.testing.assert_array_equal(found[1], reached)
        most = max(most, int(reached.sum()))
    assert most > 20, "nothing was ever complete"


def test_a_table_of_pages_is_what_reading_finds(truth, tmp_path):
    bundle = truth.bundle
    table = page_table({level.number: level.splats.extras for level in bundle.levels})
    write_bundle(tmp_path / "a.ply", bundle)
    write_bundle(tmp_path / "b.ply", replace(bundle, tables={BLOCKS: table}))
    one, other = (TreeFile(tmp_path / name).index() for name in ("a.ply", "b.ply"))
    for name in ("low", "high", "parent_size"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    means = truth.choice.splats.means[truth.parents]
    first = means[:SIZE][truth.parents[:SIZE] >= 0]
    assert (one.low[0] <= first.min(axis=0)).all() and (one.high[0] >= first.max(axis=0)).all()


def test_splats_that_cannot_be_drawn_leave_no_holes(truth, tmp_path):
    """Their parents stand for them and for their siblings."""
    above, leaves = (level.splats.select(slice(None)) for level in truth.bundle.levels)
    means = leaves.means.copy()
    means[5], means[7000] = np.nan, np.inf
    leaves = replace(leaves, means=means)
    write_bundle(tmp_path / "tree.ply", replace(truth.bundle, levels=[Level(1, above), Level(2, leaves)]))
    pager = Pager(tmp_path / "tree.ply", 10**6)
    memory = Memory(pager)
    list(come_in(pager, memory, (0, 0, 3), 1.0))
    truth.require_complete(truth.nodes(memory.shown((0, 0, 3), 1.0)))


def test_what_is_no_tree_or_has_no_room_is_a_sentence(truth, tmp_path):
    leaves = truth.bundle.levels[1].splats
    write_bundle(tmp_path / "a.ply", Bundle("flod", [Level(1, leaves, {"s_min": 0.0})], "bands"))
    write_bundle(tmp_path / "b.ply", truth.bundle)
    for read in (TreeFile, lambda path: read_budgeted(path, 10**5), lambda path: Pager(path, 10**5)):
        with pytest.raises(LodgsError, match="is no tree of splats"):
            read(tmp_path / "a.ply")
    for read, budget in ((read_budgeted, 0), (Pager, 300)):
        with pytest.raises(LodgsError, match=f"{budget} splats are too few"):
            read(tmp_path / "b.ply", budget)
    bundle, _ = read_budgeted(tmp_path / "b.ply", 1)
    assert [len(level.splats) for level in bundle.levels] == [0, 1]


@pytest.mark.parametrize("pixels", [1.0, 6.0, 30.0])
def test_the_cut_of_a_file_is_read_from_it(truth, path, pixels):
    """All of it; for a camera at least what it sees, and hardly more."""
    file, shares = TreeFile(path), []
    for eye in EYES:
        choice = by_values.LodQuery("cut", eye, FOCAL, (), (("pixels", pixels),))
        found = file.cut(choice)
        wanted = truth.cut(eye, pixels)
        drawn = truth.nodes(np.concatenate([splats.means for splats in found.values()]))
        np.testing.assert_array_equal(np.sort(drawn), wanted)
        assert not found[2].extras["node_size"].any() and found[1].extras["node_size"].all()
        towards = look_at(np.array(eye), np.array([1, 2, 0.5]), (0, 0, 1))
        camera = Camera("", 300, 200, 250, 250, 150, 100, towards)
        seen = truth.nodes(np.concatenate([each.means for each in file.cut(choice, camera, 0.1).values()]))
        assert set(seen) <= set(wanted)
        assert set(wanted[camera.sees(truth.choice.splats.means[wanted], 0.1)]) <= set(seen)
        shares.append(len(seen) / len(wanted))
    assert min(shares) < 0.75 or pixels > 1 or path.stem == "by size"  # few splats are in wide blocks


def test_what_an_eye_looks_at_comes_first(truth):
    """Of what is as far away; and with it the nodes above, wherever these are."""
    rng, eye = np.random.default_rng(4), np.array([1.0, 2.0, 3.0])
    direction = np.array([2.0, -1.0, 2.0]) / 3
    towards = rng.normal(size=(500, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    places = eye + 7 * towards
    index = paging.PageIndex(places, places, np.full(500, 1e-4))
    for k, found in ((1e6, 500), (6e4, 0)):
        assert len(index.order(eye, k, direction)) == found
    ahead = np.degrees(np.arccos(towards @ direction)) < 50
    order = index.order(eye, 1e6, direction)
    assert 20 < ahead.sum() < 200 and ahead[order[: ahead.sum()]].all()

    columns, below = truth.choice.splats.extras, truth.parents >= 0
    above = np.stack([columns[f"parent_{axis}"] for axis in "xyz"], 1).astype(np.float64)
    index = paging.PageIndex(above, above, columns["parent_size"].astype(np.float64))
    found = index.ahead(np.array([-3.0, 2, 0.5]), direction)
    assert 0.1 < found.mean() < 0.9
    assert found[truth.parents[found & below]].all()


def test_within_a_budget_cuts_are_complete_wherever_an_eye_looks(truth, path):
    pager = Pager(path, 24 * SIZE)
    memory, eye = Memory(pager), np.array([0, 0, 0.5])
    for direction in ((1, 0, 0), (-1, 0, 0), (0, 1, 0)):
        while (update := pager.step(eye, FOCAL, np.array(direction, float))) is not None:
            memory.take(update)
            truth.require_complete(truth.nodes(memory.shown(eye, 1.0)))
