"""Queries of k-d trees, also when they are interrupted."""

import signal
import threading
import time

import numpy as np
import pytest
from scipy.spatial import KDTree

from training.optimize.neighbors import query_neighbors
from training.runs import processes


@pytest.mark.parametrize("count", [1, 3])
def test_neighbours_match_all_distances(count):
    points, positions = np.random.default_rng(0).normal(size=(2, 50, 3))
    distances = np.linalg.norm(positions[:, None] - points, axis=2)
    expected = np.argsort(distances, axis=1)[:, :count].reshape(50, *[count] * (count > 1))
    found, indices = query_neighbors(KDTree(points), positions, count)
    np.testing.assert_array_equal(indices, expected)
    np.testing.assert_allclose(found, np.sort(distances, axis=1)[:, :count].reshape(expected.shape))


@pytest.fixture
def interruptible():
    """Hear Ctrl-C, which shells ignore for programs in background."""
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous)


@pytest.mark.usefixtures("interruptible")
def test_interrupt_waits_for_the_threads_of_the_query():
    finished = threading.Event()

    class SlowTree:
        def query(self, *_, **__):
            time.sleep(0.4)
            finished.set()
            return 0, 0

    threading.Timer(0.1, processes.interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        query_neighbors(SlowTree(), np.zeros((1, 3)))
    assert finished.is_set()
