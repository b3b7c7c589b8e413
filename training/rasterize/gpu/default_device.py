"""Select the graphics device of the gpu backend."""

from __future__ import annotations

import os

from ...errors import LodgsError
from .device import Adapter, Device, adapters, open_device

VARIABLE = "LODGS_GPU"
"""Environment variable with the name of the device, a part of its name, or "software"."""


def default_adapter() -> Adapter:
    """Return the device that ``LODGS_GPU`` names, or the best device that is not software.

    Raises:
        LodgsError: no such device exists.
    """
    name = os.environ.get(VARIABLE, "").strip().casefold()
    available = adapters()
    for adapter in available:
        if name in (adapter.name.casefold(), adapter.kind):
            return adapter
    for adapter in available:
        if name in adapter.name.casefold() if name else not adapter.software:
            return adapter
    names = ", ".join(adapter.name for adapter in available)
    if name:
        raise LodgsError(
            f'Cannot use graphics device "{name}" of {VARIABLE}: it does not exist.', f"Choose from: {names}."
        )
    raise LodgsError(
        f"Cannot use the gpu backend: {names} runs on the CPU and is slower than the cpu backend.",
        "Train on the CPU (Training Device in Blender, backend = auto or cpu in a job), or install the GPU's "
        "driver.",
    )


def open_default_device() -> Device:
    """Open :func:`default_adapter`; LodgsError if it does not exist or cannot be opened."""
    return open_device(default_adapter().name)
