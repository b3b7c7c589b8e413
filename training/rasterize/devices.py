"""Detect and describe the devices on which this computer can train (``lodgs devices``)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..errors import LodgsError
from . import cuda, trial
from .cpu.compile import thread_count
from .gpu import default_device
from .gpu.device import Adapter, adapters, open_device
from .self_test import find_failure, run_self_test

SECONDS = 5.0
"""Approximate duration of a trial of one device."""
SCENE = f"{trial.SPLATS:,} splats, {trial.SIZE[0]}x{trial.SIZE[1]} pixels"
"""Scene of a trial."""
LIMITS = "Jobs that the graphics card cannot train alone use the CPU."


@dataclass
class Devices:
    """Detected devices.

    Attributes:
        card: name of the NVIDIA GPU that torch detects; empty without one.
        adapters: graphics devices, best first.
        selected: device of the gpu backend; None without a usable device.
        reason: why no device is selected; empty otherwise.
    """

    card: str
    adapters: list[Adapter]
    selected: Adapter | None
    reason: str

    @classmethod
    def detect(cls) -> Devices:
        """Query the drivers, without a self-test."""
        card = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
        try:
            available = adapters()
        except LodgsError as problem:
            return cls(card, [], None, str(problem))
        try:
            return cls(card, available, default_device.default_adapter(), "")
        except LodgsError as problem:
            return cls(card, available, None, str(problem))

    @property
    def summary(self) -> str:
        """Device that automatic training uses, with the times of a trial, and devices that may be faster.

        The trial takes some seconds per device, once per machine and driver.
        """
        cores = f"the CPU ({thread_count()} thread{'s' * (thread_count() > 1)})"
        names = {"cpu": cores, "cuda": f"{self.card} (CUDA)"}
        if self.selected is not None:
            names["gpu"] = self.selected.name
        times = trial.step_times()
        if len(times) > 1:
            first, *others = (f"{names[name]}: {times[name]:.1f} ms" for name in sorted(times, key=times.get))
            hint = f"A training step takes {first}, {', '.join(others)} ({SCENE})."
            fastest = min(times, key=times.get)
            if fastest != "cpu":
                limits = f" {LIMITS}" if fastest == "gpu" and "cuda" not in times else ""
                return f"Automatic trains on {names[fastest]}. {hint}{limits}"
        elif self.selected is not None and not self.selected.software:
            hint = _reason_against(self.selected)
        elif self.adapters or not self.reason:
            hint = "A graphics card may be faster, but none was detected."
        else:
            hint = self.reason
        if self.card and (problem := cuda.find_problem()):
            hint += f" {problem}"
        return f"Automatic trains on {cores}. {hint}"

    def as_json(self) -> dict:
        """Return the information that Blender's preferences show."""
        return {"graphics": self.selected.name if self.selected else "", "sentence": self.summary}


def describe(timed: bool = False) -> str:
    """Describe all devices, the results of their self-tests and the meaning of ``auto``.

    Args:
        timed: also measure a training step on each working device, which takes some seconds per device.
    """
    devices = Devices.detect()
    rows = [("cpu", f"{thread_count()} threads")]
    problem = cuda.find_problem()
    rows.append(("cuda", str(problem) if problem else devices.card))
    working = ["cpu"] if problem else ["cpu", "cuda"]
    for adapter in devices.adapters:
        properties = [adapter.kind, adapter.api, adapter.driver]
        if adapter == devices.selected:
            status, works = _test(adapter)
            working += ["gpu"] * works
            properties += status
        else:
            properties.append(f"not selected: set {default_device.VARIABLE} to its name to use it")
        rows.append(("gpu", f"{adapter.name}: {', '.join(filter(None, properties))}"))
    if devices.selected is None:
        rows.append(("gpu", devices.reason))
    rows.append(("auto", trial.fastest_backend()))
    lines = [f"{name:<6}{text}" for name, text in rows]
    if timed:
        lines.append(f"Training step with {SCENE}:")
        lines += [f"{name:<6}{1000 * trial.step_seconds(name, SECONDS):.0f} ms" for name in working]
    return "\n".join([*lines, devices.summary])


def _reason_against(adapter: Adapter) -> str:
    """Return why the selected device is not used."""
    try:
        return f"{adapter.name} is not used: {find_failure(adapter) or 'its trial failed'}."
    except LodgsError as problem:
        return str(problem)


def _test(adapter: Adapter) -> tuple[list[str], bool]:
    """Run the self-test of the selected device; return its status and whether it works."""
    try:
        memory = f"{open_device(adapter.name).binding_bytes >> 20} MB in one buffer"
        reason = run_self_test(adapter)
    except LodgsError as problem:
        return [str(problem)], False
    if reason:
        return [memory, f"not used, because {reason}"], False
    return [memory, "selected, passed the self-test"], True
