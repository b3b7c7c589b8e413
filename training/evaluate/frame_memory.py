"""Memory that drawing takes: the resident splats, and the largest need of a frame."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from contextlib import suppress

import torch

from ..optimize.memory import peak_memory, reset_peak_memory, resident_memory
from ..rasterize import tensor_device
from ..scenes.cameras import Camera


def measure_frame_memory(
    prepare: Callable[[], Callable[[Camera], object]], cameras: Sequence[Camera], backend: str
) -> int | None:
    """Return the bytes in use while views are drawn, above those before; None if they are unknown.

    The backend ``cuda`` counts the memory of the GPU, others that of the process, which only Linux states.

    Args:
        prepare: loads splats and returns a function that draws a view. What it reads on the way does not
            count.
        cameras: views to draw.
    """
    device = tensor_device(backend)
    if device.type == "cuda":
        initial = torch.cuda.memory_allocated(device)
        draw = prepare()
        draw(cameras[0])
        torch.cuda.reset_peak_memory_stats(device)
        _draw_all(draw, cameras)
        return torch.cuda.max_memory_allocated(device) - initial
    _return_freed_memory()
    process_before = resident_memory()
    if process_before is None:
        return None
    draw = prepare()
    draw(cameras[0])
    _return_freed_memory()
    reset_peak_memory()
    _draw_all(draw, cameras)
    return max((peak_memory() or 0) - process_before, 0)


def _draw_all(draw: Callable[[Camera], object], cameras: Sequence[Camera]) -> None:
    for camera in cameras:
        draw(camera)


def _return_freed_memory() -> None:
    """Let glibc return the memory of freed arrays to the system, so that new arrays are counted."""
    with suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
