"""Measure levels of detail on a large scene, as in LODGE's Table 3: ``make bench-lod``.

Captures a generated town (``examples.town``), creates levels and chunks, and renders them from unseen
positions: the full model, levels only, with chunks, with visibility, and with blending; and levels of FLoD
and Octree-GS trained on the same photos. Frame times are measured alternately. Prints a table and writes
build/bench/lod.json. Intermediate results are stored in the same folder and reused; the first run takes
about an hour on two cores. Stages can be run separately; the table contains available results.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import torch

from examples import town
from training.evaluate.metrics import psnr
from training.lod.blocks import BLOCKS, block_table
from training.lod.on_disk import read_part
from training.lod.rules.chunks import RULE, TABLE, member_columns
from training.lod.selection import resolve_controls
from training.methods.lodge.chunks import chunk_rows
from training.methods.lodge.composite import IndexedLevel
from training.rasterize import Gaussians, Rendering
from training.rasterize.resident import ResidentBundle
from training.runs.capture import write_scene
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.scenes.cameras import Camera, pick_evenly
from training.scenes.colmap import read_scene
from training.scenes.images import write_png
from training.splats.bundle import read_bundle, write_bundle
from training.splats.levels import Bundle
from training.splats.ply import extra_columns, read_ply, splat_columns, write_ply

REPEATS = 7
PACE = 1.5 / 24
"""Metres per frame at walking pace, for measuring jumps."""
POSITIONS = 12
"""Number of chunk borders along the walk, and of positions between them, to measure."""
FRAMES = 6
"""Frames at each of these positions."""

DISTANCES = (24.0, 10.0)
"""Distances in metres beyond which LODGE's coarser levels are used. Its automatic choice is 32 and 16."""
LODGE = {"levels_from": "pruned", "chunks": 64, "keep": 0.35, "prune_weight": 0.03, "tune_steps": 240}
"""Other parameters of LODGE, for 3 million splats at 11 cm spacing that each cover part of a pixel."""
OTHER_METHODS = {
    "flod": {"steps": [400, 600, 800, 1200, 2000], "max_splats": 300_000},
    "octree": {"steps": 5000, "max_splats": 300_000, "levels_from": "anchors"},
}
"""Parameters of the other methods, trained from points on photos at half size: draft presets with more steps
and splats, at most about 20 minutes each."""
STAGES = ("town", "lodge", "others", "table")

Draw = Callable[[Camera], Rendering]


@dataclass
class Row:
    """One variant of rendering the town.

    Attributes:
        resident: loaded bundle.
        draw: renders a view.
        bytes: bytes per splat.
    """

    name: str
    resident: ResidentBundle
    draw: Draw
    bytes: int


def make_town(folder: Path, splats: int, views: int) -> None:
    """Create the town and its photos, town.ply and scene/, unless they exist."""
    plan = town.plan_for(splats, 0)
    if not (folder / "town.ply").exists():
        write_ply(folder / "town.ply", town.build(plan, splats, 1, 0))
    if not (folder / "scene").exists():
        cameras = [*town.walk(plan, views), *town.flight(plan, views)]
        write_scene(folder / "scene", read_ply(folder / "town.ply"), cameras, town.NEAR, town.POINTS)


def train(folder: Path, method: str, parameters: dict, *options: str) -> None:
    """Start or resume a method's run on the photos."""
    run = folder / method
    if (run / "bundle.ply").exists():
        return
    started = time.monotonic()
    print(f"training {method} ...", flush=True)
    command = [sys.executable, "-m", "training", "train", "--scene", folder / "scene", "--out", run]
    command += ["--method", method, "--test-every", "0", *options]
    for name, value in parameters.items():
        command += ["--set", f"{name}={value}"]
    subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)
    print(f"{method}: {time.monotonic() - started:.0f} s", flush=True)


def train_lodge(folder: Path, views: int, effort: float) -> None:
    """Train LODGE's levels and chunks of the town's splats."""
    depth = read_scene(folder / "scene").median_depth()
    distances = [round(metres / depth, 4) for metres in DISTANCES] + [0]
    parameters = {"distances": distances, **LODGE, "tune_steps": scaled(LODGE["tune_steps"], effort)}
    parameters["chunks"] = min(LODGE["chunks"], 4 * views // 3)
    train(folder, "lodge", parameters, "--base", str(folder / "town.ply"), "--image-scale", "1")


def scaled(steps, effort: float):
    """Scale numbers of steps."""
    if isinstance(steps, list):
        return [scaled(count, effort) for count in steps]
    return max(round(effort * steps), 10)


def without_visibility(file: Path) -> Path:
    """Write the bundle with all members of the chunks by Eq. 2, without visibility; return its path."""
    path = file.with_name("without_visibility.ply")
    if path.exists() and path.stat().st_mtime > file.stat().st_mtime:
        return path
    bundle = read_bundle(file)
    levels = {level.number: IndexedLevel.of(Gaussians.of(level.splats)) for level in reversed(bundle.levels)}
    d_l = {level.number: level.facts["d_l"] for level in bundle.levels}
    table, sets = bundle.tables[TABLE], {number: [] for number in levels}
    centres = np.stack([table[axis] for axis in "xyz"], axis=1)
    for centre, radius in zip(centres, table["radius"], strict=True):
        for number, rows in chunk_rows(levels, d_l, centre, float(radius)).items():
            inside = np.zeros(len(levels[number]), bool)
            inside[rows] = True
            sets[number].append(inside)
    splats = {
        level.number: replace(level.splats, extras=member_columns(np.stack(sets[level.number])))
        for level in bundle.levels
    }
    columns = ((number, level.extras) for number, level in splats.items())
    tables = {**bundle.tables, BLOCKS: block_table(RULE.block_bounds, columns)}
    levels_out = [replace(level, splats=splats[level.number]) for level in bundle.levels]
    write_bundle(path, replace(bundle, levels=levels_out, tables=tables))
    return path


def rows_of(file: Path, other_bundles: dict[str, Path]) -> list[Row]:
    """Return all variants, the full model first. Each reads only the data it needs."""

    def row(name: str, path: Path, **values: float) -> Row:
        resident = ResidentBundle(path)
        controls = resolve_controls(resident.bundle, values)
        return Row(
            name, resident, lambda camera: resident.draw(camera, controls, near=town.NEAR), bytes_of(path)
        )

    full, plain = ResidentBundle(file), bytes_of(file, extras=False)
    finest = full.bundle.levels[-1].number
    rows = [
        Row("full", full, lambda camera: full.draw_level(finest, camera, near=town.NEAR), plain),
        row("levels", file, chunks=0),
    ]
    if TABLE in full.bundle.tables:
        rows += [
            row("levels + chunks", without_visibility(file), chunks=1, fade=0),
            row("levels + chunks + visibility", file, chunks=1, fade=0),
            row("levels + chunks + visibility + blending", file, chunks=1, fade=1),
        ]
    return rows + [row(name, path) for name, path in other_bundles.items()]


def bytes_of(file: Path, extras: bool = True) -> int:
    """Return the bytes per splat of a file."""
    splats = read_part(file, [])[0].levels[-1].splats
    columns = splat_columns(splats) | (extra_columns(splats) if extras else {})
    return sum(column.dtype.itemsize for column in columns.values())


def measure(rows: Sequence[Row], paths: dict[str, list[Camera]]) -> list[dict]:
    """Render all views with all variants alternately; return the table."""
    results = {row.name: {path: [] for path in paths} for row in rows}
    for path, cameras in paths.items():
        for camera in cameras:
            truth = None
            for row in rows:
                rendering = row.draw(camera)
                truth = rendering.image if truth is None else truth
                count = int((rendering.radii > 0).sum())
                results[row.name][path].append([psnr(rendering.image, truth), count, row.resident.loaded, []])
            for _ in range(REPEATS):
                for row in rows:
                    started = time.perf_counter()
                    row.draw(camera)
                    results[row.name][path][-1][3].append(time.perf_counter() - started)
    table = []
    for row in rows:
        line: dict = {"name": row.name}
        for path, views in results[row.name].items():
            line[path] = {
                "psnr_full": round(float(np.mean([view[0] for view in views])), 2),
                "ms": round(1e3 * float(np.mean([statistics.median(view[3]) for view in views])), 1),
                "drawn": round(float(np.mean([view[1] for view in views]))),
                "loaded": round(float(np.mean([view[2] for view in views]))),
            }
        names = list(results[row.name])
        for name in ("psnr_full", "ms", "drawn", "loaded"):
            line[name] = round(float(np.mean([line[path][name] for path in names])), 2)
        line["mb"] = round(line["loaded"] * row.bytes / 1e6, 1)
        table.append(line)
    return table


def jumps(rows: Sequence[Row], bundle: Bundle, plan: town.Plan, image: Path) -> dict[str, dict[str, float]]:
    """Measure changes between frames at walking pace, relative to the full model.

    At a faster pace, motion would hide the jumps.

    Args:
        rows: variants.
        bundle: bundle with chunks.
        plan: the town.
        image: PNG to write for the most visible border: the frame before it, and ten times the difference to
            the next frame for the full model, without blending and with blending.

    Returns:
        The largest ratio at a ``border`` between chunks and ``elsewhere``, by variant.
    """
    centers = np.stack([camera.center for camera in town.walk(plan, 1000)])
    views = town.walk(plan, round(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum() / PACE), 0.5)
    values = resolve_controls(bundle, {"fade": 0})
    nearest = [RULE.near_chunks(view.center, values, bundle.tables)[:1] for view in views]
    borders = [number for number, (a, b) in enumerate(pairwise(nearest)) if a != b]
    frames_by_kind = {"border": borders, "elsewhere": [(a + b) // 2 for a, b in pairwise(borders)]}
    frames_by_kind = {
        kind: [max(frame - 2, 0) for frame in pick_evenly(frames, POSITIONS)]
        for kind, frames in frames_by_kind.items()
    }
    compared = [rows[0], *rows[3:5]]

    def render(row: Row, first: int) -> list[np.ndarray]:
        return [row.draw(view).image.numpy() for view in views[first : first + FRAMES]]

    def frame_changes(row: Row, kind: str) -> np.ndarray:
        frames = frames_by_kind[kind]
        return np.array([[np.abs(b - a).mean() for a, b in pairwise(render(row, first))] for first in frames])

    changes = {kind: [frame_changes(row, kind) for row in compared] for kind in frames_by_kind}
    worst = np.argmax((changes["border"][1] / changes["border"][0]).max(axis=1))
    index = np.argmax(changes["border"][1][worst] / changes["border"][0][worst])
    frames = [render(row, frames_by_kind["border"][worst])[index : index + 2] for row in compared]
    tiles = [frames[0][0], *(10 * np.abs(b - a) for a, b in frames)]
    sheet = np.concatenate([np.concatenate(tiles[:2], axis=1), np.concatenate(tiles[2:], axis=1)])
    write_png(image, np.round(255 * sheet.clip(0, 1)).astype(np.uint8))
    return {
        row.name: {
            kind: round(float((by_row[number] / by_row[0]).max()), 3) for kind, by_row in changes.items()
        }
        for number, row in enumerate(compared[1:], 1)
    }


def describe_run(run: Path) -> dict:
    """Return the settings and result of another method's run."""
    folder = RunFolder(run)
    job = Job.from_file(folder.job)
    end = folder.end_event() or {}
    steps = int(np.sum(job.resolved_parameters().steps))  # type: ignore[attr-defined]
    splats = [level["splats"] for level in folder.levels()]
    result = {
        "steps": steps,
        "image_scale": job.image_scale,
        "splats": splats,
        "seconds": end.get("seconds"),
    }
    result["what"] = (
        f"{steps:,} steps on photos at scale {job.image_scale:g}, from points; "
        f"{sum(splats):,} splats on {len(splats)} levels, {result['seconds']:.0f} s"
    )
    return result


def write_table(folder: Path, out: Path, frames: int, splats: int) -> None:
    """Render, measure and print all available results."""
    file = folder / "lodge" / "bundle.ply"
    bundles = {name: folder / name / "bundle.ply" for name in OTHER_METHODS}
    bundles = {name: path for name, path in bundles.items() if path.exists()}
    plan = town.plan_for(splats, 0)
    paths = {"walk": town.walk(plan, frames, 0.5), "flight": town.flight(plan, frames, 0.5)}
    rows = rows_of(file, bundles)
    table = measure(rows, paths)
    print(f"{'':<42}{'PSNR':>7}{'ms':>8}{'x':>6}{'drawn':>11}{'loaded':>11}{'MB':>8}")
    for line in table:
        times = table[0]["ms"] / line["ms"]
        print(
            f"{line['name']:<42}{line['psnr_full']:>7.2f}{line['ms']:>8.1f}{times:>6.1f}"
            f"{line['drawn']:>11,.0f}{line['loaded']:>11,.0f}{line['mb']:>8.1f}"
        )
    report = {"splats": splats, "rows": table}
    report["others"] = {name: describe_run(folder / name) for name in bundles}
    for name, result in report["others"].items():
        print(f"{name}: {result['what']}")
    bundle = rows[0].resident.bundle
    report["chunks"] = len(bundle.tables[TABLE]["x"]) if TABLE in bundle.tables else 0
    report["d_l"] = {level.number: level.facts["d_l"] for level in bundle.levels}
    if report["chunks"]:
        report["jumps"] = jumps(rows, bundle, plan, out / "lod-border.png")
        for name, change in report["jumps"].items():
            print(f"{name}: at borders of chunks {change['border']:.2f}, elsewhere {change['elsewhere']:.2f}")
    (out / "lod.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stages", nargs="*", metavar="STAGE", help=f"any of {', '.join(STAGES)}; default all")
    parser.add_argument("--splats", type=int, default=3_000_000)
    parser.add_argument("--views", type=int, default=48, help="photos per path")
    parser.add_argument("--frames", type=int, default=12, help="held-out views per path")
    parser.add_argument("--others", nargs="*", default=list(OTHER_METHODS), help="other methods to train")
    parser.add_argument("--effort", type=float, default=1.0, help="share of all steps, for a quick test")
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    options = parser.parse_args()
    stages = options.stages or STAGES
    if unknown := set(stages) - set(STAGES):
        parser.error(f"unknown stage: {', '.join(unknown)}")
    torch.set_num_threads(1)
    folder = options.out / f"town_{options.splats}"
    if "town" in stages:
        make_town(folder, options.splats, options.views)
    if "lodge" in stages:
        train_lodge(folder, options.views, options.effort)
    for name in options.others if "others" in stages else ():
        parameters = OTHER_METHODS[name] | {"steps": scaled(OTHER_METHODS[name]["steps"], options.effort)}
        train(folder, name, parameters)
    if "table" in stages:
        write_table(folder, options.out, options.frames, options.splats)


if __name__ == "__main__":
    main()
