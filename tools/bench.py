"""Measure the rasterizer by stage, against the machine's own limit: part of ``make bench``.

Prints tables, saves build/bench/bench.json and bench.png; ``--base old.json`` compares with an earlier run.
Compare runs of one machine only, and trust none that says the machine was busy.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import torch

from training.lod.blocks import spatial_order
from training.lod.query import LodQuery, SplatSelector
from training.lod.rule import collect_facts
from training.lod.rules.bands import RULE as BANDS
from training.rasterize import (
    Adam,
    Gaussians,
    Target,
    cpu,
    photometric_loss,
    rasterize,
    render,
    resolve_backend,
)
from training.rasterize.cpu import adam
from training.rasterize.cpu.bin import LOG2_ALPHA_MIN
from training.rasterize.cpu.blend import CAP, SPAN, T_MIN
from training.rasterize.cpu.compile import (
    FAST,
    Buffers,
    f32,
    kernel,
    run_parallel,
    set_thread_count,
    thread_count,
)
from training.rasterize.cpu.fastmath import exp2
from training.rasterize.cpu.project import strip_rows
from training.scenes.cameras import Camera

ROOT = Path(__file__).resolve().parent.parent
CASES = [
    (count, width, height)
    for count in (10_000, 50_000, 200_000)
    for width, height in ((320, 240), (640, 480), (960, 540))
]
FORWARD_FLOPS, BACKWARD_FLOPS = 26, 47
"""Operations for each lane of a row that a splat reaches in a tile, counted in the source of ``blend``."""
KERNELS = {
    "project_forward": "project",
    "blend_forward": "blend",
    "blend_backward": "blend_backward",
    "project_backward": "project_backward",
}
FUNCTIONS = {"bin": (cpu, "bin_splats"), "loss": (cpu, "loss_and_gradient"), "adam": (adam, "update")}
STAGES = ("project", "bin", "blend", "loss", "blend_backward", "project_backward", "adam")


def synthetic_splats(count: int, seed: int = 0) -> Gaussians:
    """Random splats in a frustum, of log-normal anisotropic scales: about 46 blends a pixel at any count."""
    random = np.random.default_rng(seed)
    z = random.uniform(2, 10, count)
    means = np.stack([random.uniform(-0.55, 0.55, count) * z, random.uniform(-0.42, 0.42, count) * z, z], 1)
    base = np.log(0.75 / np.sqrt(count)) + np.log(z) + random.normal(0, 0.6, count)
    log_scales = base[:, None] + random.normal(0, 0.45, (count, 3))
    quats = random.normal(size=(count, 4))
    opacity_logits = random.normal(-0.8, 1.6, count)
    sh = random.normal(size=(count, 16, 3)) * 0.08
    sh[:, 0] = random.uniform(-1.5, 1.5, (count, 3))
    arrays = {
        "means": means,
        "quats": quats,
        "log_scales": log_scales,
        "opacity_logits": opacity_logits,
        "sh": sh,
    }
    return Gaussians(**{name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()})


def synthetic_camera(width: int, height: int) -> Camera:
    return Camera("bench", width, height, width, width, width / 2, height / 2, np.eye(4))


class Step:
    """A full training step on the synthetic scene."""

    def __init__(self, count: int, width: int, height: int, device: str = "cpu") -> None:
        self.splats = synthetic_splats(count).map(lambda tensor: tensor.to(device).requires_grad_())
        self.camera = synthetic_camera(width, height)
        self.target = Target(np.random.default_rng(1).random((height, width, 3), dtype=np.float32))
        self.adam = Adam(vars(self.splats), dict.fromkeys(vars(self.splats), 1e-7))

    def __call__(self) -> None:
        self.adam.zero_grad()
        drawn = rasterize(self.splats, self.camera)
        photometric_loss(drawn.image, self.target).backward()
        self.adam.step()


class Stopwatch:
    """Adds up the time spent in the stages of the cpu backend, by wrapping them while it is in use."""

    def __enter__(self) -> Stopwatch:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self.originals = {stage: getattr(module, name) for stage, (module, name) in FUNCTIONS.items()}
        for stage, (module, name) in FUNCTIONS.items():
            setattr(module, name, self._timed(self.originals[stage], lambda *_, stage=stage: stage))
        cpu.run_parallel = self._timed(run_parallel, lambda kernel, *_: KERNELS[kernel.__name__])
        return self

    def _timed(self, function: Callable, stage_of: Callable) -> Callable:
        def call(*args):
            start = time.perf_counter()
            result = function(*args)
            self.seconds[stage_of(*args)] += time.perf_counter() - start
            return result

        return call

    def __exit__(self, *_) -> None:
        cpu.run_parallel = run_parallel
        for stage, (module, name) in FUNCTIONS.items():
            setattr(module, name, self.originals[stage])


def measure(step: Callable[[], None], seconds: float) -> tuple[dict[str, float], float]:
    """Milliseconds by stage of the fastest of as many steps as fit, "step" the whole; and CPU time by wall
    time."""
    step()
    best: dict[str, float] = {"step": float("inf")}
    start, cpu_start = time.perf_counter(), time.process_time()
    while time.perf_counter() - start < seconds or best["step"] == float("inf"):
        with Stopwatch() as watch:
            began = time.perf_counter()
            step()
            whole = time.perf_counter() - began
        if whole * 1e3 < best["step"]:
            best = {stage: 1e3 * spent for stage, spent in watch.seconds.items()}
            best["around"] = 1e3 * whole - sum(best.values())
            best["step"] = 1e3 * whole
    return best, (time.process_time() - cpu_start) / (time.perf_counter() - start)


@kernel(frozenset({"contract"}))
def multiply_add(begin, end, values, rounds):
    """8 dependent multiply-adds an element, 4096 elements a thread in the L1 cache."""
    for thread in range(begin, end):
        line = values[thread]
        for _ in range(rounds):
            for j in range(line.shape[0]):
                x = line[j]
                for _ in range(8):
                    x = x * f32(0.999) + f32(0.001)
                line[j] = x


def measured_peak() -> float:
    """Float32 operations a second (1e9) that multiply-adds reach on all threads."""
    values, rounds = np.ones((thread_count(), 4096), np.float32), 16_000
    run_parallel(multiply_add, len(values), 1, values, 1)
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        run_parallel(multiply_add, len(values), 1, values, rounds)
        seconds.append(time.perf_counter() - start)
    return values.size * rounds * 16 / min(seconds) / 1e9


@kernel(FAST)
def count_work(begin, end, projected, splat, tile_start, tiles_x, walked, height, lanes, blends):
    """Per tile: lanes executed, and splats that a pixel takes light from (pixels beyond the border
    included)."""
    for tile in range(begin, end):
        x0, y0 = tile % tiles_x * 16, tile // tiles_x * 16
        t = np.ones((16, 16), np.float32)
        for pair in range(tile_start[tile], tile_start[tile] + walked[tile]):
            row = projected[splat[pair]]
            left, top = f32(x0) + f32(0.5), f32(y0) + f32(0.5)
            first, last = strip_rows(row, left, SPAN, top, min(16, height - y0))
            lanes[tile] += 16 * max(0, last - first)
            for r in range(first, last):
                for j in range(16):
                    dx, dy = f32(j) + left - row[0], f32(r) + top - row[1]
                    log2_alpha = row[5] - row[2] * dx * dx - row[3] * dx * dy - row[4] * dy * dy
                    alpha = min(exp2(log2_alpha), CAP)
                    if log2_alpha >= LOG2_ALPHA_MIN and t[r, j] > 0:
                        behind = t[r, j] * (f32(1) - alpha)
                        blends[tile] += behind > T_MIN
                        t[r, j] = behind if behind > T_MIN else -t[r, j]


def work(step: Step) -> tuple[int, float]:
    """Lanes that one pass executes, and blends a pixel."""
    seen = {}

    def spy(kernel, total, grain, *args):
        run_parallel(kernel, total, grain, *args)
        if kernel is cpu.blend_forward:
            projected, splat, tile_start, tiles_x, _, _, _, transmittance, walked, _ = args
            lanes, blends = np.zeros((2, len(walked)), np.int64)
            rest = projected, splat, tile_start, tiles_x, walked, len(transmittance), lanes, blends
            run_parallel(count_work, total, grain, *rest)
            seen["lanes"], seen["blends"] = int(lanes.sum()), int(blends.sum()) / transmittance.size

    cpu.run_parallel = spy
    try:
        with torch.no_grad():
            rasterize(step.splats, step.camera)
    finally:
        cpu.run_parallel = run_parallel
    return seen["lanes"], seen["blends"]


def bytes_a_pair(step: Step) -> float:
    """Memory of a step that grows with pairs of splat and tile, for each of them."""
    taken = {}
    take = Buffers.take

    def spy(self, name: str, kind, *shape: int):
        found = take(self, name, kind, *shape)
        taken[name] = found.nbytes
        return found

    Buffers.take = spy
    try:
        step()
    finally:
        Buffers.take = take
    pairs = taken["splat"] / np.dtype(np.int32).itemsize
    return sum(taken[name] for name in ("hits", "splat", "reached", "pair_sums")) / pairs


def bench(seconds: float) -> dict:
    peak = measured_peak()
    count_of_threads = thread_count()
    print(f"{count_of_threads} threads, FP32 peak measured {peak:.0f} GFLOP/s")
    columns = [*STAGES, "around", "step"]
    print(
        f"{'splats':>7} {'pixels':>8} {'blends':>6} "
        + " ".join(f"{c:>8.8}" for c in columns)
        + "  of peak  busy"
    )
    cases = []
    for count, width, height in CASES:
        step = Step(count, width, height)
        lanes, blends = work(step)
        best, busy = measure(step, seconds)
        pixel_seconds = (best["blend"] + best["blend_backward"]) / 1e3
        share = lanes * (FORWARD_FLOPS + BACKWARD_FLOPS) / 1e9 / pixel_seconds / peak
        cases.append(
            {
                "splats": count, "width": width, "height": height, "blends_per_pixel": round(blends, 1),
                "threads": count_of_threads, "step_ms": {name: round(best[name], 2) for name in columns},
                "kernel_share_of_peak": round(share, 3), "cpu_by_wall_time": round(busy, 2),
            }
        )  # fmt: skip
        print(
            f"{count:7} {width}x{height} {blends:6.1f} "
            + " ".join(f"{best[c]:8.2f}" for c in columns)
            + f" {share:8.1%} {busy:5.2f}"
        )
    busy = min(case["cpu_by_wall_time"] for case in cases if case["splats"] >= 50_000)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0
    if load > count_of_threads + 1 or busy < 0.75 * count_of_threads:
        print(
            f"The machine had other work (load {load:.1f}, {busy:.1f} of {count_of_threads} threads "
            "at work): these times are too long."
        )
    pair = bytes_a_pair(Step(200_000, 960, 540))
    print(f"memory beyond the splats, 200k at 960x540: {pair:.0f} bytes a pair of splat and tile")
    return {"peak_gflops": round(peak, 1), "cases": cases, "bytes_a_pair": round(pair, 1)}


def least(function: Callable[[], object], seconds: float) -> float:
    """Milliseconds of the fastest of as many calls as fit, after one."""
    function()
    best, start = float("inf"), time.perf_counter()
    while time.perf_counter() - start < seconds:
        began = time.perf_counter()
        function()
        best = min(best, time.perf_counter() - began)
    return 1e3 * best


def further(seconds: float) -> dict:
    """What is not a training step: forward only, weights, threads, the first compilation."""
    found: dict[str, Any] = {}
    splats, camera = synthetic_splats(200_000), synthetic_camera(960, 540)
    found["forward_ms"] = least(lambda: next(render(splats, [camera])), seconds)

    weights = torch.from_numpy((np.random.default_rng(2).random(200_000) > 0.7).astype(np.float32))
    kept = splats.select(weights > 0)

    def draw(some: Gaussians, **options) -> Callable:
        return lambda: next(render(some, [camera], **options))

    some, removed = draw(splats, weights=weights), draw(kept)
    turns = [[least(drawn, 1e-3) for drawn in (some, removed)] for _ in range(40)]  # noise hits both alike
    found["weights_by_removed"] = float(np.divide(*np.median(turns, axis=0)))

    found["choosing_ms"], found["asking_each_ms"] = choosing(splats, camera, seconds)

    step, before = Step(50_000, 640, 480), thread_count()
    by_threads, peaks = {}, {}
    try:
        for count in sorted({1, 2, before, 16}):
            set_thread_count(count)
            by_threads[count] = least(step, seconds)
            peaks[count] = measured_peak()
    finally:
        set_thread_count(before)
    found["step_ms_by_threads"], found["peak_by_threads"] = by_threads, peaks

    program = (
        "import time, torch\nfrom training.rasterize import warm_up\nt = time.perf_counter()\nwarm_up()\n"
    )
    program += "print(time.perf_counter() - t)"
    for name in ("cold_s", "cached_s"):
        found[name] = float("inf")
    for _ in range(3):
        with tempfile.TemporaryDirectory() as folder:
            environment = os.environ | {"NUMBA_CACHE_DIR": folder}
            for name in ("cold_s", "cached_s"):
                run = [sys.executable, "-c", program]
                said = subprocess.run(
                    run, cwd=ROOT, env=environment, capture_output=True, text=True, check=True
                )
                found[name] = min(found[name], float(said.stdout))
    if resolve_backend("auto") == "cuda":
        step = Step(200_000, 960, 540, "cuda")
        found["cuda_step_ms"] = least(lambda: (step(), torch.cuda.synchronize()), seconds)
        print(f"training step on the GPU, 200k splats at 960x540: {found['cuda_step_ms']:.1f} ms")
    print(f"forward only, 200k splats at 960x540: {found['forward_ms']:.1f} ms")
    print(f"70 % of the weights zero, against those splats removed: {found['weights_by_removed']:.3f}")
    print(
        f"choosing by distance, two levels of 200k splats: {found['choosing_ms']:.2f} ms, "
        f"splat by splat {found['asking_each_ms']:.2f} ms"
    )
    gains = (
        f"{n}: {ms:.1f} ms ({by_threads[1] / ms:.2f}x, multiply-adds {peaks[n] / peaks[1]:.2f}x)"
        for n, ms in by_threads.items()
    )
    print("step by threads, and what the machine itself gains: " + ", ".join(gains))
    print(f"first compilation: {found['cold_s']:.1f} s, from the cache: {found['cached_s']:.2f} s")
    return found


def choosing(splats: Gaussians, camera: Camera, seconds: float) -> tuple[float, float]:
    """Milliseconds to choose what FLoD's rule shows a view of two levels of the same splats, which meet in
    their middle: in blocks, of which only those at the border are looked at, and splat by splat."""
    order = spatial_order(splats.means.numpy())
    means, log_scales = splats.means.numpy()[order], splats.log_scales.numpy()[order]
    chooser, values = SplatSelector(means, {}, log_scales), (("gamma", 1.0), ("first", 1), ("last", 2))
    border = float(np.median(np.linalg.norm(means, axis=1))) / camera.focal
    levels = [(1, {"s_min": border}), (2, {"s_min": 0.0})]
    choices = [
        LodQuery("bands", (0.0, 0.0, 0.0), camera.focal, tuple(facts.items()), values)
        for facts in (collect_facts(BANDS, {}, levels, number) for number, _ in levels)
    ]
    return (
        least(lambda: [chooser.chosen(choice, camera, 0.01) for choice in choices], seconds),
        least(lambda: [np.flatnonzero(choice.weights(means, {})) for choice in choices], seconds),
    )


def plot(cases: list[dict], path: Path) -> None:
    """Stacked bars of the stages of every case."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.subplots()
    labels = [f"{case['splats'] // 1000}k\n{case['width']}x{case['height']}" for case in cases]
    bottom = np.zeros(len(cases))
    for stage in (*STAGES, "around"):
        heights = np.array([case["step_ms"][stage] for case in cases])
        axes.bar(labels, heights, bottom=bottom, label=stage)
        bottom += heights
    axes.set_ylabel("ms a training step")
    axes.legend()
    figure.savefig(path, dpi=120)


def compare(new: dict, base: dict) -> None:
    """Print each case's step against the same case of an earlier run."""
    earlier = {(case["splats"], case["width"], case["height"]): case for case in base["cases"]}
    for case in new["cases"]:
        key = case["splats"], case["width"], case["height"]
        if key in earlier:
            ratio = case["step_ms"]["step"] / earlier[key]["step_ms"]["step"]
            print(f"{key[0]} splats, {key[1]}x{key[2]}: {ratio:.2f} of the earlier time")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0, help="time for each case")
    parser.add_argument("--base", type=Path, help="a bench.json to compare with")
    parser.add_argument("--out", type=Path, default=Path("build/bench/bench.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    result = bench(options.seconds)
    result |= further(options.seconds)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    plot(result["cases"], options.out.with_suffix(".png"))
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"saved {options.out}")
    if options.base:
        compare(result, json.loads(options.base.read_text()))


if __name__ == "__main__":
    main()
