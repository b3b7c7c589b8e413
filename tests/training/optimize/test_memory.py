"""Memory that a process uses at most."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import numpy as np
from training.optimize.memory import peak_memory, reset_peak_memory

BYTES = 300_000_000
reset_peak_memory()
before = peak_memory()
array = np.ones(BYTES, np.uint8)
del array
assert before + 0.9 * BYTES < peak_memory() < before + 1.5 * BYTES
reset_peak_memory()
assert peak_memory() < before + 0.5 * BYTES
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the peak is reset on Linux only")
def test_peak_counts_freed_memory_until_it_is_reset():
    """In a new process: one that trained keeps freed memory (``keep_freed_memory``)."""
    subprocess.run([sys.executable, "-c", SCRIPT], check=True, cwd=Path(__file__).parents[3])
