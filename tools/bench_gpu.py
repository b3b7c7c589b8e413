"""Measure the gpu backend on the default device, or that of LODGS_GPU. Part of ``make bench``.

Measures in one run: a training step on the device and its stages, a step through copies, and a step on the
cpu; the share of the device's measured peak of multiply-adds and copies; and bytes transferred per step.
Writes build/bench/gpu.json. Results of a software device are only sanity checks.

``--all`` measures everything in less than ten minutes on a card that is at hand for a short time: devices,
drivers and versions; the self-tests; the first step in a new process; the above; steps of ``cuda``, and of
gsplat where it is installed; trainings of ``examples/lantern_garden``; and their PSNR with three seeds per
backend. Each part has a process of its own, so a part that fails, crashes or hangs leaves the others
unchanged. The file is written after each part. ``--tiny`` tries the script.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
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
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

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
    cpu_fallback_reason,
    cuda,
    make_step_model,
    photometric_loss,
    rasterize,
    resolve_backend,
    warm_up,
)
from training.rasterize.gpu import scene  # noqa: E402
from training.rasterize.gpu.default_device import open_default_device  # noqa: E402
from training.rasterize.gpu.device import LANES, Device, adapters  # noqa: E402
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
PART_SECONDS = 120
"""Time limit of a part of ``--all``."""
TOTAL_SECONDS = 570
"""Time after which ``--all`` skips its remaining parts."""
PASSED = "passed"
"""Result of a self-test."""
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
        options = StepOptions(near=0.01, sh_degree=3, background=(0.0, 0.0, 0.0), shrink=1, sparse_sh=True)
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


def seconds_per_step(step: Callable[[], Callable[[], float]], fastest: Fastest) -> float:
    """Measure steps as in training, whose loss is rarely read."""

    def many_steps() -> None:
        for loss in [step() for _ in range(STEPS)][-1:]:
            loss()

    return fastest(many_steps) / STEPS


def device_steps(size: tuple[int, int, int], fastest: Fastest) -> dict:
    """Measure steps of gpu: time, recording, stages and bytes."""
    device, case = open_default_device(), Case(*size)
    step = case.without_autograd("gpu")
    return {
        "step_ms": round(1e3 * seconds_per_step(step, fastest), 2),
        "recording": recording_of(device, step),
        "bytes_moved": transferred_bytes(device, step),
        "stages_ms": stages_of(device, case.without_autograd("gpu", recorded=False)),
    }


def copied_steps(size: tuple[int, int, int], fastest: Fastest) -> dict:
    """Measure steps of gpu that copy splats and gradients: time and bytes."""
    device, case = open_default_device(), Case(*size)
    seconds = fastest(lambda: case.through_torch("gpu"))
    moved = transferred_bytes(device, lambda: case.through_torch("gpu"))
    return {"copied_step_ms": round(1e3 * seconds, 2), "copied_bytes_moved": moved}


def cpu_steps(size: tuple[int, int, int], fastest: Fastest) -> dict:
    """Measure steps of the cpu."""
    return {"cpu_step_ms": round(1e3 * fastest(Case(*size).without_autograd("cpu")), 2)}


def bench(seconds: float, cases: list[tuple[int, int, int]] | None = None) -> dict:
    """Measure cases; None measures CASES, but only the first on a software device."""
    device, fastest = open_default_device(), Fastest(seconds)
    warm_up("gpu")
    flops, bandwidth = peaks(device, fastest)
    print(f"{device.adapter.name}: {flops:.0f} GFLOP/s of multiply-adds, copies {bandwidth:.1f} GB/s")
    sizes, results = cases or CASES[: 1 if device.adapter.software else None], []
    for size in sizes:
        result: dict[str, Any] = {"splats": size[0], "width": size[1], "height": size[2]}
        for measure in (device_steps, copied_steps, cpu_steps):
            result |= measure(size, fastest)
        stages = result["stages_ms"]
        numbers = size[0] * (scene.SPLAT - 2 + 48)
        adam_bandwidth = BYTES_PER_NUMBER * numbers / (stages["adam"] / 1e3) / 1e9
        lanes, _ = work(Step(*size))
        blending = (stages["blend"] + stages["blend_backward"]) / 1e3
        blended = lanes * (FORWARD_FLOPS + BACKWARD_FLOPS) / 1e9 / blending
        result |= {
            "over_cpu": round(result["step_ms"] / result["cpu_step_ms"], 2),
            "blending_share_of_peak": round(blended / flops, 3),
            "adam_share_of_copies": round(adam_bandwidth / bandwidth, 3),
        }
        print(json.dumps(result))
        results.append(result)
    return {
        "device": device.adapter._asdict(),
        "peak_gflops": round(flops, 1),
        "copy_gb_s": round(bandwidth, 1),
        "cases": results,
    }


def cuda_steps(size: tuple[int, int, int], fastest: Fastest) -> dict:
    """Measure steps of cuda. This has not run yet: it needs an NVIDIA GPU."""
    step = Case(*size, device="cuda").without_autograd("cuda")
    milliseconds = 1e3 * seconds_per_step(step, fastest)
    return {"cuda_step_ms": round(milliseconds, 2), "peak_mb": torch.cuda.max_memory_allocated() >> 20}


def gsplat_steps(size: tuple[int, int, int], fastest: Fastest) -> dict:
    """Measure steps of gsplat with a torch SSIM and torch's fused Adam."""
    return {"gsplat_step_ms": round(1e3 * fastest(gsplat_step(Case(*size, device="cuda"))), 2)}


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
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=PART_SECONDS)
    return round(time.perf_counter() - begin, 1)


def training(backend: str, options: list[str], seconds: float = PART_SECONDS) -> dict:
    """Train the example for a limited time; return the last values of its events."""
    begin, result = time.perf_counter(), {}
    with tempfile.TemporaryDirectory() as folder:
        files = ["--scene", str(EXAMPLE), "--out", f"{folder}/run"]
        command = [sys.executable, "-m", "training", "train", *files, "--backend", backend, *options]
        try:
            ended = subprocess.run(command, cwd=ROOT, capture_output=True, timeout=seconds)
            output, result["code"] = ended.stdout, ended.returncode
            if ended.returncode:
                result["log"] = ended.stderr.decode(errors="replace")[-2000:]
        except subprocess.TimeoutExpired as stopped:
            output, result["code"] = stopped.stdout or b"", f"stopped after {seconds:.0f} s"
    lines = [line for line in output.splitlines() if line.startswith(b"{") and line.endswith(b"}")]
    kinds = {event["event"]: event for event in map(json.loads, lines)}
    progress = kinds.get("progress", {})
    result |= {name: progress.get(name) for name in ("step", "splats", "steps_per_s", "psnr")}
    result |= {name: kinds[name] for name in ("done", "error") if name in kinds}
    return result | {"seconds": round(time.perf_counter() - begin, 1)}


def compare_seeds(results: dict[str, object]) -> dict:
    """Return the PSNR of trainings by backend, and the largest difference of a mean from cpu's.

    Args:
        results: parts by name. Seeds that not all backends completed are left out of the means.
    """
    psnr = {
        backend: [
            part["psnr"] if isinstance(part, dict) and part["code"] == 0 else None
            for part in (results.get(_seed_label(seed, backend)) for seed in SEEDS)
        ]
        for backend in ("cpu", "gpu", "cuda")
        if any(_seed_label(seed, backend) in results for seed in SEEDS)
    }
    complete = [values for values in zip(*psnr.values(), strict=True) if None not in values]
    means = np.mean(complete, axis=0) if complete else np.zeros(0)
    difference = round(float(np.abs(means - means[0]).max()), 3) if complete else None
    return {"psnr": psnr, "seeds": len(complete), "largest_difference": difference}


def _seed_label(seed: int, backend: str) -> str:
    return f"seed {seed}, {backend}"


def versions() -> dict[str, object]:
    """Return the devices, drivers and versions of this computer."""
    nvidia = shutil.which("nvidia-smi")
    query = ["--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    packages = {}
    for name in ("torch", "wgpu", "numba", "gsplat"):
        with suppress(PackageNotFoundError):
            packages[name] = version(name)
    try:
        graphics: object = [adapter._asdict() for adapter in adapters()]
    except LodgsError as problem:
        graphics = str(problem)
    return {
        "lodgs": tomllib.loads((ROOT / "blender_manifest.toml").read_text("utf-8"))["version"],
        "python": platform.python_version(), "system": platform.platform(), "cores": os.cpu_count(),
        "packages": packages, "cuda": torch.version.cuda,
        "nvidia": subprocess.run([nvidia, *query], capture_output=True, text=True).stdout if nvidia else None,
        "graphics": graphics,
    }  # fmt: skip


def check(backend: str) -> str:
    """Run the self-test of a backend; return PASSED or the problem."""
    if backend == "cuda":
        return str(cuda.find_problem() or PASSED)
    return cpu_fallback_reason(backend) or PASSED


def peaks_of_default_device(fastest: Fastest) -> dict[str, float]:
    """Return the rates of :func:`peaks`."""
    flops, bandwidth = peaks(open_default_device(), fastest)
    return {"peak_gflops": round(flops, 1), "copy_gb_s": round(bandwidth, 1)}


def in_new_process(function: Callable[..., object], seconds: float) -> object:
    """Call a function of a module in a new process; return its result.

    Raises:
        RuntimeError: the function raised an exception, the process ended or did not end in time.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(sender, function))
    process.start()
    sender.close()
    try:
        if not receiver.poll(seconds):
            raise RuntimeError(f"stopped after {seconds:.0f} s")
        succeeded, result = receiver.recv()
    except EOFError:
        process.join()
        raise RuntimeError(f"the process ended with code {process.exitcode}") from None
    finally:
        process.kill()
        process.join()
    if not succeeded:
        raise RuntimeError(result)
    return result


def _send_result(sender: Connection, function: Callable[..., object]) -> None:
    torch.set_num_threads(1)
    try:
        sender.send((True, function()))
    except Exception as error:
        sender.send((False, f"{type(error).__name__}: {error}"))


class Parts:
    """Parts of ``--all``, measured in turn until TOTAL_SECONDS are over.

    Attributes:
        results: results of the parts by name, or why there is none.
    """

    def __init__(self, out: Path) -> None:
        self.results: dict[str, object] = {}
        self._out = out
        self._deadline = time.monotonic() + TOTAL_SECONDS
        out.parent.mkdir(parents=True, exist_ok=True)

    def measure(self, name: str, function: Callable[..., object]) -> None:
        """Call a function in a new process, and write all results so far."""
        self._measure(name, partial(in_new_process, function))

    def train(self, name: str, backend: str, options: list[str]) -> None:
        """Train the example, and write all results so far."""
        self._measure(name, partial(training, backend, options))

    def _measure(self, name: str, function: Callable[[float], object]) -> None:
        begin = time.monotonic()
        remaining = self._deadline - begin
        try:
            skipped = "skipped: the time is over"
            self.results[name] = function(min(remaining, PART_SECONDS)) if remaining > 0 else skipped
        except Exception as error:  # the other parts are measured
            self.results[name] = f"failed: {error}"
        print(f"{name}: {self.results[name]} ({time.monotonic() - begin:.0f} s)", flush=True)
        self.write()

    def write(self) -> None:
        """Write all results so far."""
        self._out.write_text(json.dumps(self.results, indent=1) + "\n")


def measure_all(seconds: float, tiny: bool, out: Path) -> dict[str, object]:
    """Measure all parts of ``--all``, the most important ones first; return their results by name."""
    parts, fastest = Parts(out), Fastest(seconds)
    sizes = TINY if tiny else CASES
    jobs = {
        "flod draft, half size": ["--method", "flod"],
        "3dgs draft, full size": ["--method", "3dgs", "--image-scale", "1"],
    }
    seeds = ["--method", "3dgs", "--image-scale", "0.25", "--set", "steps=1500"]
    if tiny:
        jobs = {"3dgs, tiny": ["--method", "3dgs", "--image-scale", "0.1", "--set", "steps=20"]}
        seeds = jobs["3dgs, tiny"]
    parts.measure("versions", versions)
    for name in ("cuda", "gpu"):
        parts.measure(f"check, {name}", partial(check, name))
    backends = [name for name in ("cuda", "gpu") if parts.results[f"check, {name}"] == PASSED]
    for name in backends:
        parts.measure(f"first step, {name}", partial(first_step_seconds, name))
    kinds = {"cuda": [cuda_steps], "gpu": [device_steps]}
    if find_spec("gsplat"):
        kinds["cuda"].append(gsplat_steps)
    steps = [measure for name in backends for measure in kinds[name]] + [cpu_steps]
    if "gpu" in backends:
        steps.append(copied_steps)
        parts.measure("peaks, gpu", partial(peaks_of_default_device, fastest))
    for measure in steps:
        for count, width, height in sizes:
            label = f"{measure.__name__.replace('_', ' ')}, {count:,} splats, {width}x{height}"
            parts.measure(label, partial(measure, (count, width, height), fastest))
    for job, options in jobs.items():
        for name in backends:
            parts.train(f"training, {name}, {job}", name, options)
    for seed in SEEDS:
        for name in ("cpu", *backends):
            parts.train(_seed_label(seed, name), name, [*seeds, "--seed", str(seed)])
    parts.results["three seeds, PSNR"] = compare_seeds(parts.results)
    parts.write()
    return parts.results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, help="time limit per measurement (3, or 1 with --all)")
    parser.add_argument("--all", action="store_true", help="measure everything, also trainings")
    parser.add_argument("--tiny", action="store_true", help="try the script with tiny sizes")
    parser.add_argument("--out", type=Path, default=Path("build/bench/gpu.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.all:
        measure_all(options.seconds or 1.0, options.tiny, options.out)
        return
    try:
        if resolve_backend("gpu") != "gpu":
            raise LodgsError("The graphics device renders incorrectly.")
        result = bench(options.seconds or 3.0, TINY if options.tiny else None)
    except LodgsError as problem:
        print(f"gpu: not measured. {problem}")
        return
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"saved {options.out}")


if __name__ == "__main__":
    main()
