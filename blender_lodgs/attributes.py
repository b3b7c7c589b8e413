"""Attributes of splats and points in Blender: names, reading and writing.

The names are those of Blender 5.3's native splats, in every Blender version: ``position``, ``radiance:base``
(three DC coefficients and the opacity), ``radiance:sh_0`` to ``radiance:sh_14`` (one vector per higher
coefficient), ``scale`` (standard deviations) and ``rotation`` (unit quaternion wxyz).

Files saved before Blender 5.3 number the higher coefficients from 1. Readers accept both: a cloud with
``radiance:sh_0`` starts at 0.
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import bpy
import numpy as np

BASE, SCALE, ROTATION = "radiance:base", "scale", "rotation"
_SH = "radiance:sh_{}"
HIGHER_SH = _SH.format("*")
"""Pattern of the names of all coefficients above degree 0."""
LOG_SCALE, OPACITY_LOGIT, QUATERNION = "log_scale", "opacity_logit", "quaternion"
COLOR, RADIUS, WEIGHT, HIDDEN = "display_color", "radius", "lod_weight", "hidden"
SELECTION = ".selection"
"""Blender's attribute of points that are selected in Edit Mode."""
LOOK_OPACITY = "look_opacity"
"""Opacity factor of a look, for Blender's own drawing of splats (``nodes.look``)."""
COLUMN = "column:{}"
"""Prefix for columns of tables, and for file columns whose names Blender uses otherwise."""


MAX_HIGHER_SH = 24
"""Number of coefficients above degree 0 at degree 4."""


def sh_name(coefficient: int) -> str:
    """Return the attribute name of SH coefficient ``coefficient`` (1 to 24; 0 is in ``radiance:base``)."""
    return _SH.format(coefficient - 1)


def sh_names(cloud: bpy.types.PointCloud) -> list[str]:
    """Return the attribute names of a cloud's SH coefficients above degree 0, in the order of the basis.

    The list covers complete degrees only, up to degree 4: 0, 3, 8, 15 or 24 names. Attributes that are no
    vectors of points end it.
    """
    first = 0 if _SH.format(0) in cloud.attributes else 1
    count = 0
    while count < MAX_HIGHER_SH and is_vector(cloud, _SH.format(first + count)):
        count += 1
    complete = int((count + 1) ** 0.5) ** 2 - 1
    return [_SH.format(first + index) for index in range(complete)]


def is_vector(cloud: bpy.types.PointCloud, name: str) -> bool:
    """Return whether a cloud has an attribute of one vector per point."""
    attribute = cloud.attributes.get(name)
    return attribute is not None and (attribute.data_type, attribute.domain) == ("FLOAT_VECTOR", "POINT")


def rename_sh(cloud: bpy.types.PointCloud) -> None:
    """Rename coefficients numbered from 1, as in files before Blender 5.3, to Blender's names."""
    if _SH.format(0) in cloud.attributes:
        return
    index = 1
    while (attribute := cloud.attributes.get(_SH.format(index))) is not None:
        attribute.name = _SH.format(index - 1)
        index += 1


class Layout(NamedTuple):
    """Data layout of an attribute type for ``foreach_get`` and ``foreach_set``."""

    key: str
    dtype: type
    width: int


LAYOUTS = {
    "FLOAT": Layout("value", np.float32, 1),
    "FLOAT_VECTOR": Layout("vector", np.float32, 3),
    "FLOAT_COLOR": Layout("color", np.float32, 4),
    "FLOAT4": Layout("vector", np.float32, 4),
    "QUATERNION": Layout("value", np.float32, 4),
    "BOOLEAN": Layout("value", np.bool_, 1),
    "INT": Layout("value", np.int32, 1),
    "INT32_2D": Layout("value", np.int32, 2),
}


def write_attribute(
    cloud: bpy.types.PointCloud | bpy.types.Mesh, name: str, kind: str, values: np.ndarray
) -> None:
    """Set a point attribute of type ``kind`` (a key of LAYOUTS) from (N,) or (N, width) values."""
    layout = LAYOUTS[kind]
    attribute = cloud.attributes.get(name) or cloud.attributes.new(name, kind, "POINT")
    attribute.data.foreach_set(layout.key, np.ascontiguousarray(values, layout.dtype).reshape(-1))


def read_attribute(cloud: bpy.types.PointCloud | bpy.types.Mesh, name: str) -> np.ndarray | None:
    """Return a point attribute as (N,) or (N, width); None if it is missing or of an unknown type."""
    attribute = cloud.attributes.get(name)
    if attribute is None or attribute.data_type not in LAYOUTS or attribute.domain != "POINT":
        return None
    layout = LAYOUTS[attribute.data_type]
    values = np.empty(len(attribute.data) * layout.width, layout.dtype)
    attribute.data.foreach_get(layout.key, values)
    return values if layout.width == 1 else values.reshape(-1, layout.width)


def view_attribute(cloud: bpy.types.PointCloud | bpy.types.Mesh, name: str) -> np.ndarray | None:
    """Return a point attribute as :func:`read_attribute`, but without a copy, read-only.

    The result is Blender's own memory, which becomes invalid as soon as Blender continues: do not store it or
    pass it to another thread.
    """
    attribute = cloud.attributes.get(name)
    if attribute is None or attribute.data_type not in LAYOUTS or attribute.domain != "POINT":
        return None
    layout, data = LAYOUTS[attribute.data_type], attribute.data
    size, last = np.dtype(layout.dtype).itemsize * layout.width, len(data) - 1
    start = data[0].as_pointer() if len(data) else 0
    if not len(data) or data[last].as_pointer() - start != size * last:  # not contiguous
        return read_attribute(cloud, name)
    memory = (ctypes.c_byte * (size * len(data))).from_address(start)
    values = np.ctypeslib.as_array(memory).view(layout.dtype)
    values.flags.writeable = False
    return values if layout.width == 1 else values.reshape(-1, layout.width)
