"""Measure training of trees larger than memory (A LoD of Gaussians, Sec. 4.4). Part of ``make bench-tree``.

Trains towns whose nodes and moments need 1, 3 and 10 times a budget for some steps, with the same average
number of visible splats: the granularity is chosen for each town. Then it updates the sizes, trains two
more steps and writes a checkpoint. Every run is a separate process; peak memory is the system's count
(VmHWM). Memory besides the budget is measured, too: ``program`` is the trainer with a small tree of which
half fits, minus this half (Python, torch, kernels, photos, transfer buffers); ``drawing`` is the additional
memory for rendering the run's largest cut with gradients, relative to that of the small tree. With several
sizes of the cache, rows are the curve of the paper's Figure 19. Rows are added to build/bench/tree.json;
towns are stored in the same folder.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from dataclasses import fields, replace
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import torch

from examples import town
from training.lod.tree.nodes import detail_of
from training.methods import method_info
from training.methods.tree import TreeParameters
from training.methods.tree.build import ForestBuilder
from training.methods.tree.sequential_point_tree import image_borders
from training.methods.tree.store import record_layout
from training.methods.tree.train import Method, RecordOptimizer
from training.optimize.memory import keep_freed_memory
from training.optimize.out_of_core.cut_cache import MMAP_BYTES, SLOT_BYTES
from training.optimize.parameters import override
from training.optimize.training_data import TrainingData
from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import read_camera_folder, write_camera
from training.scenes.colmap import Scene
from training.scenes.images import write_png
from training.splats.gaussians import Splats

WAYS = {"graph": True, "graph, no cache": True, "random": False, "random, no cache": False}
"""Order of views and use of the cache, by name; True: consecutive views are close to each other."""
WARM = 5
"""Warm-up steps, not timed."""
AFTER = 2
"""Steps after the update of sizes, not timed."""
TINY = {"budget": 10, "times": [10.0], "steps": 10, "views": 4, "drawn": 10_000, "size": 0.3, "small": 40_000,
        "ways": ["graph"]}  # fmt: skip
"""Options of the test."""
KEY = ("name", "times", "budget_mb")
"""Values that tell rows apart."""
PHOTO_BYTES = 100 << 20
"""Memory for photos, less than all photos need."""


# -- in a separate process -------------------------------------------------------------------------------


def method_in(folder: Path, options: argparse.Namespace) -> Method:
    """Create a method with its files in a folder, without a tree."""
    cameras, near = read_camera_folder(folder)  # planning the town would need memory
    cameras = [replace(camera, image=folder / f"{camera.name}.png") for camera in cameras]
    scene = Scene(folder, folder, folder, cameras, np.zeros((4, 3), np.float32), np.zeros((4, 3), np.uint8))
    data = TrainingData(
        scene,
        1.0,
        0,
        photo_memory=PHOTO_BYTES,
        splat_memory=int(options.budget * 1e6) or None,
        scratch=folder,
    )
    data.__dict__["near"] = near
    numbers = {"tune_steps": options.steps, "resize_interval": options.steps - AFTER, "grow_interval": 0}
    values = numbers | {"pixels": options.pixels, "lod_noise": 0.0, "octaves": 0.0, "sh_degree": 0}
    parameters = override(method_info("tree").preset("draft"), values)
    assert isinstance(parameters, TreeParameters)
    empty = [np.zeros((2, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (1, 3))]
    return Method(data, parameters, 0, "cpu", Splats(empty[0], empty[1], empty[2], empty[3], empty[4]))


def build_store(options: argparse.Namespace) -> dict:
    """Create a town, its tree and its photos."""
    folder = options.folder
    folder.mkdir(parents=True)
    plan, options.budget = town.plan_for(options.leaves), 0
    for camera in [*town.walk(plan, options.views), *town.flight(plan, options.views)]:
        write_camera(folder / f"{camera.name}.json", camera.scaled(options.size), town.NEAR)
    leaves = town.build(plan, options.leaves, 0)
    method = method_in(folder, options)
    method.model.keep(torch.zeros(len(method.model), dtype=torch.bool))
    start = time.perf_counter()
    method.store = store = method._new_store()
    store.fill(ForestBuilder(leaves, folder))
    seconds = time.perf_counter() - start
    for camera in method.data.train:
        assert camera.image is not None
        gaussians = store.gaussians_at(store.load_cut(camera, options.pixels, town.NEAR))
        image = rasterize(gaussians, camera, near=town.NEAR, backend="cpu").image
        write_png(camera.image, (image.numpy().clip(0, 1) * 255).round().astype(np.uint8))
    torch.save(method.state_dict(), folder / "state.pt.part")
    (folder / "state.pt.part").rename(folder / "state.pt")
    return {"seconds": seconds, "nodes": len(store)}


def load_method(options: argparse.Namespace) -> Method:
    """Load a method with a town's tree."""
    method = method_in(options.folder, options)
    method.load_state_dict(torch.load(options.folder / "state.pt", weights_only=True))
    return method


def level(options: argparse.Namespace) -> dict:
    """Find the granularity in pixels for the requested average number of visible splats, within 1 %."""
    method = load_method(options)
    store = method.store
    assert store is not None

    def mean_visible(pixels: float) -> float:
        counts = []
        for camera in method.data.train:
            center, k = camera.center, detail_of(camera.focal, pixels)
            nodes, lists, bands = store._top.traverse(center, k, image_borders(camera, town.NEAR))
            counts.append(len(nodes) + len(store.find_cut(lists.astype(np.int64), bands, center, k)[0]))
        return float(np.mean(counts))

    low, high = 0.1, 100.0
    while high > 1.003 * low:
        pixels = (low * high) ** 0.5
        low, high = (pixels, high) if mean_visible(pixels) > options.drawn else (low, pixels)
    return {"pixels": high, "shown": mean_visible(high)}


def train(options: argparse.Namespace) -> dict:
    """Train steps on a town's tree."""
    method = load_method(options)
    store = method.store
    cut_times, counts, times = [], [], []
    assert store is not None
    take, load_cut = store.load_cut, method.load_cut
    loaded: list[RecordOptimizer] = []
    if not WAYS[options.way]:
        method.view_index = lambda step: method.data.training_view(step, 0)

    def timed_take(*arguments) -> np.ndarray:
        start = time.perf_counter()
        if "no cache" in options.way:
            store.cache.evict_all()  # writes changes
        rows = take(*arguments)
        cut_times.append(1000 * (time.perf_counter() - start))
        counts.append(len(rows))
        return rows

    def kept_cut(*arguments) -> RecordOptimizer:
        loaded[:] = [load_cut(*arguments)]
        return loaded[0]

    store.load_cut, method.load_cut = timed_take, kept_cut
    resize = store.update_sizes
    resize_times = []

    def timed_resize() -> None:
        start = time.perf_counter()
        resize()
        resize_times.append(time.perf_counter() - start)

    store.update_sizes = timed_resize
    largest = 0
    for step in range(1, options.steps + 1):
        start, resizing = time.perf_counter(), sum(resize_times)
        method.train_step(step)
        times.append(time.perf_counter() - start - (sum(resize_times) - resizing))
        if counts[-1] > largest:
            largest, splats = counts[-1], loaded[0].gaussians
            for name, tensor in vars(splats).items():  # no copy, which would count as memory
                np.save(options.folder / f"largest_{name}.npy", tensor.detach().numpy())
            (options.folder / "largest_view.txt").write_text(str(method.view_index(step)))
    start = time.perf_counter()
    torch.save(method.state_dict(), options.folder / "checkpoint.pt")
    timed = slice(WARM, -AFTER)
    share = store.cache.reused / max(store.cache.reused + store.cache.loaded, 1)
    cache_mb = (store.cache.capacity * (4 * store.layout.width + SLOT_BYTES) + store.cache.table_bytes) / 1e6
    return {
        "splats": len(store), "cache_mb": cache_mb, "reused": share,
        "step_s": float(np.mean(times[timed])), "cut_ms": float(np.mean(cut_times[timed])),
        "drawn": float(np.mean(counts[timed])), "s_per_million": 1e6 * sum(times[timed]) / sum(counts[timed]),
        "resize_s": sum(resize_times), "checkpoint_s": time.perf_counter() - start,
    }  # fmt: skip


def draw(options: argparse.Namespace) -> dict:
    """Render the largest cut of a run several times with loss and gradients, without a tree."""
    keep_freed_memory(MMAP_BYTES)  # as in a run
    method = method_in(options.folder, options)
    names = [field.name for field in fields(Gaussians)]
    arrays = {name: np.load(options.folder / f"largest_{name}.npy") for name in names}
    view = method.data.view(int((options.folder / "largest_view.txt").read_text()))
    for _ in range(3):
        leaves = {name: torch.tensor(array, requires_grad=True) for name, array in arrays.items()}
        rendering = rasterize(Gaussians(**leaves), view.camera, near=town.NEAR, backend="cpu")
        ((rendering.image - view.target.image) ** 2).mean().backward()
    return {"drawn": len(arrays["means"])}


def peak_mb() -> float:
    """Return the peak memory of this process by the system's count, in MB of 10⁶ bytes."""
    match = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert match is not None
    return int(match[1]) * 1024 / 1e6


# -- the table -------------------------------------------------------------------------------------------


def run(stage: str, leaves: int, options: argparse.Namespace, **arguments: object) -> dict:
    """Run a stage in a separate process; return its result with its peak memory."""
    folder = options.out.parent / f"tree_{leaves}_{options.views}"
    if stage == "build" and (folder / "state.pt").exists():
        return {}
    values = {
        name: getattr(options, name) for name in ("budget", "steps", "views", "size", "drawn", "pixels")
    }
    command = [sys.executable, __file__, "--stage", stage, "--leaves", str(leaves), "--folder", str(folder)]
    for name, value in {**values, **arguments}.items():
        command += [f"--{name}", str(value)]
    process = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(process.stdout)


def format_row(row: dict) -> str:
    """Format a row of the table."""
    return (
        f"{row['budget_mb']:>5,.0f} MB: peak {row['peak_mb']:>6,.0f} MB of {row['allowed_mb']:>6,.0f} "
        f"(drawing {row['drawing_mb']:.0f})  step {row['step_s']:.3f} s, "
        f"{row['s_per_million']:.3f} s per million of {row['drawn']:,.0f} drawn, cut {row['cut_ms']:.0f} ms, "
        f"{row['reused']:.0%} cached, sizes {row['resize_s']:.1f} s, "
        f"checkpoint {row['checkpoint_s']:.1f} s"
    )


def add_row(path: Path, row: dict) -> None:
    """Add a row to the report, replacing an earlier row of the same town, order of views and cache."""
    report = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"rows": []}
    others = [old for old in report["rows"] if any(old.get(name) != row[name] for name in KEY)]
    report["rows"] = [*others, row]
    path.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure training of trees larger than memory.")
    parser.add_argument("--out", type=Path, default=Path("build/bench/tree.json"))
    parser.add_argument("--budget", type=float, default=400, help="memory for nodes and moments in MB")
    parser.add_argument(
        "--times", type=float, nargs="+", default=(1, 3, 10), help="sizes of towns as multiples of the budget"
    )
    parser.add_argument(
        "--caches", type=float, nargs="+", default=(1,), help="sizes of the cache as multiples of the budget"
    )
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--views", type=int, default=24, help="views per camera path")
    parser.add_argument("--drawn", type=int, default=300_000, help="average number of visible splats")
    parser.add_argument("--pixels", type=float, default=3.0, help="granularity of the photos")
    parser.add_argument("--size", type=float, default=1.0, help="image scale; 1 is 960x540")
    parser.add_argument(
        "--small", type=int, default=60_000, help="leaves of the tree that measures the program's memory"
    )
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--tiny", action="store_true", help="test with a small town")
    parser.add_argument("--stage", choices=["build", "level", "train", "draw"], help=argparse.SUPPRESS)
    parser.add_argument("--leaves", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--way", default="graph", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.stage:
        torch.set_num_threads(1)
        keep_freed_memory()
        result = {"build": build_store, "level": level, "train": train, "draw": draw}[options.stage](options)
        print(json.dumps(result | {"peak_mb": peak_mb()}))
        return
    if options.tiny:
        vars(options).update(TINY)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    run("build", options.small, options)
    small_budget = options.small * 4e-6 * record_layout(0).width  # MB of the small tree's nodes
    program = [run("train", options.small, options, budget=small_budget) for _ in range(2)][
        1
    ]  # the first one may compile
    program, small = program["peak_mb"] - program["cache_mb"], run("draw", options.small, options)["peak_mb"]
    print(f"memory besides 110 % of the budget: program {program:.0f} MB, and drawing")
    for times in options.times:
        leaves = round(options.budget * 1e6 * times / (4 * record_layout(0).width) / 2)
        built = run("build", leaves, options)
        if built:
            print(
                f"{built['nodes']:,} nodes: tree in {built['seconds']:.0f} s, peak {built['peak_mb']:,.0f} MB"
            )
        pixels = run("level", leaves, options)["pixels"]
        for order, cache in product(options.ways, options.caches):
            budget = cache * options.budget
            row = run("train", leaves, options, way=order, pixels=pixels, budget=budget)
            drawing = max(run("draw", leaves, options)["peak_mb"] - small, 0)
            allowed = 1.1 * budget + program + drawing
            row |= {"name": order, "times": times, "budget_mb": budget, "program_mb": program,
                    "drawing_mb": drawing, "allowed_mb": allowed, "pixels": pixels}  # fmt: skip
            add_row(options.out, {key: round(x, 4) if isinstance(x, float) else x for key, x in row.items()})
            print(f"  {times:>4g} x {pixels:.2f} px  {order:<17} {format_row(row)}", flush=True)


if __name__ == "__main__":
    main()
