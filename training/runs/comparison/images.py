"""Images of runs for the page that compares them: views at several details, and fly-outs."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as replaced

import numpy as np
import torch

from ...evaluate.distance import fly_out
from ...evaluate.level_sheet import in_level_colors
from ...evaluate.views import Evaluation
from ...lod.rule import Values
from ...lod.selection import full_detail_controls, resolve_controls
from ...rasterize.resident import ResidentBundle
from ...scenes.cameras import Camera, pick_evenly
from ...splats.levels import Bundle
from .measures import ComparedRun, Point

VIEWS = 3
"""Maximum number of compared views."""
WIDTH = 960
"""Maximum width of their images in pixels."""
FRAME_WIDTH = 320
"""Width of the frames of a fly-out in pixels."""
FRAMES_PER_IMAGE = 5
"""Number of measured frames of a fly-out for each frame on the page."""
QUALITY = 85
"""JPEG quality."""


@dataclass(frozen=True)
class Variant:
    """Images of a run at one detail.

    Attributes:
        title: label of the detail with its number of splats.
        images: address of an image for each view.
    """

    title: str
    images: list[str]


@dataclass(frozen=True)
class RunImages:
    """Images of a run.

    Attributes:
        label: label of the run.
        variants: images by "Full detail", "Reduced", "By distance" and "Level colours", or by names of sets.
        frames: addresses of images of a fly-out, one for FRAMES_PER_IMAGE frames; empty without a rule.
    """

    label: str
    variants: dict[str, Variant]
    frames: list[str] = field(default_factory=list)


def compared_views(evaluation: Evaluation) -> list[Camera]:
    """Return at most VIEWS of the evaluation's views, at most WIDTH pixels wide."""
    return [_narrowed(camera, WIDTH) for camera in pick_evenly(evaluation.cameras, VIEWS)]


def photos(evaluation: Evaluation, cameras: Sequence[Camera]) -> list[str]:
    """Return addresses of the photos of views, in the sizes of their cameras."""
    by_name = {camera.name: camera for camera in evaluation.cameras}
    return [
        encode(evaluation.target(by_name[camera.name]).image, (camera.width, camera.height))
        for camera in cameras
    ]


def render_run(
    evaluation: Evaluation,
    bundle: Bundle,
    run: ComparedRun,
    cameras: Sequence[Camera],
    splats: float | None,
) -> RunImages:
    """Render a run's images.

    Args:
        evaluation: evaluation of the run's scene.
        cameras: views to render.
        splats: number of splats of the variant "Reduced". None renders a variant for each set of the run.
    """
    evaluation = evaluation.with_filter(bundle.antialias)
    resident = ResidentBundle(bundle, evaluation.backend)
    near = evaluation.data.near

    def draw_point(point: Point) -> Callable[[Camera], torch.Tensor]:
        if point.values:
            controls: Values | None = resolve_controls(bundle, point.values)
            part = resident
        else:
            drawn = replaced(bundle, levels=bundle.drawn_levels(point.level))
            controls = full_detail_controls(drawn)
            part = ResidentBundle(drawn, evaluation.backend) if controls is not None else resident
        if controls is None:
            return lambda camera: part.draw_level(point.level, camera, near=near).image
        return lambda camera: part.draw(camera, controls, near=near).image

    def variant(title: str, draw: Callable[[Camera], torch.Tensor]) -> Variant:
        return Variant(title, [encode(draw(camera)) for camera in cameras])

    if splats is None:
        points = {point.name: point for point in reversed(run.points)}
    else:
        points = {"Full detail": run.finest, "Reduced": run.nearest(splats)}
    variants = {name: variant(_title(point), draw_point(point)) for name, point in points.items()}
    if run.by_distance is None:
        return RunImages(run.label, variants)
    values = resolve_controls(bundle, {})
    variants["By distance"] = variant(
        _title(run.by_distance), lambda camera: resident.draw(camera, values, near=near).image
    )
    if not bundle.on_disk:
        colored = ResidentBundle(in_level_colors(bundle), evaluation.backend)
        variants["Level colours"] = variant(
            "Levels by distance", lambda camera: colored.draw(camera, values, near=near).image
        )
    return RunImages(run.label, variants, _fly_out(evaluation, resident, values))


def render_merges(
    evaluation: Evaluation, run: ComparedRun, sets: dict, cameras: Sequence[Camera], splats: float
) -> RunImages:
    """Render the merged sets of ``measures.merge_baseline`` as :func:`render_run` renders a run."""
    variants = {}
    for name, point in (("Full detail", run.finest), ("Reduced", run.nearest(splats))):
        loaded = evaluation.load(sets[point.splats])
        images = [encode(evaluation.draw(loaded, camera)) for camera in cameras]
        variants[name] = Variant(_title(point), images)
    return RunImages(run.label, variants)


def _fly_out(evaluation: Evaluation, resident: ResidentBundle, values: Values) -> list[str]:
    """Return images of a fly-out from the middle view."""
    data = evaluation.data
    middle = _narrowed(evaluation.cameras[len(evaluation.cameras) // 2], FRAME_WIDTH)
    views = fly_out(middle, data.median_depth, FRAMES_PER_IMAGE)
    return [encode(resident.draw(view, values, near=data.near).image) for view in views]


def _narrowed(camera: Camera, width: int) -> Camera:
    return camera.scaled(min(width / camera.width, 1.0))


def _title(point: Point) -> str:
    return f"{point.name}: {point.splats:,} splats, {point.psnr:.2f} dB"


def encode(image: torch.Tensor, size: tuple[int, int] | None = None) -> str:
    """Return an image (H, W, 3), optionally resized to (width, height), as the address of a JPEG."""
    from PIL import Image

    pixels = (image.detach().cpu().clamp(0, 1) * 255).round().byte().numpy()
    picture = Image.fromarray(np.ascontiguousarray(pixels))
    if size is not None and picture.size != size:
        picture = picture.resize(size, Image.Resampling.LANCZOS)
    file = io.BytesIO()
    picture.save(file, "JPEG", quality=QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()
