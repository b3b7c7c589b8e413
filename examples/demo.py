"""``make demo``: the main job on the example scene, from photographs to levels, in Blender's Python.

Imports the scene, trains levels in a background process, saves the .blend with its selection, exports the
bundle, measures the held-out views and puts the levels side by side. Everything lands in ``build/demo``.
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
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.blender_module import EXTENSION, start_blender  # noqa: E402
from training.methods import METHODS  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description="train the example scene and show its levels")
    parser.add_argument("--scene", type=Path, default=ROOT / "examples" / "lantern_garden")
    parser.add_argument("--method", choices=list(METHODS), default="flod")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "demo")
    parser.add_argument("--image-scale", type=float, default=1.0)
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a parameter of the method"
    )
    chosen = parser.parse_args()
    started = time.monotonic()
    out: Path = chosen.out
    run = RunFolder(out / chosen.method)
    if run.state() == "done":  # an interrupted demo is resumed, a finished one is made anew
        shutil.rmtree(run.path)
    os.environ.setdefault("LODGS_TRAINER_PYTHON", sys.executable)

    method = METHODS[chosen.method]
    print(f"{method.label}, {method.about}: trained as a draft on {os.path.relpath(chosen.scene)}.")
    start_blender()
    commands = importlib.import_module(f"{EXTENSION}.blender_lodgs.commands")
    code = commands.main(
        ["train", "--scene", str(chosen.scene), "--method", chosen.method, "--preset", "draft",
         "--image-scale", str(chosen.image_scale), "--out", str(run.path),
         "--blend", str(out / "scene.blend"), "--export", str(out / "bundle.ply"),
         *(word for setting in chosen.set for word in ("--set", setting))]
    )  # fmt: skip
    if code:
        return code
    evaluation = [
        sys.executable,
        "-m",
        "training",
        "evaluate",
        str(run.path),
        "--picture",
        str(out / "levels.png"),
    ]
    code = subprocess.run(evaluation, cwd=ROOT, check=False).returncode
    if code:
        return code
    measured = json.loads(run.metrics.read_text())
    report = {"scene": str(chosen.scene), "method": chosen.method, "levels": measured["levels"]}
    if measured["selective"]:
        per_view = measured["selective"][0]
        report["selective"] = _drawn(per_view)
    if "curve" in measured:
        report["curve"] = [_drawn(row) for row in measured["curve"]]
    (out / "report.json").write_text(json.dumps(report, indent=1))
    print(f"{time.monotonic() - started:.0f} seconds. In {os.path.relpath(out)}: scene.blend, bundle.ply,")
    print("levels.png (the levels side by side), report.json")
    if run.costs.exists():
        print(f"In {os.path.relpath(run.path)}: costs.png (what finding the levels' distances has told)")
    return 0


def _drawn(row: dict) -> dict:
    """A measured row with a plain name for the number of splats in the image."""
    return {("splats_drawn" if name == "drawn" else name): value for name, value in row.items()}


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # Blender as a module can hang when Python ends
