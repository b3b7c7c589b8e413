"""Memory that drawing takes, for functions of known needs."""

import sys

import numpy as np
import pytest

from training.evaluate.frame_memory import measure_frame_memory

MEGABYTE = 1_000_000


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux states the memory of a process")
def test_resident_splats_and_the_largest_frame_count():
    """Resident 60 MB, and 80, 20 or 40 MB a frame; what was needed to read does not count."""

    def prepare():
        np.ones(200 * MEGABYTE, np.uint8).sum()
        resident = np.ones(60 * MEGABYTE, np.uint8)
        return lambda size: np.ones(size * MEGABYTE, np.uint8)[0] + resident[0]

    size = measure_frame_memory(prepare, [80, 20, 40], "cpu")
    assert size == pytest.approx(140 * MEGABYTE, rel=0.1)


def test_unknown_memory_is_none(monkeypatch):
    monkeypatch.setattr("training.evaluate.frame_memory.resident_memory", lambda: None)
    assert measure_frame_memory(lambda: lambda camera: None, [1], "cpu") is None
