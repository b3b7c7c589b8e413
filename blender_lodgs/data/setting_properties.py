"""Blender properties of settings (``training.settings``)."""

from __future__ import annotations

from dataclasses import Field
from typing import Any

import bpy

from ...training.settings import MAX_INTEGER, default_of, label_of

_MAX_FLOAT = 3.4e38
SUBTYPES = {"px": "PIXEL", "length": "DISTANCE", "K": "COLOR_TEMPERATURE"}
"""Subtypes of properties by unit."""
_MIN_STEP = 1e-6
"""Smallest number above 0 that Blender displays."""


def property_of(f: Field, **options: Any) -> Any:
    """Return a Blender property with the label, help, default, bounds and unit of a setting.

    Args:
        options: arguments of ``bpy.props`` that replace the generated ones. With ``get``, which returns the
            name of a choice, the property has no default.
    """
    about = f.metadata["about"].removesuffix(".")  # Blender adds one
    options = {"name": label_of(f), "description": about, "options": set(), **options}
    if "get" not in options:
        options.setdefault("default", f.default)
    default = default_of(f)
    if isinstance(default, bool):
        return bpy.props.BoolProperty(**options)
    if isinstance(default, str):
        return _text_property(f, options)
    bounded = isinstance(default, float) and (f.metadata["low"], f.metadata["high"]) == (0, 1)
    subtype = SUBTYPES.get(f.metadata["unit"], "FACTOR" if bounded else "NONE")
    options = {"subtype": subtype, **_ranges(f), **options}
    if isinstance(f.default, tuple):
        return bpy.props.FloatVectorProperty(size=len(f.default), **options)
    return (bpy.props.IntProperty if isinstance(default, int) else bpy.props.FloatProperty)(**options)


def _text_property(f: Field, options: dict[str, Any]) -> Any:
    if path := f.metadata["path"]:
        subtype = "DIR_PATH" if path == "folder" else "FILE_PATH"
        path_options = {"subtype": subtype, "options": {"PATH_SUPPORTS_BLEND_RELATIVE"}}
        return bpy.props.StringProperty(**options | path_options)
    choices = f.metadata["choices"]
    if not choices:
        return bpy.props.StringProperty(**options)
    items = [(name, name.replace("_", " ").title(), text) for name, text in choices.items()]
    if "get" in options:  # that of an enum returns the item's number
        name_of, names = options["get"], list(choices)
        options |= {"get": lambda group: names.index(name_of(group))}
    return bpy.props.EnumProperty(**{"items": items} | options)


def _ranges(f: Field) -> dict[str, Any]:
    """Return the bounds of a number and of its slider, as arguments of ``bpy.props``."""
    low, high, above, soft = (f.metadata[name] for name in ("low", "high", "above", "soft"))
    if isinstance(default_of(f), int):
        ranges: dict[str, Any] = {"max": int(min(high, MAX_INTEGER))}
        ranges["min"] = int(low) if above is None else int(above) + 1
    else:
        ranges = {"max": min(high, _MAX_FLOAT)}
        ranges["min"] = low if above is None else above + _MIN_STEP
    sliders = {"soft_min": soft[0], "soft_max": soft[1]}
    return ranges | {name: value for name, value in sliders.items() if value is not None}
