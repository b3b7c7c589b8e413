"""A job: everything that decides a run, as a TOML or JSON file. No torch: Blender writes and reads jobs."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path

from ..documents import quote, read_json, read_toml
from ..errors import LodgsError
from ..files import atomic_write
from ..lod.crop import Crop, is_text_of_crop
from ..methods import METHODS, method_info, parameters_of
from ..optimize.parameters import Parameters
from .folder import RunFolder

BACKENDS = ("auto", "cpu", "cuda", "gpu", "reference")
CHANGEABLE = ("backend", "out", "photo_memory", "splat_memory")
"""The keys that a run may go on with other values of: they say where it is trained, not what."""
MAX_STOPS = 32
"""Most stops that a job lightens or darkens linear images by."""
DOME = "dome"
"""What ``capture`` is for views from all around."""
VIEWS, VIEW_WIDTHS = (2, 2000), (32, 8192)
"""Bounds of how many views a dome has, and of the pixels that their pictures are wide."""
POLISH_STEPS = 300
"""Steps that fit a cell's borders to the cells beside it, if nothing is said."""
MAX_CELLS = 256
"""Most cells of a scene."""
MAX_PATH = 2000
"""Most characters of a path, so that a job with all of its paths is within the bounds of a TOML file."""
_KINDS: dict[str, tuple[type | tuple[type, ...], str]] = {
    "str": (str, "a text; give it in quotation marks"),
    "int": (int, "a whole number"),
    "float": ((int, float), "a number"),
    "bool": (bool, "true or false"),
    "dict": (dict, "a table; write it below a line with its name in brackets"),
}
"""What a key of each type takes, and how a message says it."""


@dataclass(frozen=True)
class Job:
    """What to train, from what, into which folder.

    Attributes:
        scene: folder of the COLMAP scene; "" where there is none: see ``capture``.
        out: the run's folder; made if it does not exist.
        method, preset: names from ``training.methods``, METHODS and PRESETS.
        base: a run, a bundle or a PLY of splats to begin with instead of the scene's points, for methods that
            can; "" for none.
        capture: where there is no scene, from where the base is drawn, so that its pictures are the
            photographs: DOME, from all around, or a folder of camera files; "" for nowhere.
        views, view_width: how many views a dome has, and the width of their pictures in pixels.
        seed: makes two runs of one job equal to the bit on one machine, but not with the cuda backend.
        backend: rasterizer, one of BACKENDS; auto is cuda where that works, else cpu. A run may go on with
            another one.
        image_scale: training image size over the photograph's, 0 < s <= 1.
        test_every: every n-th view by name is held out to measure quality; 0 trains on all.
        validation: hold out other views instead and leave those out altogether: who tries settings measures
            them so, and the views that report quality have had no part in it.
        exposure: stops added to linear (EXR) images before they are trained on.
        photo_memory: megabytes of photographs that are kept; others are read ahead while steps go on. 0: a
            quarter of the memory that is free, 2 GB at most. What is trained does not depend on it.
        splat_memory: megabytes of splats, with what training keeps of each, that are in memory at a time,
            where a method can have the others in a file (tree). 0: half of the memory that is free. With less
            than all need, what is trained depends on it a little.
        region: what of the scene is trained in detail, in its coordinates, as ``Crop.from_text`` has it; or,
            of a part of a scene in cells, the file of ``scenes.regions`` that says what it is trained on; ""
            for all.
        cells: how many cells on the ground are trained one by one, "COLUMNSxROWS", and then put together; ""
            for the scene as a whole.
        polish: steps that fit each cell's borders to the cells beside it, once all are trained; 0 for none.
        model, images: the COLMAP model's and the photographs' folder where they are not found by themselves.
        parameters: changes to the preset's parameters by name.
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
        """Reads a job; relative paths in it are relative to its folder.

        A run is its folder, wherever that lies: one that has begun goes on there, whatever its job says.

        Raises:
            LodgsError: if the file cannot be read, or a key or value in it is not possible.
        """
        path = Path(path)
        kind = path.suffix.lower()
        if kind not in (".toml", ".json") and path.exists():
            raise LodgsError(
                f"{path} is neither a job file (.toml or .json) nor the folder of a scene.",
                "Name one of these; unpack an archive first.",
            )
        read = read_json if kind == ".json" else read_toml
        values = read(path, f"The job file {path}")
        method, parameters = values.get("method", cls.method), values.get("parameters")
        if isinstance(method, str) and method in METHODS and isinstance(parameters, dict):
            retired = METHODS[method].retired
            values["parameters"] = {k: value for k, value in parameters.items() if k not in retired}
        run = RunFolder(path.parent)
        if path == run.job and run.started:
            values["out"] = "."
        return cls.from_dict(values, folder=path.parent)

    @classmethod
    def from_dict(cls, values: dict, folder: Path = Path()) -> Job:
        """Makes a job from the keys of a job file, checked.

        Raises:
            LodgsError: on an unknown, missing or impossible key.
        """
        known = [f.name for f in fields(cls)]
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise LodgsError(
                f"The job has the unknown key {quote(unknown[0])}.", f"Known are: {', '.join(known)}."
            )
        values = {"scene": "", **values} if values.get("capture") else dict(values)
        for key in ("out",) if values.get("capture") else ("scene", "out"):
            if not values.get(key):
                raise LodgsError(f"The job does not say '{key}'.", f'Add a line: {key} = "..."')
        for key in ("scene", "out", "base", "capture", "model", "images", "region"):
            value = values.get(key)
            if not value or (key, value) == ("capture", DOME):
                continue
            if not (key == "region" and isinstance(value, str) and is_text_of_crop(value)):
                values[key] = _path(key, value, folder)
        job = cls(**values)
        job._check()
        return job

    def _check(self) -> None:
        for key in fields(self):
            value, (kind, name) = getattr(self, key.name), _KINDS[str(key.type)]
            if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
                raise LodgsError(f"{key.name} = {quote(value)} is not {name}.")
        if not (0 <= self.seed < 2**31 and 0 <= self.test_every < 2**31) or self.test_every == 1:
            raise LodgsError(
                f"seed = {self.seed!r}, test_every = {self.test_every!r} is not possible.",
                f"Both are whole numbers from 0 to {2**31 - 1}, and test_every is not 1.",
            )
        if not 0 < self.image_scale <= 1:
            raise LodgsError(
                f"image_scale = {self.image_scale!r} is not possible.", "Give a number above 0, at most 1."
            )
        if not abs(self.exposure) <= MAX_STOPS:
            raise LodgsError(
                f"exposure = {self.exposure!r} is not possible.",
                f"Give stops from {-MAX_STOPS} to {MAX_STOPS}.",
            )
        for key, what in (("photo_memory", "megabytes"), ("splat_memory", "megabytes"), ("polish", "steps")):
            if not 0 <= getattr(self, key) < 2**31:
                raise LodgsError(
                    f"{key} = {getattr(self, key)!r} is not possible.", f"Give {what}, or 0 to let it be."
                )
        if self.backend not in BACKENDS:
            raise LodgsError(
                f"There is no backend {quote(self.backend)}.", f"Choose one of: {', '.join(BACKENDS)}."
            )
        goes_on = self.resolved_parameters().goes_on
        if goes_on and not self.base:
            raise LodgsError(
                "The job does not say which levels to go on from.", "Say 'base', or begin with level 1."
            )
        if self.base and not (goes_on or method_info(self.method).from_base):
            raise LodgsError(
                f"The method '{self.method}' cannot begin with the splats of another run.",
                "Leave out 'base', or choose another method.",
            )
        if is_text_of_crop(self.region):
            Crop.from_text(self.region)
        if self.capture:
            self._check_capture()
        if self.cells:
            self._check_cells()

    def _check_capture(self) -> None:
        if not self.base:
            raise LodgsError(
                "There are no splats to capture views of.", "Say 'base', or leave out 'capture'."
            )
        for key in ("scene", "model", "images"):
            if getattr(self, key):
                raise LodgsError(
                    f"The job says both 'capture' and '{key}'.",
                    "Leave out one of them: photographs are taken, or they are there.",
                )
        check_views(self.views, self.view_width)

    def _check_cells(self) -> None:
        columns, rows = self.grid
        if not 0 < columns * rows <= MAX_CELLS:
            raise LodgsError(
                f"cells = {self.cells!r} is not possible.",
                f"Say columns and rows, such as 2x4, {MAX_CELLS} cells at most.",
            )
        for key in ("base", "capture", "region"):
            if getattr(self, key):
                raise LodgsError(f"The job says both 'cells' and '{key}'.", "Leave out one of them.")
        if not method_info(self.method).in_cells:
            raise LodgsError(
                f"The method '{self.method}' cannot train cells one by one.",
                "Choose another method, or leave out 'cells'.",
            )

    def with_cells(self, cells: str) -> Job:
        """The same job in cells.

        Raises:
            LodgsError: it cannot be divided so.
        """
        job = replace(self, cells=cells)
        job._check_cells()
        return job

    @property
    def crop(self) -> Crop | None:
        """What is trained in detail; None for all."""
        return Crop.from_text(self.region) if is_text_of_crop(self.region) else None

    @property
    def cell(self) -> str:
        """The file of the cell that this job trains; "" where it trains none."""
        return "" if is_text_of_crop(self.region) else self.region

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of ``cells``; (0, 0) where it says none."""
        columns, _, rows = self.cells.lower().partition("x")
        return (int(columns), int(rows)) if columns.isdecimal() and rows.isdecimal() else (0, 0)

    def resolved_parameters(self) -> Parameters:
        """The preset's parameters with this job's changes."""
        return self._parameters

    @cached_property
    def _parameters(self) -> Parameters:
        captured = method_info(self.method).captured if self.capture else {}
        return parameters_of(self.method, self.preset, {**captured, **self.parameters})

    def resolved(self) -> Job:
        """The same job with every parameter written out, so that a later version repeats it unchanged."""
        told, known = self.resolved_parameters(), method_info(self.method).fields
        values = {each.name: getattr(told, each.name) for each in known}
        return replace(
            self, parameters={k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
        )

    def write(self, path: Path) -> None:
        """Writes the job as TOML; in its own run, it says that it is there, and so is what lies in it."""
        values = asdict(self)
        if Path(self.out) == path.parent:
            values["out"] = "."
            for key in ("base", "capture", "region"):
                if values[key] != DOME and path.parent in Path(values[key]).parents:
                    values[key] = f"./{Path(values[key]).relative_to(path.parent).as_posix()}"
            if self.cell and Path(self.base).parent == path.parent.parent:  # both are parts of one run
                values["base"] = f"../{Path(self.base).name}"
        table = values.pop("parameters")
        lines = [_toml_line(name, value) for name, value in values.items()]
        lines += ["", "[parameters]"] + [_toml_line(name, value) for name, value in table.items()]
        with atomic_write(path) as temporary:
            Path(temporary).write_text("\n".join(lines) + "\n", encoding="utf-8")


def save_job(job: Job, folder: RunFolder) -> None:
    """Writes a resolved job into its run, which keeps to the one that it began with, but for CHANGEABLE.

    Raises:
        LodgsError: the folder is of another job.
        OSError: it cannot be written.
    """
    if folder.job.exists():
        before = asdict(Job.from_file(folder.job).resolved())
        other = [key for key, value in asdict(job).items() if before[key] != value]
        changed = [key for key in other if key not in CHANGEABLE]
        if changed:
            raise LodgsError(
                f"The run folder {folder.path} belongs to another job (different: {', '.join(changed)}).",
                "Choose another run folder, or start the run's own job.toml to resume it.",
            )
        if not set(other) - {"out"}:
            return
    job.write(folder.job)


def check_views(views: int, width: int) -> None:
    """Raises LodgsError where so many views, or pictures so many pixels wide, are not captured."""
    for name, value, (low, high) in (("views", views, VIEWS), ("view_width", width, VIEW_WIDTHS)):
        if not low <= value <= high:
            raise LodgsError(f"{name} = {value} is not possible.", f"Give a number from {low} to {high}.")


def _path(key: str, value: object, folder: Path) -> str:
    """An absolute path; relative ones are relative to ``folder``."""
    if not isinstance(value, str):
        raise LodgsError(f"{key} = {quote(value)} is not a path.", "Give it in quotation marks.")
    try:
        path = str((folder / value).expanduser().resolve())
    except (OSError, ValueError, RuntimeError) as error:  # a NUL, an unknown ~name, links in a circle
        raise LodgsError(f"{key} = {quote(value)} is not a path: {error}.", "Correct it.") from error
    if len(path) > MAX_PATH:
        raise LodgsError(f"{key} is a path of {len(path)} characters.", f"Give at most {MAX_PATH}.")
    return path


def _toml_line(name: str, value) -> str:
    # JSON's strings, numbers, booleans and lists are TOML's as well.
    return f"{name} = {json.dumps(value, ensure_ascii=False)}"
