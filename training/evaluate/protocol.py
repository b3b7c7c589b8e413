"""Measuring a run: every level and the selective view, on the held-out views."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ..errors import LodgsError
from ..files import atomic_write
from ..lod.rules import band_mask, flod_bands
from ..methods.data import TrainingData
from ..rasterize import device_of, rasterize
from ..runs.data import training_data
from ..runs.folder import RunFolder
from ..runs.job import Job
from ..scenes.cameras import Camera
from ..splats.bundle import Bundle, read_bundle
from ..splats.gaussians import Splats
from .metrics import psnr, ssim


class Evaluation:
    """The held-out views of a scene, ready to be compared with.

    Args:
        data: the scene at training size; its ``test`` views are used.
        backend: rasterizer.
    """

    def __init__(self, data: TrainingData, backend: str = "auto") -> None:
        self.data, self.backend, self.device = data, backend, device_of(backend)
        self.cameras = data.test
        self._targets: dict[str, torch.Tensor] = {}

    def target(self, camera: Camera) -> torch.Tensor:
        """The photograph of a view, (H, W, 3)."""
        if camera.name not in self._targets:
            self._targets[camera.name] = torch.from_numpy(self.data.image(camera))
        return self._targets[camera.name]

    def draw(self, splats: Splats, camera: Camera) -> torch.Tensor:
        """A picture of splats on black, (H, W, 3), on the CPU."""
        columns = (splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.sh)
        with torch.no_grad():
            arrays = (torch.from_numpy(np.ascontiguousarray(column, np.float32)) for column in columns)
            tensors = [array.to(self.device) for array in arrays]
            return rasterize(*tensors, camera=camera, near=self.data.near, backend=self.backend).image.cpu()

    def measure(self, splats_for: Callable[[Camera], Splats]) -> dict:
        """Mean quality, splats given to the rasterizer and seconds a frame over the held-out views.

        Args:
            splats_for: the splats that a camera is shown.

        Returns:
            ``splats`` (mean count), ``psnr`` (dB), ``ssim``, ``frame_s`` (median, selection included).
        """
        rows = []
        for camera in self.cameras:
            started = time.perf_counter()
            splats = splats_for(camera)
            image = self.draw(splats, camera)
            seconds = time.perf_counter() - started
            target = self.target(camera)
            rows.append((psnr(image, target), ssim(image, target), len(splats), seconds))
        table = np.array(rows)
        return {
            "splats": round(float(table[:, 2].mean())),
            "psnr": round(float(table[:, 0].mean()), 3),
            "ssim": round(float(table[:, 1].mean()), 4),
            "frame_s": round(float(np.median(table[:, 3])), 4),
        }

    def measure_set(self, splats: Splats) -> dict:
        """The same for one set of splats that every view is shown."""
        return self.measure(lambda camera: splats)


def select_flod(
    bundle: Bundle, eye: np.ndarray, focal_px: float, gamma: float, start: int, end: int
) -> Splats:
    """The splats of FLoD's selective rendering as one set (FLoD, Eq. 7).

    Args:
        bundle: levels coarse to fine, with their s_min.
        eye: (3,) world position that distances are measured from: the camera's, or the mean training camera's
            for the predetermined set.
        focal_px: focal length in pixels of the image that is looked at.
        gamma: screen size threshold in pixels.
        start, end: coarsest and finest level in use.
    """
    bands = flod_bands([level.s_min or 0.0 for level in bundle.levels], focal_px, gamma, start, end)
    eye = np.asarray(eye, np.float32)
    chosen = []
    for level, (near, far) in zip(bundle.levels, bands, strict=True):
        if start <= level.number <= end:
            distances = np.linalg.norm(level.splats.means - eye, axis=1)
            chosen.append(level.splats.select(band_mask(distances, near, far)))
    return Splats.concatenated(chosen)


def evaluate_run(
    run: Path, gamma: float = 1.0, start: int = 0, end: int = 0, picture: Path | None = None
) -> dict:
    """Measures a finished run and writes its ``metrics.json``.

    Args:
        run: the run's folder.
        gamma, start, end: of the selective view; 0 takes the three finest levels.
        picture: a PNG to write, with the levels side by side as the middle held-out view sees them.

    Returns:
        ``levels``: coarse to fine, ``level``, ``s_min``, ``splats``, ``psnr``, ``ssim``, ``frame_s``;
        ``selective``: per view and predetermined, with ``from``, ``to``, ``gamma``.

    Raises:
        LodgsError: if the run is not finished or holds out no views.
    """
    folder = RunFolder(run)
    if not folder.bundle.exists():
        raise LodgsError(f"{run} holds no finished run (no bundle.ply).", "Train it to the end first.")
    job = Job.from_file(folder.job)
    data = training_data(job, folder)
    if not data.test:
        raise LodgsError(f"The run {run} holds out no views to measure on.", "Train with test_every = 8.")
    evaluation, bundle = Evaluation(data, job.backend), read_bundle(folder.bundle)
    end = end or len(bundle.levels)
    start = start or max(1, end - 2)
    if not 1 <= start <= end <= len(bundle.levels) or gamma <= 0:
        raise LodgsError(
            f"Levels {start} to {end} with gamma {gamma:g} cannot be shown.",
            f"Choose levels from 1 to {len(bundle.levels)}, coarse to fine, and a gamma above 0.",
        )
    levels = []
    for level in bundle.levels:
        measured = evaluation.measure_set(level.splats)
        levels.append({"level": level.number, "s_min": level.s_min, **measured})
    selective = []
    if len(levels) > 1:
        shown = {"from": start, "to": end, "gamma": gamma}

        def per_view(camera: Camera) -> Splats:
            return select_flod(bundle, camera.center, min(camera.fx, camera.fy), gamma, start, end)

        predetermined = select_flod(bundle, data.mean_camera, data.focal, gamma, start, end)
        selective = [
            {"set": "per view", **shown, **evaluation.measure(per_view)},
            {"set": "predetermined", **shown, **evaluation.measure_set(predetermined)},
        ]
    report = {
        "scene": job.scene,
        "method": job.method,
        "test_views": [camera.name for camera in data.test],
        "levels": levels,
        "selective": selective,
    }
    if picture is not None:
        from .picture import level_picture

        camera = data.test[len(data.test) // 2]
        level_picture(picture, bundle, evaluation, camera, gamma, start, end)
    with atomic_write(folder.metrics) as temporary:
        Path(temporary).write_text(json.dumps(report, indent=1), encoding="utf-8")
    return report


def table(report: dict) -> str:
    """``evaluate_run``'s report as text."""
    lines = [f"{'':>17} {'s_min':>9} {'splats':>9} {'PSNR':>7} {'SSIM':>7} {'s/frame':>8}"]
    rows = [(f"level {row['level']}", f"{row['s_min'] or 0:.5f}", row) for row in report["levels"]]
    rows += [(f"{r['to']}-{r['from']} {r['set']}", f"γ = {r['gamma']:g}", r) for r in report["selective"]]
    lines += [
        f"{name:<17} {size:>9} {r['splats']:>9,} {r['psnr']:>7.2f} {r['ssim']:>7.4f} {r['frame_s']:>8.3f}"
        for name, size, r in rows
    ]
    return "\n".join(lines)
