"""``python -m training render``: one view of a bundle, of any 3DGS PLY or of a run as a picture file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import LodgsError
from ..lod.rule import Values, find_rule
from ..lod.selection import resolve_controls
from ..rasterize import cpu_fallback_reason
from ..rasterize.resident import ResidentBundle
from ..runs.data import training_data
from ..runs.folder import RunFolder
from ..runs.job import Job
from ..scenes.cameras import Camera
from ..scenes.colmap import read_scene
from ..scenes.view_tables import read_view_tables
from ..splats.bundle import read_header, read_tables
from ..splats.dialects import Warn, ignore
from ..splats.level_folder import read_folder
from ..splats.levels import Bundle
from .image import read_depth, write_image
from .scene import Instance, draw


@dataclass(frozen=True)
class RenderSource:
    """What is rendered: levels, and where they were trained, the views that they were trained from.

    Attributes:
        levels: a file, of which nothing but the header is read yet; or what was read of a folder of levels.
        rule: by which they are chosen, see ``Bundle``.
        run: the run that the file was found in, or None.
    """

    levels: Path | Bundle
    rule: str
    run: RunFolder | None

    @classmethod
    def read(cls, path: Path, warn: Warn = ignore) -> RenderSource:
        """A run's folder, a bundle, a folder of levels, or any 3DGS PLY.

        Args:
            warn: receives a sentence for each thing that is drawn otherwise than its maker shows it.

        Raises:
            LodgsError: there is nothing of that kind.
        """
        path = Path(path)
        if not path.exists():
            raise LodgsError(f"There is no {path}.", "Give a bundle, any 3DGS PLY, or a run's folder.")
        run = RunFolder(path if path.is_dir() else path.parent)
        if path.is_dir() and run.job.exists():
            if not run.bundle.exists():
                raise LodgsError(
                    f"{path} holds no finished run (no bundle.ply).", "Train it to the end first."
                )
            path = run.bundle
        levels = read_folder(path, warn) if path.is_dir() else path
        rule = (levels if isinstance(levels, Bundle) else read_header(levels)).rule
        return cls(levels, rule, run if run.job.exists() else None)

    def view(self, name: str, scene: Path | None = None) -> tuple[Camera, float]:
        """A photograph's view in the photograph's own size, and the depth at which drawing begins.

        Args:
            name: the photograph's name, or its unmistakable end.
            scene: folder of the COLMAP scene; None: the run's, or what the bundle says.

        Raises:
            LodgsError: there is no such photograph, or no scene.
        """
        if scene is not None:
            cameras = read_scene(scene)
            there, near = cameras.cameras, cameras.near()
        else:
            tables = self.levels.tables if isinstance(self.levels, Bundle) else read_tables(self.levels)
            there, near, _ = read_view_tables(tables)
        if not there and self.run is not None:
            data = training_data(Job.from_file(self.run.job), self.run, pixels=False)
            there, near = data.scene.cameras, data.near
        if not there:
            raise LodgsError(
                "This file does not know the photographs that it was trained from.",
                "Name their folder with --scene, or give a --camera.",
            )
        found = [camera for camera in there if camera.name == name]
        found = found or [camera for camera in there if Path(camera.name).name == name]
        found = found or [camera for camera in there if Path(camera.name).stem == name]
        if len(found) != 1:
            examples = ", ".join(camera.name for camera in (found or there)[:3])
            raise LodgsError(
                f"{'Several photographs are' if found else 'No photograph is'} called {name}.",
                f"There are: {examples}, ...",
            )
        return found[0], near


def render(
    source: RenderSource,
    camera: Camera,
    near: float,
    out: Path,
    *,
    level: int = 0,
    given: Values | None = None,
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
    holdout: Path | None = None,
    backend: str = "auto",
    warn: Warn = ignore,
) -> ResidentBundle:
    """Draws one view into a file: a PNG, or an EXR with depth and levels besides.

    Args:
        near: depth at which drawing begins.
        level: the level to draw; 0 is the finest.
        given: controls of the bundle's rule by name: draw levels by their distance instead.
        background: display-coded; None leaves it transparent.
        holdout: an EXR with the depth of what hides splats, as :func:`.picture.read_depth` reads it.
        warn: as for :meth:`Source.read`.

    Returns:
        What was drawn: it tells how much was read for it.

    Raises:
        LodgsError: there is no such level or control, the bundle contradicts its rule, the holdout is not
            one, or a file cannot be read or written.
    """
    if out.suffix.lower() not in (".png", ".exr"):
        raise LodgsError(f"{out.name} is neither .png nor .exr.", "Choose one of these endings.")
    limit = None if holdout is None else read_depth(holdout, camera.width, camera.height, None)
    if problem := cpu_fallback_reason(backend):
        warn(problem)
    resident = ResidentBundle(source.levels, backend, warn)
    bundle, rule = resident.bundle, find_rule(source.rule)
    if given is not None or (rule is not None and rule.always_active and not level):
        shown = resident.select_by_rule(camera, resolve_controls(bundle, given or {}))
    else:
        shown = resident.select_level(level or bundle.levels[-1].number, camera)
    instances = [
        Instance(one.splats, level=number, antialias=bundle.antialias, choice=one.choice)
        for number, one in shown.items()
    ]
    everything = out.suffix.lower() == ".exr"
    picture = draw(
        instances, camera, near=near, background=background, depth=everything, levels=everything, limit=limit,
        backend=backend,
    )  # fmt: skip
    assert picture is not None
    write_image(out, picture)
    return resident
