"""Splats and points as Blender point clouds, and back. One datablock, one set of splats.

Attributes are those of ``attributes``, and every further column has its own name. Files hold logarithms,
logits and quaternions of any length, which float32 cannot give back to the bit from activated values; they
are therefore kept beside as ``log_scale``, ``opacity_logit`` and ``quaternion``. On the way back such a
stored value counts where it still stands for the visible one: whatever an artist has changed, wins.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.scenes.color import linear_from_srgb
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
    OPACITY_LOGIT,
    QUATERNION,
    RADIUS,
    ROTATION,
    SCALE,
    WEIGHT,
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
_TYPE = "lodgs_type:"  # custom property that remembers a column's type
_EXTRA = COLUMN.format("")
_OPACITIES = 1e-12, 1 - 2.0**-24
"""Range of opacities that have a finite logit: up to the float32 next to 1."""
_MADE = ("scenes", "objects", "collections", "pointclouds", "meshes", "cameras", "images")


@contextmanager
def all_or_nothing() -> Iterator[None]:
    """What the block has made in the file vanishes again if it fails."""
    before = {kind: set(getattr(bpy.data, kind)) for kind in _MADE}
    try:
        yield
    except BaseException:
        for kind, there in before.items():
            bpy.data.batch_remove(list(set(getattr(bpy.data, kind)) - there))
        raise


@all_or_nothing()
def new_points(name: str, positions: np.ndarray, colors: np.ndarray, radius: float) -> bpy.types.Object:
    """Coloured points as an object that is in no collection yet.

    Args:
        positions: (P, 3), in the object's own space.
        colors: (P, 3) uint8, sRGB.
        radius: display radius in the object's units.
    """
    cloud = compat.new_point_cloud(name, len(positions))
    write_attribute(cloud, "position", "FLOAT_VECTOR", positions)
    write_attribute(cloud, RADIUS, "FLOAT", np.full(len(positions), radius))
    cloud.materials.append(display.points_material())
    obj = bpy.data.objects.new(name, cloud)
    _set_colors(obj, colors)
    return obj


@all_or_nothing()
def new_splats(name: str, splats: Splats) -> bpy.types.Object:
    """Splats as an object that is in no collection yet; its local space is the splats' world."""
    cloud = compat.new_point_cloud(name, len(splats))
    opacity = _sigmoid(splats.opacity_logits)
    scale = _exp(splats.log_scales)
    base = np.empty((len(splats), 4), np.float32)
    base[:, :3], base[:, 3] = splats.sh[:, 0], opacity
    write_attribute(cloud, "position", "FLOAT_VECTOR", splats.means)
    write_attribute(cloud, BASE, compat.WIDE_TYPE, base)
    for k in range(1, splats.sh.shape[1]):
        write_attribute(cloud, sh_name(k), "FLOAT_VECTOR", splats.sh[:, k])
    write_attribute(cloud, SCALE, "FLOAT_VECTOR", scale)
    write_attribute(cloud, ROTATION, "QUATERNION", _unit(splats.quats))
    for column, values in splats.extras.items():
        taken = column in _OWN or column.startswith((".", _EXTRA, "radiance:"))
        write_column(cloud, _EXTRA + column if taken else column, values)
    obj = bpy.data.objects.new(name, cloud)
    complete_attributes(obj, splats)
    return obj


def complete_attributes(obj: bpy.types.Object, splats: Splats) -> None:
    """Give a splat object the attributes and modifiers by which LODGS edits, draws and exports it.

    Args:
        splats: those of the object, as :func:`read_splats` returns them.
    """
    cloud = obj.data
    rename_sh(cloud)
    write_attribute(cloud, LOG_SCALE, "FLOAT_VECTOR", splats.log_scales)
    write_attribute(cloud, OPACITY_LOGIT, "FLOAT", splats.opacity_logits)
    write_attribute(cloud, QUATERNION, compat.WIDE_TYPE, splats.quats)
    # A sphere with the splat's mean size; a faint splat covers less, so that fog does not hide the scene.
    opacity = _sigmoid(splats.opacity_logits)
    radius = np.exp(splats.log_scales @ np.full(3, 1 / 3, np.float32)) * np.sqrt(opacity)
    write_attribute(cloud, RADIUS, "FLOAT", radius)
    _set_colors(obj, to_bytes(SH_C0 * splats.sh[:, 0] + np.float32(0.5)))
    display.attach(obj)


def root_of(obj: bpy.types.Object | None) -> bpy.types.Object | None:
    """The root of the splat scene that an object is in: itself, or what it is a child of; None outside."""
    while obj is not None and not obj.lodgs.is_root:
        obj = obj.parent
    return obj


def read_splats(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> Splats:
    """The splats of an object, with all that artists have changed: its data, or what its modifiers leave.

    Args:
        depsgraph: where given, the modifiers are applied as it shows them, their weights to the opacities.

    Raises:
        LodgsError: if the object carries no splat attributes.
    """
    types = obj.data  # evaluated data keeps no custom properties
    cloud = obj.evaluated_get(depsgraph).data if depsgraph else types
    if depsgraph and not len(cloud.points):  # Blender drops the attributes with the last point
        return read_splats(obj).select(slice(0))
    splats = splats_of(cloud, read_attribute(cloud, WEIGHT))
    if splats is None:
        raise LodgsError(f"{obj.name} carries no splats.", "Undo what took its attributes away.")
    known = {a.name for a in cloud.attributes if a.name.startswith("radiance:")} | _OWN
    splats.extras |= {
        a.name.removeprefix(_EXTRA): column
        for a in cloud.attributes
        if a.name not in known
        and a.name[0] != "."
        and (column := read_column(cloud, a.name, types)) is not None
    }
    return splats


def splats_of(cloud: bpy.types.PointCloud, weights: np.ndarray | None = None) -> Splats | None:
    """The splats of a point cloud in the form that files have, without further columns.

    Args:
        weights: (N,) factors on the opacities; None leaves them as they are.

    Returns:
        None where the cloud lacks an attribute of splats.
    """
    means, base = read_attribute(cloud, "position"), read_attribute(cloud, BASE)
    scale, rotation = read_attribute(cloud, SCALE), read_attribute(cloud, ROTATION)
    if means is None or base is None or scale is None or rotation is None:
        return None
    if weights is not None:
        base[:, 3] *= weights
    sh = np.stack([base[:, :3], *(read_attribute(cloud, name) for name in sh_names(cloud))], axis=1)
    tiny = np.float32(1e-30)
    opacity = np.clip(base[:, 3].astype(np.float64), *_OPACITIES)
    logits = np.log(opacity / (1 - opacity)).astype(np.float32)
    return Splats(
        means=means,
        quats=_kept(cloud, QUATERNION, _unit, rotation, rotation),
        log_scales=_kept(cloud, LOG_SCALE, _exp, scale, np.log(np.maximum(scale, tiny))),
        opacity_logits=_kept(cloud, OPACITY_LOGIT, _sigmoid, base[:, 3], logits),
        sh=sh,
    )


def megabytes(cloud: bpy.types.PointCloud) -> float:
    """Size of the splats as a 3DGS file, in 10^6 bytes."""
    columns = LAYOUTS.keys() - {"BOOLEAN"}  # which no file has: Blender's own
    names = [a.name for a in cloud.attributes if a.data_type in columns and a.domain == "POINT"]
    own = _OWN - {"position", BASE, SCALE, ROTATION}
    widths = [LAYOUTS[cloud.attributes[name].data_type].width for name in names if name not in own]
    normals = 3
    return len(cloud.points) * 4e-6 * (sum(widths) + normals)


def sh_degree(cloud: bpy.types.PointCloud) -> int:
    """The degree of the spherical harmonics that a point cloud of splats carries."""
    return int((len(sh_names(cloud)) + 1) ** 0.5) - 1


def to_bytes(colors: np.ndarray) -> np.ndarray:
    """Display colours in [0, 1], clipped and rounded to uint8."""
    return (np.clip(colors, 0, 1) * np.float32(255) + np.float32(0.5)).astype(np.uint8)


def write_column(data: bpy.types.PointCloud | bpy.types.Mesh, name: str, values: np.ndarray) -> None:
    """Sets an attribute to a file's own column, (N,) of any type that PLY has.

    What Blender has no type for is remembered.
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
    """The column (N,) of an attribute that :func:`write_column` has set; None where it holds no such.

    Args:
        types: the original, where the data are evaluated: only that remembers types.
    """
    values, kind = read_attribute(data, name), types.get(_TYPE + name)
    if values is not None and values.ndim == 2:
        return values.reshape(-1).view(np.float64) if kind else None
    return values if values is None or kind is None else values.astype(kind)


def _set_colors(obj: bpy.types.Object, colors: np.ndarray) -> None:
    """Set the (N, 3) uint8 sRGB display colours of an object's points; Blender shades in linear light."""
    linear = linear_from_srgb(np.arange(256, dtype=np.float32) / 255).astype(np.float32)
    rgba = np.ones((len(colors), 4), np.float32)
    rgba[:, :3] = linear[colors]
    write_attribute(obj.data, COLOR, "FLOAT_COLOR", rgba)
    if len(colors):
        obj.color = rgba.mean(axis=0)  # what Solid shading can show of a point cloud


def _kept(cloud, name: str, activate, visible: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """The stored values where they still activate to the visible ones, the inverse elsewhere."""
    stored = read_attribute(cloud, name)
    if stored is None:
        return inverse
    with np.errstate(all="ignore"):
        # Machines differ in the last bits of exp; an edit that small is none.
        same = np.isclose(activate(stored), visible, rtol=1e-5, atol=1e-7)
    if same.ndim == 2:
        same = same.all(axis=1, keepdims=True)
    return stored if same.all() else np.where(same, stored, inverse)


# The next three functions round as Blender's importers do, so that both give the same bits and Cycles, whose
# noise depends on them, the same image.


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
