"""Jobs: all settings of a run, as a TOML or JSON file. Imports no torch: Blender reads and writes jobs."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path

from ..documents import quote, read_json, read_toml
from ..errors import LodgsError
from ..files import atomic_write
from ..lod.crop import Crop, is_crop_text
from ..methods import method_info, resolve_parameters
from ..optimize.parameters import Parameters
from .folder import RunFolder

BACKENDS = ("auto", "cpu", "cuda", "gpu", "reference")
CHANGEABLE = ("backend", "out", "photo_memory", "splat_memory")
"""Keys that may change when a run is resumed, because they do not change what is trained."""
MAX_STOPS = 32
"""Maximum exposure change of linear images, in stops."""
DOME = "dome"
"""Value of ``capture`` for views from all directions."""
VIEWS, VIEW_WIDTHS = (2, 2000), (32, 8192)
"""Limits of the number of views of a dome, and of their image width in pixels."""
POLISH_STEPS = 300
"""Default number of steps that fit a cell's borders to its neighbours."""
MAX_CELLS = 256
"""Maximum number of cells of a scene."""
MAX_PATH = 2000
"""Maximum length of a path, so that a job with all of its paths fits the size limit of a TOML file."""
_KINDS: dict[str, tuple[type | tuple[type, ...], str]] = {
    "str": (str, "a text in quotation marks"),
    "int": (int, "a whole number"),
    "float": ((int, float), "a number"),
    "bool": (bool, "true or false"),
    "dict": (dict, "a table below a line with its name in brackets"),
}
"""Accepted types by annotation of a key, and their names in messages."""


@dataclass(frozen=True)
class Job:
    """Scene, method, settings and output folder of a run.

    Attributes:
        scene: folder of the COLMAP scene; "" if there is none, see ``capture``.
        out: run folder; created if it does not exist.
        method, preset: names from METHODS and PRESETS of ``training.methods``.
        base: run, bundle or PLY of splats to start from instead of the scene's points, for methods that
            support it; "" for none.
        capture: viewpoints for rendering the base as training images if there is no scene: DOME, or a folder
            of camera files; "" if there is a scene.
        views, view_width: number of views of a dome, and their image width in pixels.
        seed: random seed. Runs of the same job on one machine are bit-identical, except with cuda.
        backend: rasterizer, one of BACKENDS; auto is cuda if available, else cpu. May change on resume.
        image_scale: training image size relative to the photo, 0 < s <= 1.
        test_every: every n-th view by name is held out to measure quality; 0 trains on all views.
        validation: hold out the views between the test views instead, and exclude the test views, so that
            choosing settings does not use the views that report quality.
        exposure: stops added to linear (EXR) images before training.
        photo_memory: megabytes for decoded photos; further ones are decoded in the background. 0 is a quarter
            of the free memory, at most 2 GB. Does not change the result.
        splat_memory: megabytes for splats and their optimizer state, for methods that keep the others on disk
            (tree). 0 is half of the free memory. If not all fit, the result depends on it slightly.
        region: part of the scene to train in detail, in scene coordinates, see ``Crop.from_text``; for a part
            of a scene in cells, its region file (``scenes.regions``); "" for the full scene.
        cells: number of cells on the ground that are trained separately and merged, "COLUMNSxROWS"; "" for
            none.
        polish: steps that fit each cell's borders to its neighbours after training; 0 disables.
        model, images: folders of the COLMAP model and of the photos, if they are not in the usual place.
        parameters: changed parameters of the preset, by name.
    """

    scene: str
    out: str
    method: str = "flod"
    preset: str = "draft"
    base: str = ""
    capture: str = ""
    views: int = 64
    view_width: int = 960
    seed: int = 0
    backend: str = "auto"
    image_scale: float = 0.5
    test_every: int = 8
    validation: bool = False
    exposure: float = 0.0
    photo_memory: int = 0
    splat_memory: int = 0
    model: str = ""
    images: str = ""
    region: str = ""
    cells: str = ""
    polish: int = POLISH_STEPS
    parameters: dict = field(default_factory=dict)

    @classmethod
    def from_file(cls, path: Path) -> Job:
        """Read and check a job; relative paths are relative to its folder.

        A started run stays in its folder even if that was moved: the job's ``out`` is ignored then.

        Raises:
            LodgsError: the file cannot be read, or a key or value is invalid.
        """
        path = Path(path)
        kind = path.suffix.lower()
        if kind not in (".toml", ".json") and path.exists():
            raise LodgsError(
                f"Cannot read {path}: it is neither a job file (.toml or .json) nor a scene folder.",
                "Choose one of these; unpack archives first.",
            )
        read = read_json if kind == ".json" else read_toml
        values = read(path, f"The job file {path}")
        run = RunFolder(path.parent)
        if path == run.job and run.started:
            values["out"] = "."
        return cls.from_dict(values, folder=path.parent)

    @classmethod
    def from_dict(cls, values: dict, folder: Path = Path()) -> Job:
        """Create a job from the keys of a job file, and check it.

        Raises:
            LodgsError: a key is unknown, missing or invalid.
        """
        keys = [key.name for key in fields(cls)]
        unknown = sorted(set(values) - set(keys))
        if unknown:
            raise LodgsError(f"Unknown key in job: {quote(unknown[0])}.", f"Use one of: {', '.join(keys)}.")
        values = {"scene": "", **values} if values.get("capture") else dict(values)
        for key in ("out",) if values.get("capture") else ("scene", "out"):
            if not values.get(key):
                raise LodgsError(f"The job has no key '{key}'.", f'Add a line: {key} = "..."')
        for key in ("scene", "out", "base", "capture", "model", "images", "region"):
            value = values.get(key)
            if not value or (key, value) == ("capture", DOME):
                continue
            if not (key == "region" and isinstance(value, str) and is_crop_text(value)):
                values[key] = _path(key, value, folder)
        job = cls(**values)
        job._check()
        return job

    def _check(self) -> None:
        for key in fields(self):
            value, (kind, name) = getattr(self, key.name), _KINDS[str(key.type)]
            if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
                raise LodgsError(f"Invalid job key {key.name} = {quote(value)}.", f"Give {name}.")
        if not (0 <= self.seed < 2**31 and 0 <= self.test_every < 2**31) or self.test_every == 1:
            raise LodgsError(
                f"Invalid job keys seed = {self.seed!r}, test_every = {self.test_every!r}.",
                f"Give whole numbers from 0 to {2**31 - 1}; test_every must not be 1.",
            )
        if not 0 < self.image_scale <= 1:
            raise LodgsError(
                f"Invalid job key image_scale = {self.image_scale!r}.", "Give a number above 0, at most 1."
            )
        if not abs(self.exposure) <= MAX_STOPS:
            raise LodgsError(
                f"Invalid job key exposure = {self.exposure!r}.",
                f"Give stops from {-MAX_STOPS} to {MAX_STOPS}.",
            )
        for key, unit in (("photo_memory", "megabytes"), ("splat_memory", "megabytes"), ("polish", "steps")):
            if not 0 <= getattr(self, key) < 2**31:
                raise LodgsError(
                    f"Invalid job key {key} = {getattr(self, key)!r}.", f"Give {unit} from 0 to {2**31 - 1}."
                )
        if self.backend not in BACKENDS:
            raise LodgsError(
                f"Unknown backend: {quote(self.backend)}.", f"Use one of: {', '.join(BACKENDS)}."
            )
        continues = self.resolved_parameters().continues_levels
        if continues and not self.base:
            raise LodgsError(
                "Cannot continue with finer levels: the job has no base.", "Add 'base', or start at level 1."
            )
        if self.base and not (continues or method_info(self.method).from_base):
            raise LodgsError(
                f"The method '{self.method}' cannot start from a base.",
                "Remove 'base', or choose another method.",
            )
        if is_crop_text(self.region):
            Crop.from_text(self.region)
        if self.capture:
            self._check_capture()
        if self.cells:
            self._check_cells()

    def _check_capture(self) -> None:
        if not self.base:
            raise LodgsError("Cannot capture views: the job has no base.", "Add 'base', or remove 'capture'.")
        for key in ("scene", "model", "images"):
            if getattr(self, key):
                raise LodgsError(
                    f"The job has both 'capture' and '{key}'.",
                    "Remove 'capture' to train on photos, or the other key to train on captured views.",
                )
        check_views(self.views, self.view_width)

    def _check_cells(self) -> None:
        columns, rows = self.grid
        if not 0 < columns * rows <= MAX_CELLS:
            raise LodgsError(
                f"Invalid job key cells = {self.cells!r}.",
                f"Give columns and rows such as 2x4, at most {MAX_CELLS} cells.",
            )
        for key in ("base", "capture", "region"):
            if getattr(self, key):
                raise LodgsError(f"The job has both 'cells' and '{key}'.", "Remove one of them.")
        if not method_info(self.method).cell_method:
            raise LodgsError(
                f"The method '{self.method}' cannot train a scene in cells.",
                "Choose another method, or remove 'cells'.",
            )

    def with_cells(self, cells: str) -> Job:
        """Return the same job with another number of cells.

        Raises:
            LodgsError: the job cannot be divided into these cells.
        """
        job = replace(self, cells=cells)
        job._check_cells()
        return job

    @property
    def crop(self) -> Crop | None:
        """Region that is trained in detail; None for the full scene."""
        return Crop.from_text(self.region) if is_crop_text(self.region) else None

    @property
    def cell(self) -> str:
        """Region file of the cell that this job trains; "" if it is not a cell's job."""
        return "" if is_crop_text(self.region) else self.region

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of ``cells``; (0, 0) without cells."""
        columns, _, rows = self.cells.lower().partition("x")
        return (int(columns), int(rows)) if columns.isdecimal() and rows.isdecimal() else (0, 0)

    def resolved_parameters(self) -> Parameters:
        """Return the preset's parameters with this job's changes."""
        return self._parameters

    @cached_property
    def _parameters(self) -> Parameters:
        captured = method_info(self.method).capture_values if self.capture else {}
        return resolve_parameters(self.method, self.preset, {**captured, **self.parameters})

    def resolved(self) -> Job:
        """Return the same job with all parameters explicit, so that later versions repeat it unchanged."""
        resolved = self.resolved_parameters()
        values = {key.name: getattr(resolved, key.name) for key in method_info(self.method).fields}
        return replace(
            self, parameters={k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
        )

    def write(self, path: Path) -> None:
        """Write the job as TOML; in its own run folder, paths inside the run are written as relative."""
        values = asdict(self)
        if Path(self.out) == path.parent:
            values["out"] = "."
            for key in ("base", "capture", "region"):
                if values[key] != DOME and path.parent in Path(values[key]).parents:
                    values[key] = f"./{Path(values[key]).relative_to(path.parent).as_posix()}"
            if self.cell and Path(self.base).parent == path.parent.parent:  # both belong to one run
                values["base"] = f"../{Path(self.base).name}"
        table = values.pop("parameters")
        lines = [_toml_line(name, value) for name, value in values.items()]
        lines += ["", "[parameters]"] + [_toml_line(name, value) for name, value in table.items()]
        with atomic_write(path) as temporary:
            Path(temporary).write_text("\n".join(lines) + "\n", encoding="utf-8")


def save_job(job: Job, folder: RunFolder) -> None:
    """Write a resolved job into its run folder. Only CHANGEABLE keys may differ from an existing job.

    Raises:
        LodgsError: the folder belongs to another job.
        OSError: the job cannot be written.
    """
    if folder.job.exists():
        existing = asdict(Job.from_file(folder.job).resolved())
        differing = [key for key, value in asdict(job).items() if existing[key] != value]
        conflicts = [key for key in differing if key not in CHANGEABLE]
        if conflicts:
            raise LodgsError(
                f"The run folder {folder.path} belongs to another job (different: {', '.join(conflicts)}).",
                "Choose another run folder, or resume the run with its own job.toml.",
            )
        if not set(differing) - {"out"}:
            return
    job.write(folder.job)


def check_views(views: int, width: int) -> None:
    """Check number and image width of captured views.

    Raises:
        LodgsError: a value is outside VIEWS or VIEW_WIDTHS.
    """
    for name, value, (low, high) in (("views", views, VIEWS), ("view_width", width, VIEW_WIDTHS)):
        if not low <= value <= high:
            raise LodgsError(f"Invalid {name} = {value}.", f"Give a number from {low} to {high}.")


def _path(key: str, value: object, folder: Path) -> str:
    """Return an absolute path; relative paths are relative to ``folder``."""
    if not isinstance(value, str):
        raise LodgsError(f"Invalid path {key} = {quote(value)}.", "Give a path in quotation marks.")
    try:
        path = str((folder / value).expanduser().resolve())
    except (OSError, ValueError, RuntimeError) as error:  # NUL, unknown ~name, link cycle
        raise LodgsError(f"Invalid path {key} = {quote(value)}: {error}.", "Correct the path.") from error
    if len(path) > MAX_PATH:
        raise LodgsError(
            f"The path {key} has {len(path)} characters.", f"Give at most {MAX_PATH} characters."
        )
    return path


def _toml_line(name: str, value) -> str:
    # JSON's strings, numbers, booleans and lists are TOML's as well.
    return f"{name} = {json.dumps(value, ensure_ascii=False)}"
