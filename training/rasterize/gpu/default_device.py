"""Which graphics device the gpu backend draws on."""

from __future__ import annotations

import os

from ...errors import LodgsError
from .device import Adapter, Device, adapters, open_device

VARIABLE = "LODGS_GPU"
"""Environment variable with the name of the device to use, or a part of it; or "software"."""


def default_adapter() -> Adapter:
    """The device that is used: the one that ``LODGS_GPU`` names, else the best that is no software.

    Raises:
        LodgsError: there is none.
    """
    wanted, found = os.environ.get(VARIABLE, "").strip().casefold(), adapters()
    for adapter in found:
        if wanted in (adapter.name.casefold(), adapter.kind):
            return adapter
    for adapter in found:
        if wanted in adapter.name.casefold() if wanted else not adapter.software:
            return adapter
    names = ", ".join(adapter.name for adapter in found)
    if wanted:
        raise LodgsError(
            f'There is no graphics device "{wanted}" here, as {VARIABLE} has it.', f"There are: {names}."
        )
    raise LodgsError(
        f"This computer has no graphics device that helps: {names} runs on the processor, slower than the "
        "cpu backend.",
        "Train on the CPU (Training Device in Blender, backend = auto or cpu in a job), or install the GPU's "
        "driver.",
    )


def open_default_device() -> Device:
    """:func:`chosen`, opened once; LodgsError as there, or it cannot be opened."""
    return open_device(default_adapter().name)
