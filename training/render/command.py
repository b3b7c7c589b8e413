"""``python -m training render``: render one view of a bundle, any 3DGS PLY or a run to an image file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LodgsError
from ..lod.rule import Values
from ..lod.selection import full_detail_controls, resolve_controls
from ..rasterize import cpu_fallback_reason
from ..rasterize.resident import ResidentBundle
from ..runs.data import training_data
from ..runs.folder import RunFolder
from ..runs.job import Job
from ..scenes.cameras import Camera
from ..scenes.colmap import read_scene
from ..scenes.images import check_suffix
from ..scenes.view_tables import read_view_tables
from ..splats.bundle import read_header, read_tables
from ..splats.dialects import Warn, ignore
from ..splats.level_folder import read_folder, read_origin
from ..splats.levels import Bundle
from .image import SUFFIXES, RenderedImage, read_depth, write_image
from .scene import Instance, draw


@dataclass(frozen=True)
class RenderSource:
    """Levels to render, and the run that trained them.

    Attributes:
        levels: bundle with only its header in memory, or the contents of a folder of levels.
        rule: name of the rule, see ``Bundle``.
        run: run that contains the file, or None.
        origin: local origin of the levels, (3,).
    """

    levels: Path | Bundle
    rule: str
    run: RunFolder | None
    origin: np.ndarray

    @classmethod
    def read(cls, path: Path, warn: Warn = ignore) -> RenderSource:
        """Open a run's folder, a bundle, a folder of levels, or any 3DGS PLY.

        Args:
            warn: receives one sentence for each omission or changed look.

        Raises:
            LodgsError: the path does not exist or has other contents.
        """
        path = Path(path)
        if not path.exists():
            raise LodgsError(
                f"Cannot render {path}: it does not exist.",
                "Choose a bundle, any 3DGS PLY or a run's folder.",
            )
        run = RunFolder(path if path.is_dir() else path.parent)
        if path.is_dir() and run.job.exists():
            if not run.bundle.exists():
                raise LodgsError(
                    f"Cannot render {path}: the run is not finished (no bundle.ply).", "Train it to the end."
                )
            path = run.bundle
        levels = read_folder(path, warn) if path.is_dir() else path
        rule = (levels if isinstance(levels, Bundle) else read_header(levels)).rule
        origin = levels.origin if isinstance(levels, Bundle) else read_origin(levels)
        return cls(levels, rule, run if run.job.exists() else None, origin)

    def view(self, name: str, scene: Path | None = None) -> tuple[Camera, float]:
        """Find the view of a photo.

        Args:
            name: photo's path in the scene, file name, or file name without suffix.
            scene: folder of the COLMAP scene; None means the bundle's views, or the run's scene.

        Returns:
            The camera in the photo's size, relative to the local origin, and the depth of the near plane.

        Raises:
            LodgsError: no photo, or several photos have the name, or the scene is unknown.
        """
        cameras, near = self._views(scene)
        matches = [camera for camera in cameras if camera.name == name]
        matches = matches or [camera for camera in cameras if Path(camera.name).name == name]
        matches = matches or [camera for camera in cameras if Path(camera.name).stem == name]
        if len(matches) != 1:
            examples = ", ".join(camera.name for camera in (matches or cameras)[:3])
            raise LodgsError(
                f"Cannot find the view: {'several photos are' if matches else 'no photo is'} named {name}.",
                f"Choose one of: {examples}, ...",
            )
        return matches[0], near

    def _views(self, scene: Path | None) -> tuple[Sequence[Camera], float]:
        """Return the cameras of all photos and the depth of the near plane."""
        if scene is not None:
            model = read_scene(scene, origin=self.origin)
            return model.cameras, model.near()
        tables = self.levels.tables if isinstance(self.levels, Bundle) else read_tables(self.levels)
        cameras, near, _ = read_view_tables(tables)
        if not cameras and self.run is not None:
            data = training_data(Job.from_file(self.run.job), self.run, pixels=False)
            return data.scene.cameras, data.near
        if not cameras:
            raise LodgsError(
                "Cannot find the view: the file does not list its training photos.",
                "Give the scene's folder with --scene, or a --camera.",
            )
        return cameras, near


def render(
    source: RenderSource,
    camera: Camera,
    near: float,
    out: Path,
    *,
    level: int = 0,
    controls: Values | None = None,
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
    holdout: Path | None = None,
    backend: str = "auto",
    warn: Warn = ignore,
) -> ResidentBundle:
    """Render one view to a PNG, or to an EXR with depth and levels.

    Args:
        near: depth of the near plane.
        level: level to draw; 0 is the finest.
        controls: select levels by distance, with these values of the rule's controls by name; None draws
            ``level``.
        background: display-coded; None is transparent.
        holdout: EXR with the depth of meshes that hide splats, see :func:`.image.read_depth`.
        warn: see :meth:`RenderSource.read`.

    Returns:
        The loaded splats, with the number of bytes that were read.

    Raises:
        LodgsError: the level or a control does not exist, the bundle contradicts its rule, the holdout is
            invalid, or a file cannot be read or written.
    """
    check_suffix(out, *SUFFIXES)
    limit = None if holdout is None else read_depth(holdout, camera.width, camera.height, None)
    if problem := cpu_fallback_reason(backend):
        warn(problem)
    resident = ResidentBundle(source.levels, backend, warn)
    all_passes = out.suffix.lower() == ".exr"
    image = draw_bundle(
        resident, camera, level, controls, near=near, background=background, depth=all_passes,
        levels=all_passes, limit=limit, backend=backend,
    )  # fmt: skip
    write_image(out, image)
    return resident


def draw_bundle(
    resident: ResidentBundle,
    camera: Camera,
    level: int = 0,
    controls: Values | None = None,
    **options: Any,
) -> RenderedImage:
    """Draw one level, or the levels that the rule selects; arguments as for :func:`render`.

    Rules that always apply also weight the finest level.

    Args:
        options: options of :func:`.scene.draw`.

    Raises:
        LodgsError: the level or a control does not exist, or as :func:`.scene.draw`.
    """
    bundle = resident.bundle
    if controls is not None or (not level and full_detail_controls(bundle) is not None):
        sets = resident.select_by_rule(camera, resolve_controls(bundle, controls or {}))
    else:
        sets = resident.select_level(level or bundle.levels[-1].number, camera)
    instances = [
        Instance(weighted.splats, level=number, antialias=bundle.antialias, query=weighted.query)
        for number, weighted in sets.items()
    ]
    image = draw(instances, camera, **options)
    assert image is not None  # nothing cancels it
    return image
