"""Settings of the training panel, stored on each scene root (``root.lodgs.training``)."""

from __future__ import annotations

from dataclasses import Field, fields
from typing import Any

import bpy

from ...training.methods import METHODS, MethodInfo, method_info
from ...training.runs.job import KEYS, MAX_CELLS, Job, default_image_scale
from ...training.settings import label_of
from ...training.splats.levels import MAX_LEVELS
from . import crops, photographs, viewpoints
from .setting_properties import property_of
from .view_settings import ViewsSettings

PANEL_KEYS = {name: f for name, f in KEYS.items() if f.metadata.get("panel")}
"""Job keys that are stored as settings of a scene root."""
COMMON_PARAMETERS = "depth_weight", "depth"
"""Parameters in the panel for every method."""
MIN_HOLD_OUT = 40
"""Minimum number of photos or views for a default hold-out; fewer are all trained on."""


def hold_out_interval(root: bpy.types.Object) -> int:
    """Return the hold-out interval n of the root's next training (every n-th photo); 0 for none."""
    settings = root.lodgs.training
    return settings.test_every if settings.use_test_every else settings.preset_test_every


def _default_interval(settings: bpy.types.PropertyGroup) -> int:
    root = settings.id_data
    views = (
        viewpoints.view_count(settings) if viewpoints.has_only_splats(root) else len(photographs.views(root))
    )
    return 0 if views < MIN_HOLD_OUT else Job.test_every


def _set_image_scale(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """Give the image scale the default of the new preset, unless the artist changed it."""
    scales = [default_image_scale(preset) for preset in KEYS["preset"].metadata["choices"]]
    if any(abs(settings.image_scale - scale) < 1e-6 for scale in scales):
        settings.image_scale = default_image_scale(settings.preset)


def panel_parameters(method: str) -> list[Field]:
    """Return the parameters of a method for the panel: its ``panel_parameters`` without per-level ones, and
    COMMON_PARAMETERS."""
    info = method_info(method)
    fields_by_name = {f.name: f for f in fields(info.parameters)}
    names = (*info.panel_parameters, *COMMON_PARAMETERS)
    return [fields_by_name[name] for name in names if not isinstance(fields_by_name[name].default, tuple)]


def has_level_distances(method: str) -> bool:
    """Return True if a method has level distances as a parameter."""
    return "distances" in {f.name for f in fields(method_info(method).parameters)}


def level_distances(settings: bpy.types.PropertyGroup) -> list[tuple[int, int]]:
    """Return the coarser levels with adjustable distances, coarse to fine.

    Returns:
        Pairs of level number and index in ``settings.distances``, where index 0 is next to the finest level.
    """
    group = settings.parameters
    levels = group.levels if group.is_property_set("levels") else group.preset_levels
    return [(number, levels - 1 - number) for number in range(1, levels)]


def _preset_value(f: Field, method: str):
    return lambda group: getattr(method_info(method).preset(group.id_data.lodgs.training.preset), f.name)


def _use(name: str, label: str, description: str) -> Any:
    """Create a checkbox that enables the user's own value; it starts as the previous default."""

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
    """Return three properties: the artist's value, its switch, and the preset's value to show until then."""
    tooltip = f"{f.metadata['about']} Value of the preset; tick the box to change it"
    return {
        f.name: property_of(f),
        f"use_{f.name}": _use(f.name, label_of(f), "Use your own value instead of the preset's"),
        f"preset_{f.name}": property_of(f, description=tooltip, get=_preset_value(f, method)),
    }


def _parameters_of(method: MethodInfo) -> type[bpy.types.PropertyGroup]:
    """Return a group with a method's parameters; those with ``is_property_set`` override the preset."""
    annotations = {}
    for f in panel_parameters(method.name):
        annotations |= _properties_of(f, method.name)
    return type(
        f"LODGS_parameters_{method.name}", (bpy.types.PropertyGroup,), {"__annotations__": annotations}
    )


PARAMETERS = {method: _parameters_of(info) for method, info in METHODS.items()}
"""Property groups of all methods by name; ``TrainingSettings`` has them as ``parameters_<name>``."""


class TrainingCell(bpy.types.PropertyGroup):
    """A planned cell of a scene that is trained in cells."""

    views: bpy.props.IntProperty(name="Views", description="Number of views for training and measuring")
    points: bpy.props.IntProperty(name="Points", description="Number of initial points")
    splats: bpy.props.IntProperty(name="Max Splats", description="Maximum number of splats")
    steps: bpy.props.IntProperty(name="Steps", description="Number of training steps")
    megabytes: bpy.props.FloatProperty(name="Memory", description="Estimated memory of its training, in MB")
    outline: bpy.props.FloatVectorProperty(
        name="Outline", description="Corners of the cell on the ground, in scene units", size=12
    )
    enlarged: bpy.props.FloatVectorProperty(
        name="Training Area",
        description="Corners of the area that its training covers, in scene units",
        size=12,
    )
    view_indices: bpy.props.StringProperty(
        name="View Indices", description="Indices of its views, sorted by name, as JSON", options={"HIDDEN"}
    )


class TrainingSettings(ViewsSettings, bpy.types.PropertyGroup):
    """Settings of the Training panel and the newest run of a scene root (``root.lodgs.training``).

    Job keys that are declared with a panel (PANEL_KEYS) have a property of the same name.
    ``run`` is the folder of that run, relative to the .blend file if possible. Everything else about the run
    is read from the folder.
    """

    method: property_of(
        KEYS["method"],
        items=[(m.name, m.label, f"{m.label}: {m.about}", m.number) for m in METHODS.values()],
    )
    start_from: bpy.props.EnumProperty(
        name="Start From",
        description="Initial splats of the training",
        items=[
            ("POINTS", "Points", "Points of the COLMAP scene"),
            ("RUN", "This Run", "Finest level of the newest run of this scene, which must be finished"),
            (
                "FILE",
                "Splat File",
                "Finest level of a finished run, a bundle or any splat PLY",
            ),
            ("SCENE", "These Splats", "Finest level of this scene, with all edits"),
        ],
    )
    find_distances: bpy.props.BoolProperty(
        name="Find Distances",
        description="Let training choose the level distances that leave the fewest splats to draw. Disable "
        "it to set them yourself",
        default=True,
    )
    distances: bpy.props.FloatVectorProperty(
        name="Level Distances",
        description="Distance from which each level is shown, in multiples of the scene's median depth. "
        "Coarser levels need larger distances. 0 lets training choose",
        size=MAX_LEVELS - 1,
        default=[3.0 * 2.0**index for index in range(MAX_LEVELS - 1)],
        min=0.0,
        soft_max=100.0,
        step=50,
        precision=2,
    )
    median_depth: bpy.props.FloatProperty(
        name="Median Depth",
        description="Median depth of the photos, in scene units. 0 if unknown",
        options={"HIDDEN"},
    )
    preset: property_of(KEYS["preset"], update=_set_image_scale)
    image_scale: property_of(KEYS["image_scale"], min=0.01)
    region: bpy.props.PointerProperty(
        type=bpy.types.Object,
        name="Region",
        description="Box or sphere of this scene to train in detail, and the rest coarsely. Empty to train "
        "everything in detail",
        poll=lambda settings, obj: obj in crops.crops_of(settings.id_data),
    )
    use_test_every: _use(
        "test_every", "Hold Out Every", "Use your own number instead of the default for this number of photos"
    )
    preset_test_every: bpy.props.IntProperty(
        name="Hold Out Every",
        description=f"Default: hold out every {Job.test_every}th view to measure quality, or none (0) with "
        f"fewer than {MIN_HOLD_OUT} photos. Tick the box to change it",
        get=_default_interval,
        options=set(),
    )
    divide_by: bpy.props.EnumProperty(
        name="Divide By",
        description="Criterion for dividing the ground into cells, which are trained separately",
        items=[
            ("GRID", "By Number", "Number of columns and rows. 1 by 1 trains the scene as a whole"),
            (
                "SPLATS",
                "By Splats",
                "Fewest cells with at most a number of splats each. Plan Cells computes them",
            ),
            (
                "MEMORY",
                "By Memory",
                "Fewest cells that each need at most a limit of memory. Plan Cells computes them",
            ),
        ],
        options=set(),
    )
    cell_splats: bpy.props.IntProperty(
        name="Max Splats",
        description="Maximum number of splats per cell",
        default=1_000_000,
        min=1000,
        soft_max=16_000_000,
        step=10_000,
        options=set(),
    )
    cell_memory: bpy.props.FloatProperty(
        name="Max Memory (GB)",
        description="Maximum estimated memory for training one cell",
        default=8.0,
        min=0.5,
        soft_max=64.0,
        precision=1,
        step=50,
        options=set(),
    )
    columns: bpy.props.IntProperty(
        name="Columns",
        description="Number of columns along the longer side of the ground",
        default=1,
        min=1,
        soft_max=8,
        max=MAX_CELLS,
        options=set(),
    )
    rows: bpy.props.IntProperty(
        name="Rows",
        description="Number of cells per column",
        default=1,
        min=1,
        soft_max=8,
        max=MAX_CELLS,
        options=set(),
    )
    at_once: bpy.props.IntProperty(
        name="Cells at Once",
        description="Number of cells that train at the same time, each with its own memory. More than 1 "
        "requires Dask",
        default=1,
        min=1,
        soft_max=8,
        max=MAX_CELLS,
        options=set(),
    )
    show_cells: bpy.props.BoolProperty(
        name="Show Cells",
        description="Show cells on the ground, their training areas, and the cameras of the active cell",
        default=True,
        options=set(),
    )
    planned_cells: bpy.props.CollectionProperty(type=TrainingCell, name="Cells", description="Planned cells")
    active_cell: bpy.props.IntProperty(
        name="Active Cell", description="Active row of the list of cells", options=set()
    )
    planned_for: bpy.props.StringProperty(
        name="Plan Inputs",
        description="Settings for which the cells were planned, as JSON",
        options={"HIDDEN"},
    )
    output: bpy.props.StringProperty(
        name="Runs Folder",
        description="Folder for new runs. If empty, lodgs_runs next to the .blend file",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    run: bpy.props.StringProperty(
        name="Run Folder",
        description="Folder of the newest run of this scene",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    read: bpy.props.IntProperty(
        name="Events Read",
        description="Number of bytes of the run's event log that this file has read",
        options={"HIDDEN"},
    )

    @property
    def limits(self) -> tuple[int, int]:
        """Maximum numbers of splats and bytes per cell if they determine the grid; otherwise 0."""
        return (
            self.cell_splats if self.divide_by == "SPLATS" else 0,
            round(self.cell_memory * 1e9) if self.divide_by == "MEMORY" else 0,
        )

    @property
    def grid(self) -> str:
        """The grid as a job key, "COLUMNSxROWS"; "" for the scene as a whole."""
        return f"{self.columns}x{self.rows}" if self.columns * self.rows > 1 else ""

    @property
    def parameters(self) -> bpy.types.PropertyGroup:
        """The parameters of the selected method."""
        return getattr(self, f"parameters_{self.method}")


TrainingSettings.__annotations__ |= {
    name: property_of(f) for name, f in PANEL_KEYS.items() if name not in TrainingSettings.__annotations__
}
TrainingSettings.__annotations__ |= {
    f"parameters_{name}": bpy.props.PointerProperty(
        name=METHODS[name].label, description="Parameters that differ from the preset", type=parameters
    )
    for name, parameters in PARAMETERS.items()
}
