"""What this computer can train on, and what would make training faster: ``lodgs devices``."""

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
"""Of what :func:`step_seconds` draws."""
SECONDS = 5.0
"""That it takes, about."""


@dataclass
class Devices:
    """What was found.

    Attributes:
        card: name of the NVIDIA card that torch sees; empty where there is none.
        adapters: graphics devices, best first.
        chosen: the one that the gpu backend draws on; None where there is none that helps.
        missing: why there is none; empty where there is.
    """

    card: str
    adapters: list[Adapter]
    chosen: Adapter | None
    missing: str

    @classmethod
    def found(cls) -> Devices:
        """Asks the drivers; nothing is tried."""
        card = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
        try:
            found = adapters()
        except LodgsError as problem:
            return cls(card, [], None, str(problem))
        try:
            return cls(card, found, default_device.default_adapter(), "")
        except LodgsError as problem:
            return cls(card, found, None, str(problem))

    @property
    def sentence(self) -> str:
        """What trains by itself, and what might be faster."""
        cores = f"the processor ({thread_count()} thread{'s' * (thread_count() > 1)})"
        if self.card and find_spec("gsplat"):
            return f"Automatic trains on {self.card} if gsplat works there, else on {cores}."
        if self.chosen is not None and not self.chosen.software:
            may = f"The graphics card may be faster: choose it to try {self.chosen.name}."
        elif self.adapters or not self.missing:
            may = "A graphics card might be faster, and none was found."
        else:
            may = self.missing
        if self.card:
            may += f" So may {self.card} be with CUDA, once gsplat is installed."
        return f"Automatic trains on {cores}. {may}"

    def as_json(self) -> dict:
        """For Blender's preferences."""
        return {"graphics": self.chosen.name if self.chosen else "", "sentence": self.sentence}


def describe(timed: bool = False) -> str:
    """What there is, what of it works (it is tried), and what ``auto`` means here.

    Args:
        timed: measure a training step on each as well, some seconds for each.
    """
    found = Devices.found()
    rows = [("cpu", f"{thread_count()} threads")]
    problem = cuda.problem()
    rows.append(("cuda", str(problem) if problem else f"{found.card}, through gsplat"))
    working = ["cpu"] if problem else ["cpu", "cuda"]
    for adapter in found.adapters:
        told = [adapter.kind, adapter.api, adapter.driver]
        if adapter == found.chosen:
            said, works = _tried(adapter)
            working += ["gpu"] * works
            told += said
        else:
            told.append(f"not chosen: {default_device.VARIABLE} may name it")
        rows.append(("gpu", f"{adapter.name}: {', '.join(filter(None, told))}"))
    if found.chosen is None:
        rows.append(("gpu", found.missing))
    rows.append(("auto", resolve_backend("auto")))
    lines = [f"{name:<6}{text}" for name, text in rows]
    if timed:
        lines.append(f"A step with {SPLATS:,} splats, {SIZE[0]}x{SIZE[1]} pixels:")
        lines += [f"{name:<6}{1000 * step_seconds(name):.0f} ms" for name in working]
    return "\n".join([*lines, found.sentence])


def _tried(adapter: Adapter) -> tuple[list[str], bool]:
    """What is to be said of the chosen device, and whether it works."""
    try:
        memory = f"{open_device(adapter.name).most_bytes >> 20} MB in one buffer"
        differs = run_self_test(adapter)
    except LodgsError as problem:
        return [str(problem)], False
    if differs:
        return [memory, f"not used, as {differs}"], False
    return [memory, "chosen, draws what the reference draws"], True


def step_seconds(backend: str) -> float:
    """Seconds of a training step (picture, loss, gradients, Adam) on random splats: the median of some.

    It is made as plain steps are: where the backend keeps splats on its device, they stay there.
    """
    random, (width, height) = np.random.default_rng(0), SIZE
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
    adam, taken = Adam(leaves, dict.fromkeys(leaves, 1e-4)), []
    warm_up(backend)
    twin = make_device_model(backend, adam, {})

    def step() -> None:
        if twin is not None:
            twin.step(camera, target, near=0.01, sh_degree=3, background=(0.0, 0.0, 0.0), ssim_weight=0.2)
            return
        drawn = rasterize(Gaussians(**leaves), camera, backend=backend)
        photometric_loss(drawn.image, target, backend=backend).backward()
        adam.step()
        adam.zero_grad()
        if device.type == "cuda":
            torch.cuda.synchronize()

    end = time.perf_counter() + SECONDS
    while len(taken) < 3 or time.perf_counter() < end:
        begin = time.perf_counter()
        step()
        taken.append(time.perf_counter() - begin)
    return float(np.median(taken[1:]))
