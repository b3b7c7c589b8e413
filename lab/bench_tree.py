"""What cuts of a large tree of splats cost, as A LoD of Gaussians' Sec. 4.3 asks: ``make bench-tree``.

Trees over a town (``examples.town``) of more and more splats are cut for views from the streets and from
over the roofs, in turn, by HSPT, by a walk from the root over all nodes (the paper's Algorithm 1), and by
asking every node (Eq. 5) on all threads. All find the same nodes, but for what HSPT leaves out of the image,
and that is checked. Prints the table, draws time against the number of nodes, saves build/bench/tree.json.
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
from training.lod.rules.cut import ABOVE_ROOT, detail_of
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
from training.rasterize.sequential_point_tree import SequentialPointTree
from training.scenes.cameras import Camera

NODES = (100_000, 1_000_000, 10_000_000)
VIEWS = 6
"""Of each way through the town."""
REPEATS = 5
_GRAIN = 1 << 16

Cut = Callable[[Camera, float], np.ndarray]


@inlined(STRICT)
def _fine(balls, i, first, eye, k):
    """Whether the node whose mean and size begin at ``first`` is fine enough."""
    x, y, z = balls[i, first] - eye[0], balls[i, first + 1] - eye[1], balls[i, first + 2] - eye[2]
    return np.sqrt(x * x + y * y + z * z) >= k * balls[i, first + 3]


@kernel(STRICT)
def _walk_all(balls, children, leaves, eye, k, ahead, found, count):
    """Breadth first from the root, the last node; serial, and nothing is left out."""
    begin, end, place = 0, 1, 0
    ahead[0] = len(balls) - 1
    while begin < end:
        node = ahead[begin]
        begin += 1
        if _fine(balls, node, 0, eye, k):
            found[place] = node
            place += 1
        else:
            ahead[end], ahead[end + 1] = children[node - leaves, 0], children[node - leaves, 1]
            end += 2
    count[0] = place


@kernel(STRICT)
def _ask_all(begin, end, families, eye, k, found, counts):
    """Of a range of nodes those that are fine enough and whose parent is not."""
    place = begin
    for i in range(begin, end):
        if _fine(families, i, 0, eye, k) and not _fine(families, i, 4, eye, k):
            found[place] = i
            place += 1
    counts[begin // _GRAIN] = place - begin


def walk_of(tree: Tree, balls: np.ndarray) -> Cut:
    """Algorithm 1 over all nodes."""
    ahead, found, count = (np.empty(size, np.int32) for size in (len(tree) + 2, len(tree), 1))

    def cut(camera: Camera, k: float) -> np.ndarray:
        eye = camera.center.astype(np.float32)
        run_serial(_walk_all, balls, tree.children, tree.leaves, eye, f32(k), ahead, found, count)
        return found[: count[0]].copy()

    return cut


def asking_all(tree: Tree, balls: np.ndarray) -> Cut:
    """Eq. 5 for every node, on all threads."""
    above = balls[tree.parents]
    above[-1, 3] = ABOVE_ROOT
    families = np.concatenate([balls, above], axis=1)
    found = np.empty(len(tree), np.int32)
    counts = np.zeros(-(-len(tree) // _GRAIN), np.int64)

    def cut(camera: Camera, k: float) -> np.ndarray:
        eye = camera.center.astype(np.float32)
        run_parallel(_ask_all, len(tree), _GRAIN, families, eye, f32(k), found, counts)
        parts = [found[part * _GRAIN : part * _GRAIN + count] for part, count in enumerate(counts)]
        return np.concatenate(parts)

    return cut


def measure(cuts: dict[str, Cut], cameras: Sequence[Camera], pixels: float) -> dict[str, tuple[float, float]]:
    """Milliseconds a cut and nodes found, by name: medians of REPEATS, means over views; all in turn."""
    times: dict[str, list[float]] = {name: [] for name in cuts}
    counts: dict[str, list[int]] = {name: [] for name in cuts}
    for camera in cameras:
        of_view: dict[str, list[float]] = {name: [] for name in cuts}
        k = detail_of(camera.focal, pixels)
        for _ in range(REPEATS + 1):  # the first one warms up
            for name, cut in cuts.items():
                begun = time.perf_counter()
                found = cut(camera, k)
                of_view[name].append(1000 * (time.perf_counter() - begun))
                if len(of_view[name]) == 1:
                    counts[name].append(len(found))
        for name in cuts:
            times[name].append(statistics.median(of_view[name][1:]))
    return {name: (statistics.mean(times[name]), statistics.mean(counts[name])) for name in cuts}


def check(cuts: dict[str, Cut], camera: Camera, pixels: float) -> None:
    """All find the same nodes, but for what is out of the image."""
    k = detail_of(camera.focal, pixels)
    some, *others = (np.sort(cut(camera, k)) for cut in cuts.values())
    for other in others:
        assert np.array_equal(other, others[0]) and np.isin(some, other).all()


def rows_of(nodes: int, pixels: float) -> list[dict]:
    """The measured rows of a tree of about so many nodes."""
    leaves = nodes // 2
    plan = town.plan_for(leaves)
    begun = time.perf_counter()
    splats = town.build(plan, leaves, 0)
    made = time.perf_counter()
    splats, tree = build(splats)
    built = time.perf_counter()
    sizes = tree.sizes(splats.means, splats.log_scales)
    hspt = SequentialPointTree(tree, splats.means, sizes, splats.log_scales)
    ready = time.perf_counter()
    print(
        f"{len(tree):,} nodes: town {made - begun:.0f} s, tree {built - made:.0f} s, "
        f"HSPT {ready - built:.0f} s, {hspt.lists:,} lists"
    )
    balls = np.concatenate([splats.means, sizes[:, None]], axis=1)
    cuts: dict[str, Cut] = {
        "HSPT": lambda camera, k: hspt.cut(camera, camera.focal / k, town.NEAR),
        "HSPT, nothing left out": lambda camera, k: hspt.cut_at(camera.center, k),
        "walk over all nodes": walk_of(tree, balls),
        "all nodes asked (Eq. 5)": asking_all(tree, balls),
    }
    rows = []
    for kind, way in (("street", town.walk), ("flight", town.flight)):
        cameras = way(plan, VIEWS, 0.5)
        for camera in cameras:
            check(cuts, camera, pixels)
        for name, (cut_ms, found) in measure(cuts, cameras, pixels).items():
            row = {"name": name, "views": kind, "splats": leaves, "nodes": len(tree), "pixels": pixels}
            row |= {"found": round(found), "cut_ms": round(cut_ms, 3)}
            rows.append(row | dict.fromkeys(("budget_mb", "peak_mb", "step_s")))  # nothing is trained here
            print(f"  {kind:<7} {name:<24} {cut_ms:>9.2f} ms {found:>11,.0f} nodes found")
    return rows


def ratios(rows: Sequence[dict]) -> dict[str, float]:
    """Of the largest tree, how many times faster HSPT is than each other way, all views together."""
    most = max(row["nodes"] for row in rows)
    total: dict[str, float] = {}
    for row in rows:
        if row["nodes"] == most:
            total[row["name"]] = total.get(row["name"], 0.0) + row["cut_ms"]
    return {name: round(each / total["HSPT"], 2) for name, each in total.items() if name != "HSPT"}


def plot(path: Path, rows: Sequence[dict]) -> None:
    """Time a view against the number of nodes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), sharey=True)
    for each, kind in zip(axes, ("street", "flight"), strict=True):
        for name in dict.fromkeys(row["name"] for row in rows):
            some = [row for row in rows if (row["name"], row["views"]) == (name, kind)]
            each.plot([row["nodes"] for row in some], [row["cut_ms"] for row in some], "o-", label=name)
        each.set(xscale="log", yscale="log", xlabel="nodes", title=kind)
        each.grid(alpha=0.3)
    axes[0].set_ylabel("ms a cut")
    axes[1].legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description="measure cuts of large trees")
    parser.add_argument("--out", type=Path, default=Path("build/bench/tree.json"))
    parser.add_argument("--nodes", type=int, nargs="+", default=NODES)
    parser.add_argument("--pixels", type=float, default=3.0, help="granularity (the paper's: 3)")
    options = parser.parse_args()
    rows = [row for nodes in options.nodes for row in rows_of(nodes, options.pixels)]
    faster = ratios(rows)
    for name, times in faster.items():
        print(f"At {max(row['nodes'] for row in rows):,} nodes HSPT is {times:.1f} times faster than: {name}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    known = json.loads(options.out.read_text(encoding="utf-8"))["rows"] if options.out.exists() else []
    trained = [row for row in known if row.get("peak_mb") is not None]  # lab/bench_tree_memory.py's
    report = {"threads": thread_count(), "hspt_times_faster": faster, "rows": rows + trained}
    options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    plot(options.out.with_suffix(".png"), rows)
    print(f"{options.out} and {options.out.with_suffix('.png').name}")


if __name__ == "__main__":
    main()
