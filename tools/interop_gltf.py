"""Check that three.js draws our glTF files as we do. Part of ``make interop``.

Writes the levels of a bundle with views as ``.glb``, draws the first view in Chromium without a window and
without a graphics card, and compares the image with our own. Opacities are as trained, because three.js has
a filter like Mip-Splatting's. ``python tools/interop_gltf.py [BUNDLE.ply]`` uses a given bundle, or that of
``make demo``. Exit code 0: the images agree; 1: they do not; 2: nothing was checked.
"""

from __future__ import annotations

import http.server
import io
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools import interop  # noqa: E402
from training.api import load_bundle, render_image  # noqa: E402
from training.editing.export import export_levels  # noqa: E402
from training.scenes.cameras import Camera  # noqa: E402
from training.scenes.view_tables import read_view_tables  # noqa: E402
from training.splats.levels import Bundle  # noqa: E402

PACKAGE, VERSION = "three", "0.187.0"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
MIN_PSNR = 30.0
WIDTH = 360
SECONDS = 180
DEMO = ROOT / "build" / "demo" / "bundle.ply"


def main() -> int:
    inputs = prepare(PACKAGE, VERSION, WIDTH)
    if inputs is None:
        return 2
    browser, source, bundle, camera = inputs
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.glb"
        export_levels(scene, bundle, antialiased=True)
        mounts = {"/three": interop.FOLDER / "node_modules" / "three", "/scene.glb": scene}
        page = Path(__file__).with_suffix(".html")
        answer = draw(browser, page, mounts, f"{camera.width}x{camera.height}")
    return judge(f"three.js {VERSION}", answer, render_image(bundle, camera, backend="cpu"), source, MIN_PSNR)


def prepare(package: str, version: str, width: int) -> tuple[str, Path, Bundle, Camera] | None:
    """Install a package from npm. Return Chromium, the bundle's path, the bundle, and its first view.

    The bundle is that of the command line or of ``make demo``. If something is missing, print a message and
    return None.

    Args:
        width: width of the view in pixels.
    """
    source = Path(sys.argv[1]) if len(sys.argv) > 1 else DEMO
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    problem = interop.node_problem() or ("" if browser else "Chromium is not installed.")
    problem = problem or ("" if source.exists() else f"{source} does not exist; run make demo.")
    if problem or not interop.install(package, version):
        print(f"interop: {problem or 'npm cannot install it.'} {package} is not checked.")
        return None
    bundle = load_bundle(source)
    cameras, _, _ = read_view_tables(bundle.tables)
    return str(browser), source, bundle, cameras[0].scaled(width / cameras[0].width)


def judge(program: str, answer: np.ndarray | str, expected: np.ndarray, source: Path, min_psnr: float) -> int:
    """Print the likeness of a program's image, or its error message, and return the exit code."""
    if isinstance(answer, str):
        print(f"{program}: {answer}")
        return 1
    value = psnr(answer, expected)
    print(f"{program}: {value:.1f} dB from our image of {source}, at least {min_psnr:g}")
    return int(value < min_psnr)


def psnr(image: np.ndarray, expected: np.ndarray) -> float:
    """Return the PSNR of two images in dB."""
    return float(-10 * np.log10(np.square(image - expected.clip(0, 1)).mean()))


def draw(browser: str, page: Path, mounts: Mapping[str, Path], query: str) -> np.ndarray | str:
    """Return the image (H, W, 3) that a page sends, or an error message.

    Args:
        browser: path of Chromium.
        page: the page; it sends its image to /image, or an error message to /error.
        mounts: files and folders that the page loads, by the begin of their path on the server.
        query: query string of the page's address.
    """
    answers: list[tuple[str, bytes]] = []
    arrived = threading.Event()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def translate_path(self, path: str) -> str:
            name = path.partition("?")[0]
            for prefix, target in mounts.items():
                if name.startswith(prefix):
                    return f"{target}{name.removeprefix(prefix)}"
            return str(page)

        def do_POST(self) -> None:
            answers.append((self.path, self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()
            arrived.set()

        def log_message(self, *_: object) -> None:
            return

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}/?{query}"
    with tempfile.TemporaryDirectory() as profile:
        process = subprocess.Popen(
            [browser, "--headless=new", "--no-sandbox", "--use-angle=swiftshader",
             "--enable-unsafe-swiftshader", f"--user-data-dir={profile}", address],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        arrived.wait(SECONDS)
        process.kill()
        process.wait()
        shutil.rmtree(profile, ignore_errors=True)
        Path(profile).mkdir(exist_ok=True)
    server.shutdown()
    if not answers:
        return f"no image within {SECONDS} s"
    path, body = answers[0]
    if path != "/image":
        return body.decode("utf-8", "replace")
    return np.asarray(Image.open(io.BytesIO(body)).convert("RGB"), np.float32) / 255


if __name__ == "__main__":
    sys.exit(main())
