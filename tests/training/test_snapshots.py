"""Snapshots of small renderings, tables and the help of commands.

After an intended change, update them with ``pytest tests/training/test_snapshots.py --force-regen`` and
check the difference before the commit.
"""

import numpy as np
import pytest

from training.__main__ import main
from training.runs.report_text import format_report
from training.scenes.cameras import Camera, write_camera
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply

SHARE = 0.02
"""Allowed mean pixel difference in percent, because processors round differently."""


def splats(count: int, seed: int, size: float) -> Splats:
    """Return random splats around the origin; ``size`` is the logarithm of their mean scale."""
    random = np.random.default_rng(seed)
    return Splats(
        means=random.normal(0, 0.7, (count, 3)).astype(np.float32),
        quats=random.normal(size=(count, 4)).astype(np.float32),
        log_scales=random.normal(size, 0.5, (count, 3)).astype(np.float32),
        opacity_logits=random.normal(1, 1, count).astype(np.float32),
        sh=(random.normal(size=(count, 16, 3)) * 0.3).astype(np.float32),
    )


@pytest.fixture(scope="module")
def levels() -> list[Splats]:
    return [splats(40, 1, -1.5), splats(120, 2, -2.2), splats(500, 3, -3.0)]


@pytest.fixture
def bundle(levels, tmp_path):
    path = tmp_path / "bundle.ply"
    sizes = (0.4, 0.1, 0.0)
    numbered = [Level(n + 1, levels[n], {"s_min": sizes[n]}) for n in range(3)]
    write_bundle(path, Bundle("flod", numbered, "bands"))
    return path


@pytest.fixture
def render(tmp_path):
    """Return ``render(source, *options)``, which renders a PNG of 64x48 pixels and returns its bytes."""
    pose = np.eye(4)
    pose[:3, 3] = 0.1, -0.05, 3
    write_camera(tmp_path / "camera.json", Camera("", 64, 48, 60.0, 62.0, 30.5, 25.0, pose), 0.01)

    def run(source, *options: str) -> bytes:
        out = tmp_path / "image.png"
        arguments = ["render", source, "--camera", tmp_path / "camera.json", "--out", out, "--backend", "cpu"]
        assert main([*map(str, arguments), *options]) == 0
        return out.read_bytes()

    return run


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("finest", []),
        ("coarsest", ["--level", "1", "--background", "0.2,0.4,0.6"]),
        ("by distance", ["--first", "1", "--last", "3", "--gamma", "2"]),
    ],
)
def test_rendering_of_a_bundle(bundle, render, image_regression, name, options):
    image_regression.check(render(bundle, *options), SHARE, basename=name.replace(" ", "_"))


def test_rendering_of_a_ply(levels, render, tmp_path, image_regression):
    write_ply(tmp_path / "splats.ply", levels[1])
    image_regression.check(
        render(tmp_path / "splats.ply", "--background", "transparent"), SHARE, basename="ply"
    )


def test_info(bundle, levels, tmp_path, monkeypatch, capsys, file_regression):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "splats.ply", levels[0])
    assert main(["info", "bundle.ply"]) == main(["info", "splats.ply"]) == 0
    file_regression.check(capsys.readouterr().out, basename="info")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "job.toml").touch()
    (tmp_path / "bundle.ply").rename(tmp_path / "run" / "bundle.ply")
    assert main(["info", "run"]) == 0
    assert "bundle.ply: flod, 3 levels" in capsys.readouterr().out


def test_report_of_evaluate(file_regression):
    numbers = [(1, 0.08, 4_000, 19.5, 0.61), (2, 0.02, 21_000, 23.25, 0.755), (3, 0.0, 120_000, 28.125, 0.9)]
    rows = [
        {
            "level": n,
            "s_min": s_min,
            "splats": count,
            "drawn": count // 2,
            "psnr": psnr,
            "ssim": ssim,
            "frame_s": count / 1e6,
            "veil": {"mean": 0.04 * n, "max": 1.0},
            "by_size": [psnr, psnr + 1, psnr + 2, psnr + 3],
            **({"merged": [psnr - 1, psnr, psnr + 1, psnr + 2]} if n < 3 else {}),
        }
        for n, s_min, count, psnr, ssim in numbers
    ]
    detail = {
        "gamma": 1.0,
        "first": 1,
        "last": 3,
        "splats": 35_000,
        "drawn": 9_500,
        "psnr": 26.5,
        "ssim": 0.85,
        "frame_s": 0.04,
    }
    report = {
        "test_views": ["view_00.jpg"],
        "train_psnr": 30.75,
        "worst": {"view": "view_00.jpg", "psnr": 16.84},
        "veil": {"mean": 0.12, "max": 1.0},
        "oversized": 1_234,
        "aside": {"psnr": 21.25, "views": ["a.jpg", "b.jpg"]},
        "levels": rows,
        "selective": [{"set": "per view", **detail}, {"set": "predetermined", **detail}],
        "frame_s": {"by_distance": 0.04, "full": 0.08},
        "bytes": 35_100_000,
        "frame_memory": {"by_distance": 12_340_000, "full": 34_500_000},
        "farther": [{"factor": 2, "drawn": 9_000, "drawn_full": 120_000, "psnr": 31.5}],
        "jumps": {"faded": 1.25, "hard": 3.5},
    }
    file_regression.check(format_report(report) + "\n", basename="evaluate")


@pytest.mark.parametrize("name", ["", "flod"])
def test_methods(name, capsys, file_regression):
    assert main(["methods", *name.split()]) == 0
    file_regression.check(capsys.readouterr().out, basename=f"methods_{name or 'all'}")


@pytest.mark.parametrize("command", ["", "train", "evaluate", "render", "edit", "info", "methods"])
def test_help(command, monkeypatch, capsys, file_regression):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    file_regression.check(capsys.readouterr().out, basename=f"help_{command or 'lodgs'}")
