"""The rule of trees: by hand, and proper cuts of random trees for random cameras."""

from math import log

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.lod.rule import rules
from training.lod.tree.nodes import ABOVE_ROOT, MIN_DETAIL, min_parent_size

CUT = rules()["cut"]


def weights(means, columns, position=(0, 0, 0), focal=100.0, pixels=1.0):
    return CUT.weights(means, np.array(position), focal, columns, {}, {"pixels": pixels})


def columns_of(sizes, parents, means):
    """Return the columns of nodes with sizes (N,) and parent rows (N,), -1 for the root."""
    above = sizes[parents]
    above[parents < 0] = ABOVE_ROOT
    x, y, z = means[parents].T
    named = {"node_size": sizes, "parent_size": above, "parent_x": x, "parent_y": y, "parent_z": z}
    return {name: column.astype(np.float32) for name, column in named.items()}


def random_tree(rng, leaves, spread=1.0, offset=0.0):
    """Return means, parents and saturated sizes of a binary tree, parents before children."""
    parents, ends = [-1], [0]
    while len(ends) < leaves:
        split = ends.pop(rng.integers(len(ends)))
        parents += [split, split]
        ends += [len(parents) - 2, len(parents) - 1]
    parents = np.array(parents)
    means = rng.normal(0, 1, (len(parents), 3))
    for node in range(1, len(parents)):
        means[node] = means[parents[node]] + spread * 0.6 ** rng.integers(1, 9) * means[node]
    means, sizes = (means + offset).astype(np.float32), np.zeros(len(parents), np.float32)
    inner = np.unique(parents[1:])
    sizes[inner] = rng.uniform(0, 0.1, len(inner))
    for node in range(len(parents) - 1, 0, -1):
        above = parents[node]
        distance = np.linalg.norm(means[node].astype(float) - means[above].astype(float))
        needed = np.float32(min_parent_size(float(sizes[node]), distance))
        sizes[above] = max(sizes[above], np.nextafter(needed, np.float32(np.inf)))
    return means, parents, sizes


def test_fine_enough_nodes_with_coarse_parents_are_drawn():
    # k = 100 / 2 = 50: the node of size 0.1 is drawn from 5, its parent of size 0.2, 1 behind it, from 10
    means = np.float32([[0, 0, 4.9], [0, 0, 5.1], [0, 0, 8.9], [0, 0, 9.1]])
    columns = columns_of(np.full(4, 0.1, np.float32), np.full(4, -1), means)
    columns["parent_size"][:] = 0.2
    columns["parent_z"] = means[:, 2] + 1
    assert weights(means, columns, pixels=2.0).tolist() == [0, 1, 1, 0]
    # k = 120 / 2 = 60: from 6 and from 12, for a camera that is 1 farther away
    assert weights(means, columns, (0, 0, -1), focal=120, pixels=2.0).tolist() == [0, 1, 1, 1]


def test_leaves_are_drawn_nearby_and_the_root_far_away():
    means = np.float32([[0, 0, 0], [1, 0, 0]])
    columns = columns_of(np.float32([0.5, 0]), np.array([-1, 0]), means)
    assert weights(means, columns, (0, 0, 0)).tolist() == [0, 1]
    assert weights(means, columns, (1, 0, 0)).tolist() == [0, 1]
    assert weights(means, columns, (0, 0, 51)).tolist() == [1, 0]
    assert weights(means, columns, (0, 0, 1e12)).tolist() == [1, 0]


def test_splats_without_columns_are_not_drawn():
    nothing = dict.fromkeys(CUT.columns, np.zeros(3, np.float32))
    assert not weights(np.eye(3, dtype=np.float32), nothing).any()


def test_detail_has_a_minimum():
    means, parents, sizes = random_tree(np.random.default_rng(1), 200)
    columns = columns_of(sizes, parents, means)
    minimum = weights(means, columns, (3, 0, 0), MIN_DETAIL, 1.0)
    np.testing.assert_array_equal(weights(means, columns, (3, 0, 0), MIN_DETAIL, 50.0), minimum)


@given(st.integers(0, 2**32), st.integers(1, 60), st.floats(MIN_DETAIL, 5000), st.floats(0.01, 200))
def test_each_path_to_a_leaf_has_one_drawn_node(seed, leaves, k, reach):
    rng = np.random.default_rng(seed)
    spread, offset = rng.choice([1e-3, 1.0, 30.0]), rng.choice([0, 1000])  # float32 is coarse at 1000
    means, parents, sizes = random_tree(rng, leaves, spread, offset)
    columns = columns_of(sizes, parents, means)
    leaf = np.setdiff1d(np.arange(len(means)), parents)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    node_at_border = int(rng.integers(len(means)))
    for position in (
        means[node_at_border] + reach * direction,
        means[node_at_border] + k * sizes[node_at_border] * direction,
        means[node_at_border],
    ):
        drawn = weights(means, columns, position, k) > 0
        for node in leaf:
            count = 0
            while node >= 0:
                count += int(drawn[node])
                node = parents[node]
            assert count == 1


def test_coarser_granularity_draws_less():
    means, parents, sizes = random_tree(np.random.default_rng(2), 2000)
    columns = columns_of(sizes, parents, means)
    counts = [weights(means, columns, (9, 0, 0), 1000.0, pixels).sum() for pixels in (0.5, 1, 2, 4, 8, 16)]
    assert counts == sorted(counts, reverse=True) and counts[0] > 2 * counts[-1] > 0


def test_coarser_values_raise_the_granularity():
    values, steps = {"pixels": 1.0}, 0
    while (values := CUT.coarser(values, [1, 2])) is not None:
        assert values["pixels"] <= 100
        steps += 1
    assert steps == int(log(100) / log(1.25))
    assert CUT.resolve_controls({"pixels": 2}, [1, 2]) == pytest.approx({"pixels": 2})
