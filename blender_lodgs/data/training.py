"""What the training panel sets, kept on each scene root (``root.lodgs.training``)."""

from __future__ import annotations

from dataclasses import Field, fields
from typing import Any

import bpy

from ...training.methods import METHODS, PRESETS, MethodInfo, method_info
from ...training.runs.job import MAX_CELLS, Job
from ...training.splats.levels import MAX_LEVELS
from . import crops, photographs, viewpoints

_WHOLE_MOST, _MOST = 2**31 - 1, 3.4e38
_LEAST = 1e-6
"""The smallest number above 0 that Blender shows."""

ALL_OFFER = "depth_weight", "depth"
"""Parameters that the panel offers of every method."""
FEW = 40
"""Photographs, or views in their place, below which every one is needed to train on."""


def hold_out(root: bpy.types.Object) -> int:
    """Of how many photographs the root's next training holds one out: what is set, or affordable; 0: none."""
    settings = root.lodgs.training
    return settings.test_every if settings.use_test_every else settings.preset_test_every


def _affordable(settings: bpy.types.PropertyGroup) -> int:
    root = settings.id_data
    views = viewpoints.count(settings) if viewpoints.alone(root) else len(photographs.views(root))
    return 0 if views < FEW else Job.test_every


def offered(method: str) -> list[Field]:
    """The parameters of a method that the panel offers: those that it declares, but for per-level ones, and
    ALL_OFFER."""
    info = method_info(method)
    known = {f.name: f for f in fields(info.parameters)}
    names = (*info.panel_parameters, *ALL_OFFER)
    return [known[name] for name in names if not isinstance(known[name].default, tuple)]


def chooses_distances(method: str) -> bool:
    """Whether a method can be told from where on each level is shown."""
    return "distances" in {f.name for f in fields(method_info(method).parameters)}


def level_distances(settings: bpy.types.PropertyGroup) -> list[tuple[int, int]]:
    """The coarser levels whose distances can be set: their numbers, coarse to fine, and their places in
    ``settings.distances``, where the one next to the finest comes first, however many there are."""
    group = settings.parameters
    levels = group.levels if group.is_property_set("levels") else group.preset_levels
    return [(number, levels - 1 - number) for number in range(1, levels)]


def _preset_value(f: Field, method: str):
    return lambda group: getattr(method_info(method).preset(group.id_data.lodgs.training.preset), f.name)


def _property(f: Field, label: str, **options) -> Any:
    """A property of the parameter's kind, within its bounds."""
    about = f.metadata
    options = {"name": label, "options": set(), **options}
    if isinstance(f.default, bool):
        return bpy.props.BoolProperty(**options)
    if isinstance(f.default, str) and "get" in options:  # an enum's would have to give numbers
        return bpy.props.StringProperty(**options)
    if isinstance(f.default, str):
        items = [(name, name.replace("_", " ").title(), "") for name in about["choices"]]
        return bpy.props.EnumProperty(items=items, **options)
    low, high, above = about["low"], about["high"], about["above"]
    if isinstance(f.default, int):
        low = low if above is None else above + 1
        return bpy.props.IntProperty(min=int(low), max=int(min(high, _WHOLE_MOST)), **options)
    subtype = "PIXEL" if about["unit"] == "px" else "FACTOR" if (low, high) == (0, 1) else "NONE"
    low = low if above is None else above + _LEAST
    return bpy.props.FloatProperty(min=low, max=min(high, _MOST), subtype=subtype, **options)


def _use(name: str, label: str, description: str) -> Any:
    """A box to tick for a value of the artist's own: it begins as what was taken before, and is forgotten."""

    def set_use(group: bpy.types.PropertyGroup, use: bool) -> None:
        if not use:
            group.property_unset(name)
        elif not group.is_property_set(name):
            setattr(group, name, getattr(group, f"preset_{name}"))

    return bpy.props.BoolProperty(
        name=f"Set {label}", description=description, get=lambda group: group.is_property_set(name),
        set=set_use, options=set(),
    )  # fmt: skip


def _properties_of(f: Field, method: str) -> dict[str, Any]:
    """Three properties: the artist's value, whether there is one, and the preset's, to show until then."""
    name, label = f.name, f.metadata["label"] or f.name.replace("_", " ").title()
    about = f.metadata["about"].removesuffix(".")  # Blender adds one
    tooltip = f"{about}. This is the preset's; tick the box to give another"
    return {
        name: _property(f, label, description=about, default=f.default),
        f"use_{name}": _use(name, label, "Take a value of your own instead of the preset's"),
        f"preset_{name}": _property(f, label, description=tooltip, get=_preset_value(f, method)),
    }


def _parameters_of(method: MethodInfo) -> type[bpy.types.PropertyGroup]:
    """A group with the parameters that a method offers; one counts when it is set (``is_property_set``)."""
    annotations = {}
    for f in offered(method.name):
        annotations |= _properties_of(f, method.name)
    return type(
        f"LODGS_parameters_{method.name}", (bpy.types.PropertyGroup,), {"__annotations__": annotations}
    )


PARAMETERS = {method: _parameters_of(info) for method, info in METHODS.items()}
"""The groups of all methods by name; each is a property ``parameters_<name>`` of ``TrainingSettings``."""


class TrainingCell(bpy.types.PropertyGroup):
    """A cell of a scene that is trained in cells, as its plan has it."""

    views: bpy.props.IntProperty(name="Views", description="How many views it is trained and measured on")
    points: bpy.props.IntProperty(name="Points", description="With how many points its training begins")
    splats: bpy.props.IntProperty(name="Splats at Most", description="How many splats it has at most")
    steps: bpy.props.IntProperty(name="Steps", description="How many steps it is trained for")
    megabytes: bpy.props.FloatProperty(name="Memory", description="About how much its training takes, in MB")
    outline: bpy.props.FloatVectorProperty(
        name="Outline", description="Its corners on the ground, in the scene's own units", size=12
    )
    enlarged: bpy.props.FloatVectorProperty(
        name="Enlarged", description="The corners of what it is trained on, in the same units", size=12
    )
    places: bpy.props.StringProperty(
        name="Places", description="The places by name of its views, as JSON", options={"HIDDEN"}
    )


class TrainingSettings(viewpoints.ViewsSettings, bpy.types.PropertyGroup):
    """Choices of the training panel, and the scene root's newest run (``root.lodgs.training``).

    ``run`` is the folder of that run, relative to the .blend where possible; all else about it is read from
    there.
    """

    method: bpy.props.EnumProperty(
        name="Method",
        description="What is trained",
        items=[(m.name, m.label, f"{m.label}: {m.about}", m.number) for m in METHODS.values()],
    )
    preset: bpy.props.EnumProperty(
        name="Preset",
        description="How long the training takes",
        items=[(name, name.title(), text) for name, text in PRESETS.items()],
    )
    start_from: bpy.props.EnumProperty(
        name="Start From",
        description="What the training begins with",
        items=[
            ("POINTS", "Points", "The points of the COLMAP scene"),
            ("RUN", "This Run", "The finest level of this scene's newest run, which has to be finished"),
            (
                "FILE",
                "Splat File",
                "The finest level of a finished run, of a bundle or of any splat PLY",
            ),
            ("SCENE", "These Splats", "The finest level of this scene, with all that was changed in it"),
        ],
    )
    find_distances: bpy.props.BoolProperty(
        name="Find Distances",
        description="Training finds from where on each level is shown: where the least is left to draw. "
        "Without it these distances are yours",
        default=True,
    )
    distances: bpy.props.FloatVectorProperty(
        name="Level Distances",
        description="From how far away a level is shown, in median depths: half of all that photographs show "
        "is nearer than 1. The coarser a level, the farther away; 0 has training find it",
        size=MAX_LEVELS - 1,
        default=[3.0 * 2.0**place for place in range(MAX_LEVELS - 1)],
        min=0.0,
        soft_max=100.0,
        step=50,
        precision=2,
    )
    median_depth: bpy.props.FloatProperty(
        name="Median Depth",
        description="How far away what photographs show is, in the scene's own units; 0 where nobody knows",
        options={"HIDDEN"},
    )
    base: bpy.props.StringProperty(
        name="Splats",
        description="PLY of splats, or folder of a finished run, that the training begins with",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    image_scale: bpy.props.FloatProperty(
        name="Image Scale",
        description="Size of the training images over the size of the photographs",
        default=0.5,
        min=0.01,
        soft_min=0.1,
        max=1.0,
        subtype="FACTOR",
    )
    region: bpy.props.PointerProperty(
        type=bpy.types.Object,
        name="Region",
        description="A box or sphere of this scene: what lies in it is trained in detail, all else coarsely. "
        "Empty: everything",
        poll=lambda settings, obj: obj in crops.crops_of(settings.id_data),
    )
    test_every: bpy.props.IntProperty(
        name="Hold Out Every",
        description="Every n-th view by name is kept out of training to measure quality; 0 trains on all",
        default=Job.test_every,
        min=0,
        soft_max=16,
    )
    use_test_every: _use(
        "test_every", "Hold Out Every", "Take a number of your own instead of the one for so many photographs"
    )
    preset_test_every: bpy.props.IntProperty(
        name="Hold Out Every",
        description=f"Every {Job.test_every}th view is kept out of training to measure quality, or none (0) "
        f"where there are fewer than {FEW} photographs; tick the box to give another number",
        get=_affordable,
        options=set(),
    )
    seed: bpy.props.IntProperty(
        name="Seed", description="Two runs with the same seed are equal", default=0, min=0
    )
    divide_by: bpy.props.EnumProperty(
        name="Divide By",
        description="How many cells the ground is divided into, each of which is trained by itself",
        items=[
            ("GRID", "By Number", "So many columns of so many cells; 1 by 1 trains the scene as a whole"),
            ("SPLATS", "By Splats", "As few cells as have so many splats at most; Plan finds them"),
            ("MEMORY", "By Memory", "As few cells as take so much memory at most; Plan finds them"),
        ],
        options=set(),
    )
    cell_splats: bpy.props.IntProperty(
        name="Splats at Most",
        description="How many splats a cell has at most",
        default=1_000_000,
        min=1000,
        soft_max=16_000_000,
        step=10_000,
        options=set(),
    )
    cell_memory: bpy.props.FloatProperty(
        name="GB at Most",
        description="How many gigabytes of memory the training of a cell takes at most, estimated",
        default=8.0,
        min=0.5,
        soft_max=64.0,
        precision=1,
        step=50,
        options=set(),
    )
    columns: bpy.props.IntProperty(
        name="Columns",
        description="How many columns of cells there are, across the longer side of the ground",
        default=1,
        min=1,
        soft_max=8,
        max=MAX_CELLS,
        options=set(),
    )
    rows: bpy.props.IntProperty(
        name="Rows",
        description="How many cells each column has",
        default=1,
        min=1,
        soft_max=8,
        max=MAX_CELLS,
        options=set(),
    )
    polish: bpy.props.IntProperty(
        name="Border Steps",
        description="Steps that fit each cell's borders to the cells beside it, once all are trained; "
        "0 leaves them as they are",
        default=Job.polish,
        min=0,
        soft_max=2000,
        options=set(),
    )
    at_once: bpy.props.IntProperty(
        name="Cells at Once",
        description="How many cells are trained at a time on this computer. Each takes its own memory, and "
        "they share the processor. Above 1 the trainer needs Dask",
        default=1,
        min=1,
        soft_max=8,
        max=MAX_CELLS,
        options=set(),
    )
    show_cells: bpy.props.BoolProperty(
        name="Show Cells",
        description="Show the cells on the ground: what each is trained on fainter, and the cameras of the "
        "chosen one",
        default=True,
        options=set(),
    )
    planned_cells: bpy.props.CollectionProperty(
        type=TrainingCell, name="Cells", description="What the plan says of each cell"
    )
    active_cell: bpy.props.IntProperty(
        name="Chosen Cell", description="Line of the list of cells", options=set()
    )
    planned_for: bpy.props.StringProperty(
        name="Planned For", description="What the cells were planned for, as JSON", options={"HIDDEN"}
    )
    output: bpy.props.StringProperty(
        name="Run Folders In",
        description="Folder that receives the folders of the runs; empty: lodgs_runs beside the .blend file",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    model: bpy.props.StringProperty(
        name="Model",
        description="Folder of the COLMAP model; empty: the scene's largest",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    images: bpy.props.StringProperty(
        name="Photographs",
        description="Folder of the photographs; empty: found beside the model",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    run: bpy.props.StringProperty(
        name="Run Folder",
        description="Folder of this scene's newest run",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    read: bpy.props.IntProperty(
        name="Events Read",
        description="Bytes of the run's events that this file has taken in",
        options={"HIDDEN"},
    )

    @property
    def limits(self) -> tuple[int, int]:
        """Splats and bytes that a cell has at most, where these decide how many cells there are; else 0."""
        return (
            self.cell_splats if self.divide_by == "SPLATS" else 0,
            round(self.cell_memory * 1e9) if self.divide_by == "MEMORY" else 0,
        )

    @property
    def grid(self) -> str:
        """The cells as a job has them; "" for the scene as a whole."""
        return f"{self.columns}x{self.rows}" if self.columns * self.rows > 1 else ""

    @property
    def parameters(self) -> bpy.types.PropertyGroup:
        """The parameters that the chosen method offers."""
        return getattr(self, f"parameters_{self.method}")


TrainingSettings.__annotations__ |= {
    f"parameters_{name}": bpy.props.PointerProperty(
        name=METHODS[name].label, description="What is changed from the preset", type=parameters
    )
    for name, parameters in PARAMETERS.items()
}
