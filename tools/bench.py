"""Measure the rasterizer by stage, relative to the machine's peak performance. Part of ``make bench``.

Prints tables and writes build/bench/bench.json and bench.png; ``--base old.json`` compares with an earlier
run. Compare only runs on the same machine, and discard runs that report a busy machine.
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

from training.lod.query import LodQuery, SplatSelector
from training.lod.rule import collect_facts
from training.lod.rules.bands import RULE as BANDS
from training.rasterize import (
    Adam,
    Gaussians,
    StepOptions,
    Target,
    make_step_model,
    photometric_loss,
    rasterize,
    render,
    resolve_backend,
)
from training.rasterize.cpu import frame, host_model
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
from training.rasterize.cpu.lanes import WIDTH
from training.rasterize.cpu.project import LOG2_ALPHA_MIN32, strip_rows
from training.scenes.cameras import Camera
from training.splats.morton import spatial_order

ROOT = Path(__file__).resolve().parent.parent
CASES = [
    (count, width, height)
    for count in (10_000, 50_000, 200_000)
    for width, height in ((320, 240), (640, 480), (960, 540))
]
FORWARD_FLOPS, BACKWARD_FLOPS = 26, 47
"""Operations per lane of a row that a splat covers in a tile, counted in the source of ``blend``."""
KERNELS = {
    "project_forward": "project",
    "blend_forward": "blend",
    "blend_backward": "blend_backward",
    "project_backward": "project_backward",
}
FUNCTIONS = {
    "bin": (frame, "bin_splats"),
    "loss": (host_model, "loss_and_gradient"),
}
"""Functions of further stages. The kernel "project_backward" also makes the Adam step."""
STAGES = ("project", "bin", "blend", "loss", "blend_backward", "project_backward")


def synthetic_splats(count: int, seed: int = 0) -> Gaussians:
    """Return random splats in a frustum with log-normal scales; about 46 blends per pixel at any count."""
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
    """A complete training step on the synthetic scene."""

    def __init__(self, count: int, width: int, height: int, device: str = "cpu") -> None:
        self.backend = device
        self.splats = synthetic_splats(count).map(lambda tensor: tensor.to(device).requires_grad_())
        self.camera = synthetic_camera(width, height)
        self.target = Target(np.random.default_rng(1).random((height, width, 3), dtype=np.float32))
        self.adam = Adam(vars(self.splats), dict.fromkeys(vars(self.splats), 1e-7))

    def __call__(self) -> None:
        if model := make_step_model(self.backend, self.adam, {}):
            options = StepOptions(near=0.01, sh_degree=3, background=(0.0, 0.0, 0.0), sparse_sh=True)
            model.step(self.camera, self.target, options)()
            return
        self.adam.zero_grad()
        rendering = rasterize(self.splats, self.camera)
        photometric_loss(rendering.image, self.target).backward()
        self.adam.step()


class StageTimer:
    """Context manager that sums the time of each stage of the cpu backend by wrapping its functions."""

    def __enter__(self) -> StageTimer:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self.originals = {stage: getattr(module, name) for stage, (module, name) in FUNCTIONS.items()}
        for stage, (module, name) in FUNCTIONS.items():
            setattr(module, name, self._timed(self.originals[stage], lambda *_, stage=stage: stage))
        frame.run_parallel = self._timed(run_parallel, lambda kernel, *_: KERNELS[kernel.__name__])
        return self

    def _timed(self, function: Callable, stage_of: Callable) -> Callable:
        def call(*args):
            start = time.perf_counter()
            result = function(*args)
            self.seconds[stage_of(*args)] += time.perf_counter() - start
            return result

        return call

    def __exit__(self, *_) -> None:
        frame.run_parallel = run_parallel
        for stage, (module, name) in FUNCTIONS.items():
            setattr(module, name, self.originals[stage])


def measure(step: Callable[[], None], seconds: float) -> tuple[dict[str, float], float]:
    """Return milliseconds per stage of the fastest step, in total as "step", and CPU time over wall time."""
    step()
    best: dict[str, float] = {"step": float("inf")}
    start, cpu_start = time.perf_counter(), time.process_time()
    while time.perf_counter() - start < seconds or best["step"] == float("inf"):
        with StageTimer() as timer:
            step_start = time.perf_counter()
            step()
            total = time.perf_counter() - step_start
        if total * 1e3 < best["step"]:
            best = {stage: 1e3 * spent for stage, spent in timer.seconds.items()}
            best["around"] = 1e3 * total - sum(best.values())
            best["step"] = 1e3 * total
    return best, (time.process_time() - cpu_start) / (time.perf_counter() - start)


@kernel(frozenset({"contract"}))
def multiply_add(begin, end, values, rounds):
    """Compute 8 dependent multiply-adds per element, on 4096 elements per thread in the L1 cache."""
    for thread in range(begin, end):
        line = values[thread]
        for _ in range(rounds):
            for j in range(line.shape[0]):
                x = line[j]
                for _ in range(8):
                    x = x * f32(0.999) + f32(0.001)
                line[j] = x


def measured_peak() -> float:
    """Return the measured float32 peak of multiply-adds on all threads, in GFLOP/s."""
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
    """Count per tile the executed lanes and the blends, including pixels beyond the image border."""
    for tile in range(begin, end):
        x0, y0 = tile % tiles_x * 16, tile // tiles_x * 16
        t = np.ones((16, 16), np.float32)
        for pair in range(tile_start[tile], tile_start[tile] + walked[tile]):
            row = projected[splat[pair]]
            x_left, y_top = f32(x0) + f32(0.5), f32(y0) + f32(0.5)
            for start in range(0, 16, WIDTH):
                left = x_left + f32(start)
                first, last = strip_rows(row, left, f32(WIDTH - 1), y_top, min(16, height - y0))
                lanes[tile] += WIDTH * (last - first)
            first, last = strip_rows(row, x_left, SPAN, y_top, min(16, height - y0))
            for r in range(first, last):
                for j in range(16):
                    dx, dy = f32(j) + x_left - row[0], f32(r) + y_top - row[1]
                    log2_alpha = row[5] - row[2] * dx * dx - row[3] * dx * dy - row[4] * dy * dy
                    alpha = min(exp2(log2_alpha), CAP)
                    if log2_alpha >= LOG2_ALPHA_MIN32 and t[r, j] > 0:
                        remaining = t[r, j] * (f32(1) - alpha)
                        blends[tile] += remaining > T_MIN
                        t[r, j] = remaining if remaining > T_MIN else -t[r, j]


def work(step: Step) -> tuple[int, float]:
    """Return the lanes that one pass executes, and the blends per pixel."""
    counts = {}

    def spy(kernel, total, grain, *args):
        run_parallel(kernel, total, grain, *args)
        if kernel is frame.blend_forward:
            projected, splat, tile_start, tiles_x, _, _, _, transmittance, walked, _ = args
            lanes, blends = np.zeros((2, len(walked)), np.int64)
            arguments = projected, splat, tile_start, tiles_x, walked, len(transmittance), lanes, blends
            run_parallel(count_work, total, grain, *arguments)
            counts["lanes"] = int(lanes.sum())
            counts["blends"] = int(blends.sum()) / transmittance.size

    frame.run_parallel = spy
    try:
        with torch.no_grad():
            rasterize(step.splats, step.camera)
    finally:
        frame.run_parallel = run_parallel
    return counts["lanes"], counts["blends"]


def bytes_per_pair(step: Step) -> float:
    """Return the memory of a step per pair of splat and tile, in bytes."""
    sizes = {}
    take = Buffers.take

    def spy(self, name: str, kind, *shape: int):
        buffer = take(self, name, kind, *shape)
        sizes[name] = buffer.nbytes
        return buffer

    Buffers.take = spy
    try:
        step()
    finally:
        Buffers.take = take
    pairs = sizes["splat"] / np.dtype(np.int32).itemsize
    return sum(sizes[name] for name in ("hits", "splat", "reached", "pair_sums")) / pairs


def bench(seconds: float) -> dict:
    peak = measured_peak()
    threads = thread_count()
    print(f"{threads} threads, FP32 peak measured {peak:.0f} GFLOP/s")
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
                "threads": threads, "step_ms": {name: round(best[name], 2) for name in columns},
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
    if load > threads + 1 or busy < 0.75 * threads:
        print(
            f"The machine was busy (load {load:.1f}, {busy:.1f} of {threads} threads available): "
            "do not use these results."
        )
    pair = bytes_per_pair(Step(200_000, 960, 540))
    print(f"memory besides splats, 200k at 960x540: {pair:.0f} bytes per pair of splat and tile")
    return {"peak_gflops": round(peak, 1), "cases": cases, "bytes_a_pair": round(pair, 1)}


def fastest(function: Callable[[], object], seconds: float) -> float:
    """Return the milliseconds of the fastest call within a time limit, after one warm-up call."""
    function()
    best, start = float("inf"), time.perf_counter()
    while time.perf_counter() - start < seconds:
        call_start = time.perf_counter()
        function()
        best = min(best, time.perf_counter() - call_start)
    return 1e3 * best


def measure_other(seconds: float) -> dict:
    """Measure forward passes, weights, selection, thread counts, compilation and the cuda backend."""
    results: dict[str, Any] = {}
    splats, camera = synthetic_splats(200_000), synthetic_camera(960, 540)
    results["forward_ms"] = fastest(lambda: next(render(splats, [camera])), seconds)
    results["weights_by_removed"] = weights_over_removed(splats, camera)
    results["choosing_ms"], results["asking_each_ms"] = selection_ms(splats, camera, seconds)
    steps, peaks = measure_threads(seconds)
    results["step_ms_by_threads"], results["peak_by_threads"] = steps, peaks
    results |= compilation_seconds()
    if resolve_backend("auto") == "cuda":
        step = Step(200_000, 960, 540, "cuda")
        results["cuda_step_ms"] = fastest(lambda: (step(), torch.cuda.synchronize()), seconds)
        print(f"training step on the GPU, 200k splats at 960x540: {results['cuda_step_ms']:.1f} ms")
    print(f"forward only, 200k splats at 960x540: {results['forward_ms']:.1f} ms")
    print(f"70 % of the weights zero, relative to removing these splats: {results['weights_by_removed']:.3f}")
    print(
        f"selection by distance, two levels of 200k splats: {results['choosing_ms']:.2f} ms, "
        f"splat by splat {results['asking_each_ms']:.2f} ms"
    )
    gains = (
        f"{n}: {ms:.1f} ms ({steps[1] / ms:.2f}x, multiply-adds {peaks[n] / peaks[1]:.2f}x)"
        for n, ms in steps.items()
    )
    print("step by number of threads, and gain of multiply-adds: " + ", ".join(gains))
    print(f"first compilation: {results['cold_s']:.1f} s, from the cache: {results['cached_s']:.2f} s")
    return results


def weights_over_removed(splats: Gaussians, camera: Camera) -> float:
    """Return the time with 70 % zero weights relative to that without these splats."""
    weights = torch.from_numpy((np.random.default_rng(2).random(200_000) > 0.7).astype(np.float32))
    visible = splats.select(weights > 0)

    def draw(gaussians: Gaussians, **options) -> Callable:
        return lambda: next(render(gaussians, [camera], **options))

    functions = draw(splats, weights=weights), draw(visible)
    # alternate, so that noise affects both
    times = [[fastest(function, 1e-3) for function in functions] for _ in range(40)]
    return float(np.divide(*np.median(times, axis=0)))


def measure_threads(seconds: float) -> tuple[dict[int, float], dict[int, float]]:
    """Return milliseconds per step and measured peak, by number of threads."""
    step, default = Step(50_000, 640, 480), thread_count()
    steps, peaks = {}, {}
    try:
        for count in sorted({1, 2, default, 16}):
            set_thread_count(count)
            steps[count] = fastest(step, seconds)
            peaks[count] = measured_peak()
    finally:
        set_thread_count(default)
    return steps, peaks


def compilation_seconds() -> dict[str, float]:
    """Return the seconds of the first compilation of the kernels, and of loading them from the cache."""
    program = (
        "import time, torch\nfrom training.rasterize import warm_up\nt = time.perf_counter()\nwarm_up()\n"
        "print(time.perf_counter() - t)"
    )
    results = {"cold_s": float("inf"), "cached_s": float("inf")}
    for _ in range(3):
        with tempfile.TemporaryDirectory() as folder:
            environment = os.environ | {"NUMBA_CACHE_DIR": folder}
            for name, best in results.items():
                process = subprocess.run(
                    [sys.executable, "-c", program],
                    cwd=ROOT, env=environment, capture_output=True, text=True, check=True,
                )  # fmt: skip
                results[name] = min(best, float(process.stdout))
    return results


def selection_ms(splats: Gaussians, camera: Camera, seconds: float) -> tuple[float, float]:
    """Return milliseconds to select two levels by FLoD's rule, by blocks and splat by splat.

    Both levels have the same splats, and the border between them is at their median distance. By blocks, only
    blocks at the border are evaluated per splat.
    """
    order = spatial_order(splats.means.numpy())
    means, log_scales = splats.means.numpy()[order], splats.log_scales.numpy()[order]
    selector, values = SplatSelector(means, {}, log_scales), (("gamma", 1.0), ("first", 1), ("last", 2))
    border = float(np.median(np.linalg.norm(means, axis=1))) / camera.focal
    levels = [(1, {"s_min": border}), (2, {"s_min": 0.0})]
    queries = [
        LodQuery("bands", (0.0, 0.0, 0.0), camera.focal, tuple(facts.items()), values)
        for facts in (collect_facts(BANDS, {}, levels, number) for number, _ in levels)
    ]
    return (
        fastest(lambda: [selector.select(query, camera, 0.01) for query in queries], seconds),
        fastest(lambda: [np.flatnonzero(query.weights(means, {})) for query in queries], seconds),
    )


def plot(cases: list[dict], path: Path) -> None:
    """Plot the stages of each case as stacked bars."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.subplots()
    labels = [f"{case['splats'] // 1000}k\n{case['width']}x{case['height']}" for case in cases]
    bottom = np.zeros(len(cases))
    for stage in (*STAGES, "around"):
        heights = np.array([case["step_ms"][stage] for case in cases])
        axes.bar(labels, heights, bottom=bottom, label=stage)
        bottom += heights
    axes.set_ylabel("ms per training step")
    axes.legend()
    figure.savefig(path, dpi=120)


def read_results(path: str) -> dict:
    """Read the results of an earlier run, for argparse."""
    try:
        results = json.loads(Path(path).read_text(encoding="utf-8"))
        return {"cases": results["cases"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise argparse.ArgumentTypeError(f"{path} is not the bench.json of an earlier run") from error


def compare(new: dict, base: dict) -> None:
    """Print the step time of each case relative to an earlier run."""
    earlier = {(case["splats"], case["width"], case["height"]): case for case in base["cases"]}
    for case in new["cases"]:
        key = case["splats"], case["width"], case["height"]
        if key in earlier:
            ratio = case["step_ms"]["step"] / earlier[key]["step_ms"]["step"]
            print(f"{key[0]} splats, {key[1]}x{key[2]}: {ratio:.2f} of the earlier time")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0, help="time limit per case")
    parser.add_argument("--base", type=read_results, help="earlier bench.json to compare with")
    parser.add_argument("--out", type=Path, default=Path("build/bench/bench.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    result = bench(options.seconds)
    result |= measure_other(options.seconds)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    plot(result["cases"], options.out.with_suffix(".png"))
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"saved {options.out}")
    if options.base:
        compare(result, options.base)


if __name__ == "__main__":
    main()
