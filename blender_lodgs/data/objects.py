"""Conversion of splats and points to Blender point clouds and back; one datablock per set of splats.

Attributes have the names in ``attributes``; additional columns keep their own names. Files store logarithms,
logits and unnormalised quaternions, which cannot be recovered bit by bit from activated float32 values. They
are therefore stored as well, as ``log_scale``, ``opacity_logit`` and ``quaternion``. A stored value is used
only while it matches the activated one, so that artists' edits take precedence.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from ...training.color import linear_from_srgb
from ...training.errors import LodgsError
from ...training.splats.gaussians import SH_C0, Splats
from .. import compat
from ..attributes import (
    BASE,
    COLOR,
    COLUMN,
    HIDDEN,
    LAYOUTS,
    LOG_SCALE,
    LOOK_OPACITY,
    MAX_HIGHER_SH,
    OPACITY_LOGIT,
    QUATERNION,
    RADIUS,
    ROTATION,
    SCALE,
    WEIGHT,
    is_vector,
    read_attribute,
    rename_sh,
    sh_name,
    sh_names,
    write_attribute,
)
from ..nodes import display

_OWN = {
    "position", BASE, SCALE, ROTATION, LOG_SCALE, OPACITY_LOGIT, QUATERNION, COLOR, RADIUS, WEIGHT, HIDDEN,
    LOOK_OPACITY,
}  # fmt: skip
_WIDTHS = {BASE: 4, SCALE: 3, ROTATION: 4}
"""Number of values per splat."""
_TYPE = "lodgs_type:"  # custom property that remembers a column's type
_EXTRA = COLUMN.format("")
_OPACITIES = 1e-12, 1 - 2.0**-24
"""Range of opacities that have a finite logit: up to the float32 next to 1."""
_KINDS = ("scenes", "objects", "collections", "pointclouds", "meshes", "cameras", "images")


@contextmanager
def all_or_nothing() -> Iterator[None]:
    """Remove all datablocks created in the block if it fails."""
    existing = {kind: set(getattr(bpy.data, kind)) for kind in _KINDS}
    try:
        yield
    except BaseException:
        for kind, previous in existing.items():
            bpy.data.batch_remove(list(set(getattr(bpy.data, kind)) - previous))
        raise


@all_or_nothing()
def new_points(name: str, positions: np.ndarray, colors: np.ndarray, radius: float) -> bpy.types.Object:
    """Create an object of coloured points, not yet in a collection.

    Args:
        positions: (P, 3), in the object's local space.
        colors: (P, 3) uint8, sRGB.
        radius: display radius in the object's units.
    """
    cloud = compat.new_point_cloud(name, positions)
    write_attribute(cloud, RADIUS, "FLOAT", np.full(len(positions), radius))
    cloud.materials.append(display.points_material())
    obj = bpy.data.objects.new(name, cloud)
    _set_colors(obj, colors)
    return obj


@all_or_nothing()
def new_splats(name: str, splats: Splats) -> bpy.types.Object:
    """Create an object of splats, not yet in a collection; its local space is the splats' world."""
    cloud = compat.new_point_cloud(name, splats.means)
    base = np.empty((len(splats), 4), np.float32)
    base[:, :3], base[:, 3] = splats.sh[:, 0], _sigmoid(splats.opacity_logits)
    write_attribute(cloud, BASE, compat.WIDE_TYPE, base)
    del base  # frees memory before further attributes need it
    write_attribute(cloud, SCALE, "FLOAT_VECTOR", _exp(splats.log_scales))
    write_attribute(cloud, ROTATION, "QUATERNION", _unit(splats.quats))
    for column, values in splats.extras.items():
        reserved = column in _OWN or column.startswith((".", _EXTRA, "radiance:"))
        write_column(cloud, _EXTRA + column if reserved else column, values)
    obj = bpy.data.objects.new(name, cloud)
    complete_attributes(obj, splats)
    # last: harmonics fill most of the memory, and writing the other attributes needs more of it
    for k in range(1, splats.sh.shape[1]):
        write_attribute(cloud, sh_name(k), "FLOAT_VECTOR", splats.sh[:, k])
    return obj


def complete_attributes(obj: bpy.types.Object, splats: Splats) -> None:
    """Give a splat object the attributes and modifiers by which LODGS edits, draws and exports it.

    Args:
        splats: splats of the object, as :func:`read_splats` returns them.
    """
    cloud = obj.data
    rename_sh(cloud)
    write_attribute(cloud, LOG_SCALE, "FLOAT_VECTOR", splats.log_scales)
    write_attribute(cloud, OPACITY_LOGIT, "FLOAT", splats.opacity_logits)
    write_attribute(cloud, QUATERNION, compat.WIDE_TYPE, splats.quats)
    # Mean size of the splat, smaller for faint splats: fog would otherwise hide the scene.
    opacity = _sigmoid(splats.opacity_logits)
    radius = np.exp(splats.log_scales @ np.full(3, 1 / 3, np.float32)) * np.sqrt(opacity)
    write_attribute(cloud, RADIUS, "FLOAT", radius)
    _set_colors(obj, to_bytes(SH_C0 * splats.sh[:, 0] + np.float32(0.5)))
    display.attach(obj)


def root_of(obj: bpy.types.Object | None) -> bpy.types.Object | None:
    """Return the root of the splat scene of an object: itself or an ancestor; None outside splat scenes."""
    while obj is not None and not obj.lodgs.is_root:
        obj = obj.parent
    return obj


def read_splats(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> Splats:
    """Return the splats of an object with all edits.

    Args:
        depsgraph: apply modifiers as evaluated in it, and multiply opacities by their weights; None reads the
            object's data.

    Raises:
        LodgsError: the object has no splat attributes.
    """
    types = obj.data  # evaluated data keeps no custom properties
    cloud = obj.evaluated_get(depsgraph).data if depsgraph else types
    if depsgraph and not len(cloud.points):  # Blender drops the attributes with the last point
        return read_splats(obj).select(slice(0))
    splats = splats_of(cloud, read_attribute(cloud, WEIGHT))
    if splats is None:
        raise LodgsError(
            f"Cannot read '{obj.name}': it has no splats.", "Undo the step that removed its attributes."
        )
    own_names = {a.name for a in cloud.attributes if a.name.startswith("radiance:")} | _OWN
    splats.extras |= {
        a.name.removeprefix(_EXTRA): column
        for a in cloud.attributes
        if a.name not in own_names
        and a.name[0] != "."
        and (column := read_column(cloud, a.name, types)) is not None
    }
    return splats


def splats_of(cloud: bpy.types.PointCloud, weights: np.ndarray | None = None) -> Splats | None:
    """Return the splats of a point cloud in the form of files, without additional columns.

    Args:
        weights: (N,) factors of the opacities; None for no factors.

    Returns:
        None if the cloud lacks an attribute of splats.

    Raises:
        LodgsError: an attribute has another type.
    """
    means, base = read_attribute(cloud, "position"), read_attribute(cloud, BASE)
    scale, rotation = read_attribute(cloud, SCALE), read_attribute(cloud, ROTATION)
    if means is None or base is None or scale is None or rotation is None:
        return None
    _check_types(cloud, {BASE: base, SCALE: scale, ROTATION: rotation})
    if weights is not None:
        base[:, 3] *= weights
    higher = [values for name in sh_names(cloud) if (values := read_attribute(cloud, name)) is not None]
    sh = np.stack([base[:, :3], *higher], axis=1)
    tiny = np.float32(1e-30)
    opacity = np.clip(base[:, 3].astype(np.float64), *_OPACITIES)
    logits = np.log(opacity / (1 - opacity)).astype(np.float32)
    return Splats(
        means=means,
        quats=_stored_or_inverse(cloud, QUATERNION, _unit, rotation, rotation),
        log_scales=_stored_or_inverse(cloud, LOG_SCALE, _exp, scale, np.log(np.maximum(scale, tiny))),
        opacity_logits=_stored_or_inverse(cloud, OPACITY_LOGIT, _sigmoid, base[:, 3], logits),
        sh=sh,
    )


def _check_types(cloud: bpy.types.PointCloud, values: dict[str, np.ndarray]) -> None:
    """Raise LodgsError if an attribute of splats has another type, as Store Named Attribute can give it."""
    wrong = [name for name, width in _WIDTHS.items() if values[name].shape[1:] != (width,)]
    coefficients = (sh_name(k) for k in range(1, MAX_HIGHER_SH + 1))
    wrong += [name for name in coefficients if name in cloud.attributes and not is_vector(cloud, name)]
    if wrong:
        raise LodgsError(
            f"Cannot read '{cloud.name}': its attribute {wrong[0]} has another type than those of splats.",
            "Store it with its own type, or remove it.",
        )


def megabytes(cloud: bpy.types.PointCloud) -> float:
    """Return the size of the splats as a 3DGS file, in 10^6 bytes."""
    columns = LAYOUTS.keys() - {"BOOLEAN"}  # files have no booleans
    names = [a.name for a in cloud.attributes if a.data_type in columns and a.domain == "POINT"]
    derived = _OWN - {"position", BASE, SCALE, ROTATION}
    widths = [LAYOUTS[cloud.attributes[name].data_type].width for name in names if name not in derived]
    normals = 3
    return len(cloud.points) * 4e-6 * (sum(widths) + normals)


def sh_degree(cloud: bpy.types.PointCloud) -> int:
    """Return the degree of the spherical harmonics of a point cloud of splats."""
    return int((len(sh_names(cloud)) + 1) ** 0.5) - 1


def to_bytes(colors: np.ndarray) -> np.ndarray:
    """Convert display colours in [0, 1] to uint8, clipped and rounded."""
    return (np.clip(colors, 0, 1) * np.float32(255) + np.float32(0.5)).astype(np.uint8)


def write_column(data: bpy.types.PointCloud | bpy.types.Mesh, name: str, values: np.ndarray) -> None:
    """Store a file column (N,) of any PLY type as an attribute.

    Types that Blender lacks are recorded in a custom property.
    """
    if values.dtype == np.float32:
        write_attribute(data, name, "FLOAT", values)
        return
    if values.dtype == np.float64:
        write_attribute(data, name, "INT32_2D", np.ascontiguousarray(values).view(np.int32))
    else:
        write_attribute(data, name, "INT", values.astype(np.int32))
    data[_TYPE + name] = values.dtype.str


def read_column(
    data: bpy.types.PointCloud | bpy.types.Mesh, name: str, types: bpy.types.PointCloud | bpy.types.Mesh
) -> np.ndarray | None:
    """Return the column (N,) stored by :func:`write_column`, or None if the attribute is not such a column.

    Args:
        types: original datablock with the recorded types; evaluated data have none.
    """
    values, dtype = read_attribute(data, name), types.get(_TYPE + name)
    if values is not None and values.ndim == 2:
        return values.reshape(-1).view(np.float64) if dtype else None
    return values if values is None or dtype is None else values.astype(dtype)


def _set_colors(obj: bpy.types.Object, colors: np.ndarray) -> None:
    """Set the (N, 3) uint8 sRGB display colours of an object's points; Blender shades in linear light."""
    linear = linear_from_srgb(np.arange(256, dtype=np.float32) / 255).astype(np.float32)
    rgba = np.ones((len(colors), 4), np.float32)
    rgba[:, :3] = linear[colors]
    write_attribute(obj.data, COLOR, "FLOAT_COLOR", rgba)
    if len(colors):
        obj.color = rgba.mean(axis=0)  # Solid shading shows one colour per point cloud


def _stored_or_inverse(cloud, name: str, activate, visible: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return stored values that still activate to the visible ones, and inverse values elsewhere."""
    stored = read_attribute(cloud, name)
    if stored is None:
        return inverse
    with np.errstate(all="ignore"):
        # Machines differ in the last bits of exp; smaller differences are not edits.
        same = np.isclose(activate(stored), visible, rtol=1e-5, atol=1e-7)
    if same.ndim == 2:
        same = same.all(axis=1, keepdims=True)
    return stored if same.all() else np.where(same, stored, inverse)


# The next three functions round as Blender's importers do: Cycles noise depends on the exact bits.


def _exp(values: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.exp(values, dtype=np.float64).astype(np.float32)


def _sigmoid(logits: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.float32(1) / (np.float32(1) + _exp(-logits))


def _unit(quats: np.ndarray) -> np.ndarray:
    w, x, y, z = np.square(quats, dtype=np.float32).T
    norm = np.sqrt(((w + x) + y) + z)[:, None]
    unit = quats * (np.float32(1) / np.maximum(norm, np.float32(1e-30)))
    return np.where(norm > 0, unit, np.float32([1, 0, 0, 0]))
