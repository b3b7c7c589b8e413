"""Update callbacks of properties, looked up by name because they need modules that import the properties."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

ON_CHANGE: dict[str, Callable[[Any, bpy.types.Context], None]] = {}
"""Update callbacks by name, called with the property's owner; ``updates`` fills the table."""


def look_up(name: str) -> Callable[[Any, bpy.types.Context], None]:
    """Return a callback that calls the entry ``name`` of ON_CHANGE."""
    return lambda owner, context: ON_CHANGE[name](owner, context)


def tag_owner(self, context) -> None:
    """Tag the owner: properties set from scripts do not trigger an evaluation by themselves."""
    self.id_data.update_tag()
