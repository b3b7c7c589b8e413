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
from ..lod.selection import Detail, complete, select
from ..methods import create
from ..methods.data import TrainingData
from ..rasterize import Rendering, device_of, rasterize
from ..runs.data import training_data
from ..runs.folder import RunFolder
from ..runs.job import Job
from ..scenes.cameras import Camera
from ..splats.bundle import Bundle, read_bundle
from ..splats.gaussians import Splats
from .metrics import psnr, ssim

STANDARD_DETAIL = Detail()
"""What the rules say, unchanged; FLoD's three finest levels."""


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

    def draw(self, splats: Splats, camera: Camera, weights: np.ndarray | None = None) -> torch.Tensor:
        """A picture of splats on black, (H, W, 3), on the CPU, with a weight on each splat's opacity."""
        return self.render(splats, camera, weights).image.cpu()

    def render(self, splats: Splats, camera: Camera, weights: np.ndarray | None = None) -> Rendering:
        """The same with all that a rendering tells."""
        columns = (splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.sh)

        def tensor(column: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(column, np.float32)).to(self.device)

        with torch.no_grad():
            return rasterize(
                *map(tensor, columns),
                camera=camera,
                weights=None if weights is None else tensor(weights),
                near=self.data.near,
                backend=self.backend,
            )

    def measure(self, shown_to: Callable[[Camera], tuple[Splats, np.ndarray | None]]) -> dict:
        """Mean quality, splats given to the rasterizer and seconds a frame over the held-out views.

        Args:
            shown_to: the splats that a camera is shown, with their weights.

        Returns:
            ``splats`` (mean count), ``psnr`` (dB), ``ssim``, ``frame_s`` (median, selection included).
        """
        counts = []

        def picture(camera: Camera) -> torch.Tensor:
            splats, weights = shown_to(camera)
            counts.append(len(splats))
            return self.draw(splats, camera, weights)

        quality = self.measure_pictures(picture)
        return {"splats": round(float(np.mean(counts))), **quality}

    def measure_pictures(self, picture: Callable[[Camera], torch.Tensor]) -> dict:
        """``psnr``, ``ssim`` and ``frame_s`` as :meth:`measure`, of pictures however they are made."""
        rows = []
        for camera in self.cameras:
            started = time.perf_counter()
            image = picture(camera)
            seconds = time.perf_counter() - started
            target = self.target(camera)
            rows.append((psnr(image, target), ssim(image, target), seconds))
        table = np.array(rows)
        return {
            "psnr": round(float(table[:, 0].mean()), 3),
            "ssim": round(float(table[:, 1].mean()), 4),
            "frame_s": round(float(np.median(table[:, 2])), 4),
        }

    def measure_by_distance(self, bundle: Bundle, detail: Detail = STANDARD_DETAIL) -> dict:
        """The same of what each view is shown of a bundle by its distances."""
        return self.measure(lambda camera: select(bundle, camera.center, min(camera.fx, camera.fy), detail))

    def measure_set(self, splats: Splats) -> dict:
        """The same for one set of splats that every view is shown."""
        return self.measure(lambda camera: (splats, None))


def evaluate_run(
    run: Path, detail: Detail = STANDARD_DETAIL, picture: Path | None = None, far: bool = False
) -> dict:
    """Measures a finished run and writes its ``metrics.json``.

    Args:
        run: the run's folder.
        detail: of the selective view.
        picture: a PNG to write, with the levels side by side as the middle held-out view sees them.
        far: measure also how levels do from farther away (``distance``).

    Returns:
        ``levels``: coarse to fine, ``level``, ``s_min``, ``splats``, ``psnr``, ``ssim``, ``frame_s``; where
        levels add up, of each with all coarser ones. ``selective``: per view and predetermined (chosen from
        the mean training camera), with the detail's settings. ``networks``: of a model that was baked,
        before that. ``farther`` and ``jumps`` (of the middle held-out view), where asked for.

    Raises:
        LodgsError: if the run is not finished or holds out no views, or such detail cannot be shown.
    """
    folder = RunFolder(run)
    if not folder.bundle.exists():
        raise LodgsError(f"{run} holds no finished run (no bundle.ply).", "Train it to the end first.")
    job = Job.from_file(folder.job)
    data = training_data(job, folder)
    if not data.test:
        raise LodgsError(f"The run {run} holds out no views to measure on.", "Train with test_every = 8.")
    evaluation, bundle = Evaluation(data, job.backend), read_bundle(folder.bundle)
    finest, detail = len(bundle.levels), detail.of(bundle)
    levels = []
    for level in bundle.levels:
        measured = evaluation.measure_set(complete(bundle, level))
        levels.append({"level": level.number, "s_min": level.s_min, **measured})
    selective = []
    if finest > 1:
        if bundle.cumulative:
            shown = {"offset": detail.offset}
        else:
            shown = {"from": detail.start, "to": detail.end, "gamma": detail.gamma}

        predetermined = select(bundle, data.mean_camera, data.focal, detail)
        selective = [
            {"set": "per view", **shown, **evaluation.measure_by_distance(bundle, detail)},
            {"set": "predetermined", **shown, **evaluation.measure(lambda camera: predetermined)},
        ]
    report = {
        "scene": job.scene,
        "method": job.method,
        "test_views": [camera.name for camera in data.test],
        "levels": levels,
        "selective": selective,
    }
    if folder.model.exists():
        method = create(job.method, data, job.resolved_parameters(), job.seed, job.backend)
        with np.load(folder.model, allow_pickle=False) as arrays:
            method.load_arrays(arrays)
        report["networks"] = evaluation.measure_pictures(method.picture)
    if far and finest > 1:
        from .distance import farther, jumps

        report["farther"] = farther(evaluation, bundle, detail)
        report["jumps"] = jumps(evaluation, bundle, detail, data.test[len(data.test) // 2])
    if picture is not None:
        from .picture import level_picture

        camera = data.test[len(data.test) // 2]
        level_picture(picture, bundle, evaluation, camera, detail)
    with atomic_write(folder.metrics) as temporary:
        Path(temporary).write_text(json.dumps(report, indent=1), encoding="utf-8")
    return report


def table(report: dict) -> str:
    """``evaluate_run``'s report as text."""
    lines = [f"{'':>17} {'s_min':>9} {'splats':>9} {'PSNR':>7} {'SSIM':>7} {'s/frame':>8}"]
    rows = [(f"level {row['level']}", f"{row['s_min'] or 0:.5f}", row) for row in report["levels"]]
    for r in report["selective"]:
        if "gamma" in r:
            rows.append((f"{r['to']}-{r['from']} {r['set']}", f"γ = {r['gamma']:g}", r))
        else:
            rows.append((f"distance {r['set']}", f"{r['offset']:+g}", r))
    if "networks" in report:
        rows.append(("with networks", "", {"splats": 0, **report["networks"]}))
    lines += [
        f"{name:<17} {size:>9} {r['splats']:>9,} {r['psnr']:>7.2f} {r['ssim']:>7.4f} {r['frame_s']:>8.3f}"
        for name, size, r in rows
    ]
    for row in report.get("farther", []):
        lines.append(
            f"{row['factor']}x the distance: {row['drawn']:,} of {row['drawn_full']:,} splats drawn, "
            f"{row['psnr']:.1f} dB against full detail"
        )
    if "jumps" in report:
        lines.append(
            "largest jump: {faded} times that of full detail, {hard} unfaded".format(**report["jumps"])
        )
    return "\n".join(lines)
