"""Measure the gpu backend on the default device, or that of LODGS_GPU. Part of ``make bench``.

Measures in one run: a training step on the device and its stages, a step through copies, and a step on the
cpu; the share of the device's measured peak of multiply-adds and copies; and bytes transferred per step.
Writes build/bench/gpu.json. Results of a software device are only sanity checks.

``--all`` measures everything in less than ten minutes on a card that is at hand for a short time: devices,
drivers and versions; the first step in a new process; the above; steps of ``cuda``, and of gsplat where it is
installed; trainings of ``examples/lantern_garden``; and their PSNR with three seeds per backend. The file is
written after each part. ``--tiny`` tries the script.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
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
    StepOptions,
    Target,
    cuda,
    make_step_model,
    photometric_loss,
    rasterize,
    resolve_backend,
    warm_up,
)
from training.rasterize.gpu import scene  # noqa: E402
from training.rasterize.gpu.default_device import open_default_device  # noqa: E402
from training.rasterize.gpu.device import LANES, Device  # noqa: E402
from training.rasterize.gpu.device_model import GpuModel  # noqa: E402

CASES = [(50_000, 640, 426), (200_000, 960, 540), (1_000_000, 1920, 1080), (3_000_000, 1920, 1080)]
"""Splats, width and height. A software device runs only the first case."""
STAGES = {
    "project forward": "project", "project backward": "project_backward", "blend forward": "blend",
    "blend backward": "blend_backward", "gather gradients": "gather", "project train": "adam",
}  # fmt: skip
"""Stages by shader and function; for other shaders, by shader only."""
SHADERS = {"sort": "sort", "scan": "sort", "bin": "bin", "loss": "loss", "train": "loss"}
WORDS, ROUNDS, GROUPS = 1 << 24, 4096, 1024
"""Sizes of the measurements of copies and multiply-adds."""
TINY = [(2_000, 160, 120)]
"""Cases of ``--tiny``."""
EXAMPLE = ROOT / "examples" / "lantern_garden"
TRAINING_SECONDS = 120
"""Time limit of a training of ``--all``."""
TOTAL_SECONDS = 570
"""Time after which ``--all`` skips its remaining parts."""
SEEDS = 0, 1, 2
"""Seeds of the trainings whose PSNR is compared."""
STEPS = 16
"""Steps between two reads of the loss."""
COUNTS = "dispatches", "buffers", "bind_groups", "submissions", "reads", "bytes"
"""Numbers per step that :func:`recording_of` returns."""
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

    def __init__(self, count: int, width: int, height: int, device: str = "cpu") -> None:
        self.camera, self.size = synthetic_camera(width, height), (count, width, height)
        photograph = np.random.default_rng(1).integers(0, 256, (height, width, 3)) / np.float32(255)
        self.target = Target(torch.from_numpy(photograph).to(device))
        splats = synthetic_splats(count).map(lambda tensor: tensor.to(device).requires_grad_())
        self.adam = Adam(vars(splats), dict.fromkeys(vars(splats), 1e-7))
        self.stats = {name: torch.zeros(count, device=device) for name in ("gradient_sum", "seen")}

    def through_torch(self, backend: str) -> None:
        self.adam.zero_grad()
        rendering = rasterize(Gaussians(**self.adam.tensors), self.camera, backend=backend)
        photometric_loss(rendering.image, self.target, backend=backend).backward()
        self.adam.step()

    def without_autograd(self, backend: str, recorded: bool = True) -> Callable[[], Callable[[], float]]:
        """Return a step as in training, which returns its loss on demand."""
        model = make_step_model(backend, self.adam, self.stats)
        assert model is not None
        if isinstance(model, GpuModel) and not recorded:
            model._capacity = None
        options = StepOptions(near=0.01, sh_degree=3, background=(0.0, 0.0, 0.0), shrink=1)
        return lambda: model.step(self.camera, self.target, options)


def transferred_bytes(device: Device, step: Callable[[], object]) -> int:
    """Return the bytes transferred between device and host in a step."""
    step()
    previous = device.transferred
    step()
    return device.transferred - previous


def recording_of(device: Device, step: Callable[[], object], steps: int = 20) -> dict[str, float]:
    """Return the counts of a step, and the milliseconds of CPU time that record it: median and 95 %.

    Blocking reads wait for the device. Their time is excluded. Each step begins after the previous one has
    ended on the device, because a software device would compete with the recording for the caches.
    """
    read, waited = device.read, 0.0

    def timed_read(*arguments):
        nonlocal waited
        begin = time.thread_time()
        try:
            return read(*arguments)
        finally:
            waited += time.thread_time() - begin

    step()
    times, counts = [], Counter()
    device.read = timed_read  # type: ignore[method-assign]
    try:
        for _ in range(steps):
            device.wait()
            previous = device.counts + Counter(bytes=device.transferred)
            begin, waited = time.thread_time(), 0.0
            step()
            times.append(time.thread_time() - begin - waited)
            counts += device.counts + Counter(bytes=device.transferred) - previous
    finally:
        del device.read
    median, high = (round(1e3 * float(np.percentile(times, share)), 2) for share in (50, 95))
    return {name: round(counts[name] / steps, 2) for name in COUNTS} | {"cpu_ms": median, "cpu_ms_95": high}


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


def bench(seconds: float, cases: list[tuple[int, int, int]] | None = None) -> dict:
    """Measure cases; None measures CASES, but only the first on a software device."""
    device, fastest = open_default_device(), Fastest(seconds)
    warm_up("gpu")
    flops, bandwidth = peaks(device, fastest)
    print(f"{device.adapter.name}: {flops:.0f} GFLOP/s of multiply-adds, copies {bandwidth:.1f} GB/s")
    sizes, cases = cases or CASES[: 1 if device.adapter.software else None], []
    for size in sizes:
        case = Case(*size)
        copied = fastest(lambda case=case: case.through_torch("gpu"))
        cpu = fastest(case.without_autograd("cpu"))
        copied_bytes = transferred_bytes(device, lambda case=case: case.through_torch("gpu"))
        step = case.without_autograd("gpu")

        def many_steps(step: Callable[[], Callable[[], float]] = step) -> None:
            for loss in [step() for _ in range(STEPS)][-1:]:
                loss()

        device_seconds, bytes_moved = fastest(many_steps) / STEPS, transferred_bytes(device, step)
        recording = recording_of(device, step)
        stages = stages_of(device, case.without_autograd("gpu", recorded=False))
        numbers = size[0] * (scene.SPLAT - 2 + 48)
        adam_bandwidth = BYTES_PER_NUMBER * numbers / (stages["adam"] / 1e3) / 1e9
        lanes, _ = work(Step(*size))
        blending = (stages["blend"] + stages["blend_backward"]) / 1e3
        blended = lanes * (FORWARD_FLOPS + BACKWARD_FLOPS) / 1e9 / blending
        result = {
            "splats": size[0], "width": size[1], "height": size[2],
            "step_ms": round(1e3 * device_seconds, 2), "copied_step_ms": round(1e3 * copied, 2),
            "cpu_step_ms": round(1e3 * cpu, 2), "over_cpu": round(device_seconds / cpu, 2),
            "recording": recording, "stages_ms": stages, "bytes_moved": bytes_moved,
            "copied_bytes_moved": copied_bytes,
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


def cuda_seconds(size: tuple[int, int, int], fastest: Fastest) -> dict[str, float]:
    """Measure a step of cuda; with gsplat, also its step with a torch SSIM and torch's fused Adam.

    This part has not run yet: it needs an NVIDIA GPU.
    """
    case = Case(*size, device="cuda")

    step = case.without_autograd("cuda")

    def step_cuda() -> None:
        step()
        torch.cuda.synchronize()

    steps = {"cuda_step_ms": step_cuda}
    if find_spec("gsplat"):
        steps["gsplat_step_ms"] = gsplat_step(case)
    return {name: round(1e3 * fastest(step), 2) for name, step in steps.items()}


def gsplat_step(case: Case) -> Callable[[], None]:
    """Return a training step of gsplat on an NVIDIA GPU."""
    rasterization = import_module("gsplat").rasterization
    leaves = case.adam.tensors
    adam = torch.optim.Adam(list(leaves.values()), lr=1e-7, fused=True)
    camera = case.camera
    intrinsics = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    pose, intrinsics = (
        torch.as_tensor(x, dtype=torch.float32, device="cuda")[None]
        for x in (camera.world_to_camera, intrinsics)
    )

    def step() -> None:
        image, _, _ = rasterization(
            leaves["means"], leaves["quats"], leaves["log_scales"].exp(), leaves["opacity_logits"].sigmoid(),
            leaves["sh"], pose, intrinsics, *case.size[1:], sh_degree=3,
        )  # fmt: skip
        photometric_loss(image[0], case.target, backend="reference").backward()
        adam.step()
        adam.zero_grad(set_to_none=True)
        torch.cuda.synchronize()

    return step


def first_step_seconds(backend: str) -> float:
    """Measure a new process until the end of its first step."""
    code = f"from training.rasterize import warm_up; warm_up({backend!r})"
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=TRAINING_SECONDS)
    return round(time.perf_counter() - begin, 1)


def training(backend: str, options: list[str], seconds: float = TRAINING_SECONDS) -> dict:
    """Train the example; return the last values of its events.

    Raises:
        subprocess.TimeoutExpired: the training took longer than ``seconds``.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = ["--scene", str(EXAMPLE), "--out", f"{folder}/run"]
        command = [sys.executable, "-m", "training", "train", *files, "--backend", backend, *options]
        begin = time.perf_counter()
        ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=seconds)
    events = [json.loads(line) for line in ended.stdout.splitlines() if line.startswith("{")]
    kinds = {event["event"]: event for event in events}
    progress, done = kinds.get("progress", {}), kinds.get("done", {})
    result = {name: progress.get(name) for name in ("step", "splats", "steps_per_s", "psnr")}
    result |= {"seconds": round(time.perf_counter() - begin, 1), "code": ended.returncode, "done": done}
    return result | ({"error": kinds["error"]} if "error" in kinds else {})


def compare_seeds(backends: list[str], options: list[str], left: Callable[[], float]) -> dict:
    """Train with each seed and backend; return PSNR, and the largest difference of a mean from cpu's.

    Args:
        left: returns the time limit of the next training in seconds. Seeds beyond it are left out.
    """
    psnr: dict[str, list[float]] = {name: [] for name in ("cpu", *backends)}
    with suppress(subprocess.TimeoutExpired):
        for seed in SEEDS:
            for name, values in psnr.items():
                values.append(training(name, [*options, "--seed", str(seed)], left())["psnr"])
    count = min(map(len, psnr.values()))
    means = {name: sum(values[:count]) / max(count, 1) for name, values in psnr.items()}
    difference = max(abs(mean - means["cpu"]) for mean in means.values())
    return {"psnr": psnr, "seeds": count, "largest_difference": round(difference, 3)}


def versions() -> dict[str, object]:
    """Return the devices, drivers and versions of this computer."""
    nvidia = shutil.which("nvidia-smi")
    query = ["--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    packages = {}
    for name in ("torch", "wgpu", "numba", "gsplat"):
        with suppress(PackageNotFoundError):
            packages[name] = version(name)
    return {
        "lodgs": tomllib.loads((ROOT / "blender_manifest.toml").read_text("utf-8"))["version"],
        "python": platform.python_version(), "system": platform.platform(), "cores": os.cpu_count(),
        "packages": packages, "cuda": torch.version.cuda,
        "nvidia": subprocess.run([nvidia, *query], capture_output=True, text=True).stdout if nvidia else None,
        "graphics": open_default_device().adapter._asdict(),
    }  # fmt: skip


def measure_all(seconds: float, tiny: bool, out: Path) -> dict:
    """Measure all parts of ``--all`` within TOTAL_SECONDS, and write the results so far after each.

    The most important parts come first. When the time is over, the remaining parts are skipped.
    """
    deadline = time.monotonic() + TOTAL_SECONDS
    backends = ["gpu"] if cuda.find_problem() else ["gpu", "cuda"]
    jobs = {
        "flod draft, half size": ["--method", "flod"],
        "3dgs draft, full size": ["--method", "3dgs", "--image-scale", "1"],
    }
    seeds = ["--method", "3dgs", "--image-scale", "0.25", "--set", "steps=1500"]
    if tiny:
        jobs = {"3dgs, tiny": ["--method", "3dgs", "--image-scale", "0.1", "--set", "steps=20"]}
        seeds = jobs["3dgs, tiny"]

    def left() -> float:
        return max(min(deadline - time.monotonic(), TRAINING_SECONDS), 1.0)

    parts: dict[str, Callable[[], object]] = {"versions": versions}
    for name in backends:
        parts[f"first step, {name}"] = lambda name=name: first_step_seconds(name)
    for size in CASES if "cuda" in backends else []:
        label = f"steps, cuda, {size[0]:,} splats, {size[1]}x{size[2]}"
        parts[label] = lambda size=size: cuda_seconds(size, Fastest(seconds))
    parts["steps, gpu"] = lambda: bench(seconds, TINY if tiny else None)
    for job, options in jobs.items():
        for name in backends:
            label = f"training, {name}, {job}"
            parts[label] = lambda name=name, options=options: training(name, options, left())
    parts["three seeds, PSNR"] = lambda: compare_seeds(backends, seeds, left)
    results: dict[str, object] = {}
    for name, measure in parts.items():
        begin = time.monotonic()
        try:
            results[name] = measure() if begin < deadline else "skipped: the time is over"
        except Exception as error:  # the other parts are measured
            results[name] = f"{type(error).__name__}: {error}"
        print(f"{name}: {results[name]} ({time.monotonic() - begin:.0f} s)", flush=True)
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(results, indent=1) + "\n")
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0, help="time limit per measurement")
    parser.add_argument("--all", action="store_true", help="measure everything, also trainings")
    parser.add_argument("--tiny", action="store_true", help="try the script with tiny sizes")
    parser.add_argument("--out", type=Path, default=Path("build/bench/gpu.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        if resolve_backend("gpu") != "gpu":
            raise LodgsError("The graphics device renders incorrectly.")
        if options.all:
            measure_all(options.seconds, options.tiny, options.out)
            return
        result = bench(options.seconds, TINY if options.tiny else None)
    except LodgsError as problem:
        print(f"gpu: not measured. {problem}")
        return
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"saved {options.out}")


if __name__ == "__main__":
    main()
