"""Jobs: all settings of a run, as a TOML or JSON file. Imports no torch: Blender reads and writes jobs."""

from __future__ import annotations

import json
from dataclasses import Field, asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

from ..documents import quote, read_json, read_toml
from ..errors import LodgsError
from ..files import atomic_write
from ..lod.crop import Crop, is_crop_text
from ..methods import METHODS, PRESETS, method_info, resolve_parameters
from ..optimize.parameters import Parameters
from ..settings import check_value, setting, settings_of
from .folder import RunFolder

BACKENDS = ("auto", "cpu", "cuda", "gpu", "reference")
AUTO, DOME = "auto", "dome"
"""Value of ``capture`` for views from all directions."""
MIN_VIEWS = 2
"""Minimum number of views to train on."""
MAX_CELLS = 256
"""Maximum number of cells of a scene."""
MAX_PATH = 2000
"""Maximum length of a path, so that a job with all of its paths fits the size limit of a TOML file."""


@dataclass(frozen=True)
class Job:
    """Scene, method, settings and output folder of a run.

    Each key is a ``setting`` with additional metadata:

    - changeable: the key may change when a run is resumed, because it does not change what is trained.
    - panel: Blender stores the key as a property of the training settings of a scene; "Advanced" also draws
      it in that panel.
    - unless: predicate of the texts that are not a path, for keys that are paths.
    """

    scene: str = setting("", "Folder of the COLMAP scene.", path="folder", metavar="DIR")
    out: str = setting(
        "", "Run folder. The same job resumes a run in it.", path="folder", metavar="RUN", changeable=True
    )
    method: str = setting(
        "flod",
        "Training method, which determines the kind of levels.",
        choices={method.name: f"{method.label}: {method.about}" for method in METHODS.values()},
        panel="Training",
    )
    preset: str = setting("draft", "Duration and quality of the training.", choices=PRESETS, panel="Training")
    base: str = setting(
        "",
        "Run, bundle or splat PLY to start from instead of the scene's points.",
        label="Splats",
        path="file",
        metavar="PATH",
        panel="Training",
    )
    capture: str = setting(
        "",
        "Views of the base to render and to train on instead of a scene: auto (the base's own cameras, else "
        "as dome), dome (from all sides and close to the surface), or a folder of camera files.",
        path="folder",
        metavar="auto|dome|DIR",
        unless=lambda text: text in (AUTO, DOME),
    )
    views: int = setting(64, "Number of views to render.", low=MIN_VIEWS, high=2000)
    view_width: int = setting(
        960,
        "Width of the rendered views. Training scales them by the image scale.",
        low=32,
        high=8192,
        unit="px",
    )
    seed: int = setting(0, "Seed of random choices. Runs with the same seed are equal.", panel="Advanced")
    backend: str = setting(
        "auto",
        "Device that trains and renders. The choice auto is the fastest device that can train the job alone.",
        choices=BACKENDS,
        changeable=True,
    )
    image_scale: float = setting(
        0.5,
        "Scale of the photos for training. Increase it for finer detail at the cost of time. The default of "
        "the preset paper is 1.",
        above=0,
        high=1,
        soft=(0.1, None),
        metavar="FACTOR",
        panel="Training",
    )
    test_every: int = setting(
        8,
        "Hold out every n-th view by name to measure quality. 0 trains on all views.",
        label="Hold Out Every",
        soft=(None, 16),
        panel="Training",
    )
    validation: bool = setting(
        False,
        "Hold out the views between the test views instead, and exclude the test views. For choosing "
        "settings without the views that report quality.",
    )
    exposure: float = setting(
        0.0, "Exposure change of linear (EXR) images before training.", low=-32, high=32, unit="stops"
    )
    photo_memory: int = setting(
        0,
        "Memory for decoded photos. 0 uses a quarter of the free memory, at most 2048 MB. Does not change "
        "the result.",
        unit="MB",
        changeable=True,
    )
    splat_memory: int = setting(
        0,
        "Memory for splats and their optimizer state (method tree). 0 uses half of the free memory. If not "
        "all splats fit, the result depends on it slightly.",
        unit="MB",
        changeable=True,
    )
    model: str = setting(
        "",
        "Folder of the COLMAP model. If empty, the largest model of the scene.",
        path="folder",
        metavar="DIR",
        panel="Training",
    )
    images: str = setting(
        "",
        "Folder of the photos. If empty, the folder next to the model.",
        label="Photos",
        path="folder",
        metavar="DIR",
        panel="Training",
    )
    region: str = setting(
        "",
        "Region to train in detail, in the scene's coordinates: 'box X Y Z X Y Z' (two opposite corners) or "
        "'sphere X Y Z RADIUS'. The rest is trained coarsely.",
        path="file",
        metavar="SHAPE",
        unless=is_crop_text,
    )
    cells: str = setting(
        "",
        "Columns and rows of cells on the ground, such as 2x4, which are trained separately and merged.",
        metavar="CxR",
    )
    polish: int = setting(
        300,
        "Training steps that match the borders of neighbouring cells after all are trained. 0 disables them.",
        label="Border Steps",
        soft=(None, 2000),
        unit="steps",
        panel="Training",
    )
    parameters: dict = field(default_factory=dict)
    """Changed parameters of the preset, by name."""

    @classmethod
    def from_file(cls, path: Path, preset: str = "") -> Job:
        """Read and check a job; relative paths are relative to its folder.

        A started run stays in its folder even if that was moved: the job's ``out`` is ignored then.

        Args:
            preset: preset instead of the job's; keys that the job omits have its defaults.

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
        if preset:
            values["preset"] = preset
        return cls.from_dict(values, folder=path.parent)

    @classmethod
    def from_dict(cls, values: dict, folder: Path = Path()) -> Job:
        """Create a job from the keys of a job file, and check it.

        Raises:
            LodgsError: a key is unknown, missing or invalid.
        """
        declared = settings_of(cls)
        if unknown := sorted(set(values) - {*declared, "parameters"}):
            raise LodgsError(
                f"Unknown key in job: {quote(unknown[0])}.", f"Use one of: {', '.join(declared)}, parameters."
            )
        for key in ("out",) if values.get("capture") else ("scene", "out"):
            if not values.get(key):
                raise LodgsError(f"The job has no key '{key}'.", f'Add a line: {key} = "..."')
        parameters = values.get("parameters", {})
        if not isinstance(parameters, dict):
            raise LodgsError(
                f"parameters = {quote(parameters)} is invalid.", "Use a table below a line [parameters]."
            )
        checked = {key: check_value(f, values[key]) for key, f in declared.items() if key in values}
        for key, value in checked.items():
            if value and _is_path(declared[key], value):
                checked[key] = _absolute_path(key, value, folder)
        checked.setdefault("image_scale", default_image_scale(checked.get("preset", "")))
        job = cls(**checked, parameters=parameters)
        job._check()
        return job

    def _check(self) -> None:
        """Check keys against each other, and the parameters."""
        minimum = 3 if self.validation else 2
        if 0 < self.test_every < minimum:
            raise LodgsError(
                f"test_every = {self.test_every} leaves no view to train on.", f"Use 0 or at least {minimum}."
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

    def _check_cells(self) -> None:
        columns, rows = self.grid
        if not 0 < columns * rows <= MAX_CELLS:
            raise LodgsError(
                f"cells = {quote(self.cells)} is invalid.",
                f"Use columns and rows such as 2x4, at most {MAX_CELLS} cells.",
            )
        for key in ("base", "capture", "region"):
            if getattr(self, key):
                raise LodgsError(f"The job has both 'cells' and '{key}'.", "Remove one of them.")
        if not method_info(self.method).cell_method:
            raise LodgsError(
                f"The method '{self.method}' cannot train a scene in cells.",
                "Choose another method, or remove 'cells'.",
            )
        if not self.resolved_parameters().base_steps:
            raise LodgsError(
                "Cannot train a single level in cells: the merged cells already are that level.",
                "Set levels to 2 or more, or choose the method 3dgs.",
            )

    def warnings(self) -> list[str]:
        """Return warnings about settings that contradict each other but are valid."""
        warnings = []
        if self.preset == "paper" and self.image_scale != 1:
            warnings.append(
                f"The preset paper trains at the photos' size, but image_scale is {self.image_scale:g}. "
                "Set it to 1 to reproduce the paper."
            )
        if self.validation and not self.test_every:
            warnings.append(
                "No views are held out, because test_every is 0. Set it to 3 or more, or remove validation."
            )
        return warnings

    def with_cells(self, cells: str) -> Job:
        """Return the same job with another number of cells.

        Raises:
            LodgsError: the job cannot be divided into these cells.
        """
        job = replace(self, cells=cells)
        job._check_cells()
        return job

    @property
    def model_and_images(self) -> tuple[Path | None, Path | None]:
        """Folders of the COLMAP model and of the photos; None to find them in the scene."""
        return Path(self.model) if self.model else None, Path(self.images) if self.images else None

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

    @property
    def steps(self) -> int:
        """Number of training steps, less those that a base replaces."""
        parameters = self.resolved_parameters()
        return parameters.base_steps if self.base else parameters.total_steps

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
                if values[key] not in (AUTO, DOME) and path.parent in Path(values[key]).parents:
                    values[key] = f"./{Path(values[key]).relative_to(path.parent).as_posix()}"
            if self.cell and Path(self.base).parent == path.parent.parent:  # both belong to one run
                values["base"] = f"../{Path(self.base).name}"
        table = values.pop("parameters")
        lines = [_toml_line(name, value) for name, value in values.items()]
        lines += ["", "[parameters]"] + [_toml_line(name, value) for name, value in table.items()]
        with atomic_write(path) as temporary:
            Path(temporary).write_text("\n".join(lines) + "\n", encoding="utf-8")


KEYS = settings_of(Job)
"""Declarations of all keys except ``parameters``, by name."""
CHANGEABLE = tuple(name for name, key in KEYS.items() if key.metadata.get("changeable"))
"""Keys that may change when a run is resumed."""


def default_image_scale(preset: str) -> float:
    """Return the image scale of jobs that omit it: the preset paper trains at the photos' size."""
    return 1.0 if preset == "paper" else Job.image_scale


def save_job(job: Job, folder: RunFolder) -> None:
    """Write a resolved job into its run folder. Only CHANGEABLE keys may differ from those of an existing job
    with results.

    Raises:
        LodgsError: the folder has results of another job.
        OSError: the job cannot be written.
    """
    if folder.job.exists():
        existing = asdict(Job.from_file(folder.job).resolved())
        differing = [key for key, value in asdict(job).items() if existing[key] != value]
        conflicts = [key for key in differing if key not in CHANGEABLE]
        if conflicts and folder.has_results:
            raise LodgsError(
                f"The run folder {folder.path} belongs to another job (different: {', '.join(conflicts)}).",
                "Choose another run folder, or resume the run with its own job.toml.",
            )
        if not set(differing) - {"out"}:
            return
    job.write(folder.job)


def _is_path(f: Field, value: str) -> bool:
    exception = f.metadata.get("unless")
    return bool(f.metadata["path"]) and not (exception and exception(value))


def _absolute_path(key: str, value: str, folder: Path) -> str:
    """Return an absolute path; relative paths are relative to ``folder``."""
    try:
        home = Path(value).expanduser() if value.startswith("~") else value
        path = str((folder / home).resolve())
        path.encode()
    except (OSError, ValueError, RuntimeError) as error:  # NUL, unknown ~name, link cycle, not UTF-8
        raise LodgsError(f"Invalid path {key} = {quote(value)}: {error}.", "Correct the path.") from error
    if len(path) > MAX_PATH:
        raise LodgsError(
            f"The path {key} has {len(path)} characters.", f"Give at most {MAX_PATH} characters."
        )
    return path


def _toml_line(name: str, value) -> str:
    # JSON's strings, numbers, booleans and lists are TOML's as well, except for one character.
    text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"{name} = {text}"
