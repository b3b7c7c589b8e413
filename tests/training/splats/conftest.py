"""Fixtures for tests of splat files."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from training.splats.gaussians import Splats

NODE_PROGRAMS = Path(__file__).parents[3] / "build" / "interop" / "node_modules" / ".bin"
"""npm's program folder after ``make interop``."""


@pytest.fixture
def splat_transform():
    """Return ``splat_transform(source, target)``, which converts a file, or skip the test."""
    folders = os.pathsep.join([str(NODE_PROGRAMS), os.environ["PATH"]])
    program = shutil.which("splat-transform", path=folders)
    if program is None:
        pytest.skip("splat-transform is not installed; make interop installs it if Node.js is available")
    environment = os.environ | {"PATH": folders}

    def convert(source, target):
        command = [program, "-w", "--no-tty", "-g", "cpu", str(source), str(target)]
        subprocess.run(command, env=environment, check=True, capture_output=True)

    return convert


@pytest.fixture
def make_splats():
    """Return ``make_splats(count, degree=3, **extras)``, which makes random splats of distinct values."""
    random = np.random.default_rng(7)

    def normal(*shape):
        return random.standard_normal(shape, dtype=np.float32)

    def make(count, degree=3, **extras):
        sh = normal(count, (degree + 1) ** 2, 3)
        return Splats(normal(count, 3), normal(count, 4), normal(count, 3), normal(count), sh, extras)

    return make


@pytest.fixture
def same():
    """Return ``same(a, b)``, which asserts that splats, extras and types are equal bit for bit."""

    def compare(a, b):
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            assert getattr(b, name).dtype == np.float32
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        assert list(a.extras) == list(b.extras)
        for name, column in a.extras.items():
            assert b.extras[name].dtype == column.dtype
            np.testing.assert_array_equal(column, b.extras[name], err_msg=name)
        return True

    return compare
