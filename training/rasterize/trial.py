"""Trial of the working devices: time training steps once per machine, driver and version, for ``auto``."""

from __future__ import annotations

import hashlib
import platform
import time
from contextlib import suppress
from importlib import metadata

import numpy as np
import torch

from ..documents import read_json
from ..errors import LodgsError
from ..files import cache_folder
from ..scenes.cameras import Camera
from . import (
    Adam,
    Gaussians,
    StepOptions,
    Target,
    cpu_fallback_reason,
    cuda,
    make_step_model,
    photometric_loss,
    rasterize,
    resolve_backend,
    tensor_device,
    warm_up,
)
from .cpu.compile import thread_count
from .gpu.default_device import default_adapter
from .self_test import result_key, store_result

SPLATS, SIZE = 50_000, (640, 426)
"""Scene and image size of a trial."""
SECONDS = 1.0
"""Approximate duration of a trial of one device, without the compilation of its kernels."""
STEPS = 8
"""Steps between two reads of the loss, as in training."""
RESULTS = "trials.json"
"""File in the user's cache folder that stores the milliseconds."""


def working_backends() -> list[str]:
    """Return the backends of this computer that pass their check. Software devices are no candidates."""
    names = ["cpu"]
    if not cuda.find_problem():
        names.append("cuda")
    with suppress(LodgsError):
        if not default_adapter().software and resolve_backend("gpu") == "gpu":
            names.append("gpu")
    return names


def card_problem() -> str:
    """Return why the graphics card cannot train; empty if it can, or if there is none."""
    try:
        adapter = default_adapter()
    except LodgsError:
        return ""
    try:
        return "" if adapter.software else cpu_fallback_reason("gpu")
    except LodgsError as problem:  # lost or out of memory
        return f"{adapter.name} is not used. {problem}"


def step_times() -> dict[str, float]:
    """Return milliseconds of a training step by working backend; empty if only the CPU works.

    Measures the backends on the first call per machine, driver and version, for some seconds each.
    """
    names = working_backends()
    if names == ["cpu"]:
        return {}
    key, times = _key(tuple(names)), {}
    with suppress(LodgsError):
        stored = read_json(cache_folder() / RESULTS).get(key)
        times = {name: float(ms) for name, ms in stored.items()} if isinstance(stored, dict) else {}
    if set(times) == set(names):
        return times
    times = {}
    for name in names:
        try:
            times[name] = round(1e3 * step_seconds(name), 2)
        except (LodgsError, RuntimeError):  # lost or out of memory; torch raises RuntimeError
            continue
    if set(times) == set(names):
        store_result(RESULTS, key, times)
    return times


def fastest_backend() -> str:
    """Return the backend with the shortest step; cpu if no other backend works."""
    times = step_times()
    return min(times, key=times.__getitem__, default="cpu")


def _key(names: tuple[str, ...]) -> str:
    """Return a key of a trial: a digest of computer, threads, devices, drivers and versions."""
    parts = [*names, platform.node(), platform.machine(), str(thread_count()), metadata.version("numba")]
    if "cuda" in names:
        parts += [torch.__version__, torch.cuda.get_device_name()]
    parts.append(result_key(default_adapter()) if "gpu" in names else "")
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


def step_seconds(backend: str, seconds: float = SECONDS) -> float:
    """Measure the time in seconds of a training step (image, loss, gradients, Adam) on random splats.

    Return the median of batches of steps. Splats stay on the device if the backend supports it, as in
    training.
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
    model = make_step_model(backend, adam, {})

    def steps() -> float:
        """Make a batch of steps; return the seconds of one."""
        begin = time.perf_counter()
        if model is not None:
            options = StepOptions(near=0.01, sh_degree=3, background=(0.0, 0.0, 0.0))
            [model.step(camera, target, options) for _ in range(STEPS)][-1]()
            return (time.perf_counter() - begin) / STEPS
        rendering = rasterize(Gaussians(**leaves), camera, backend=backend)
        photometric_loss(rendering.image, target, backend=backend).backward()
        adam.step()
        adam.zero_grad()
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - begin

    steps()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < 2 or time.perf_counter() < end:
        times.append(steps())
    return float(np.median(times))
