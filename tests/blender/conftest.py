"""Blender's Python module with the checkout linked as an extension; each test gets an empty file."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from tools.blender_module import EXTENSION, start_blender

_exit_status: int | None = None


def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker("blender")


@pytest.fixture(scope="session")
def bpy():
    """The module; tests that need it are skipped where it is not installed."""
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("bpy is not installed in this environment")
    return start_blender()


@pytest.fixture(autouse=True)
def empty_file(bpy):
    """An empty file with one empty scene; enabled extensions stay."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


@pytest.fixture
def lodgs(bpy):
    """``lodgs("data.scenes")``, ``lodgs("training.errors")``: modules of the extension's two packages."""

    def load(name: str):
        room = "" if name.startswith("training") else "blender_lodgs."
        return importlib.import_module(f"{EXTENSION}.{room}{name}")

    return load


@pytest.fixture
def frame(bpy):
    """``frame(size, draw)``: what ``draw()`` leaves in float colours, (size, size, 4) linear, row 0 low.

    ``frame(size, draw, before)`` does so in 8 bits coded in sRGB, like a viewport's, that hold
    ``before``. Tests that draw are skipped where this Blender has no graphics in background.
    """
    import gpu

    if not hasattr(gpu, "init"):
        pytest.skip("no graphics in background before Blender 5.2")
    try:
        gpu.init()
    except Exception as error:
        pytest.skip(f"no graphics here: {error}")
    if not _draws(gpu):
        pytest.skip("no graphics here: a cleared framebuffer stays empty; install mesa-vulkan-drivers")

    def drawn(size, draw, before=None):
        kind, data = "RGBA32F", np.zeros((size, size, 4), np.float32)
        if before is not None:
            kind, data = "SRGB8_A8", before.copy()
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
        seen = np.array(buffer, np.float32).reshape(size, size, 4)
        if before is not None:
            code = seen[..., :3]
            seen[..., :3] = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
        return seen

    return drawn


def _draws(gpu):
    """Return True if this Blender's graphics draw at all. Blender 5.3 starts without a working driver too."""
    texture = gpu.types.GPUTexture((1, 1), format="RGBA32F")
    frame = gpu.types.GPUFrameBuffer(color_slots=texture)
    with frame.bind():
        frame.clear(color=(0.25, 0.5, 0.75, 1.0))
        seen = frame.read_color(0, 0, 1, 1, 4, 0, "FLOAT")
    return np.allclose(np.ravel(seen.to_list()), (0.25, 0.5, 0.75, 1.0))


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """``fake("crash")`` sets how the trainer, played by ``fake_trainer.py``, behaves from now on."""
    program = tmp_path / "python with a space"
    program.write_text(
        f'#!/bin/sh\nexec "{sys.executable}" "{Path(__file__).with_name("fake_trainer.py")}" "$@"\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", str(program))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return lambda mode="": monkeypatch.setenv("LODGS_FAKE", mode)


@pytest.fixture
def blender(bpy, tmp_path, monkeypatch):
    """Blender as a program that panels start: ``as_blender.py`` plays it."""
    program = tmp_path / "blender"
    program.write_text(
        f'#!/bin/sh\nexec "{sys.executable}" "{Path(__file__).with_name("as_blender.py")}" "$@"\n'
    )
    program.chmod(0o755)
    monkeypatch.setattr(bpy.app, "binary_path", str(program))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return program


@pytest.fixture(scope="session")
def _one_renderer(bpy):
    """Starting the renderer takes seconds: all tests share one, though each has a new file."""
    renderer = importlib.import_module(f"{EXTENSION}.blender_lodgs.render.renderer")
    bpy.app.handlers.load_pre.remove(renderer._on_load)
    yield renderer
    renderer.close()
    bpy.app.handlers.load_pre.append(renderer._on_load)


@pytest.fixture
def renderer(request):
    """The module that keeps the real renderer; skipped where $LODGS_TRAINER_PYTHON names none."""
    if not os.environ.get("LODGS_TRAINER_PYTHON"):
        pytest.skip("no trainer; set LODGS_TRAINER_PYTHON")
    return request.getfixturevalue("_one_renderer")


def pytest_sessionfinish(session, exitstatus):
    global _exit_status
    _exit_status = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    """Blender 4.5 as a module can hang when Python ends, so a session that used it ends at once."""
    if "bpy" in sys.modules and _exit_status is not None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_exit_status)
