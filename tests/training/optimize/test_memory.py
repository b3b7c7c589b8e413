"""Memory that a process uses at most."""

import sys

import numpy as np
import pytest

from training.optimize.memory import peak_memory, reset_peak_memory

BYTES = 300_000_000


@pytest.mark.skipif(sys.platform != "linux", reason="the peak is reset on Linux only")
def test_peak_counts_freed_memory_until_it_is_reset():
    reset_peak_memory()
    before = peak_memory() or 0
    array = np.ones(BYTES, np.uint8)
    del array
    assert before + 0.9 * BYTES < (peak_memory() or 0) < before + 1.5 * BYTES
    reset_peak_memory()
    assert (peak_memory() or 0) < before + 0.5 * BYTES
