"""Paged trees: complete cuts at any time, and the full cut within a sufficient budget."""

import time
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from tests.training.lod.tree.trees import page_table, random_leaves, tree_of
from training.errors import LodgsError
from training.lod import query as by_values
from training.lod.blocks import BLOCKS, BOUNDS, SIZE, BlockIndex
from training.lod.on_disk import open_paged
from training.lod.rule import rules
from training.lod.selection import BundleSelector, select
from training.lod.tree import paging
from training.lod.tree.nodes import ABOVE_ROOT, ResidentTree, streaming_order
from training.lod.tree.paging import TreeFile
from training.scenes.cameras import Camera, look_at
from training.splats.bundle import read_bundle, write_bundle
from training.splats.levels import Bundle, Level

CUT = rules()["cut"]
FOCAL = 1000.0
LEAVES = 30_000


class Truth:
    """A full tree: its nodes by their unique positions, and their parents."""

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

    def cut(self, position, pixels):
        return np.flatnonzero(self.choice.weights(np.float32(position), FOCAL, {"pixels": pixels}))

    def nodes(self, means):
        return np.array([self.node_at[mean.tobytes()] for mean in means], int)

    def require_complete(self, drawn):
        """Check that exactly one node on each path to a leaf is drawn."""
        assert len(set(drawn.tolist())) == len(drawn)
        present = np.zeros(len(self.parents) + 1, int)
        present[drawn] = 1
        above, result = self.leaves.copy(), np.zeros(len(self.leaves), int)
        while (above >= 0).any():
            result += present[above]
            above = np.where(above >= 0, self.parents[above], -1)
        assert (result == 1).all()


@pytest.fixture(scope="module")
def truth():
    return Truth(tree_of(random_leaves(LEAVES, np.random.default_rng(1), degree=1)))


@pytest.fixture(params=["by octaves", "with a table", pytest.param("by size", marks=pytest.mark.nightly)])
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
    """Memory that applies updates."""

    def __init__(self, pager):
        self.means = np.zeros((pager.rows, 3), np.float32)
        self.columns = {name: np.zeros(pager.rows, np.float32) for name in CUT.columns}

    def take(self, update):
        for begin, splats in update.pages:
            rows = slice(begin, begin + len(splats))
            self.means[rows] = splats.means
            for name in CUT.columns[2:]:
                self.columns[name][rows] = splats.extras[name]
        self.columns |= update.columns

    def visible_means(self, position, pixels):
        """Return the means of the splats that a camera sees."""
        weights = CUT.weights(self.means, np.float32(position), FOCAL, self.columns, {}, {"pixels": pixels})
        return self.means[weights > 0]


def load_pages(pager, memory, position, pixels):
    """Apply updates one by one until the camera needs no more pages."""
    while (update := pager.step(np.array(position), max(FOCAL / pixels, 32))) is not None:
        memory.take(update)
        yield


POSITIONS = [(0, 0, 3), (0.5, 0.2, 2), (-8, 8, 1), (7, -7, 0.5), (7, -6, 0.2), (60, 0, 20), (0, 0, 3)]


def test_sufficient_budget_gives_the_full_cut(truth, path):
    pager = TreeFile(path).pager(10**6)
    memory = Memory(pager)
    for position in POSITIONS:
        for pixels in (1.0, 4.0, 30.0):
            list(load_pages(pager, memory, position, pixels))
            drawn = truth.nodes(memory.visible_means(position, pixels))
            np.testing.assert_array_equal(np.sort(drawn), truth.cut(position, pixels))


@pytest.mark.parametrize("budget", [SIZE, pytest.param(5000, marks=pytest.mark.nightly), 20_000])
def test_cuts_are_complete_within_a_budget(truth, path, budget, monkeypatch):
    """Also while pages arrive, and for other cameras."""
    monkeypatch.setattr(paging, "PAGES_PER_UPDATE", 3)
    pager, equal = TreeFile(path).pager(budget), 0
    memory = Memory(pager)
    assert pager.rows <= budget
    memory.take(pager.step(None, 0.0))  # the initial pages
    for position in POSITIONS:
        for pixels in (30.0, 3.0):
            for number, _ in enumerate(load_pages(pager, memory, position, pixels)):
                assert pager.splats <= budget
                if number % 5 == 0:
                    for second in (position, (3, 3, 1)):
                        truth.require_complete(truth.nodes(memory.visible_means(second, pixels)))
            drawn = truth.nodes(memory.visible_means(position, pixels))
            truth.require_complete(drawn)
            needed = paging.page_order(pager._index, np.array(position), FOCAL / pixels * 1.001)
            if len(needed) <= budget // SIZE:
                equal += 1
                np.testing.assert_array_equal(np.sort(drawn), truth.cut(position, pixels))
    assert equal or budget < 20_000 or path.stem == "by size"  # pages sorted by size are wide


def test_coarse_pages_load_first_and_old_pages_are_evicted_first(path):
    file = TreeFile(path)
    order = paging.page_order(file.index(), np.array([7, -7, 0.5]), 1000.0)
    sizes, ranks = file.index().columns["parent_size"][order], np.arange(len(order))
    assert np.corrcoef(np.log(np.minimum(sizes, 100)), ranks)[0, 1] < -0.5
    pager = TreeFile(path).pager(12 * SIZE)
    a, b, c = ((0, 0, 40), 300.0), ((9, 9, 1), 60.0), ((-9, -9, 1), 60.0)
    present = []
    for position, pixels in (a, b, c, a, b):
        list(load_pages(pager, Memory(pager), position, pixels))
        present.append(set(np.flatnonzero(pager._slot_of >= 0)))
        assert len(present[-1]) <= 12 and pager.splats <= 12 * SIZE
        needed = paging.page_order(pager.file.index(), np.array(position), max(FOCAL / pixels, 32))
        assert pager.short == (len(needed) > 12)
    assert present[0] <= present[1]  # within the budget


def test_thread_reads_requested_pages(truth, path):
    pager = TreeFile(path).pager(10**6)
    memory, used = Memory(pager), 0
    pager.start()
    try:
        for position in POSITIONS[:4]:
            pager.ask(by_values.LodQuery("cut", position, FOCAL, (), (("pixels", 1.0),)))
            expected, until = truth.cut(position, 1.0), time.monotonic() + 200
            while not pager.idle and time.monotonic() < until:
                if (update := pager.take()) is not None:
                    memory.take(update)
                    used += 1
                    truth.require_complete(truth.nodes(memory.visible_means(position, 1.0)))
                time.sleep(0.01)
            np.testing.assert_array_equal(np.sort(truth.nodes(memory.visible_means(position, 1.0))), expected)
            assert used == pager.arrived
    finally:
        pager.stop()
    assert not pager.problem


def test_thread_reports_errors(path, monkeypatch):
    pager = TreeFile(path).pager(5000)
    monkeypatch.setattr(pager.file, "read", lambda pages: (_ for _ in ()).throw(OSError("the disk is gone")))
    pager.start()
    pager._thread.join(10)
    assert pager.problem == "the disk is gone"
    pager.stop()


@pytest.mark.parametrize("budget", [SIZE, pytest.param(5000, marks=pytest.mark.nightly), 10**6])
def test_budgeted_read_gives_a_smaller_tree(truth, path, budget, tmp_path):
    file = open_paged(path)
    bundle = file.top(budget)
    assert file.total == 2 * LEAVES - 1
    assert 0 < sum(len(level.splats) for level in bundle.levels) <= budget
    write_bundle(tmp_path / "small.ply", bundle)
    choice = BundleSelector(read_bundle(tmp_path / "small.ply"))
    for position in POSITIONS:
        for pixels in (1.0, 30.0):
            subset = choice.weights(np.float32(position), FOCAL, {"pixels": pixels}) > 0
            drawn = truth.nodes(choice.splats.means[subset])
            truth.require_complete(drawn)
            if budget == 10**6:
                np.testing.assert_array_equal(np.sort(drawn), truth.cut(position, pixels))
    finest = bundle.levels[-1].splats
    truth.require_complete(truth.nodes(finest.means))
    assert not finest.extras["node_size"].any() and set(finest.extras) == set(CUT.columns)


def test_budgeted_read_for_one_camera(truth, path):
    for position in POSITIONS[-2:]:
        k = FOCAL / 20
        part = TreeFile(path).top(10**6, np.array(position), k)
        assert sum(len(level.splats) for level in part.levels) < 1.8 * LEAVES
        splats, _ = select(part, np.array(position), FOCAL, {"pixels": 20.0})
        np.testing.assert_array_equal(np.sort(truth.nodes(splats.means)), truth.cut(position, 20.0))


def test_nodes_replace_missing_children():
    """By hand: 0 is the parent of 1 and 2, 1 of 3 and 4, 3 of 5 and 6; and one unreachable node."""
    x = np.arange(8, dtype=np.float32)
    sizes = np.float32([8, 4, 0, 2, 0, 0, 0, 0])
    parents = np.array([-1, 0, 0, 1, 1, 3, 3, 3])
    columns = {
        "x": x, "y": 0 * x, "z": 0 * x, "node_size": sizes, "parent_x": x[parents],
        "parent_y": 0 * x, "parent_z": -0.0 * x, "parent_size": sizes[parents],
    }  # fmt: skip
    columns["parent_size"][0] = ABOVE_ROOT

    def links(*rows):
        current = ResidentTree({name: column[list(rows)] for name, column in columns.items()})
        return [np.array(rows)[item].tolist() for item in current.update(np.arange(len(rows)))]

    assert links(0, 1, 2, 3, 4, 5, 6) == [[0, 1, 3], [0, 1, 2, 3, 4, 5, 6]]
    assert links(6, 5, 4, 3, 2, 1, 0) == [[3, 1, 0], [6, 5, 4, 3, 2, 1, 0]]
    assert links(0, 1, 2, 3, 4, 5) == [[0, 1], [0, 1, 2, 3, 4]]
    assert links(0, 1, 3, 4, 5, 6) == [[1, 3], [0]]
    assert links(0, 1, 2, 3, 5, 6) == [[0, 3], [0, 1, 2]]
    assert links(1, 2, 3, 4, 5, 6) == [[1, 3], []]
    assert links(5, 6) == [[], []]
    assert links(0) == [[], [0]]
    # nodes with three children are not linked
    assert links(0, 1, 2, 3, 4, 5, 6, 7) == [[0, 1], [0, 1, 2, 3, 4]]


def test_links_follow_arbitrary_changes(truth):
    """Compare with a walk from each splat to the root, for random contents of memory."""
    rng, splats = np.random.default_rng(3), truth.choice.splats
    top = np.argsort(-splats.extras["parent_size"], kind="stable")[:600]  # large nodes and few leaves
    full = splats.extras | dict(zip("xyz", splats.means.T, strict=True))
    columns = {name: np.zeros(len(top), np.float32) for name in (*CUT.columns, *"xyz")}
    node_of_slot, current, limit = np.full(len(top), -1), ResidentTree(columns), 0
    for _ in range(60):
        slots = rng.permutation(len(top))[: rng.integers(1, 200)]
        absent = np.setdiff1d(top, np.delete(node_of_slot, slots))
        node_of_slot[slots] = -1
        loaded = rng.permutation(absent)[: len(slots) - rng.integers(min(len(slots), 9))]
        node_of_slot[slots[: len(loaded)]] = loaded
        for name, column in columns.items():
            column[slots] = 0
            column[slots[: len(loaded)]] = full[name][loaded]
        slot_of_node = {node: slot for slot, node in enumerate(node_of_slot.tolist()) if node >= 0}
        children = Counter(truth.parents[node] for node in slot_of_node)
        inner, reached = np.zeros((2, len(top)), bool)
        for node, slot in slot_of_node.items():
            inner[slot] = children[node] == 2
            above = truth.parents[node]
            while above >= 0 and above in slot_of_node and children[above] == 2:
                above = truth.parents[above]
            reached[slot] = above < 0
        result = current.update(slots)
        np.testing.assert_array_equal(result[0], inner)
        np.testing.assert_array_equal(result[1], reached)
        limit = max(limit, int(reached.sum()))
    assert limit > 20, "some nodes are complete"


def test_page_table_equals_the_index_from_reading(truth, tmp_path):
    bundle = truth.bundle
    table = page_table({level.number: level.splats.extras for level in bundle.levels})
    write_bundle(tmp_path / "a.ply", bundle)
    write_bundle(tmp_path / "b.ply", replace(bundle, tables={BLOCKS: table}))
    single, second = (TreeFile(tmp_path / name).index() for name in ("a.ply", "b.ply"))
    for name in (*BOUNDS, "parent_size"):
        np.testing.assert_array_equal(single.columns[name], second.columns[name])
    means = truth.choice.splats.means[truth.parents]
    first = means[:SIZE][truth.parents[:SIZE] >= 0]
    assert (single.low[0] <= first.min(axis=0)).all() and (single.high[0] >= first.max(axis=0)).all()


def test_undrawable_splats_leave_no_holes(truth, tmp_path):
    """Parents replace them and their siblings."""
    above, leaves = (level.splats.select(slice(None)) for level in truth.bundle.levels)
    means = leaves.means.copy()
    means[5], means[7000] = np.nan, np.inf
    leaves = replace(leaves, means=means)
    write_bundle(tmp_path / "tree.ply", replace(truth.bundle, levels=[Level(1, above), Level(2, leaves)]))
    pager = TreeFile(tmp_path / "tree.ply").pager(10**6)
    memory = Memory(pager)
    list(load_pages(pager, memory, (0, 0, 3), 1.0))
    truth.require_complete(truth.nodes(memory.visible_means((0, 0, 3), 1.0)))


def test_other_rules_and_small_budgets_are_reported(truth, tmp_path):
    leaves = truth.bundle.levels[1].splats
    write_bundle(tmp_path / "a.ply", Bundle("flod", [Level(1, leaves, {"s_min": 0.0})], "bands"))
    write_bundle(tmp_path / "b.ply", truth.bundle)
    with pytest.raises(LodgsError, match="its rule 'bands' needs the complete file"):
        open_paged(tmp_path / "a.ply")
    file = TreeFile(tmp_path / "b.ply")
    for read, budget in ((file.top, 0), (file.pager, 300)):
        with pytest.raises(LodgsError, match=f"budget of {budget} splats is too small"):
            read(budget)
    bundle = file.top(1)
    assert [len(level.splats) for level in bundle.levels] == [0, 1]


@pytest.mark.parametrize("pixels", [1.0, pytest.param(6.0, marks=pytest.mark.nightly), 30.0])
def test_cut_is_read_from_disk(truth, path, pixels):
    """Complete without a camera; with a camera, all visible splats and few others."""
    file, shares = TreeFile(path), []
    for position in POSITIONS:
        choice = by_values.LodQuery("cut", position, FOCAL, (), (("pixels", pixels),))
        result = file.visible(choice)
        expected = truth.cut(position, pixels)
        drawn = truth.nodes(np.concatenate([splats.means for splats in result.values()]))
        np.testing.assert_array_equal(np.sort(drawn), expected)
        assert not result[2].extras["node_size"].any() and result[1].extras["node_size"].all()
        direction_to = look_at(np.array(position), np.array([1, 2, 0.5]), (0, 0, 1))
        camera = Camera("", 300, 200, 250, 250, 150, 100, direction_to)
        parts = file.visible(choice, camera, 0.1).values()
        visible = truth.nodes(np.concatenate([splats.means for splats in parts]))
        assert set(visible) <= set(expected)
        assert set(expected[camera.sees(truth.choice.splats.means[expected], 0.1)]) <= set(visible)
        shares.append(len(visible) / len(expected))
    assert min(shares) < 0.75 or pixels > 1 or path.stem == "by size"  # few blocks are wide


def index_of(positions, sizes):
    """Return an index of pages that are points."""
    bounds = dict(zip(BOUNDS, [*positions.T, *positions.T], strict=True))
    return BlockIndex({1: SIZE * len(positions)}, bounds | {"parent_size": sizes})


def test_pages_in_view_load_first(truth):
    """Among pages at the same distance; their ancestors load with them."""
    rng, position = np.random.default_rng(4), np.array([1.0, 2.0, 3.0])
    direction = np.array([2.0, -1.0, 2.0]) / 3
    direction_to = rng.normal(size=(500, 3))
    direction_to /= np.linalg.norm(direction_to, axis=1, keepdims=True)
    positions = position + 7 * direction_to
    index = index_of(positions, np.full(500, 1e-4))
    for k, result in ((1e6, 500), (6e4, 0)):
        assert len(paging.page_order(index, position, k, direction)) == result
    ahead = np.degrees(np.arccos(direction_to @ direction)) < 50
    order = paging.page_order(index, position, 1e6, direction)
    assert 20 < ahead.sum() < 200 and ahead[order[: ahead.sum()]].all()

    columns, below = truth.choice.splats.extras, truth.parents >= 0
    above = np.stack([columns[f"parent_{axis}"] for axis in "xyz"], 1).astype(np.float64)
    index = index_of(above, columns["parent_size"].astype(np.float64))
    result = paging.pages_ahead(index, np.array([-3.0, 2, 0.5]), direction)
    assert 0.1 < result.mean() < 0.9
    assert result[truth.parents[result & below]].all()


def test_cuts_are_complete_for_every_view_direction(truth, path):
    pager = TreeFile(path).pager(24 * SIZE)
    memory, position = Memory(pager), np.array([0, 0, 0.5])
    for direction in ((1, 0, 0), (-1, 0, 0), (0, 1, 0)):
        while (update := pager.step(position, FOCAL, np.array(direction, float))) is not None:
            memory.take(update)
            truth.require_complete(truth.nodes(memory.visible_means(position, 1.0)))
