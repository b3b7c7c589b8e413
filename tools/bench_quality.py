"""Measure quality over training time: all methods on all scenes, for several shares of the preset's steps.

    python tools/bench_quality.py examples/lantern_walk DIR ...      validation views, for choosing settings
    python tools/bench_quality.py --report --base ../other DIR ...   test views, compared with a checkout
    python tools/bench_quality.py --subsets DIR ...                  also harder copies (quality_scenes.py)

Each point is a complete run, because schedules depend on the number of steps. Runs of two checkouts alternate
on the same cores; this checkout measures both. Finished runs are reused when the benchmark is repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(HERE))

from tools.quality_scenes import SUBSETS, write_courtyard, write_subset  # noqa: E402
from training.errors import LodgsError  # noqa: E402
from training.evaluate.views import REDUCTIONS  # noqa: E402
from training.methods import METHODS  # noqa: E402
from training.runs.measure import evaluate_run  # noqa: E402

RUN = ("scene", "method", "version", "share", "seed")
COLUMNS = (
    "psnr",
    "fitted_psnr",
    "worst",
    "train_psnr",
    "gap",
    "veil",
    "veil_max",
    "oversized",
    "splats",
    "seconds",
)


@dataclass
class Point:
    """Settings of a run, the quality of its finest level, and the measures of all levels."""

    scene: str
    method: str
    version: str
    share: float
    seed: int
    psnr: float
    fitted_psnr: float
    worst: float
    train_psnr: float
    veil: float
    veil_max: float
    oversized: int
    splats: int
    seconds: float
    levels: list[dict]
    curve: list[dict]

    @property
    def gap(self) -> float:
        """PSNR of training views minus that of held-out views, in dB."""
        return self.train_psnr - self.psnr


def scenes_to_train(folders: Iterable[Path], subsets: Path | None) -> dict[Path, int]:
    """Return the scenes and the distance of their held-out views.

    Args:
        folders: scenes.
        subsets: folder for harder copies of them, which are written if missing; None for no copies.
    """
    scenes = {folder.resolve(): 8 for folder in folders}
    if subsets is not None:
        subsets.mkdir(parents=True, exist_ok=True)
        for folder in list(scenes):
            for name, subset in SUBSETS.items():
                copy = write_subset(folder, subsets / f"{folder.name}-{name}", subset)
                scenes |= {copy: subset.test_every} if copy else {}
        scenes[write_courtyard(subsets / "courtyard")] = 8
    return scenes


def train(
    checkout: Path, out: Path, scene: Path, method: str, share: float, seed: int, args, test_every: int = 8
) -> None:
    """Train with a checkout of the project, unless the run is finished.

    Args:
        test_every: distance of held-out views.

    Raises:
        LodgsError: training failed, or the folder holds another run.
    """
    preset = METHODS[method].preset(args.preset)
    scaled = [
        f"--set={name}={json.dumps(_scaled(getattr(preset, name), share))}"
        for name in ("steps", "tune_steps")
        if hasattr(preset, name)
    ]
    command = [
        sys.executable, "-m", "training", "train", "--scene", str(scene), "--out", str(out),
        "--method", method, "--preset", args.preset, "--seed", str(seed),
        "--image-scale", str(args.image_scale), "--test-every", str(test_every),
        *scaled, *(f"--set={assignment}" for assignment in args.set),
        *([] if args.report else ["--validation"]),
    ]  # fmt: skip
    key = json.dumps([_version(checkout), *command[2:]])
    record = out.with_name(f".{out.name}.json")
    if (out / "bundle.ply").exists():
        if not record.exists() or record.read_text(encoding="utf-8") != key:
            raise LodgsError(
                f"The run {out} was trained with other options or another version.",
                "Choose another folder with --out DIR.",
            )
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(key, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": "", "OMP_NUM_THREADS": "1"}
    process = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True)
    if process.returncode:
        output = process.stdout.strip() or process.stderr.strip() or "no output"
        raise LodgsError(f"Cannot train {method} on {scene.name} with {checkout}: {output.splitlines()[-1]}")


def _version(checkout: Path) -> str:
    """Return git's description of a checkout."""
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40"]
    return subprocess.run(command, capture_output=True, text=True).stdout.strip()


def _scaled(steps: int | tuple[int, ...], share: float) -> int | list[int]:
    if isinstance(steps, int):
        return max(round(share * steps), 1)
    return [max(round(share * count), 1) for count in steps]


def measure(out: Path, **run) -> Point:
    """Measure a finished run."""
    events = [json.loads(line) for line in (out / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    report = evaluate_run(out)
    finest = report["levels"][-1]
    return Point(
        **run, psnr=finest["psnr"], fitted_psnr=report["fitted_psnr"], worst=report["worst"]["psnr"],
        train_psnr=report["train_psnr"], veil=report["veil"]["mean"], veil_max=report["veil"]["max"],
        oversized=report["oversized"], splats=finest["splats"], seconds=events[-1]["seconds"],
        levels=report["levels"], curve=report.get("curve", []),
    )  # fmt: skip


def table(points: Iterable[Point]) -> str:
    """Format points as a Markdown table."""
    return _markdown([*RUN, *COLUMNS], ([getattr(p, name) for name in (*RUN, *COLUMNS)] for p in points))


def level_table(points: Iterable[Point]) -> str:
    """Format the PSNR of levels by image size, and that of merges of as many splats, as a Markdown table."""
    sizes = [f"1/{factor}" for factor in REDUCTIONS]
    rows = []
    for p in points:
        for row in p.levels:
            merged = row.get("merged", [""] * len(sizes))
            run = [getattr(p, name) for name in RUN]
            rows.append([*run, row["level"], row["splats"], *row["by_size"], *merged])
    return _markdown([*RUN, "level", "splats", *sizes, *(f"merged {size}" for size in sizes)], rows)


def _markdown(names: list[str], rows: Iterable[list]) -> str:
    cells = ([f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row] for row in rows)
    return "\n".join(" | ".join(row) for row in [names, ["---"] * len(names), *cells])


def plot(points: list[Point], path: Path) -> None:
    """Plot PSNR and veil over seconds: a column per scene, a colour per method, a line style per version."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes, methods, versions = (
        list(dict.fromkeys(getattr(p, name) for p in points)) for name in ("scene", "method", "version")
    )
    figure, axes = pyplot.subplots(
        2, len(scenes), figsize=(4.5 * len(scenes), 7), squeeze=False, sharex="col"
    )
    for column, scene in enumerate(scenes):
        for row, (name, label) in enumerate((("psnr", "PSNR (dB)"), ("veil", "veil (share)"))):
            axis = axes[row, column]
            axis.set(ylabel=label, xlabel="seconds" if row else "", title="" if row else scene)
            for color, method in enumerate(methods):
                for dash, version in enumerate(versions):
                    curve: dict[float, list[Point]] = {}
                    for p in points:
                        if (p.scene, p.method, p.version) == (scene, method, version):
                            curve.setdefault(p.share, []).append(p)
                    x, y = (
                        [sum(getattr(p, key) for p in runs) / len(runs) for _, runs in sorted(curve.items())]
                        for key in ("seconds", name)
                    )
                    style = {"color": f"C{color}", "linestyle": ["-", "--", ":"][dash % 3], "marker": "o"}
                    axis.plot(x, y, label=f"{method}, {version}", **style)
    axes[0, 0].legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def sizes_and_quality(point: Point) -> tuple[list[tuple[int, float]], list[tuple[int, float]]]:
    """Return splat counts and dB at full size, ascending: of levels and selections, and of merges."""
    rows = [(row["splats"], row["by_size"][0], row.get("merged", [None])[0]) for row in point.levels]
    rows += [(row["splats"], row["psnr"], row.get("merged")) for row in point.curve if "psnr" in row]
    rows.sort(key=lambda row: row[0])
    return [row[:2] for row in rows], [(row[0], row[2]) for row in rows if row[2] is not None]


def plot_levels(points: Iterable[Point], path: Path) -> None:
    """Plot PSNR over splats: a panel per scene, a colour per method, merges of the finest level dashed.

    Points are the longest runs of this checkout with the first seed.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    longest: dict[tuple[str, str], Point] = {}
    for p in sorted(points, key=lambda p: (-p.share, p.seed)):
        if p.version == "this":
            longest.setdefault((p.scene, p.method), p)
    scenes, methods = (list(dict.fromkeys(key)) for key in zip(*longest, strict=True))
    figure, axes = pyplot.subplots(1, len(scenes), figsize=(6.5 * len(scenes), 4.5), squeeze=False)
    for axis, scene in zip(axes[0], scenes, strict=True):
        for color, method in enumerate(methods):
            if (scene, method) in longest:
                levels, merges = sizes_and_quality(longest[scene, method])
                axis.plot(*zip(*levels, strict=True), color=f"C{color}", marker="o", ms=4, label=method)
                if merges:
                    axis.plot(*zip(*merges, strict=True), color=f"C{color}", linestyle="--", lw=1)
        axis.set(title=scene, xlabel="splats (dashed: merged)", ylabel="PSNR (dB)", xscale="log")
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--base", type=Path, help="another checkout to compare with; requires --report")
    parser.add_argument(
        "--report", action="store_true", help="measure test views instead of validation views"
    )
    parser.add_argument(
        "--subsets", action="store_true", help="also measure harder copies of the scenes; implies --report"
    )
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--preset", default="draft")
    parser.add_argument(
        "--shares", nargs="+", type=float, default=[0.25, 0.5, 1.0], help="shares of the preset's steps"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="parameter of the method, as for lodgs train",
    )
    parser.add_argument("--out", type=Path, default=HERE / "build" / "quality")
    args = parser.parse_args(arguments)
    args.report |= args.subsets
    if args.base and not args.report:
        parser.error("--base requires --report: older versions may not support validation views")
    versions = {"this": HERE} | ({"base": args.base.resolve()} if args.base else {})
    if args.base and not (args.base / "training" / "__main__.py").is_file():
        parser.error(f"--base {args.base} is not a checkout of the project")
    if not all(0 < share <= 10 for share in args.shares):
        parser.error("--shares must be above 0 and at most 10")
    args.out = args.out.resolve()
    args.subsets = args.out / "scenes" if args.subsets else None
    points = []
    try:
        for scene, test_every in scenes_to_train(args.scenes, args.subsets).items():
            for method in args.methods:
                for share in args.shares:
                    for seed in args.seeds:
                        for version, checkout in versions.items():
                            run = {"scene": scene.name, "method": method, "version": version}
                            run |= {"share": share, "seed": seed}
                            out = args.out / "-".join(map(str, run.values()))
                            train(checkout, out, scene, method, share, seed, args, test_every)
                            points.append(measure(out, **run))
                            print(table(points[-1:]).splitlines()[-1], flush=True)
    except LodgsError as error:
        print(error.what, error.remedy, file=sys.stderr)
        return 2
    tables = f"{table(points)}\n\n{level_table(points)}\n"
    print(level_table(points))
    (args.out / "quality.md").write_text(tables, encoding="utf-8")
    (args.out / "quality.json").write_text(
        json.dumps([asdict(p) for p in points], indent=1), encoding="utf-8"
    )
    plot(points, args.out / "quality.png")
    plot_levels(points, args.out / "levels.png")
    print(f"Wrote {args.out / 'quality.md'}, quality.png and levels.png.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
