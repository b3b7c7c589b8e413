"""Measure the gpu backend on the default device, or that of LODGS_GPU. Part of ``make bench``.

Measures in one run: a training step on the device and its stages, a step through copies, and a step on the
cpu; the share of the device's measured peak of multiply-adds and copies; and bytes transferred per step.
Writes build/bench/gpu.json. Results of a software device are only sanity checks.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.bench import (  # noqa: E402
    BACKWARD_FLOPS,
    FORWARD_FLOPS,
    Step,
    synthetic_camera,
    synthetic_splats,
    work,
)
from training.errors import LodgsError  # noqa: E402
from training.rasterize import (  # noqa: E402
    Adam,
    Gaussians,
    Target,
    make_device_model,
    photometric_loss,
    rasterize,
    resolve_backend,
    warm_up,
)
from training.rasterize.gpu import scene  # noqa: E402
from training.rasterize.gpu.default_device import open_default_device  # noqa: E402
from training.rasterize.gpu.device import LANES, Device  # noqa: E402

CASES = [(50_000, 640, 426), (200_000, 960, 540), (1_000_000, 1920, 1080)]
"""Splats, width and height. A software device runs only the first case."""
STAGES = {
    "project forward": "project", "project backward": "project_backward", "blend forward": "blend",
    "blend backward": "blend_backward", "gather gradients": "gather", "train adam": "adam",
    "train collect_stats": "statistics",
}  # fmt: skip
"""Stages by shader and function; for other shaders, by shader only."""
SHADERS = {"sort": "sort", "scan": "sort", "bin": "bin", "loss": "loss", "train": "loss"}
WORDS, ROUNDS, GROUPS = 1 << 24, 4096, 1024
"""Sizes of the measurements of copies and multiply-adds."""
MULTIPLY_ADDS = 4
"""Multiply-adds of four-component vectors per round."""
BYTES_PER_NUMBER = 24
"""Bytes that Adam transfers per number: value and two moments, in and out; few gradients are read."""


class Fastest:
    """Callable that returns the seconds of the fastest call within a time limit."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    def __call__(self, call: Callable[[], object]) -> float:
        call()
        times = []
        deadline = time.perf_counter() + self._seconds
        while not times or time.perf_counter() < deadline:
            begin = time.perf_counter()
            call()
            times.append(time.perf_counter() - begin)
        return min(times)


def peaks(device: Device, fastest: Fastest) -> tuple[float, float]:
    """Return GFLOP/s of dependent multiply-adds, and GB/s of a copy (read and write)."""
    source, destination = (device.empty(np.float32, WORDS) for _ in range(2))

    def run(entry: str, groups: int, numbers: tuple) -> None:
        device.run("calibrate", entry, groups, numbers, source=source, destination=destination)
        device.read(destination, WORDS - 1)

    adds = fastest(lambda: run("multiply_add", GROUPS, (GROUPS * LANES, ROUNDS)))
    copies = fastest(lambda: run("copy", WORDS // LANES // 4, (WORDS // 4, 1)))
    return GROUPS * LANES * ROUNDS * MULTIPLY_ADDS * 8 / adds / 1e9, 8 * WORDS / copies / 1e9


class Case:
    """Training steps of one scene."""

    def __init__(self, count: int, width: int, height: int) -> None:
        self.camera, self.size = synthetic_camera(width, height), (count, width, height)
        photograph = np.random.default_rng(1).integers(0, 256, (height, width, 3)) / np.float32(255)
        self.target = Target(photograph)
        splats = synthetic_splats(count).map(lambda tensor: tensor.requires_grad_())
        self.adam = Adam(vars(splats), dict.fromkeys(vars(splats), 1e-7))
        self.stats = {name: torch.zeros(count) for name in ("gradient_sum", "seen")}

    def through_torch(self, backend: str) -> None:
        self.adam.zero_grad()
        rendering = rasterize(Gaussians(**self.adam.tensors), self.camera, backend=backend)
        photometric_loss(rendering.image, self.target, backend=backend).backward()
        self.adam.step()

    def on_device(self) -> Callable[[], object]:
        """Return a step that stays on the device."""
        model = make_device_model("gpu", self.adam, self.stats)
        assert model is not None
        options = {"near": 0.01, "sh_degree": 3, "background": (0.0, 0.0, 0.0), "ssim_weight": 0.2}
        return lambda: model.step(self.camera, self.target, shrink=1, **options)


def transferred_bytes(device: Device, step: Callable[[], object]) -> int:
    """Return the bytes transferred between device and host in a step."""
    step()
    previous = device.transferred
    step()
    return device.transferred - previous


def stages_of(device: Device, step: Callable[[], object]) -> dict[str, float]:
    """Return milliseconds per stage of a step, synchronising the device after each dispatch."""
    run, spent, wait = device.run, defaultdict(float), device.empty(np.float32, 1)

    def timed(shader: str, entry: str, *arguments, **buffers) -> None:
        device.read(wait)
        begin = time.perf_counter()
        run(shader, entry, *arguments, **buffers)
        device.read(wait)
        stage = STAGES.get(f"{shader} {entry}") or SHADERS[shader]
        spent[stage] += 1e3 * (time.perf_counter() - begin)

    device.run = timed  # type: ignore[method-assign]
    try:
        step()
    finally:
        del device.run
    return {stage: round(ms, 2) for stage, ms in spent.items()}


def bench(seconds: float) -> dict:
    device, fastest = open_default_device(), Fastest(seconds)
    warm_up("gpu")
    flops, bandwidth = peaks(device, fastest)
    print(f"{device.adapter.name}: {flops:.0f} GFLOP/s of multiply-adds, copies {bandwidth:.1f} GB/s")
    cases = []
    for size in CASES[: 1 if device.adapter.software else None]:
        case = Case(*size)
        copied = fastest(lambda case=case: case.through_torch("gpu"))
        cpu = fastest(lambda case=case: case.through_torch("cpu"))
        copied_bytes = transferred_bytes(device, lambda case=case: case.through_torch("gpu"))
        step = case.on_device()
        device_seconds, bytes_moved = fastest(step), transferred_bytes(device, step)
        stages = stages_of(device, step)
        numbers = size[0] * (scene.SPLAT - 2 + 48)
        adam_bandwidth = BYTES_PER_NUMBER * numbers / (stages["adam"] / 1e3) / 1e9
        lanes, _ = work(Step(*size))
        blending = (stages["blend"] + stages["blend_backward"]) / 1e3
        blended = lanes * (FORWARD_FLOPS + BACKWARD_FLOPS) / 1e9 / blending
        result = {
            "splats": size[0], "width": size[1], "height": size[2],
            "step_ms": round(1e3 * device_seconds, 2), "copied_step_ms": round(1e3 * copied, 2),
            "cpu_step_ms": round(1e3 * cpu, 2), "over_cpu": round(device_seconds / cpu, 2),
            "stages_ms": stages, "bytes_moved": bytes_moved, "copied_bytes_moved": copied_bytes,
            "blending_share_of_peak": round(blended / flops, 3),
            "adam_share_of_copies": round(adam_bandwidth / bandwidth, 3),
        }  # fmt: skip
        print(json.dumps(result))
        cases.append(result)
    adapter = device.adapter._asdict()
    return {
        "device": adapter,
        "peak_gflops": round(flops, 1),
        "copy_gb_s": round(bandwidth, 1),
        "cases": cases,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0, help="time limit per measurement")
    parser.add_argument("--out", type=Path, default=Path("build/bench/gpu.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        if resolve_backend("gpu") != "gpu":
            raise LodgsError("The graphics device renders incorrectly.")
        result = bench(options.seconds)
    except LodgsError as problem:
        print(f"gpu: not measured. {problem}")
        return
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"saved {options.out}")


if __name__ == "__main__":
    main()
