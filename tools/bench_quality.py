"""Quality against seconds: every method on every scene, trained for shares of its preset's steps.

    python tools/bench_quality.py examples/lantern_walk DIR ...      validation views, to choose by
    python tools/bench_quality.py --report --base ../before DIR ...  test views, beside another checkout

A point of a curve is a whole run, so that schedules end as they should. Runs of two checkouts take turns with
each other, on the same cores; both are measured by this one. What was trained is kept, so that a bench that
was ended goes on.
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

from training.errors import LodgsError  # noqa: E402
from training.methods import METHODS  # noqa: E402
from training.runs.measure import evaluate_run  # noqa: E402

COLUMNS = ("psnr", "fitted_psnr", "worst", "train_psnr", "veil", "veil_max", "oversized", "splats", "seconds")


@dataclass
class Point:
    """One run: which it was, and what it was worth at its finest level."""

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


def train(checkout: Path, out: Path, scene: Path, method: str, share: float, seed: int, args) -> None:
    """Trains in a checkout of the project, unless that was done before.

    Raises:
        LodgsError: the trainer says what is wrong, or what was done before is another run.
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
        "--image-scale", str(args.image_scale),
        *scaled, *(f"--set={each}" for each in args.set), *([] if args.report else ["--validation"]),
    ]  # fmt: skip
    asked = json.dumps([_version(checkout), *command[2:]])
    record = out.with_name(f".{out.name}.json")
    if (out / "bundle.ply").exists():
        if not record.exists() or record.read_text(encoding="utf-8") != asked:
            raise LodgsError(
                f"{out} was trained with other options, or by another version.",
                "Name another folder: --out DIR.",
            )
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(asked, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": "", "OMP_NUM_THREADS": "1"}
    ran = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True)
    if ran.returncode:
        last = ran.stdout.strip().splitlines()[-1:] or [ran.stderr]
        raise LodgsError(f"{method} on {scene.name} in {checkout}: {last[0]}")


def _version(checkout: Path) -> str:
    """What a checkout holds, as far as git knows."""
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40"]
    return subprocess.run(command, capture_output=True, text=True).stdout.strip()


def _scaled(steps: int | tuple[int, ...], share: float) -> int | list[int]:
    if isinstance(steps, int):
        return max(round(share * steps), 1)
    return [max(round(share * each), 1) for each in steps]


def measured(out: Path, **run) -> Point:
    """What a finished run is worth."""
    events = [json.loads(line) for line in (out / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    report = evaluate_run(out)
    finest = report["levels"][-1]
    return Point(
        **run, psnr=finest["psnr"], fitted_psnr=report["fitted_psnr"], worst=report["worst"]["psnr"],
        train_psnr=report["train_psnr"], veil=report["veil"]["mean"], veil_max=report["veil"]["max"],
        oversized=report["oversized"], splats=finest["splats"], seconds=events[-1]["seconds"],
    )  # fmt: skip


def table(points: Iterable[Point]) -> str:
    """The points as Markdown."""
    names = ("scene", "method", "version", "share", "seed", *COLUMNS)
    rows = [
        [f"{value:.4g}" if isinstance(value, float) else str(value) for value in asdict(p).values()]
        for p in points
    ]
    return "\n".join(" | ".join(row) for row in [names, ["---"] * len(names), *rows])


def plot(points: list[Point], path: Path) -> None:
    """PSNR and veil against seconds: scenes side by side, methods in colours, versions dashed."""
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
                    across, up = (
                        [sum(getattr(p, key) for p in some) / len(some) for _, some in sorted(curve.items())]
                        for key in ("seconds", name)
                    )
                    style = {"color": f"C{color}", "linestyle": ["-", "--", ":"][dash % 3], "marker": "o"}
                    axis.plot(across, up, label=f"{method}, {version}", **style)
    axes[0, 0].legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--base", type=Path, help="another checkout to train with as well; needs --report")
    parser.add_argument("--report", action="store_true", help="measure on test views instead")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--shares", nargs="+", type=float, default=[0.25, 0.5, 1.0], help="of the steps")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="as train has it")
    parser.add_argument("--out", type=Path, default=HERE / "build" / "quality")
    args = parser.parse_args()
    if args.base and not args.report:
        parser.error("--base needs --report: an older version may not know validation views")
    versions = {"this": HERE} | ({"base": args.base.resolve()} if args.base else {})
    if args.base and not (args.base / "training").is_dir():
        parser.error(f"--base {args.base} is no checkout of the project")
    if not all(0 < share <= 10 for share in args.shares):
        parser.error("--shares are of a preset's steps, above 0 and at most 10")
    args.out = args.out.resolve()
    points = []
    try:
        for scene in args.scenes:
            for method in args.methods:
                for share in args.shares:
                    for seed in args.seeds:
                        for version, checkout in versions.items():
                            run = {"scene": scene.name, "method": method, "version": version}
                            run |= {"share": share, "seed": seed}
                            out = args.out / "-".join(str(each) for each in run.values())
                            train(checkout, out, scene.resolve(), method, share, seed, args)
                            points.append(measured(out, **run))
                            print(table(points[-1:]).splitlines()[-1], flush=True)
    except LodgsError as error:
        print(error.what, error.remedy, file=sys.stderr)
        return 2
    (args.out / "quality.md").write_text(table(points) + "\n", encoding="utf-8")
    (args.out / "quality.json").write_text(
        json.dumps([asdict(p) for p in points], indent=1), encoding="utf-8"
    )
    plot(points, args.out / "quality.png")
    print(f"{args.out / 'quality.md'} and quality.png are written.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
