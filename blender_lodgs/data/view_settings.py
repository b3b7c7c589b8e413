"""Settings of the views that render training images; ``viewpoints`` places them."""

from __future__ import annotations

from typing import NamedTuple

import bpy

from ...training.runs.job import KEYS
from .setting_properties import property_of


def _is_curve(settings: bpy.types.PropertyGroup, obj: bpy.types.Object) -> bool:
    return obj.type == "CURVE"


class ViewPattern(NamedTuple):
    """A pattern of the cameras that render training images.

    Attributes:
        identifier, label, about: entry of the enum ``ViewsSettings.views_from``.
        option: name of its option on the command line; "" if the pattern needs viewports.
        setting: property of ``ViewsSettings`` for this pattern only, or "".
    """

    identifier: str
    label: str
    about: str
    option: str = ""
    setting: str = ""


VIEW_PATTERNS = (
    ViewPattern(
        "DOME",
        "All Around",
        "Dome of cameras around the splats or the selected objects. For splats, half of the cameras are "
        "close to their surface",
        "around",
    ),
    ViewPattern(
        "GRID",
        "Above",
        "Grid of cameras above the splats or the selected objects that look down and to four sides, "
        "as a drone does, for terrain and towns",
        "above",
        setting="height",
    ),
    ViewPattern("CAMERAS", "Cameras", "Cameras enabled in renders, without other splat scenes", "cameras"),
    ViewPattern(
        "ANIMATION", "Animation", "Scene camera at frames spread evenly over the frame range", "animation"
    ),
    ViewPattern(
        "CURVE",
        "Along Curve",
        "Cameras along a curve that look ahead, to both sides and back in turn",
        "curve",
        setting="curve",
    ),
    ViewPattern(
        "VISITED",
        "Visited Views",
        "Views where viewports rested since the file was opened, such as those of a walk",
    ),
)


class ViewsSettings:
    """Settings of views for rendering training images, of splats or of a Blender scene."""

    views_from: bpy.props.EnumProperty(
        name="Views From",
        description="Placement of the cameras that render training images",
        items=[(pattern.identifier, pattern.label, pattern.about) for pattern in VIEW_PATTERNS],
    )
    views: property_of(KEYS["views"])
    show_views: bpy.props.BoolProperty(
        name="Show Views",
        description="Show the views in the viewport",
        default=False,
        options=set(),
    )
    view_width: property_of(KEYS["view_width"])
    height: bpy.props.FloatProperty(
        name="Height",
        description="Height of the views above the top of the subject. 0 uses twice their spacing",
        default=0.0,
        min=0.0,
        soft_max=1000.0,
        subtype="DISTANCE",
    )
    curve: bpy.props.PointerProperty(
        name="Curve",
        description="Curve for the cameras to follow, at eye level",
        type=bpy.types.Object,
        poll=_is_curve,
    )
