"""Commands on a small tmpfs: one message with the file's name, and nothing half written."""

import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from training.runs.capture import is_complete
from training.runs.folder import RunFolder
from training.splats.gaussians import Splats
from training.splats.ply import read_ply, write_ply

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(
        not sys.platform.startswith("linux") or os.geteuid() != 0,
        reason="mounting a disk needs root on Linux",
    ),
]


@contextmanager
def small_disk(folder: Path, kilobytes: int):
    """Mount a new disk of this size."""
    folder.mkdir()
    options = f"size={kilobytes}k"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture
def base(tmp_path) -> Path:
    """Opaque splats on a sphere."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(600, 3))
    means = 2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    quats = np.tile(np.float32([1, 0, 0, 0]), (600, 1))
    sh = rng.normal(0, 0.5, (600, 1, 3)).astype(np.float32)
    scales, logits = np.full((600, 3), -1.8, np.float32), np.full(600, 6.0, np.float32)
    write_ply(tmp_path / "base.ply", Splats(means.astype(np.float32), quats, scales, logits, sh))
    return tmp_path / "base.ply"


def lodgs(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "training", *map(str, words)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


def require_message(result: subprocess.CompletedProcess[str], folder: Path) -> None:
    output = result.stdout.splitlines()[-1:] + result.stderr.splitlines()
    assert result.returncode == 2 and "Traceback" not in result.stderr, result
    assert any(str(folder) in line for line in output), output
    assert any("No space left" in line or "disk is full" in line for line in output), output


@pytest.mark.parametrize("kilobytes", [4, 20, 60, 120, 300])
def test_captured_scenes(base, tmp_path, kilobytes):
    with small_disk(tmp_path / "disk", kilobytes) as disk:
        scene = disk / "scene"
        words = ["capture", base, "--out", scene, "--views", 8, "--view-width", 96]
        result = lodgs(*words)
        if result.returncode:
            require_message(result, disk)
            assert not any(disk.iterdir())
        else:
            assert is_complete(scene)
        assert kilobytes > 100 or result.returncode


@pytest.mark.parametrize("kilobytes", [150, 250, 350])
def test_runs_that_capture_their_scene(base, tmp_path, kilobytes):
    with small_disk(tmp_path / "disk", kilobytes) as disk:
        run = RunFolder(disk / "run")
        words = [
            "train", "--base", base, "--capture", "dome", "--views", 8, "--view-width", 64,
            "--method", "lodge", "--set", "tune_steps=4", "--set", "levels=2", "--image-scale", 1,
            "--out", run.path,
        ]  # fmt: skip
        require_message(lodgs(*words), disk)
        assert not run.captured.exists() or is_complete(run.captured)
        subprocess.run(["mount", "-o", "remount,size=100m", str(disk)], check=True)
        assert lodgs(*words).returncode == 0 and run.bundle.exists()


@pytest.mark.parametrize("kilobytes", [4, 20, 60])
def test_edited_splats(base, tmp_path, kilobytes):
    with small_disk(tmp_path / "disk", kilobytes) as disk:
        target = disk / "edited.ply"
        target.write_bytes(b"old")
        result = lodgs("edit", base, "--out", target, "--scale", 2)
        if result.returncode:
            require_message(result, disk)
            assert target.read_bytes() == b"old"
        else:
            assert len(read_ply(target)) == 600
        assert [path.name for path in disk.iterdir()] == ["edited.ply"]


@pytest.mark.parametrize("suffix", ["usdc", "usdz", "glb", "sog"])
def test_exported_levels(base, tmp_path, suffix):
    option = "--plain" if suffix == "sog" else "--levels"
    with small_disk(tmp_path / "disk", 12) as disk:
        require_message(lodgs("edit", base, option, disk / f"a.{suffix}"), disk)
        assert not any(disk.iterdir())
