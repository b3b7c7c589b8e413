"""``make demo``: the main workflow on the example scene, from photos to levels, in Blender's Python.

Imports the scene, trains levels in a background process, saves a .blend file with all levels,
exports the bundle, measures held-out views and compares the levels. Output folder: ``build/demo``.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shutil
import subprocess
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.blender_module import EXTENSION, start_blender  # noqa: E402
from tools.viewer import fetch  # noqa: E402
from training.__main__ import main as lodgs  # noqa: E402
from training.methods import METHODS  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description="Train the example scene and compare its levels.")
    parser.add_argument("--scene", type=Path, default=ROOT / "examples" / "lantern_garden")
    parser.add_argument("--method", choices=list(METHODS), default="flod")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "demo")
    parser.add_argument("--image-scale", type=float, default=1.0)
    parser.add_argument("--report", action="store_true", help="only measure a finished run")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="parameter of the method"
    )
    options = parser.parse_args()
    started = time.monotonic()
    out: Path = options.out
    run = RunFolder(out / options.method)
    if options.report:
        return write_report(options.scene, run, out)
    if run.state() == "done":  # resume an interrupted demo, repeat a finished one
        shutil.rmtree(run.path)
    os.environ.setdefault("LODGS_TRAINER_PYTHON", sys.executable)
    download = [sys.executable, ROOT / "tools" / "viewer.py"]  # for the page, while training runs
    subprocess.Popen(download, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    method = METHODS[options.method]
    print(f"Training {method.label} ({method.about}), draft preset, on {os.path.relpath(options.scene)}.")
    start_blender()
    commands = importlib.import_module(f"{EXTENSION}.blender_lodgs.commands")
    code = commands.main(
        ["train", "--scene", str(options.scene), "--method", options.method, "--preset", "draft",
         "--image-scale", str(options.image_scale), "--out", str(run.path),
         "--blend", str(out / "scene.blend"), "--export", str(out / "bundle.ply"),
         *(word for setting in options.set for word in ("--set", setting))]
    )  # fmt: skip
    if code:
        return code
    report = [sys.executable, __file__, "--report", "--method", options.method,
              "--scene", str(options.scene), "--out", str(out)]  # fmt: skip
    if code := subprocess.run(report, check=False).returncode:
        return code
    print(f"Finished in {time.monotonic() - started:.0f} seconds. Files in {os.path.relpath(out)}:")
    print("  index.html   compare the levels in a browser: open this next")
    print("  scene.blend  the scene in Blender, with all levels")
    print("  bundle.ply   all levels in one file, which ordinary viewers open at the finest")
    if (out / "page").exists():
        print("  page         all levels for any browser, to upload; python -m http.server shows it here")
    print("  levels.png   comparison of the levels; report.json has the numbers")
    if run.costs.exists():
        print(f"In {os.path.relpath(run.path)}: costs.png (costs measured to choose the levels' distances)")
    return 0


def write_report(scene: Path, run: RunFolder, out: Path) -> int:
    """Measure a finished run, and write its report and pages; return an exit code."""
    if code := lodgs(["evaluate", str(run.path), "--far"]):  # compare needs these measures, too
        return code
    measured = json.loads(run.metrics.read_text())
    report = {"scene": str(scene), "method": run.path.name, "levels": measured["levels"]}
    if measured["selective"]:
        per_view = measured["selective"][0]
        report["selective"] = _splat_count_row(per_view)
    if "curve" in measured:
        report["curve"] = [_splat_count_row(row) for row in measured["curve"]]
    (out / "report.json").write_text(json.dumps(report, indent=1))
    shutil.copy2(run.sheet, out / "levels.png")
    title = scene.resolve().name.replace("_", " ").capitalize()
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        code = lodgs(["compare", str(run.path), "--out", str(out)])
        if code or not fetch():  # without network there is no viewer, and no page
            return code
        return lodgs(["page", str(run.path), "--out", str(out / "page"), "--title", title])


def _splat_count_row(row: dict) -> dict:
    """Return a measured row with a clear name for the number of splats in the image."""
    return {("splats_drawn" if name == "drawn" else name): value for name, value in row.items()}


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # Blender as a module can hang when Python ends
