"""Detect and describe the devices on which this computer can train (``lodgs devices``)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import torch

from ..errors import LodgsError
from ..scenes.cameras import Camera
from . import (
    Adam,
    Gaussians,
    Target,
    cuda,
    make_device_model,
    photometric_loss,
    rasterize,
    resolve_backend,
    tensor_device,
    warm_up,
)
from .cpu.compile import thread_count
from .gpu import default_device
from .gpu.device import Adapter, adapters, open_device
from .self_test import run_self_test

SPLATS, SIZE = 50_000, (640, 426)
"""Scene and image size of :func:`step_seconds`."""
SECONDS = 5.0
"""Approximate duration of :func:`step_seconds`."""


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
        """Device that automatic training uses, and devices that may be faster."""
        cores = f"the CPU ({thread_count()} thread{'s' * (thread_count() > 1)})"
        if self.card and find_spec("gsplat"):
            return f"Automatic trains on {self.card} if gsplat works, otherwise on {cores}."
        if self.selected is not None and not self.selected.software:
            hint = f"The graphics card may be faster: choose it to try {self.selected.name}."
        elif self.adapters or not self.reason:
            hint = "A graphics card may be faster, but none was detected."
        else:
            hint = self.reason
        if self.card:
            hint += f" {self.card} may be faster with CUDA: install gsplat."
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
    problem = cuda.problem()
    rows.append(("cuda", str(problem) if problem else f"{devices.card}, through gsplat"))
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
    rows.append(("auto", resolve_backend("auto")))
    lines = [f"{name:<6}{text}" for name, text in rows]
    if timed:
        lines.append(f"Training step with {SPLATS:,} splats, {SIZE[0]}x{SIZE[1]} pixels:")
        lines += [f"{name:<6}{1000 * step_seconds(name):.0f} ms" for name in working]
    return "\n".join([*lines, devices.summary])


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


def step_seconds(backend: str) -> float:
    """Measure the median time in seconds of a training step (image, loss, gradients, Adam) on random splats.

    Splats stay on the device if the backend supports it, as in training.
    """
    random = np.random.default_rng(0)
    width, height = SIZE
    arrays = {
        "means": random.uniform((-1.5, -1, 2), (1.5, 1, 4), (SPLATS, 3)),
        "quats": random.normal(size=(SPLATS, 4)),
        "log_scales": random.normal(-4.5, 0.5, (SPLATS, 3)),
        "opacity_logits": random.normal(0, 2, SPLATS),
        "sh": random.normal(0, 0.3, (SPLATS, 16, 3)),
    }
    device = tensor_device(backend)
    leaves = {
        name: torch.tensor(array, dtype=torch.float32, device=device).requires_grad_()
        for name, array in arrays.items()
    }
    camera = Camera("", width, height, 0.8 * width, 0.8 * width, width / 2, height / 2, np.eye(4))
    target = Target(random.uniform(0, 1, (height, width, 3)).astype(np.float32))
    adam = Adam(leaves, dict.fromkeys(leaves, 1e-4))
    warm_up(backend)
    device_model = make_device_model(backend, adam, {})

    def step() -> None:
        if device_model is not None:
            loss = device_model.step(
                camera, target, near=0.01, sh_degree=3, background=(0.0, 0.0, 0.0), ssim_weight=0.2
            )
            loss()
            return
        rendering = rasterize(Gaussians(**leaves), camera, backend=backend)
        photometric_loss(rendering.image, target, backend=backend).backward()
        adam.step()
        adam.zero_grad()
        if device.type == "cuda":
            torch.cuda.synchronize()

    times: list[float] = []
    end = time.perf_counter() + SECONDS
    while len(times) < 3 or time.perf_counter() < end:
        begin = time.perf_counter()
        step()
        times.append(time.perf_counter() - begin)
    return float(np.median(times[1:]))
