"""Test the extension in a real Blender window, with screenshots of every step: ``make window``.

Installs the built zip into a Blender with separate settings, on a virtual display, and runs
``window_tour.py``: import, train, view and render the example scene. Screenshots are written to
``build/window``. The exit code is 0 only if every step succeeded.

``--flight BUNDLE --cameras DIR`` runs ``window_flight.py`` instead: fly through a tree of splats along the
cameras of a folder, and print how long each piece of LODGS' work blocks Blender's main thread.
``--speed SPLATS --cameras DIR`` runs ``window_speed.py``: measure the redraws of a moving view of a file.
``--cells`` runs ``window_cells.py``: train the scene in cells, two at a time.
``--walk`` runs ``window_walk.py``: from photos to a rendered shot, as in the artists' guide.

Uses a virtual display (Xvfb) and ImageMagick for screenshots, so that results do not depend on the desktop.
Blender's own screenshots are black with software rendering.
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
"""Maximum seconds for a script."""


def main() -> int:
    parser = argparse.ArgumentParser(description="Test the extension in a real Blender window.")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "window")
    parser.add_argument("--scene", type=Path, default=ROOT / "examples" / "lantern_garden")
    methods_with_levels = [name for name, method in METHODS.items() if method.rule]
    parser.add_argument("--method", choices=methods_with_levels, default="flod")
    parser.add_argument(
        "--long", action="store_true", help="train for some minutes, for presentable screenshots"
    )
    parser.add_argument("--flight", type=Path, help="fly through this tree of splats instead")
    parser.add_argument(
        "--cameras", type=Path, help="folder of cameras for --flight or --speed, from examples.town"
    )
    parser.add_argument(
        "--budget", type=int, default=1_000_000, help="memory budget for the flight, in splats"
    )
    parser.add_argument("--speed", type=Path, help="measure redraws of a moving view of this file instead")
    parser.add_argument("--cells", action="store_true", help="train the scene in cells instead")
    parser.add_argument("--walk", action="store_true", help="work from photos to a rendered shot instead")
    options = parser.parse_args()
    if (options.flight or options.speed) and not options.cameras:
        parser.error("--flight and --speed require --cameras")
    blender, x_server, camera = find_programs()
    archive = extension.build(ROOT / "dist")
    out: Path = options.out.resolve()
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    install(blender, archive, out / "user")

    plan = {
        "scene": str(options.scene.resolve()),
        "out": str(out),
        "run": str(out / "run"),
        "method": options.method,
        "long": options.long,
        "cells": options.cells,
        "walk": options.walk,
        "camera": [camera, "-window", "root"],
    }
    if options.flight:
        plan |= {"flight": str(options.flight.resolve()), "cameras": str(options.cameras.resolve())}
        plan["budget"] = options.budget
    if options.speed:
        plan |= {"speed": str(options.speed.resolve()), "cameras": str(options.cameras.resolve())}
    with display(x_server) as os.environ["DISPLAY"]:
        problem = run_script(blender, plan, out / "blender.log")
    for line in facts(out):
        print(line)
    print(f"Screenshots and blender.log are in {os.path.relpath(out)}.")
    if problem:
        print(f"window: {problem}", file=sys.stderr)
    return 1 if problem else 0


def find_programs() -> tuple[str, str, str]:
    """Return the paths of Blender, Xvfb and ImageMagick's ``import``; exit if one is missing."""
    blender = shutil.which(os.environ.get("BLENDER") or "blender")
    if blender is None:
        sys.exit("window: Blender not found. Add it to PATH, or set BLENDER to its path.")
    paths = [blender]
    for program, package in (("Xvfb", "Xvfb"), ("import", "ImageMagick")):
        path = shutil.which(program)
        if path is None:
            sys.exit(
                f"window: {program} not found. Install {package}; a virtual display is required (Linux only)."
            )
        paths.append(path)
    return paths[0], paths[1], paths[2]


def install(blender: str, archive: Path, user: Path) -> None:
    """Install the zip into a new Blender user folder, and prepare the environment of Blender's window.

    Exits with Blender's message on errors.
    """
    os.environ["BLENDER_USER_RESOURCES"] = str(user)
    # Mesa maps its cache of shaders: another program that shares and shortens it ends Blender with SIGBUS
    os.environ["MESA_SHADER_CACHE_DIR"] = str(user / "shaders")
    os.environ.setdefault("LODGS_TRAINER_PYTHON", sys.executable)
    os.environ.pop("WAYLAND_DISPLAY", None)  # otherwise Blender opens its window there
    command = [blender, "--command", "extension", "install-file", "-r", "user_default", "-e", str(archive)]
    process = subprocess.run(command, check=False, capture_output=True, text=True)
    if process.returncode:
        sys.exit(f"window: Blender cannot install {archive.name}:\n{process.stdout}{process.stderr}")


@contextmanager
def display(x_server: str) -> Iterator[str]:
    """Start a virtual display; yield its name."""
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


def run_script(blender: str, plan: dict, log: Path) -> str:
    """Run a script in Blender; return the reason for its failure, or an empty string."""
    name = next((key for key in ("flight", "speed", "cells", "walk", "pictures") if plan.get(key)), "tour")
    script = ROOT / "tools" / f"window_{name}.py"
    command = [
        blender, "--gpu-backend", "opengl", "--window-geometry", "0", "0", *map(str, SIZE),
        *(["--enable-event-simulate"] if any(map(plan.get, ("walk", "speed", "pictures"))) else []),
        "--python-exit-code", "1", "--python", str(script), "--", json.dumps(plan),
    ]  # fmt: skip
    with open(log, "wb") as output:
        try:
            subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, timeout=LIMIT, check=False)
        except subprocess.TimeoutExpired:
            return f"The script did not end within {LIMIT} seconds."
        finally:
            run = RunFolder(plan["run"])
            if run.state() == "running":  # the trainer continues without Blender
                run.request_cancel()
    result = "".join(facts(Path(plan["out"]))[-1:])
    if result.startswith("failed"):
        return result
    if result != "passed":
        return f"Blender ended before the script: see {log.name}."
    if "Traceback" in log.read_text(errors="replace"):
        return f"Errors were logged: see {log.name}."
    return ""


def facts(out: Path) -> list[str]:
    """Return the log lines of the script; the last one is "passed", or "failed" with a reason."""
    path = out / "facts.txt"
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


if __name__ == "__main__":
    sys.exit(main())
