"""What levels of detail are worth on a large scene, as LODGE's Table 3 asks: ``make bench-lod``.

A town of known truth (``examples.town``) is photographed, given levels and chunks, and drawn from places that
no training saw: the whole model, levels alone, with chunks, what is visible of them, and blending; and FLoD's
and Octree-GS's own levels, trained on the same photographs. Frames are timed in turn. Prints the table, and
saves build/bench/lod.json. What was made is kept beside it, and taken up again where it was left; the first
time takes about an hour on two cores. Stages can be asked for one by one: the table has what is there.
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
from training.lod.partial_read import BLOCKS, block_table, read_part
from training.lod.rules.chunks import RULE, TABLE, member_columns
from training.lod.selection import resolve_controls
from training.methods.lodge.chunks import members
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
"""Metres from frame to frame of somebody who walks, where jumps are looked for."""
PLACES = 12
"""So many of the chunks' borders along the walk, and as many places between them, are looked at."""
FRAMES = 6
"""Frames at each of these places."""

DISTANCES = (24.0, 10.0)
"""From so many metres on LODGE's coarser levels are shown. Left to itself it takes 32 and 16."""
LODGE = {"chunks": 64, "keep": 0.35, "prune_weight": 0.03, "tune_steps": 240}
"""Its other parameters: for 3 million splats 11 cm apart, of which each has a fair share of some pixel."""
OTHERS = {
    "flod": {"steps": [400, 600, 800, 1200, 2000], "max_splats": 300_000},
    "octree": {"steps": 5000, "max_splats": 300_000},
}
"""The other methods, which begin with points and are trained on the photographs at half size, and their
budget: draft presets with more steps and splats, for at most some 20 minutes each."""
STAGES = ("town", "lodge", "others", "table")

Draw = Callable[[Camera], Rendering]


@dataclass
class Row:
    """One way to draw the town.

    Attributes:
        resident: what is held ready.
        draw: a picture of it.
        bytes: of a splat.
    """

    name: str
    resident: ResidentBundle
    draw: Draw
    bytes: int


def make_town(folder: Path, splats: int, views: int) -> None:
    """Town and photographs, unless they are there: town.ply and scene/."""
    plan = town.plan_for(splats, 0)
    if not (folder / "town.ply").exists():
        write_ply(folder / "town.ply", town.build(plan, splats, 1, 0))
    if not (folder / "scene").exists():
        cameras = [*town.walk(plan, views), *town.flight(plan, views)]
        write_scene(folder / "scene", read_ply(folder / "town.ply"), cameras, town.NEAR, town.POINTS)


def train(folder: Path, method: str, parameters: dict, *options: str) -> None:
    """A run of a method on the photographs; taken up where it was left."""
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
    """LODGE's levels and chunks of the town itself."""
    depth = read_scene(folder / "scene").median_depth()
    distances = [round(metres / depth, 4) for metres in DISTANCES] + [0]
    parameters = {"distances": distances, **LODGE, "tune_steps": scaled(LODGE["tune_steps"], effort)}
    parameters["chunks"] = min(LODGE["chunks"], 4 * views // 3)
    train(folder, "lodge", parameters, "--base", str(folder / "town.ply"), "--image-scale", "1")


def scaled(steps, effort: float):
    """Numbers of steps, or a share of them."""
    if isinstance(steps, list):
        return [scaled(each, effort) for each in steps]
    return max(round(effort * steps), 10)


def without_visibility(file: Path) -> Path:
    """The same chunks with all that Eq. 2 gives them at their centres, in a file beside."""
    path = file.with_name("without_visibility.ply")
    if path.exists() and path.stat().st_mtime > file.stat().st_mtime:
        return path
    bundle = read_bundle(file)
    levels = {level.number: IndexedLevel.of(Gaussians.of(level.splats)) for level in reversed(bundle.levels)}
    d_l = {level.number: level.facts["d_l"] for level in bundle.levels}
    table, sets = bundle.tables[TABLE], {number: [] for number in levels}
    centres = np.stack([table[axis] for axis in "xyz"], axis=1)
    for centre, radius in zip(centres, table["radius"], strict=True):
        for number, rows in members(levels, d_l, centre, float(radius)).items():
            inside = np.zeros(len(levels[number]), bool)
            inside[rows] = True
            sets[number].append(inside)
    splats = {
        level.number: replace(level.splats, extras=member_columns(np.stack(sets[level.number])))
        for level in bundle.levels
    }
    tables = {**bundle.tables, BLOCKS: block_table(RULE, splats)}
    found = [replace(level, splats=splats[level.number]) for level in bundle.levels]
    write_bundle(path, replace(bundle, levels=found, tables=tables))
    return path


def rows_of(file: Path, others: dict[str, Path]) -> list[Row]:
    """All ways to draw, the whole model first. Of each what it needs is read of its file."""

    def row(name: str, shown: Path, **values: float) -> Row:
        resident = ResidentBundle(shown)
        given = resolve_controls(resident.bundle, values)
        return Row(
            name, resident, lambda camera: resident.draw(camera, given, near=town.NEAR), bytes_of(shown)
        )

    alone, plain = ResidentBundle(file), bytes_of(file, extras=False)
    finest = alone.bundle.levels[-1].number
    found = [
        Row("full", alone, lambda camera: alone.draw_level(finest, camera, near=town.NEAR), plain),
        row("levels", file, chunks=0),
    ]
    if TABLE in alone.bundle.tables:
        found += [
            row("levels + chunks", without_visibility(file), chunks=1, fade=0),
            row("levels + chunks + visibility", file, chunks=1, fade=0),
            row("levels + chunks + visibility + blending", file, chunks=1, fade=1),
        ]
    return found + [row(name, other) for name, other in others.items()]


def bytes_of(file: Path, extras: bool = True) -> int:
    """Of a splat in a file."""
    splats = read_part(file, [])[0].levels[-1].splats
    columns = splat_columns(splats) | (extra_columns(splats) if extras else {})
    return sum(column.dtype.itemsize for column in columns.values())


def measure(rows: Sequence[Row], ways: dict[str, list[Camera]]) -> list[dict]:
    """The table: every view drawn by every row, in turn."""
    found = {row.name: {way: [] for way in ways} for row in rows}
    for way, cameras in ways.items():
        for camera in cameras:
            truth = None
            for row in rows:
                drawn = row.draw(camera)
                truth = drawn.image if truth is None else truth
                count = int((drawn.radii > 0).sum())
                found[row.name][way].append([psnr(drawn.image, truth), count, row.resident.loaded, []])
            for _ in range(REPEATS):
                for row in rows:
                    started = time.perf_counter()
                    row.draw(camera)
                    found[row.name][way][-1][3].append(time.perf_counter() - started)
    table = []
    for row in rows:
        line: dict = {"name": row.name}
        for way, views in found[row.name].items():
            line[way] = {
                "psnr_full": round(float(np.mean([view[0] for view in views])), 2),
                "ms": round(1e3 * float(np.mean([statistics.median(view[3]) for view in views])), 1),
                "drawn": round(float(np.mean([view[1] for view in views]))),
                "loaded": round(float(np.mean([view[2] for view in views]))),
            }
        both = list(found[row.name])
        for name in ("psnr_full", "ms", "drawn", "loaded"):
            line[name] = round(float(np.mean([line[way][name] for way in both])), 2)
        line["mb"] = round(line["loaded"] * row.bytes / 1e6, 1)
        table.append(line)
    return table


def jumps(rows: Sequence[Row], bundle: Bundle, plan: town.Plan, picture: Path) -> dict[str, dict[str, float]]:
    """How much frames at walking pace change where the nearest chunk does and elsewhere, over the full one's.

    At a quicker pace all that moves hides the border.

    Args:
        picture: PNG to write of the border that shows most: the frame before it, and ten times the difference
            to the next frame of the full model, without blending, and with it.

    Returns:
        By the row's name the largest ``border`` and ``elsewhere``.
    """
    eyes = np.stack([camera.center for camera in town.walk(plan, 1000)])
    views = town.walk(plan, round(np.linalg.norm(np.diff(eyes, axis=0), axis=1).sum() / PACE), 0.5)
    values = resolve_controls(bundle, {"fade": 0})
    nearest = [RULE.near_chunks(view.center, values, bundle.tables)[:1] for view in views]
    borders = [number for number, (a, b) in enumerate(pairwise(nearest)) if a != b]
    places = {"border": borders, "elsewhere": [(a + b) // 2 for a, b in pairwise(borders)]}
    places = {
        name: [max(place - 2, 0) for place in pick_evenly(some, PLACES)] for name, some in places.items()
    }
    shown = [rows[0], *rows[3:5]]

    def drawn(row: Row, place: int) -> list[np.ndarray]:
        return [row.draw(view).image.numpy() for view in views[place : place + FRAMES]]

    def changes(row: Row, name: str) -> np.ndarray:
        found = [[np.abs(b - a).mean() for a, b in pairwise(drawn(row, place))] for place in places[name]]
        return np.array(found)

    found = {name: [changes(row, name) for row in shown] for name in places}
    worst = np.argmax((found["border"][1] / found["border"][0]).max(axis=1))
    at = np.argmax(found["border"][1][worst] / found["border"][0][worst])
    frames = [drawn(row, places["border"][worst])[at : at + 2] for row in shown]
    tiles = [frames[0][0], *(10 * np.abs(b - a) for a, b in frames)]
    sheet = np.concatenate([np.concatenate(tiles[:2], axis=1), np.concatenate(tiles[2:], axis=1)])
    write_png(picture, np.round(255 * sheet.clip(0, 1)).astype(np.uint8))
    return {
        row.name: {
            name: round(float((of_rows[number] / of_rows[0]).max()), 3) for name, of_rows in found.items()
        }
        for number, row in enumerate(shown[1:], 1)
    }


def about(run: Path) -> dict:
    """What another method was given and what it made of it, by its run's own files."""
    folder = RunFolder(run)
    job, ended = Job.from_file(folder.job), folder.end_event() or {}
    steps = int(np.sum(job.resolved_parameters().steps))  # type: ignore[attr-defined]
    splats = [level["splats"] for level in folder.levels()]
    found = {
        "steps": steps,
        "image_scale": job.image_scale,
        "splats": splats,
        "seconds": ended.get("seconds"),
    }
    found["what"] = (
        f"{steps:,} steps on photographs at {job.image_scale:g} of their size, from points; "
        f"{sum(splats):,} splats on {len(splats)} levels, {found['seconds']:.0f} s"
    )
    return found


def write_table(folder: Path, out: Path, frames: int, splats: int) -> None:
    """Draws, measures and prints all that is there."""
    file = folder / "lodge" / "bundle.ply"
    others = {name: folder / name / "bundle.ply" for name in OTHERS}
    others = {name: path for name, path in others.items() if path.exists()}
    plan = town.plan_for(splats, 0)
    ways = {"walk": town.walk(plan, frames, 0.5), "flight": town.flight(plan, frames, 0.5)}
    rows = rows_of(file, others)
    table = measure(rows, ways)
    print(f"{'':<42}{'PSNR':>7}{'ms':>8}{'x':>6}{'drawn':>11}{'loaded':>11}{'MB':>8}")
    for line in table:
        times = table[0]["ms"] / line["ms"]
        print(
            f"{line['name']:<42}{line['psnr_full']:>7.2f}{line['ms']:>8.1f}{times:>6.1f}"
            f"{line['drawn']:>11,.0f}{line['loaded']:>11,.0f}{line['mb']:>8.1f}"
        )
    said = {"splats": splats, "rows": table, "others": {name: about(folder / name) for name in others}}
    for name, given in said["others"].items():
        print(f"{name}: {given['what']}")
    bundle = rows[0].resident.bundle
    said["chunks"] = len(bundle.tables[TABLE]["x"]) if TABLE in bundle.tables else 0
    said["d_l"] = {level.number: level.facts["d_l"] for level in bundle.levels}
    if said["chunks"]:
        said["jumps"] = jumps(rows, bundle, plan, out / "lod-border.png")
        for name, change in said["jumps"].items():
            print(f"{name}: at chunks' borders {change['border']:.2f}, elsewhere {change['elsewhere']:.2f}")
    (out / "lod.json").write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stages", nargs="*", metavar="STAGE", help=f"of {', '.join(STAGES)}; otherwise all")
    parser.add_argument("--splats", type=int, default=3_000_000)
    parser.add_argument("--views", type=int, default=48, help="photographs of each way")
    parser.add_argument("--frames", type=int, default=12, help="held-out views of each way")
    parser.add_argument("--others", nargs="*", default=list(OTHERS), help="other methods to train")
    parser.add_argument("--effort", type=float, default=1.0, help="share of all steps, to try it out")
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    options = parser.parse_args()
    stages = options.stages or STAGES
    if unknown := set(stages) - set(STAGES):
        parser.error(f"there is no stage {', '.join(unknown)}")
    torch.set_num_threads(1)
    folder = options.out / f"town_{options.splats}"
    if "town" in stages:
        make_town(folder, options.splats, options.views)
    if "lodge" in stages:
        train_lodge(folder, options.views, options.effort)
    for name in options.others if "others" in stages else ():
        parameters = OTHERS[name] | {"steps": scaled(OTHERS[name]["steps"], options.effort)}
        train(folder, name, parameters)
    if "table" in stages:
        write_table(folder, options.out, options.frames, options.splats)


if __name__ == "__main__":
    main()
