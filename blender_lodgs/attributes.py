"""The attributes of splats and points in Blender: their names, how they are read and how they are written.

They follow Blender 5.3's native splats: ``position``, ``radiance:base`` (the three DC coefficients and the
opacity), ``radiance:sh_1``.. (one vector a coefficient), ``scale`` (standard deviations) and ``rotation``
(unit quaternion wxyz).
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import bpy
import numpy as np

BASE, SH, SCALE, ROTATION = "radiance:base", "radiance:sh_{}", "scale", "rotation"
LOG_SCALE, OPACITY_LOGIT, QUATERNION = "log_scale", "opacity_logit", "quaternion"
COLOR, RADIUS, WEIGHT, HIDDEN = "display_color", "radius", "lod_weight", "hidden"
SELECTION = ".selection"
"""Blender's own of the points that are selected in Edit Mode."""
LOOK_OPACITY = "look_opacity"
"""What a look makes of opacities, a factor, where Blender itself draws splats (``nodes.look``)."""
COLUMN = "column:{}"
"""A file's column whose own name may mean something else to Blender; every column of a table."""


class Layout(NamedTuple):
    """How an attribute type travels through ``foreach_get`` and ``foreach_set``."""

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
    """Sets a point attribute of type ``kind`` (a key of LAYOUTS) from (N,) or (N, width) values."""
    layout = LAYOUTS[kind]
    attribute = cloud.attributes.get(name) or cloud.attributes.new(name, kind, "POINT")
    attribute.data.foreach_set(layout.key, np.ascontiguousarray(values, layout.dtype).reshape(-1))


def read_attribute(cloud: bpy.types.PointCloud | bpy.types.Mesh, name: str) -> np.ndarray | None:
    """A point attribute as (N,) or (N, width), or None if there is none of that name and a known type."""
    attribute = cloud.attributes.get(name)
    if attribute is None or attribute.data_type not in LAYOUTS or attribute.domain != "POINT":
        return None
    layout = LAYOUTS[attribute.data_type]
    values = np.empty(len(attribute.data) * layout.width, layout.dtype)
    attribute.data.foreach_get(layout.key, values)
    return values if layout.width == 1 else values.reshape(-1, layout.width)


def view_attribute(cloud: bpy.types.PointCloud | bpy.types.Mesh, name: str) -> np.ndarray | None:
    """As :func:`read_attribute`, without copying: to read some rows of many, at once.

    It is Blender's own memory, which is another as soon as Blender goes on: never keep it, nor hand it to
    another thread.
    """
    attribute = cloud.attributes.get(name)
    if attribute is None or attribute.data_type not in LAYOUTS or attribute.domain != "POINT":
        return None
    layout, data = LAYOUTS[attribute.data_type], attribute.data
    size, last = np.dtype(layout.dtype).itemsize * layout.width, len(data) - 1
    start = data[0].as_pointer() if len(data) else 0
    if not len(data) or data[last].as_pointer() - start != size * last:  # no such array
        return read_attribute(cloud, name)
    memory = (ctypes.c_byte * (size * len(data))).from_address(start)
    values = np.ctypeslib.as_array(memory).view(layout.dtype)
    values.flags.writeable = False
    return values if layout.width == 1 else values.reshape(-1, layout.width)
