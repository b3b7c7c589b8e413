"""Measure cuts of large trees of splats (A LoD of Gaussians, Sec. 4.3): ``make bench-tree``.

Cuts trees over towns (``examples.town``) of increasing size for views from the streets and from above the
roofs, alternately with HSPT, by traversal from the root (the paper's Algorithm 1), and by testing every
node (Eq. 5) on all threads. Checks that all return the same nodes, except nodes outside the image that HSPT
skips. Prints a table, plots time over the number of nodes, and writes build/bench/tree.json.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np

from examples import town
from tests.training.methods.tree.sequential_tree import SequentialPointTree
from training.lod.tree.nodes import ABOVE_ROOT, detail_of
from training.lod.tree.shape import Tree
from training.methods.tree.build import build
from training.rasterize.cpu.compile import (
    STRICT,
    f32,
    inlined,
    kernel,
    run_parallel,
    run_serial,
    thread_count,
)
from training.scenes.cameras import Camera

NODES = (100_000, 1_000_000, 10_000_000)
VIEWS = 6
"""Views per camera path."""
REPEATS = 5
_GRAIN = 1 << 16

Cut = Callable[[Camera, float], np.ndarray]


@inlined(STRICT)
def _fine(balls, i, first, center, k):
    """Return whether the node with mean and size at column ``first`` is fine enough."""
    x, y, z = balls[i, first] - center[0], balls[i, first + 1] - center[1], balls[i, first + 2] - center[2]
    return np.sqrt(x * x + y * y + z * z) >= k * balls[i, first + 3]


@kernel(STRICT)
def _traverse(balls, children, leaves, center, k, queue, nodes, count):
    """Traverse breadth first from the root, which is the last node; serial, without culling."""
    head, tail, size = 0, 1, 0
    queue[0] = len(balls) - 1
    while head < tail:
        node = queue[head]
        head += 1
        if _fine(balls, node, 0, center, k):
            nodes[size] = node
            size += 1
        else:
            queue[tail], queue[tail + 1] = children[node - leaves, 0], children[node - leaves, 1]
            tail += 2
    count[0] = size


@kernel(STRICT)
def _test_all(begin, end, families, center, k, nodes, counts):
    """Select the nodes of a range that are fine enough and whose parent is not."""
    size = begin
    for i in range(begin, end):
        if _fine(families, i, 0, center, k) and not _fine(families, i, 4, center, k):
            nodes[size] = i
            size += 1
    counts[begin // _GRAIN] = size - begin


def traversal(tree: Tree, balls: np.ndarray) -> Cut:
    """Return a cut function by Algorithm 1 over all nodes."""
    queue, nodes, count = (np.empty(size, np.int32) for size in (len(tree) + 2, len(tree), 1))

    def cut(camera: Camera, k: float) -> np.ndarray:
        center = camera.center.astype(np.float32)
        run_serial(_traverse, balls, tree.children, tree.leaves, center, f32(k), queue, nodes, count)
        return nodes[: count[0]].copy()

    return cut


def exhaustive_test(tree: Tree, balls: np.ndarray) -> Cut:
    """Return a cut function that tests Eq. 5 for every node, on all threads."""
    parents = balls[tree.parents]
    parents[-1, 3] = ABOVE_ROOT
    families = np.concatenate([balls, parents], axis=1)
    nodes = np.empty(len(tree), np.int32)
    counts = np.zeros(-(-len(tree) // _GRAIN), np.int64)

    def cut(camera: Camera, k: float) -> np.ndarray:
        center = camera.center.astype(np.float32)
        run_parallel(_test_all, len(tree), _GRAIN, families, center, f32(k), nodes, counts)
        parts = [nodes[part * _GRAIN : part * _GRAIN + count] for part, count in enumerate(counts)]
        return np.concatenate(parts)

    return cut


def measure(cuts: dict[str, Cut], cameras: Sequence[Camera], pixels: float) -> dict[str, tuple[float, float]]:
    """Return milliseconds per cut and number of nodes by name: medians of REPEATS, means over views."""
    times: dict[str, list[float]] = {name: [] for name in cuts}
    counts: dict[str, list[int]] = {name: [] for name in cuts}
    for camera in cameras:
        of_view: dict[str, list[float]] = {name: [] for name in cuts}
        k = detail_of(camera.focal, pixels)
        for _ in range(REPEATS + 1):  # the first is a warm-up
            for name, cut in cuts.items():
                start = time.perf_counter()
                nodes = cut(camera, k)
                of_view[name].append(1000 * (time.perf_counter() - start))
                if len(of_view[name]) == 1:
                    counts[name].append(len(nodes))
        for name in cuts:
            times[name].append(statistics.median(of_view[name][1:]))
    return {name: (statistics.mean(times[name]), statistics.mean(counts[name])) for name in cuts}


def check(cuts: dict[str, Cut], camera: Camera, pixels: float) -> None:
    """Check that all cuts have the same nodes, except nodes outside the image."""
    k = detail_of(camera.focal, pixels)
    visible, *complete = (np.sort(cut(camera, k)) for cut in cuts.values())
    for nodes in complete:
        assert np.array_equal(nodes, complete[0]) and np.isin(visible, nodes).all()


def rows_of(nodes: int, pixels: float) -> list[dict]:
    """Measure a tree of about this many nodes; return the rows."""
    leaves = nodes // 2
    plan = town.plan_for(leaves)
    start = time.perf_counter()
    splats = town.build(plan, leaves, 0)
    town_end = time.perf_counter()
    splats, tree = build(splats)
    built = time.perf_counter()
    sizes = tree.sizes(splats.means, splats.log_scales)
    hspt = SequentialPointTree(tree, splats.means, sizes, splats.log_scales)
    ready = time.perf_counter()
    print(
        f"{len(tree):,} nodes: town {town_end - start:.0f} s, tree {built - town_end:.0f} s, "
        f"HSPT {ready - built:.0f} s, {hspt.lists:,} lists"
    )
    balls = np.concatenate([splats.means, sizes[:, None]], axis=1)
    cuts: dict[str, Cut] = {
        "HSPT": lambda camera, k: hspt.cut(camera, camera.focal / k, town.NEAR),
        "HSPT without culling": lambda camera, k: hspt.cut_at(camera.center, k),
        "traversal of all nodes": traversal(tree, balls),
        "test of all nodes (Eq. 5)": exhaustive_test(tree, balls),
    }
    rows = []
    for kind, path in (("street", town.walk), ("flight", town.flight)):
        cameras = path(plan, VIEWS, 0.5)
        for camera in cameras:
            check(cuts, camera, pixels)
        for name, (cut_ms, count) in measure(cuts, cameras, pixels).items():
            row = {"name": name, "views": kind, "splats": leaves, "nodes": len(tree), "pixels": pixels}
            row |= {"found": round(count), "cut_ms": round(cut_ms, 3)}
            rows.append(row | dict.fromkeys(("budget_mb", "peak_mb", "step_s")))  # no training
            print(f"  {kind:<7} {name:<24} {cut_ms:>9.2f} ms {count:>11,.0f} nodes")
    return rows


def ratios(rows: Sequence[dict]) -> dict[str, float]:
    """Return the speedup of HSPT over each other method on the largest tree, over all views."""
    largest = max(row["nodes"] for row in rows)
    total: dict[str, float] = {}
    for row in rows:
        if row["nodes"] == largest:
            total[row["name"]] = total.get(row["name"], 0.0) + row["cut_ms"]
    return {name: round(time_ms / total["HSPT"], 2) for name, time_ms in total.items() if name != "HSPT"}


def plot(path: Path, rows: Sequence[dict]) -> None:
    """Plot time per view over the number of nodes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), sharey=True)
    for axis, kind in zip(axes, ("street", "flight"), strict=True):
        for name in dict.fromkeys(row["name"] for row in rows):
            selected = [row for row in rows if (row["name"], row["views"]) == (name, kind)]
            axis.plot(
                [row["nodes"] for row in selected], [row["cut_ms"] for row in selected], "o-", label=name
            )
        axis.set(xscale="log", yscale="log", xlabel="nodes", title=kind)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("ms per cut")
    axes[1].legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure cuts of large trees.")
    parser.add_argument("--out", type=Path, default=Path("build/bench/tree.json"))
    parser.add_argument("--nodes", type=int, nargs="+", default=NODES)
    parser.add_argument("--pixels", type=float, default=3.0, help="granularity (the paper's: 3)")
    options = parser.parse_args()
    rows = [row for nodes in options.nodes for row in rows_of(nodes, options.pixels)]
    speedups = ratios(rows)
    for name, times in speedups.items():
        print(f"At {max(row['nodes'] for row in rows):,} nodes HSPT is {times:.1f} times as fast as {name}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    earlier = json.loads(options.out.read_text(encoding="utf-8"))["rows"] if options.out.exists() else []
    trained = [row for row in earlier if row.get("peak_mb") is not None]  # by bench_tree_memory.py
    report = {"threads": thread_count(), "hspt_times_faster": speedups, "rows": rows + trained}
    options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    plot(options.out.with_suffix(".png"), rows)
    print(f"{options.out} and {options.out.with_suffix('.png').name}")


if __name__ == "__main__":
    main()
