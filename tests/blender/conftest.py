"""Fixtures: Blender as a Python module with the checkout as an extension, and an empty file for each test."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from tools.blender_module import EXTENSION, start_blender
from training.files import cache_folder

TRAINER = Path(__file__).parents[2] / ".venv" / "bin" / "python"
if TRAINER.exists():  # as in the Makefile, so that tests with a trainer also run without it
    os.environ.setdefault("LODGS_TRAINER_PYTHON", str(TRAINER))

_exit_status: int | None = None


def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker("blender")


@pytest.fixture(scope="session")
def bpy():
    """Start Blender's module; skip tests if it is not installed."""
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("bpy is not installed in this environment")
    return start_blender()


@pytest.fixture(autouse=True)
def empty_file(bpy):
    """Open an empty file with one empty scene, and reset the extension's preferences. It stays enabled."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    preferences = bpy.context.preferences.addons[EXTENSION].preferences
    for name in type(preferences).__annotations__:
        preferences.property_unset(name)


@pytest.fixture
def lodgs(bpy):
    """``lodgs("data.scenes")``, ``lodgs("training.errors")``: import a module of the extension."""

    def load(name: str):
        package = "" if name.startswith("training") else "blender_lodgs."
        return importlib.import_module(f"{EXTENSION}.{package}{name}")

    return load


@pytest.fixture
def instance_of(bpy):
    """``instance_of(collection, location)``: add an instance of a collection to the scene."""

    def add(collection, location=(0, 0, 0)):
        instance = bpy.data.objects.new("instance", None)
        instance.instance_type, instance.instance_collection = "COLLECTION", collection
        instance.location = location
        bpy.context.scene.collection.objects.link(instance)
        bpy.context.view_layer.update()
        return instance

    return add


@pytest.fixture
def measure_renders(bpy, lodgs, tmp_path):
    """``measure_renders(measure)``: render frames 1 and 2 with LODGS, without the trainer.

    Returns the result of ``measure(depsgraph)`` for each frame.
    """

    def render(measure):
        scene, engine, results = bpy.context.scene, lodgs("render.engine"), {}
        engine.use(scene)
        scene.frame_start, scene.frame_end = 1, 2
        scene.frame_set(2)
        scene.render.filepath = str(tmp_path / "frame_")
        scene.render.resolution_x = scene.render.resolution_y = 8

        def render_frame(depsgraph, *_):
            results[depsgraph.scene.frame_current] = measure(depsgraph)

        with engine.use_renderer(render_frame):
            bpy.ops.render.render(animation=True)
        return results

    return render


@pytest.fixture
def frame(bpy):
    """``frame(size, draw)``: call ``draw()``, return the linear image (size, size, 4), bottom row first.

    ``frame(size, draw, background)`` draws over an image in an 8-bit sRGB framebuffer, as in viewports.
    Tests are skipped if this Blender has no graphics in background mode.
    """
    import gpu

    if not hasattr(gpu, "init"):
        pytest.skip("no graphics in background before Blender 5.2")
    try:
        gpu.init()
    except Exception as error:
        pytest.skip(f"no graphics: {error}")
    if not _draws(gpu):
        pytest.skip("no graphics: a cleared framebuffer stays empty; install mesa-vulkan-drivers")

    def draw_frame(size, draw, background=None):
        kind, data = "RGBA32F", np.zeros((size, size, 4), np.float32)
        if background is not None:
            kind, data = "SRGB8_A8", background.copy()
            data[..., :3] = np.where(
                data[..., :3] <= 0.0031308, 12.92 * data[..., :3], 1.055 * data[..., :3] ** (1 / 2.4) - 0.055
            )
        colors = gpu.types.GPUTexture(
            (size, size), format=kind, data=gpu.types.Buffer("FLOAT", data.size, data.reshape(-1))
        )
        depth = gpu.types.GPUTexture((size, size), format="DEPTH_COMPONENT32F")
        frame = gpu.types.GPUFrameBuffer(depth_slot=depth, color_slots=colors)
        with frame.bind():
            frame.clear(depth=1.0)
            draw()
            buffer = frame.read_color(0, 0, size, size, 4, 0, "FLOAT")
        buffer.dimensions = size * size * 4
        image = np.array(buffer, np.float32).reshape(size, size, 4)
        if background is not None:
            code = image[..., :3]
            image[..., :3] = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
        return image

    return draw_frame


def _draws(gpu):
    """Return True if drawing works. Blender 5.3 also starts without a working driver."""
    texture = gpu.types.GPUTexture((1, 1), format="RGBA32F")
    frame = gpu.types.GPUFrameBuffer(color_slots=texture)
    with frame.bind():
        frame.clear(color=(0.25, 0.5, 0.75, 1.0))
        image = frame.read_color(0, 0, 1, 1, 4, 0, "FLOAT")
    return np.allclose(np.ravel(image.to_list()), (0.25, 0.5, 0.75, 1.0))


FAKE = """#!/bin/sh
case "$3 $LODGS_FAKE" in  # answered by the shell, because Python takes half a second
    "check no_torch") echo '{"ok": false, "problems": ["The package torch is missing in here."]}'; exit 2;;
    "check no_dask") echo '{"torch": "2.13.0", "ok": true, "problems": []}'; exit;;
    "check "*) echo '{"torch": "2.13.0", "distributed": "2026.8.0", "ok": true, "problems": []}'; exit;;
esac
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """``fake("crash")``: set the behaviour of the fake trainer, ``fake_trainer.py``.

    In the modes ``no_dask`` and ``no_torch``, its check misses these packages.
    """
    program = tmp_path / "python with a space"
    program.write_text(
        f'{FAKE}exec "{sys.executable}" "{Path(__file__).with_name("fake_trainer.py")}" "$@"\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", str(program))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return lambda mode="": monkeypatch.setenv("LODGS_FAKE", mode)


@pytest.fixture
def blender(bpy, tmp_path, monkeypatch):
    """Replace Blender's executable by ``as_blender.py``."""
    program = tmp_path / "blender"
    program.write_text(
        f'#!/bin/sh\nexec "{sys.executable}" "{Path(__file__).with_name("as_blender.py")}" "$@"\n'
    )
    program.chmod(0o755)
    monkeypatch.setattr(bpy.app, "binary_path", str(program))
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache_folder().parent))  # compiled code
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return program


HANG = """
import sys, time

write = sys.stderr.write

def write_and_hang(text):
    write(text)
    sys.stderr.flush()
    if {text!r} in text:
        time.sleep(1000)

sys.stderr.write = write_and_hang
"""


@pytest.fixture
def hanging(tmp_path):
    """``hanging(path, text, *command)``: write a program whose Python hangs once it reports a text.

    Such a program cannot end before the test cancels it, even on a busy computer.
    """

    def write(path: Path, text: str, *command) -> None:
        folder = tmp_path / "hang"
        folder.mkdir()
        (folder / "sitecustomize.py").write_text(HANG.format(text=text))
        words = " ".join(f'"{word}"' for word in command)
        path.write_text(f'#!/bin/sh\nPYTHONPATH="{folder}" exec {words} "$@"\n')
        path.chmod(0o755)

    return write


@pytest.fixture(scope="session")
def _shared_renderer(bpy):
    """Share one renderer between all tests, as it takes seconds to start."""
    renderer = importlib.import_module(f"{EXTENSION}.blender_lodgs.render.renderer")
    bpy.app.handlers.load_pre.remove(renderer._on_load)
    yield renderer
    renderer.close()
    bpy.app.handlers.load_pre.append(renderer._on_load)


@pytest.fixture
def renderer(request):
    """Return the module of the real renderer; skip if LODGS_TRAINER_PYTHON is not set."""
    if not os.environ.get("LODGS_TRAINER_PYTHON"):
        pytest.skip("no trainer; set LODGS_TRAINER_PYTHON")
    return request.getfixturevalue("_shared_renderer")


def pytest_sessionfinish(session, exitstatus):
    global _exit_status
    _exit_status = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    """End the process at once: Blender 4.5 as a module can hang when Python ends."""
    if "bpy" in sys.modules and _exit_status is not None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_exit_status)
