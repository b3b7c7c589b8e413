"""Python interface: read scenes and splats, train, select levels and render.

Coordinates and lengths are in the scene's units. Cameras have OpenCV axes (``scenes.cameras.Camera``). Wrong
arguments and files raise a ``LodgsError``. Warnings about files use Python's ``warnings``. Only ``train`` and
``render_image`` import torch.
"""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from .errors import LodgsError
from .lod.selection import BundleSelector, resolve_controls
from .runs.failures import CANCELLED, DONE
from .runs.folder import RunFolder, find_splats
from .runs.job import Job
from .scenes.cameras import Camera
from .scenes.colmap import Scene, read_scene
from .scenes.formats import ensure_colmap_scene
from .splats.bundle import read_bundle
from .splats.formats import open_as_ply
from .splats.level_folder import read_folder
from .splats.levels import Bundle

__all__ = ["FinishedRun", "LodgsError", "load_bundle", "load_scene", "render_image", "select", "train"]

AnyPath = str | PathLike[str]
Event = Mapping[str, Any]
"""An event of a run, as in its ``events.jsonl``: its kind as "event", and further values by name."""


def load_scene(folder: AnyPath, *, model: AnyPath | None = None, images: AnyPath | None = None) -> Scene:
    """Read the cameras and points of a COLMAP scene.

    An export of another program, such as nerfstudio or Polycam, is first converted: a COLMAP model is written
    into its folder.

    Args:
        folder: folder of the scene, a model inside it, or another program's export.
        model: folder of the model. Default: the largest model in the scene.
        images: folder of the photos. Default: the folder in or next to the scene that contains them.

    Returns:
        The scene: a list ``cameras``, ``points`` (P, 3) float32, ``point_colors`` (P, 3) uint8.

    Raises:
        LodgsError: the folder has no scene, or a file of it is damaged.

    Example:
        >>> import lodgs
        >>> scene = lodgs.load_scene("examples/lantern_garden")
        >>> camera = scene.cameras[0]
        >>> camera.width > camera.height > 0, camera.world_to_camera.shape, scene.points.shape[1]
        (True, (4, 4), 3)
    """
    folder = ensure_colmap_scene(Path(folder), _warn)
    scene = read_scene(
        folder, None if model is None else Path(model), None if images is None else Path(images)
    )
    for message in scene.warnings:
        _warn(message)
    return scene


@dataclass(frozen=True)
class FinishedRun:
    """A finished training.

    Attributes:
        folder: the run folder.
        bundle: file with all levels.
        metrics: quality of the finest level, see ``evaluate.summary.summarize``, and ``seconds``.
    """

    folder: Path
    bundle: Path
    metrics: dict[str, Any]


def train(
    scene: AnyPath, out: AnyPath, *, progress: Callable[[Event], object] | None = None, **keys: Any
) -> FinishedRun:
    """Train levels of detail, or resume the run in a folder.

    Training sets the number of torch's threads in this process to 1, because its kernels use every core.

    Args:
        scene: folder of a COLMAP scene or of another program's export; "" with the key ``capture``.
        out: run folder. The same call resumes an interrupted run. A finished run is not trained again.
        progress: receives each event. Events with ``event["event"] == "progress"`` have ``step``, ``of`` (the
            number of steps) and ``psnr`` in dB. Raise KeyboardInterrupt in it to stop.
        keys: other keys of a job, such as method, preset, image_scale and parameters, see ``runs.job.Job``.

    Raises:
        LodgsError: a key is invalid, the scene cannot be read, or training fails.
        KeyboardInterrupt: training was stopped. It can be resumed.

    Example:
        >>> import lodgs, tempfile
        >>> steps = []
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     run = lodgs.train(
        ...         "examples/lantern_garden", folder, method="3dgs", image_scale=0.1, backend="cpu",
        ...         parameters={"steps": 3}, progress=lambda event: steps.append(event.get("step", 0)),
        ...     )
        ...     bundle = lodgs.load_bundle(run.folder)
        >>> max(steps), run.metrics["train_psnr"] > 5, len(bundle.levels)
        (3, True, 1)
    """
    source = ensure_colmap_scene(Path(scene), _warn) if str(scene) else ""
    job = Job.from_dict({"scene": str(source), "out": str(out), **keys})
    from .runs.train import train as run_job

    stream = _EventStream(progress)
    code = run_job(job, cast("IO[str]", stream))
    if stream.error is not None:
        raise stream.error
    if code == CANCELLED:
        raise KeyboardInterrupt(stream.last.get("message", ""))
    if code != DONE:
        raise LodgsError(stream.last.get("what", ""), stream.last.get("remedy", ""))
    folder = RunFolder(job.out)
    metrics = {name: value for name, value in stream.last.items() if name not in ("event", "bundle")}
    return FinishedRun(folder.path, folder.bundle, metrics)


class _EventStream(io.TextIOBase):
    """Text stream that passes events to a callback until it raises an error.

    Attributes:
        last: the newest event.
        error: the callback's error, or None.
    """

    def __init__(self, callback: Callable[[Event], object] | None) -> None:
        self.last: dict[str, Any] = {}
        self.error: BaseException | None = None
        self._callback = callback

    def write(self, text: str, /) -> int:
        if text.strip():
            self.last = json.loads(text)
            if self._callback is not None and self.error is None:
                try:
                    self._callback(self.last)
                except BaseException as error:
                    self.error = error
                    raise KeyboardInterrupt from error  # ends the training as Ctrl-C does
        return len(text)


def load_bundle(path: AnyPath) -> Bundle:
    """Read splats with all levels into memory.

    Args:
        path: folder of a finished run, bundle, folder of levels, or any 3DGS file: PLY, or another format
            of ``docs/reference/formats.md``. Plain files become a bundle with one level.

    Returns:
        The bundle. ``levels`` are ordered from coarse to fine, each with ``number``, ``facts`` and
        ``splats``: means (N, 3), quats (N, 4) wxyz, log_scales (N, 3), opacity_logits (N,) and
        sh (N, K, 3), all float32.

    Raises:
        LodgsError: the file does not exist, is damaged or has another format, or the run is not finished.

    Example:
        >>> import lodgs, numpy as np, tempfile
        >>> from lodgs.splats.gaussians import Splats
        >>> from lodgs.splats.ply import write_ply
        >>> def zeros(*shape):
        ...     return np.zeros(shape, np.float32)
        >>> splats = Splats(zeros(5, 3), zeros(5, 4) + 1, zeros(5, 3) - 2, zeros(5), zeros(5, 1, 3))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_ply(f"{folder}/splats.ply", splats)
        ...     bundle = lodgs.load_bundle(f"{folder}/splats.ply")
        >>> bundle.levels[0].splats.means.shape
        (5, 3)
    """
    with open_as_ply(find_splats(Path(path))) as ply:
        return read_folder(ply, _warn) if ply.is_dir() else read_bundle(ply, _warn)


def select(
    bundle: Bundle,
    center: np.ndarray | tuple[float, float, float],
    focal_px: float,
    controls: Mapping[str, float] | None = None,
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Select the splats of each level for a camera, by the bundle's rule.

    For many cameras, keep a ``lod.selection.BundleSelector``.

    Args:
        center: (3,) camera position.
        focal_px: focal length in pixels (``Camera.focal``).
        controls: values of the rule's controls by name. Default: the bundle's own.

    Returns:
        For each level number, rows (M,) int64 of the level's splats, ascending, and their weights (M,)
        float32 in (0, 1], which multiply opacities.

    Raises:
        LodgsError: the bundle has no rule, an unknown one or contradicts it, or a control is invalid.

    Example:
        A coarse level of 3 splats is drawn from afar, a fine one of 9 nearby.

        >>> import lodgs, numpy as np
        >>> from lodgs.splats.gaussians import Splats
        >>> from lodgs.splats.levels import Bundle, Level
        >>> def level(number, count, s_min):
        ...     means, rest = np.zeros((count, 3), "f4"), np.ones((count, 4), "f4")
        ...     splats = Splats(means, rest, means - 2, means[:, 0], means[:, None])
        ...     return Level(number, splats, {"s_min": s_min})
        >>> bundle = Bundle("flod", [level(1, 3, 0.5), level(2, 9, 0.0)], rule="bands")
        >>> for distance in (1, 1000):
        ...     selected = lodgs.select(bundle, (0, 0, distance), focal_px=500)
        ...     print({number: len(rows) for number, (rows, weights) in selected.items()})
        {1: 0, 2: 9}
        {1: 3, 2: 0}
    """
    values = resolve_controls(bundle, controls or {})
    weights = BundleSelector(bundle).level_weights(np.asarray(center, np.float32), focal_px, values)
    selected = {}
    for level, level_weights in zip(bundle.levels, weights, strict=True):
        rows = np.flatnonzero(level_weights > 0)
        selected[level.number] = rows, level_weights[rows].astype(np.float32)
    return selected


def render_image(
    bundle: Bundle,
    camera: Camera,
    *,
    level: int = 0,
    controls: Mapping[str, float] | None = None,
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
    near: float = 0.01,
    backend: str = "auto",
) -> np.ndarray:
    """Render a bundle.

    For many images, keep a ``rasterize.resident.ResidentBundle``: this function copies the splats to the
    device each time.

    Args:
        level: number of the level. 0 is the finest.
        controls: select levels by camera distance, with these values of the rule's controls by name; {} for
            the bundle's own values. None renders ``level``.
        background: display-coded RGB in [0, 1], or None for a transparent background.
        near: depth of the near plane.
        backend: rasterizer, one of ``runs.job.BACKENDS``.

    Returns:
        Display-coded (sRGB) colours (H, W, 3) float32, not clamped above 1. With a transparent background
        (H, W, 4): straight colours and alpha.

    Raises:
        LodgsError: the level or a control does not exist, the image is too large, or the backend is not
            available.

    Example:
        >>> import lodgs, numpy as np
        >>> from lodgs.scenes.cameras import Camera
        >>> from lodgs.splats.gaussians import Splats
        >>> from lodgs.splats.levels import Bundle, Level
        >>> zero, one = np.zeros((1, 3), np.float32), np.ones((1, 4), np.float32)
        >>> white = Splats(zero, one, zero - 2, one[:, 0] * 5, zero[:, None] + 1.77)
        >>> pose = np.eye(4)
        >>> pose[2, 3] = 2  # the splat is 2 units in front of the camera
        >>> camera = Camera("view", 32, 24, 30.0, 30.0, 16.0, 12.0, pose)
        >>> bundle = Bundle("", [Level(1, white)])
        >>> image = lodgs.render_image(bundle, camera, background=None, backend="cpu")
        >>> image.shape, bool(image[12, 16, 3] > 0.9), float(image[0, 0, 3])
        ((24, 32, 4), True, 0.0)
    """
    from .rasterize.resident import ResidentBundle
    from .render.command import draw_bundle

    resident = ResidentBundle(bundle, backend, _warn)
    image = draw_bundle(resident, camera, level, controls, near=near, background=background, backend=backend)
    if background is not None:
        return image.image
    return np.concatenate([image.straight(), image.alpha[..., None]], 2)


def _warn(message: str) -> None:
    warnings.warn(message, stacklevel=3)
