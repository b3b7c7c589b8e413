"""Take all of the documentation's pictures that show panels: ``make pictures``.

Opens a real Blender window on a virtual display (see ``window.py``) and runs ``window_pictures.py`` in it.
Writes docs/images/<page>-<subject>.jpg, and the layouts of all panels to docs/images/panels.json.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from PIL import Image  # noqa: E402

from tools import extension, window  # noqa: E402

IMAGES = ROOT / "docs" / "images"
PARAMETERS = {"max_splats": 60_000, "steps": (60, 90, 120, 180, 750), "refine_steps": 90}


def main() -> int:
    parser = argparse.ArgumentParser(description="Take the documentation's pictures that show panels.")
    parser.add_argument("--keep", action="store_true", help="only write build/pictures, not docs/images")
    options = parser.parse_args()
    blender, x_server, camera = window.find_programs()
    out = ROOT / "build" / "pictures"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    archive = extension.build(out)
    os.environ.setdefault("LODGS_TRAINER_PYTHON", sys.executable)
    os.environ.pop("WAYLAND_DISPLAY", None)
    # panels show paths of the scene, the run and the extension: they name no user
    with tempfile.TemporaryDirectory(prefix="lodgs-") as work:
        os.environ["BLENDER_USER_RESOURCES"] = str(Path(work, "user"))
        window.install(blender, archive)
        scene = Path(work, "lantern_garden")
        shutil.copytree(ROOT / "examples" / "lantern_garden", scene)
        plan = {
            "scene": str(scene), "run": str(Path(work, "run")), "file": str(Path(work, "garden.blend")),
             "out": str(out), "pictures": True,
            "parameters": PARAMETERS, "camera": [camera, "-window", "root"],
        }  # fmt: skip
        with window.display(x_server) as os.environ["DISPLAY"]:
            problem = window.run_script(blender, plan, out / "blender.log")
    if problem:
        print(f"pictures: {problem}", file=sys.stderr)
        return 1
    for path in sorted(out.glob("[0-9]*.png")):
        name = path.stem.partition("-")[2]
        target = (out if options.keep else IMAGES) / f"{name}.jpg"
        Image.open(path).convert("RGB").save(target, quality=85, optimize=True)
        print(target.relative_to(ROOT))
    if not options.keep:
        subprocess.run([sys.executable, str(ROOT / "tools" / "panel_layouts.py")], check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
