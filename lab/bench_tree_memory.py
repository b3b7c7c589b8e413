"""What training a tree larger than memory costs (A LoD of Gaussians, Sec. 4.4): part of ``make bench-tree``.

Towns whose nodes, with their moments, take 1, 3 and 10 times a budget are trained for some steps each, at
equal splats in view: a town's granularity is that at which its views show so many on average. Then sizes are
made anew, two more steps made, and a checkpoint is written. Every run is a process of its own, and peak
memory is what the system says of it (VmHWM). What a run takes beside its budget is measured as well:
``program``, the trainer at work on a small tree of which half has room, less this half (Python, torch,
kernels, photographs, what passes between file and memory), and ``drawing``, by how much more it takes to draw
the run's largest cut, with its gradients, than that of the small tree: equal on average, cuts are not all
equal. Rows are added to build/bench/tree.json; towns are kept beside it.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import torch

from examples import town
from training.lod.rules.cut import detail_of
from training.methods import method_info
from training.methods.tree import TreeParameters
from training.methods.tree.build import GrowingForest
from training.methods.tree.store import layout_of
from training.methods.tree.train import Method, SeenRecords
from training.optimize.memory import keep_freed_memory
from training.optimize.out_of_core.cut_cache import BESIDE, LARGE
from training.optimize.parameters import override
from training.optimize.training_data import TrainingData
from training.rasterize import Gaussians, rasterize
from training.rasterize.sequential_point_tree import image_borders
from training.scenes.cameras import read_camera_folder, write_camera
from training.scenes.colmap import Scene
from training.scenes.images import write_png
from training.splats.gaussians import Splats

WAYS = {"graph": True, "graph, no cache": True, "random": False, "random, no cache": False}
"""How views follow each other, and what is kept from one to the next; True: near ones do (``Walk``)."""
WARM = 5
"""Steps that no time is taken of."""
AFTER = 2
"""Steps after sizes were made anew, nor of these."""
TINY = {"budget": 10, "times": [10.0], "steps": 10, "views": 4, "drawn": 10_000, "size": 0.3, "small": 40_000,
        "ways": ["graph"]}  # fmt: skip
"""What a test runs."""
PHOTOGRAPHS = 100 << 20
"""Bytes for photographs, which is less than all take."""


# -- in a process of its own -----------------------------------------------------------------------------


def method_in(folder: Path, options: argparse.Namespace) -> Method:
    """A run whose files are in a folder, before a tree is in it."""
    cameras, near = read_camera_folder(folder)  # a plan of the town would take memory
    cameras = [replace(camera, image=folder / f"{camera.name}.png") for camera in cameras]
    scene = Scene(folder, folder, folder, cameras, np.zeros((4, 3), np.float32), np.zeros((4, 3), np.uint8))
    data = TrainingData(
        scene,
        1.0,
        0,
        photo_memory=PHOTOGRAPHS,
        splat_memory=int(options.budget * 1e6) or None,
        scratch=folder,
    )
    data.__dict__["near"] = near
    numbers = {"tune_steps": options.steps, "resize_interval": options.steps - AFTER, "grow_interval": 0}
    values = numbers | {"pixels": options.pixels, "lod_noise": 0.0, "sh_degree": 0}
    parameters = override(method_info("tree").preset("draft"), values)
    assert isinstance(parameters, TreeParameters)
    none = [np.zeros((2, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (1, 3))]
    return Method(data, parameters, 0, "cpu", Splats(none[0], none[1], none[2], none[3], none[4]))


def build_store(options: argparse.Namespace) -> dict:
    """Makes a town, its tree, and its photographs."""
    folder = options.folder
    folder.mkdir(parents=True)
    plan, options.budget = town.plan_for(options.leaves), 0
    for camera in [*town.walk(plan, options.views), *town.flight(plan, options.views)]:
        write_camera(folder / f"{camera.name}.json", camera.scaled(options.size), town.NEAR)
    leaves = town.build(plan, options.leaves, 0)
    method = method_in(folder, options)
    method.model.keep(torch.zeros(len(method.model), dtype=torch.bool))
    begun = time.perf_counter()
    method.store = store = method._new_store()
    store.fill(GrowingForest(leaves, folder))
    seconds = time.perf_counter() - begun
    for camera in method.data.train:
        assert camera.image is not None
        gaussians = store.gaussians_at(store.take(camera, options.pixels, town.NEAR))
        image = rasterize(gaussians, camera, near=town.NEAR, backend="cpu").image
        write_png(camera.image, (image.numpy().clip(0, 1) * 255).round().astype(np.uint8))
    torch.save(method.state_dict(), folder / "state.pt.part")
    (folder / "state.pt.part").rename(folder / "state.pt")
    return {"seconds": seconds, "nodes": len(store)}


def trained(options: argparse.Namespace) -> Method:
    """A run that has a town's tree."""
    method = method_in(options.folder, options)
    method.load_state_dict(torch.load(options.folder / "state.pt", weights_only=True))
    return method


def level(options: argparse.Namespace) -> dict:
    """The granularity, in pixels, at which views show so many splats on average; within 1 %."""
    method = trained(options)
    store = method.store
    assert store is not None

    def shown(pixels: float) -> float:
        counts = []
        for camera in method.data.train:
            eye, k = camera.center, detail_of(camera.focal, pixels)
            nodes, lists, bands = store._top.traverse(eye, k, image_borders(camera, town.NEAR))
            counts.append(len(nodes) + len(store.cut(lists.astype(np.int64), bands, eye, k)[0]))
        return float(np.mean(counts))

    low, high = 0.1, 100.0
    while high > 1.003 * low:
        pixels = (low * high) ** 0.5
        low, high = (pixels, high) if shown(pixels) > options.drawn else (low, pixels)
    return {"pixels": high, "shown": shown(high)}


def train(options: argparse.Namespace) -> dict:
    """Makes steps on a town's tree."""
    method = trained(options)
    store, cuts, drawn, times = method.store, [], [], []
    assert store is not None
    take = store.take
    if not WAYS[options.way]:
        method.view_index = lambda step: method.data.training_view(step, 0)

    def timed(*given) -> np.ndarray:
        begun = time.perf_counter()
        if "no cache" in options.way:
            store.cache.clear()  # what has changed is written
        places = take(*given)
        cuts.append(1000 * (time.perf_counter() - begun))
        drawn.append(len(places))
        return places

    store.take, resize, resized = timed, store.resize, []  # pyright: ignore

    def resize_timed() -> None:
        begun = time.perf_counter()
        resize()
        resized.append(time.perf_counter() - begun)

    store.resize = resize_timed
    largest = 0
    for step in range(1, options.steps + 1):
        begun, before = time.perf_counter(), sum(resized)
        method.train_step(step)
        times.append(time.perf_counter() - begun - (sum(resized) - before))
        if drawn[-1] > largest:
            assert isinstance(method._optimizer, SeenRecords)
            largest, splats = drawn[-1], method._optimizer.gaussians
            for name, each in vars(splats).items():  # without a copy, which would count
                np.save(options.folder / f"largest_{name}.npy", each.detach().numpy())
            (options.folder / "largest_view.txt").write_text(str(method.view_index(step)))
    begun = time.perf_counter()
    torch.save(method.state_dict(), options.folder / "checkpoint.pt")
    some = slice(WARM, -AFTER)
    share = store.cache.reused / max(store.cache.reused + store.cache.loaded, 1)
    cache_mb = (store.cache.capacity * (4 * store.layout.width + BESIDE) + store.cache.tables) / 1e6
    return {
        "splats": len(store), "cache_mb": cache_mb, "reused": share,
        "step_s": float(np.mean(times[some])), "cut_ms": float(np.mean(cuts[some])),
        "drawn": float(np.mean(drawn[some])), "s_per_million": 1e6 * sum(times[some]) / sum(drawn[some]),
        "resize_s": sum(resized), "checkpoint_s": time.perf_counter() - begun,
    }  # fmt: skip


def draw(options: argparse.Namespace) -> dict:
    """Draws the largest cut of a run some times, with gradients and the loss, and knows nothing of trees."""
    keep_freed_memory(LARGE)  # as a run does
    method = method_in(options.folder, options)
    names = [field.name for field in fields(Gaussians)]
    arrays = {name: np.load(options.folder / f"largest_{name}.npy") for name in names}
    view = method.data.view(int((options.folder / "largest_view.txt").read_text()))
    for _ in range(3):
        leaves = {name: torch.tensor(each, requires_grad=True) for name, each in arrays.items()}
        drawn = rasterize(Gaussians(**leaves), view.camera, near=town.NEAR, backend="cpu")
        ((drawn.image - view.target.image) ** 2).mean().backward()
    return {"drawn": len(arrays["means"])}


def peak_mb() -> float:
    """The most memory that this process has had, by the system's own count, in MB of 10⁶ bytes."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) * 1024 / 1e6


# -- the table -------------------------------------------------------------------------------------------


def run(stage: str, leaves: int, options: argparse.Namespace, **others: object) -> dict:
    """What a stage says that is run in a process of its own, with its peak."""
    folder = options.out.parent / f"tree_{leaves}_{options.views}"
    if stage == "build" and (folder / "state.pt").exists():
        return {}
    given = {name: getattr(options, name) for name in ("budget", "steps", "views", "size", "drawn", "pixels")}
    command = [sys.executable, __file__, "--stage", stage, "--leaves", str(leaves), "--folder", str(folder)]
    for name, value in {**given, **others}.items():
        command += [f"--{name}", str(value)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def told(row: dict) -> str:
    """A row of the table."""
    return (
        f"peak {row['peak_mb']:>6,.0f} MB of {row['allowed_mb']:>6,.0f} (drawing "
        f"{row['drawing_mb']:.0f})  step {row['step_s']:.3f} s, "
        f"{row['s_per_million']:.3f} s a million of {row['drawn']:,.0f} drawn, cut {row['cut_ms']:.0f} ms, "
        f"{row['reused']:.0%} were there, sizes {row['resize_s']:.1f} s, "
        f"checkpoint {row['checkpoint_s']:.1f} s"
    )


def add_row(path: Path, row: dict) -> None:
    """Puts a row into the report, for an earlier one of its town and way: sizes can be run one by one."""
    report = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"rows": []}
    named = row["name"], row["times"]
    report["rows"] = [each for each in report["rows"] if (each["name"], each.get("times")) != named] + [row]
    path.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description="measure training of trees larger than memory")
    parser.add_argument("--out", type=Path, default=Path("build/bench/tree.json"))
    parser.add_argument("--budget", type=float, default=400, help="MB of nodes with their moments")
    parser.add_argument("--times", type=float, nargs="+", default=(1, 3, 10), help="towns over the budget")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--views", type=int, default=24, help="of each way through a town")
    parser.add_argument("--drawn", type=int, default=300_000, help="splats that views show on average")
    parser.add_argument("--pixels", type=float, default=3.0, help="granularity of photographs")
    parser.add_argument("--size", type=float, default=1.0, help="of the pictures, 1 is 960x540")
    parser.add_argument(
        "--small", type=int, default=60_000, help="leaves of the tree that tells what the program takes"
    )
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--tiny", action="store_true", help="a small town, to see that memory is kept to")
    parser.add_argument("--stage", choices=["build", "level", "train", "draw"], help=argparse.SUPPRESS)
    parser.add_argument("--leaves", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--way", default="graph", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.stage:
        torch.set_num_threads(1)
        keep_freed_memory()
        found = {"build": build_store, "level": level, "train": train, "draw": draw}[options.stage](options)
        print(json.dumps(found | {"peak_mb": peak_mb()}))
        return
    if options.tiny:
        vars(options).update(TINY)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    run("build", options.small, options)
    half = options.small * 4e-6 * layout_of(0).width  # MB of the small tree's nodes
    program = [run("train", options.small, options, budget=half) for _ in range(2)][1]  # one may compile
    program, small = program["peak_mb"] - program["cache_mb"], run("draw", options.small, options)["peak_mb"]
    print(f"beside the budget and a tenth: program {program:.0f} MB, and drawing")
    for times in options.times:
        leaves = round(options.budget * 1e6 * times / (4 * layout_of(0).width) / 2)
        made = run("build", leaves, options)
        if made:
            print(f"{made['nodes']:,} nodes: tree in {made['seconds']:.0f} s, peak {made['peak_mb']:,.0f} MB")
        pixels = run("level", leaves, options)["pixels"]
        for way in options.ways:
            row = run("train", leaves, options, way=way, pixels=pixels)
            drawing = max(run("draw", leaves, options)["peak_mb"] - small, 0)
            allowed = 1.1 * options.budget + program + drawing
            row |= {"name": way, "times": times, "budget_mb": options.budget, "program_mb": program,
                    "drawing_mb": drawing, "allowed_mb": allowed, "pixels": pixels}  # fmt: skip
            add_row(options.out, {key: round(x, 4) if isinstance(x, float) else x for key, x in row.items()})
            print(f"  {times:>4g} x {pixels:.2f} px  {way:<17} {told(row)}", flush=True)


if __name__ == "__main__":
    main()
