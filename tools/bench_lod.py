"""What levels of detail are worth on a large scene, as LODGE's Table 3 asks: ``make bench-lod``.

A town of known truth (``examples.town``) is photographed, given levels and chunks, and drawn from places that
no training saw: the whole model, levels alone, with chunks, what is visible of them, and blending; and FLoD's
and Octree-GS's own levels, trained on the same photographs. Frames are timed in turn. Prints the table, and
saves build/bench/lod.json. What was trained is kept beside it, and taken up again; the first time takes
about an hour on two cores.
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
from training.lod.rules.chunks import RULE, TABLE, member_columns
from training.lod.selection import settings
from training.methods.lodge.chunks import members
from training.methods.lodge.composite import IndexedLevel
from training.rasterize import Gaussians, Rendering
from training.rasterize.resident import Resident
from training.runs.capture import write_scene
from training.scenes.cameras import Camera, evenly
from training.scenes.colmap import read_scene
from training.scenes.images import write_png
from training.splats.bundle import Bundle, Level, read_bundle
from training.splats.ply import columns_of, columns_of_extras, read_ply, write_ply

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
    resident: Resident
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


def train(folder: Path, method: str, *options: str) -> Path:
    """A run of a method on the photographs, its bundle; taken up where it was left."""
    run = folder / method
    if not (run / "bundle.ply").exists():
        started = time.monotonic()
        print(f"training {method} ...", flush=True)
        command = [sys.executable, "-m", "training", "train", "--scene", folder / "scene", "--out", run]
        command += ["--method", method, "--test-every", "0", *options]
        subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)
        print(f"{method}: {time.monotonic() - started:.0f} s")
    return run / "bundle.ply"


def without_visibility(bundle: Bundle) -> Bundle:
    """The same chunks with all that Eq. 2 gives them at their centres."""
    levels = {level.number: IndexedLevel.of(Gaussians.of(level.splats)) for level in reversed(bundle.levels)}
    d_l = {level.number: level.facts["d_l"] for level in bundle.levels}
    table, sets = bundle.tables[TABLE], {number: [] for number in levels}
    centres = np.stack([table[axis] for axis in "xyz"], axis=1)
    for centre, radius in zip(centres, table["radius"], strict=True):
        for number, rows in members(levels, d_l, centre, float(radius)).items():
            inside = np.zeros(len(levels[number]), bool)
            inside[rows] = True
            sets[number].append(inside)
    return replace(
        bundle,
        levels=[
            Level(
                x.number,
                replace(x.splats, extras=member_columns(np.stack(sets[x.number]))),
                x.facts,
            )
            for x in bundle.levels
        ],
    )


def rows_of(bundle: Bundle, others: dict[str, Bundle]) -> list[Row]:
    """All ways to draw, the whole model first."""

    def row(name: str, shown: Bundle, **values: float) -> Row:
        resident, size = Resident(shown), bytes_of(shown)
        given = settings(shown, values)
        return Row(name, resident, lambda camera: resident.draw(camera, given, near=town.NEAR), size)

    finest = bundle.levels[-1].number
    alone = Resident(replace(bundle, levels=bundle.levels[-1:], tables={}))
    plain = bytes_of(replace(bundle, levels=[Level(1, replace(bundle.levels[-1].splats, extras={}))]))
    found = [
        Row("full", alone, lambda camera: alone.draw_level(finest, camera, near=town.NEAR), plain),
        row("levels", bundle, chunks=0),
    ]
    if TABLE in bundle.tables:
        found += [
            row("levels + chunks", without_visibility(bundle), chunks=1, fade=0),
            row("levels + chunks + visibility", bundle, chunks=1, fade=0),
            row("levels + chunks + visibility + blending", bundle, chunks=1, fade=1),
        ]
    return found + [row(name, other) for name, other in others.items()]


def bytes_of(bundle: Bundle) -> int:
    """Of a splat in a file."""
    splats = bundle.levels[-1].splats
    columns = columns_of(splats) | columns_of_extras(splats)
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
    values = settings(bundle, {"fade": 0})
    nearest = [RULE.near_chunks(view.center, values, bundle.tables)[:1] for view in views]
    borders = [number for number, (a, b) in enumerate(pairwise(nearest)) if a != b]
    places = {"border": borders, "elsewhere": [(a + b) // 2 for a, b in pairwise(borders)]}
    places = {name: [max(place - 2, 0) for place in evenly(some, PLACES)] for name, some in places.items()}
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--splats", type=int, default=3_000_000)
    parser.add_argument("--views", type=int, default=48, help="photographs of each way")
    parser.add_argument("--frames", type=int, default=12, help="held-out views of each way")
    parser.add_argument("--others", nargs="*", default=["flod", "octree"], help="other methods to train")
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    folder = options.out / f"town_{options.splats}"
    make_town(folder, options.splats, options.views)
    depth = read_scene(folder / "scene").median_depth()
    distances = [round(metres / depth, 4) for metres in DISTANCES] + [0]
    options_of_lodge = ["--base", str(folder / "town.ply"), "--image-scale", "1"]
    for name, value in {"distances": distances, **LODGE}.items():
        options_of_lodge += ["--set", f"{name}={value}"]
    bundle = read_bundle(train(folder, "lodge", *options_of_lodge))
    others = {name: read_bundle(train(folder, name)) for name in options.others}
    plan = town.plan_for(options.splats, 0)
    ways = {"walk": town.walk(plan, options.frames, 0.5), "flight": town.flight(plan, options.frames, 0.5)}
    rows = rows_of(bundle, others)
    table = measure(rows, ways)
    print(f"{'':<42}{'PSNR':>7}{'ms':>8}{'x':>6}{'drawn':>11}{'loaded':>11}{'MB':>8}")
    for line in table:
        times = table[0]["ms"] / line["ms"]
        print(
            f"{line['name']:<42}{line['psnr_full']:>7.2f}{line['ms']:>8.1f}{times:>6.1f}"
            f"{line['drawn']:>11,.0f}{line['loaded']:>11,.0f}{line['mb']:>8.1f}"
        )
    chunks = len(bundle.tables[TABLE]["x"]) if TABLE in bundle.tables else 0
    said = {"splats": options.splats, "chunks": chunks, "rows": table}
    said |= {"d_l": {level.number: level.facts["d_l"] for level in bundle.levels}}
    if chunks:
        said["jumps"] = jumps(rows, bundle, plan, options.out / "lod-border.png")
        for name, change in said["jumps"].items():
            print(f"{name}: at chunks' borders {change['border']:.2f}, elsewhere {change['elsewhere']:.2f}")
    (options.out / "lod.json").write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
