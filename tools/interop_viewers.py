"""Check that web viewers draw our files as we do. Part of ``make interop``.

Trains each method briefly, writes its splats in each format, draws the first view with each viewer in
Chromium, without a window and without a graphics card, and compares the image with our own. Viewers that
stream walk towards the splats of FLoD (``interop_walk.py``).
``python tools/interop_viewers.py BUNDLE.ply ...`` checks given bundles as those of FLoD, without a record.
Exit code 0: all checks pass; 1: some do not; 2: nothing was checked.
"""

from __future__ import annotations

import argparse
import base64
import http.server
import io
import json
import math
import shutil
import subprocess
import sys
import tempfile
import threading
import urllib.parse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools import interop  # noqa: E402
from tools.interop_cut import draw_with_cut  # noqa: E402
from tools.interop_results import Record, store_result  # noqa: E402
from tools.interop_walk import WALKS, Walk  # noqa: E402
from tools.viewer import VERSION as PAGE_VERSION  # noqa: E402
from training.api import load_bundle, render_image, train  # noqa: E402
from training.editing.edit import Outputs, edit  # noqa: E402
from training.editing.export import FileOptions  # noqa: E402
from training.scenes.cameras import Camera  # noqa: E402
from training.scenes.view_tables import read_view_tables  # noqa: E402
from training.splats.levels import Bundle, Level  # noqa: E402
from training.splats.ply import read_ply  # noqa: E402
from training.splats.streamed_levels import STREAMED_FILE  # noqa: E402
from training.splats.tiles import TILESET_FILE  # noqa: E402

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PAGE = Path(__file__).with_suffix(".html")
WIDTH = 320
SECONDS = 240
SHORT = {"max_splats": 6000}
METHODS = {
    "flod": SHORT
    | {"levels": 3, "steps": [60, 80, 120], "densify_until": [0.5] * 3, "densify_interval": [20] * 3},
    "lodge": SHORT | {"steps": 160, "tune_steps": 8, "levels": 3},
    "clod": SHORT | {"steps": 200},
    "octree": SHORT | {"steps": 200, "levels_from": "anchors"},
    "tree": SHORT | {"steps": 160, "tune_steps": 40},
    "matryoshka": SHORT | {"steps": 200},
}
"""Parameters of short trainings."""
WALKED = "flod"
"""Method whose levels are streamed in walks."""
SCENE = ROOT / "examples" / "lantern_garden"
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the axes of OpenCV's cameras to those of OpenGL's, and from those of 3DGS files to those of SPZ."""
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Format:
    """A format in which viewers open splats.

    Attributes:
        label: its name in the report.
        option: option of ``edit`` that writes it.
        name: file or folder to write.
        main: file that viewers open, if the format is a folder.
        min_psnr: minimum likeness to our image, dB.
        trained: opacities are as trained, for Mip-Splatting's filter.
        axes: axes of positions: "3dgs" for those of 3DGS files, "spz", or "y" or "z" for the axis that is up.
        flat: colours do not depend on the view.
    """

    label: str
    option: str
    name: str
    main: str = ""
    min_psnr: float = 28.0
    trained: bool = False
    axes: str = "3dgs"
    flat: bool = False


FORMATS = {
    "ply": Format("PLY", "plain", "scene.ply", min_psnr=30.0),
    "splat": Format(".splat", "plain", "scene.splat", flat=True),
    "spz": Format("SPZ", "plain", "scene.spz", trained=True, axes="spz"),
    "sog": Format("SOG", "plain", "scene.sog"),
    "streamed": Format("streamed levels", "streamed", "streamed", STREAMED_FILE),
    "glb": Format("glTF", "levels", "scene.glb", min_psnr=30.0, axes="y"),
    "tiles": Format("3D Tiles", "tiles", "tiles", TILESET_FILE, axes="z"),
}


@dataclass(frozen=True)
class Viewer:
    """A program that draws splats.

    Attributes:
        label: its name in the report.
        packages: packages from npm and their versions.
        formats: names in FORMATS.
        filtered: formats that it draws with a filter like Mip-Splatting's.
        cuts: it cuts splats as :func:`.interop_cut.draw_with_cut` does.
    """

    label: str
    packages: Mapping[str, str]
    formats: tuple[str, ...]
    filtered: tuple[str, ...] = ()
    cuts: bool = False

    @property
    def version(self) -> str:
        return next(iter(self.packages.values()))


VIEWERS = {
    "three": Viewer("three.js", {"three": "0.187.0"}, ("glb",), filtered=("glb",), cuts=True),
    "cesium": Viewer("CesiumJS", {"cesium": "1.145.0"}, ("tiles",)),
    "babylon": Viewer(
        "Babylon.js",
        {"babylonjs": "9.35.0", "babylonjs-loaders": "9.28.0", "fflate": "0.8.3"},
        ("ply", "splat", "spz", "sog", "streamed", "glb"),
        filtered=("spz",),
    ),
    "playcanvas": Viewer("PlayCanvas", {"playcanvas": "2.23.3"}, ("ply", "sog", "streamed")),
    "spark": Viewer(
        "Spark", {"@sparkjsdev/spark": "2.2.0", "three": "0.187.0"}, ("ply", "splat", "spz", "sog")
    ),
}
PAGE_VIEWER = Viewer("SuperSplat Viewer", {"@playcanvas/supersplat-viewer": PAGE_VERSION}, ())
"""Viewer in the pages of ``lodgs page``."""


def main() -> int:
    options = parse_arguments()
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    problem = interop.node_problem() or ("" if browser else "Chromium is not installed.")
    missing = [str(path) for path in options.bundles if not path.exists()]
    problem = problem or (f"{missing[0]} does not exist." if missing else "")
    if problem:
        print(f"interop: {problem} Viewers are not checked.")
        return 2
    sources: Sequence[Path] = options.bundles or [train_method(method) for method in options.methods]
    failed = False
    print(f"{'bundle':<10}  {'viewer':<18}  {'format':<8}  {'dB':>5}  at least")
    for source in sources:
        walks = source in options.bundles or source.parent.name == WALKED
        with tempfile.TemporaryDirectory() as folder:
            scene = Scene(source, Path(folder))
            for key in options.viewers:
                viewer = VIEWERS[key]
                if not all(interop.install(*package) for package in viewer.packages.items()):
                    return 2
                for kind in viewer.formats:
                    if not options.formats or kind in options.formats:
                        result = check(str(browser), key, kind, scene, options.images)
                        failed |= keep(result, options)
            for key, kind in WALKS.items() if walks else ():
                if not options.formats or kind in options.formats:
                    failed |= keep(check_walk(str(browser), key, scene, options.images), options)
    return int(failed)


def keep(result: Record, options: argparse.Namespace) -> bool:
    """Store a result of a trained method, and return whether its check failed."""
    if not options.bundles:
        store_result(result)
    return not result["passed"]


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("bundles", nargs="*", type=Path, metavar="BUNDLE.ply")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--viewers", nargs="*", choices=list(VIEWERS), default=list(VIEWERS))
    parser.add_argument("--formats", nargs="+", choices=[*FORMATS, *WALKS.values()], default=[])
    parser.add_argument("--images", type=Path, metavar="DIR", help="folder for the images of both")
    return parser.parse_args()


class Scene:
    """A bundle, its files in all formats, and our images of a view.

    Args:
        folder: empty folder for the files.
    """

    def __init__(self, source: Path, folder: Path) -> None:
        self.source, self.folder = source, folder
        self.bundle: Bundle = load_bundle(source)
        cameras, self.near, _ = read_view_tables(self.bundle.tables)
        self.camera: Camera = cameras[0].scaled(WIDTH / cameras[0].width)
        self._write = cache(self._write_once)
        self._image = cache(self._image_once)

    def file(self, kind: str, filters: bool) -> Path:
        """Return the file or folder of a format, for viewers with or without a filter."""
        return self._write(FORMATS[kind], filters)

    def _write_once(self, kind: Format, antialiased: bool) -> Path:
        path = self.folder / f"{'trained' if antialiased else 'baked'}-{kind.name}"
        value = path if kind.option in ("streamed", "tiles") else [path]
        edit(self.source, Outputs(**{kind.option: value}), options=FileOptions(antialiased))
        return path

    def image(self, kind: str, filters: bool, cuts: bool) -> np.ndarray:
        """Return our image (H, W, 3) of a format's finest splats, as a viewer should draw them."""
        return self._image(FORMATS[kind].trained or filters, filters, FORMATS[kind].flat, cuts)

    def _image_once(self, trained: bool, filters: bool, flat: bool, cuts: bool) -> np.ndarray:
        splats = read_ply(self._write(FORMATS["ply"], trained))
        if cuts:
            return draw_with_cut(splats, self.camera, self.near).clip(0, 1)
        if flat:
            splats.sh = splats.sh[:, :1]
        bundle = Bundle("", [Level(1, splats)], meta={"antialias": filters and self.bundle.antialias})
        return render_image(bundle, self.camera, near=self.near, backend="cpu").clip(0, 1)

    def pose(self, axes: str, camera: Camera | None = None) -> np.ndarray:
        """Return the transform (4, 4) of a camera to the world of a format, OpenGL axes.

        Args:
            camera: None for that of the first view.
        """
        upright = np.eye(4)
        upright[:3, :3] = self.bundle.up_rotation
        world = {"3dgs": np.eye(4), "spz": FLIP, "z": upright, "y": Y_UP @ upright}[axes]
        return world @ np.linalg.inv((camera or self.camera).world_to_camera) @ FLIP


def check(browser: str, key: str, kind: str, scene: Scene, images: Path | None) -> Record:
    """Compare a viewer's image of a format with ours, print the likeness, and return the result.

    Args:
        images: folder for both images, or None.
    """
    viewer = VIEWERS[key]
    expected, minimum = scene.image(kind, kind in viewer.filtered, viewer.cuts), FORMATS[kind].min_psnr
    answer = view(browser, key, kind, scene)
    if isinstance(answer, str):  # Babylon.js sometimes fails to load levels of glTF
        answer = view(browser, key, kind, scene)
    if not isinstance(answer, str) and answer.shape != expected.shape:
        answer = f"image of {answer.shape[1]}x{answer.shape[0]} pixels"
    likeness = -math.inf if isinstance(answer, str) else psnr(answer, expected)
    name = scene.source.parent.name
    problem = f"  {answer}" if isinstance(answer, str) else ""
    row = f"{name:<10}  {viewer.label + ' ' + viewer.version:<18}  {kind:<8}  {likeness:5.1f}"
    print(f"{row}  {minimum:g}{problem}", flush=True)
    if not isinstance(answer, str):
        save(images, f"{name}-{key}-{kind}.png", [answer, expected])
    return {
        "check": "image", "program": viewer.label, "version": viewer.version, "format": FORMATS[kind].label,
        "method": name, "passed": likeness >= minimum, "psnr": round(max(likeness, 0.0), 1),
        "min_psnr": minimum,
    }  # fmt: skip


def view(browser: str, key: str, kind: str, scene: Scene) -> np.ndarray | str:
    """Return a viewer's image (H, W, 3) of a format, or an error message."""
    viewer, main = VIEWERS[key], FORMATS[kind].main
    path = scene.file(kind, kind in viewer.filtered)
    job = {
        "viewer": key, "file": f"/files/{path.name}{'/' + main if main else ''}",
        "pose": scene.pose(FORMATS[kind].axes).T.ravel().tolist(),
    }  # fmt: skip
    answer = send(browser, job, scene.camera, scene.folder)
    return answer if isinstance(answer, str) else decode_image(answer)


def check_walk(browser: str, key: str, scene: Scene, images: Path | None) -> Record:
    """Walk towards a scene in a viewer, print splats and holes of each step, and return the result.

    Args:
        images: folder for the images of the steps, or None.
    """
    walk = Walk(scene.bundle, scene.camera, scene.near, key, scene.folder / f"walk-{key}")
    poses = [scene.pose(walk.axes, camera).T.ravel().tolist() for camera in walk.cameras]
    job = {"viewer": key, **walk.write(poses)}
    answer = send(browser, job, walk.cameras[0], walk.folder)
    name = f"{scene.source.parent.name:<10}  {key + ' walk':<18}  {WALKS[key]:<8}"
    viewer = VIEWERS.get(key, PAGE_VIEWER)
    kind = FORMATS[WALKS[key]].label if WALKS[key] in FORMATS else WALKS[key]
    result = {
        "check": "walk", "program": viewer.label, "version": viewer.version, "format": kind,
        "method": scene.source.parent.name, "passed": False, "splats": [], "budget": walk.budget,
    }  # fmt: skip
    if isinstance(answer, str):
        print(f"{name}  {answer}", flush=True)
        return result
    steps = json.loads(answer)
    problem = walk.judge(steps)
    for distance, step in zip(walk.distances, steps, strict=True):
        row = f"{name}  {distance:5.1f} away: {step['splats']:6,} splats, largest hole {step['hole']:.2%}"
        print(f"{row} of {step['frames']} frames", flush=True)
    print(f"{name}  at most {walk.budget:,} splats: {problem or 'no hole, budget kept'}", flush=True)
    pictures = [decode_image(base64.b64decode(step["image"].partition(",")[2])) for step in steps]
    save(images, f"{scene.source.parent.name}-{key}-walk.png", pictures)
    return result | {
        "passed": not problem, "splats": [step["splats"] for step in steps],
        "hole": round(max(step["hole"] for step in steps), 5),
    }  # fmt: skip


def send(browser: str, job: Mapping[str, object], camera: Camera, folder: Path) -> bytes | str:
    """Return a viewer's answer to a job, or an error message.

    Args:
        job: values for the page, without those of the camera.
        camera: size and angle of the images.
        folder: folder with the files of the job.
    """
    angle = 2 * math.atan(camera.height / 2 / camera.fy)
    query = json.dumps({**job, "size": [camera.width, camera.height], "angle": angle})
    viewer = VIEWERS.get(str(job["viewer"]))
    packages = viewer.packages if viewer else ()
    modules = {f"/{name}": interop.FOLDER / "node_modules" / name for name in packages}
    return ask(browser, PAGE, {"/files": folder, **modules}, urllib.parse.quote(query))


def save(images: Path | None, name: str, pictures: Sequence[np.ndarray]) -> None:
    """Save images (H, W, 3) side by side in a folder, if there is one."""
    if images is not None:
        images.mkdir(parents=True, exist_ok=True)
        both = np.rint(255 * np.concatenate(pictures, axis=1)).astype(np.uint8)
        Image.fromarray(both).save(images / name)


def decode_image(data: bytes) -> np.ndarray:
    """Return the image (H, W, 3) float32 of a PNG."""
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.float32) / 255


def psnr(image: np.ndarray, expected: np.ndarray) -> float:
    """Return the PSNR of two images in dB."""
    return float(-10 * np.log10(np.square(image - expected).mean()))


def train_method(method: str) -> Path:
    """Train a method on the example scene, unless done before, and return the path of its bundle."""
    folder = interop.FOLDER / "methods" / method
    parameters = METHODS[method]
    scene = {"image_scale": 0.25, "backend": "cpu", "seed": 0, "preset": "draft"}
    return train(SCENE, folder, method=method, parameters=parameters, **scene).bundle


@contextmanager
def run_browser(
    browser: str, address: str, *options: str, stderr: int = subprocess.DEVNULL
) -> Iterator[subprocess.Popen[bytes]]:
    """Open a page in Chromium, without a window and a graphics card, during the block."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [browser, "--headless=new", "--no-sandbox", "--use-angle=swiftshader",
             "--enable-unsafe-swiftshader", f"--user-data-dir={profile}", *options, address],
            stdout=subprocess.DEVNULL, stderr=stderr,
        )  # fmt: skip
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def ask(browser: str, page: Path, mounts: Mapping[str, Path], query: str) -> bytes | str:
    """Return the answer that a page sends, or an error message.

    Args:
        browser: path of Chromium.
        page: the page; it sends an answer, or an error message to /error.
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
    with run_browser(browser, address):
        arrived.wait(SECONDS)
    server.shutdown()
    if not answers:
        return f"no answer within {SECONDS} s"
    path, body = answers[0]
    return body.decode("utf-8", "replace") if path == "/error" else body


if __name__ == "__main__":
    sys.exit(main())
