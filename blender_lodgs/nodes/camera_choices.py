"""Choices of the camera whose distance selects the level of detail: values of ``SplatScene.camera_choice``.

The menu, the sockets and drivers of the rules' node groups, and the panel follow from ``CHOICES``.
"""

from __future__ import annotations

from typing import NamedTuple


class CameraChoice(NamedTuple):
    """A choice of the camera for levels of detail. Without object and position, the active camera.

    Attributes:
        identifier: value of ``SplatScene.camera_choice``.
        label: name in the menu.
        about: tooltip in the menu.
        object: property of ``SplatScene`` with the object whose origin is the camera, created from the table.
        position: existing property of ``SplatScene`` with the camera position in the splats' space.
        viewport: True if the viewport that moved last stores its position and focal length in the scene.
    """

    identifier: str
    label: str
    about: str
    object: str = ""
    position: str = ""
    viewport: bool = False


STORED_POSITION = "stored_position"
"""Property of ``SplatScene`` with the position of a frozen camera or of the viewport."""
VIEWPORT = CameraChoice(
    "VIEW",
    "Viewport",
    "View of the 3D viewport that moved last. Renders keep its selection: choose Scene Camera before "
    "rendering",
    position=STORED_POSITION,
    viewport=True,
)
CHOICES = (
    CameraChoice("CAMERA", "Scene Camera", "Active camera of the scene"),
    CameraChoice("OBJECT", "Object", "Origin of an object", object="camera_object"),
    CameraChoice(
        "TRAINING",
        "Training Cameras",
        "Mean position of the training cameras, which never moves",
        position="camera_center",
    ),
    VIEWPORT,
)
"""All choices. Files store the index of a choice: only append."""


def find_choice(identifier: str) -> CameraChoice:
    """Return the choice with this identifier; the first one for an identifier of a newer version."""
    return next((choice for choice in CHOICES if choice.identifier == identifier), CHOICES[0])


def position_expression(source: str, freeze: str) -> str:
    """Return the driver expression of the camera position, in variables named after the properties.

    Args:
        source: variable with the index of the choice.
        freeze: variable that is true for a frozen camera.
    """
    branches = [
        f"{choice.position} if {source} == {number} else "
        for number, choice in enumerate(CHOICES)
        if choice.position not in ("", STORED_POSITION)
    ]
    return f"{STORED_POSITION} if {freeze} else {''.join(branches)}{STORED_POSITION}"
