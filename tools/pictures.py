"""Take all of the documentation's pictures that show panels and pages: ``make pictures``.

Opens a real Blender window on a virtual display (see ``window.py``), runs ``window_pictures.py`` in it, and
opens the pages of its run in Chromium. Writes docs/images/<page>-<subject>.jpg, and the layouts of all panels
to docs/images/panels.json.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from PIL import Image  # noqa: E402

from tools import extension, window  # noqa: E402
from tools.interop_viewers import BROWSERS  # noqa: E402

IMAGES = ROOT / "docs" / "images"
PAGE = ("page", "--single", "--title", "Lantern garden")
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
    # panels show paths of the scene, the run and the extension: they name no user
    with tempfile.TemporaryDirectory(prefix="lodgs-") as work:
        window.install(blender, archive, Path(work, "user"))
        scene = Path(work, "lantern_garden")
        shutil.copytree(ROOT / "examples" / "lantern_garden", scene)
        plan = {
            "scene": str(scene), "run": str(Path(work, "run")), "file": str(Path(work, "garden.blend")),
             "out": str(out), "pictures": True,
            "parameters": PARAMETERS, "camera": [camera, "-window", "root"],
        }  # fmt: skip
        with window.display(x_server) as os.environ["DISPLAY"]:
            problem = window.run_script(blender, plan, out / "blender.log")
            if not problem:
                take_pages(Path(plan["run"]), Path(work), out, camera)
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


def take_pages(run: Path, work: Path, out: Path, camera: str) -> None:
    """Take pictures of a run's page to share and of its comparison, if Chromium is installed."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print("pictures: Chromium not found; export-page and compare-page are not retaken.", file=sys.stderr)
        return
    for name, arguments, page in (
        ("90-export-page", [*PAGE, str(run), "--out", str(work / "page.html")], "page.html"),
        (
            "91-compare-page",
            ["compare", str(run), "--out", str(work / "comparison")],
            "comparison/index.html#quality",
        ),
    ):
        subprocess.run([sys.executable, "-m", "training", *arguments], cwd=ROOT, check=True)
        process = subprocess.Popen(
            [browser, "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--kiosk",
             "--no-first-run", "--window-position=0,0", f"--window-size={window.SIZE[0]},{window.SIZE[1]}",
             f"--user-data-dir={work / 'profile'}", f"{work.as_uri()}/{page}"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            photograph(camera, out / f"{name}.png")
        finally:
            process.kill()
            process.wait()


def photograph(camera: str, path: Path) -> None:
    """Take a picture of the display once it has not changed for 15 seconds; at most after 3 minutes."""
    previous = None
    for _ in range(12):
        time.sleep(15)
        subprocess.run([camera, "-window", "root", str(path)], check=True)
        image = Image.open(path).convert("L")
        low, high = image.getextrema()
        if previous == image.tobytes() and low < high:
            return
        previous = image.tobytes()


if __name__ == "__main__":
    sys.exit(main())
