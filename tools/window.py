"""``make window``: a tour of the extension in a real Blender window, with a picture of every step.

Installs the built zip into a Blender that has fresh settings of its own, opens that on a virtual display, and
has ``window_tour.py`` import the example scene, train it, look at it and render it. The pictures come to
``build/window``. The exit code is 0 only when every step did what it should, so this is a test as well.

``--flight BUNDLE --cameras DIR`` has ``window_flight.py`` open a tree of splats instead and fly through it,
along the cameras of a folder's files, and prints how long each piece of our work holds Blender's main thread.

``--cells`` has ``window_cells.py`` train the scene in cells, two at a time. ``--walk`` has ``window_walk.py``
go from photographs to a rendered shot, as the artists' page tells it.

Always on a virtual display (Xvfb), photographed from outside by ImageMagick: the same pictures on every
computer, nothing of the desktop in them, and nobody's screen is taken. Blender's own screenshots are black
where software draws, as it does there.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools import extension  # noqa: E402
from training.methods import METHODS  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402

SIZE = (1280, 800)
LIMIT = 1800
"""Seconds after which a tour that does not end is ended."""


def main() -> int:
    parser = argparse.ArgumentParser(description="tour the extension in a real Blender window")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "window")
    parser.add_argument("--scene", type=Path, default=ROOT / "examples" / "lantern_garden")
    with_detail = [name for name, method in METHODS.items() if method.rule]
    parser.add_argument("--method", choices=with_detail, default="flod")
    parser.add_argument("--long", action="store_true", help="train for some minutes: for pictures to show")
    parser.add_argument("--flight", type=Path, help="a tree of splats to fly through, instead of the tour")
    parser.add_argument(
        "--cameras", type=Path, help="folder of cameras to fly along, as examples.town has it"
    )
    parser.add_argument("--budget", type=int, default=1_000_000, help="splats of that tree in memory")
    parser.add_argument("--cells", action="store_true", help="train the scene in cells, instead of the tour")
    parser.add_argument("--walk", action="store_true", help="from photographs to a shot, instead of the tour")
    chosen = parser.parse_args()
    if chosen.flight and not chosen.cameras:
        parser.error("--flight needs --cameras")
    blender, x_server, camera = find_programs()
    archive = extension.build(ROOT / "dist")
    out: Path = chosen.out.resolve()
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    os.environ["BLENDER_USER_RESOURCES"] = str(out / "user")
    os.environ.setdefault("LODGS_TRAINER_PYTHON", sys.executable)
    os.environ.pop("WAYLAND_DISPLAY", None)  # or Blender would open its window there
    install(blender, archive)

    plan = {
        "scene": str(chosen.scene.resolve()),
        "out": str(out),
        "run": str(out / "run"),
        "method": chosen.method,
        "long": chosen.long,
        "cells": chosen.cells,
        "walk": chosen.walk,
        "camera": [camera, "-window", "root"],
    }
    if chosen.flight:
        plan |= {"flight": str(chosen.flight.resolve()), "cameras": str(chosen.cameras.resolve())}
        plan["budget"] = chosen.budget
    with display(x_server) as os.environ["DISPLAY"]:
        problem = tour(blender, plan, out / "blender.log")
    for line in facts(out):
        print(line)
    print(f"Pictures and blender.log are in {os.path.relpath(out)}.")
    if problem:
        print(f"window: {problem}", file=sys.stderr)
    return 1 if problem else 0


def find_programs() -> tuple[str, str, str]:
    """Blender, Xvfb and ImageMagick's ``import``. Exits with a sentence if one is missing."""
    blender = shutil.which(os.environ.get("BLENDER") or "blender")
    if blender is None:
        sys.exit("window: Blender is missing; put `blender` on PATH, or its path into BLENDER.")
    found = [blender]
    for program, package in (("Xvfb", "Xvfb"), ("import", "ImageMagick")):
        path = shutil.which(program)
        if path is None:
            sys.exit(
                f"window: {program} is missing; install {package}. The tour has a virtual display, on Linux."
            )
        found.append(path)
    return found[0], found[1], found[2]


def install(blender: str, archive: Path) -> None:
    """Install the zip as artists do, into Blender's user folder. Exits with Blender's words if it refuses."""
    command = [blender, "--command", "extension", "install-file", "-r", "user_default", "-e", str(archive)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"window: Blender does not install {archive.name}:\n{done.stdout}{done.stderr}")


@contextmanager
def display(x_server: str) -> Iterator[str]:
    """A virtual display of its own; yields its name."""
    size = f"{SIZE[0]}x{SIZE[1]}x24"
    command = [x_server, "-displayfd", "1", "-screen", "0", size, "-nolisten", "tcp"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert server.stdout is not None
        number = server.stdout.readline().strip()
        if not number:
            sys.exit("window: Xvfb did not start.")
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()


def tour(blender: str, plan: dict, log: Path) -> str:
    """Have Blender take the tour, or fly; return why it failed, or nothing."""
    script = (
        ROOT / "tools" / f"window_{next((k for k in ('flight', 'cells', 'walk') if plan.get(k)), 'tour')}.py"
    )
    command = [
        blender, "--gpu-backend", "opengl", "--window-geometry", "0", "0", *map(str, SIZE),
        *(["--enable-event-simulate"] if plan.get("walk") else []),
        "--python-exit-code", "1", "--python", str(script), "--", json.dumps(plan),
    ]  # fmt: skip
    with open(log, "wb") as said:
        try:
            subprocess.run(command, stdout=said, stderr=subprocess.STDOUT, timeout=LIMIT, check=False)
        except subprocess.TimeoutExpired:
            return f"The tour did not end within {LIMIT} seconds."
        finally:
            run = RunFolder(plan["run"])
            if run.state() == "running":  # the trainer outlives Blender
                run.request_cancel()
    end = "".join(facts(Path(plan["out"]))[-1:])
    if end.startswith("failed"):
        return end
    if end != "passed":
        return f"Blender ended before the tour did: see {log.name}."
    if "Traceback" in log.read_text(errors="replace"):
        return f"There was an error by the way: see {log.name}."
    return ""


def facts(out: Path) -> list[str]:
    """What the tour has found so far, a line a step; the last is "passed", or "failed" with why."""
    written = out / "facts.txt"
    return written.read_text(encoding="utf-8").splitlines() if written.exists() else []


if __name__ == "__main__":
    sys.exit(main())
