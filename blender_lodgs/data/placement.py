"""Where a splat scene stands: its root, which is the artist's, and below that its axes.

The axes are an empty in whose space the files' coordinates are: all parts of the scene hang on it. What turns
a scene upright, lays it on the ground and gives it its size is the transform of the axes, so that the root
begins without one: artists move, turn and scale the root, by Euler angles, and Alt+R takes away no more than
that. The axes are locked against Alt+R themselves. In files of older versions they are missing, and the root
is in their place.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.splats.similarity import Similarity, is_similarity

SMALL = 1e-4
"""How large axes are drawn: nobody is to click them in place of the root."""


def axes_of(root: bpy.types.Object) -> bpy.types.Object:
    """The empty in whose space the coordinates of a splat scene's files are: the root itself, in older files
    and where a root has been copied alone."""
    axes = root.lodgs.axes
    return axes if axes is not None and axes.parent == root else root


def new_axes(root: bpy.types.Object) -> bpy.types.Object:
    """Axes for a new root, in its collection."""
    axes = bpy.data.objects.new(f"{root.name} axes", None)
    axes.parent, axes.rotation_mode, axes.empty_display_size = root, "QUATERNION", SMALL
    axes.lock_location = axes.lock_rotation = axes.lock_scale = (True, True, True)
    axes.lock_rotation_w = axes.lock_rotations_4d = True
    root.users_collection[0].objects.link(axes)
    root.lodgs.axes = axes
    return axes


def in_parent(root: bpy.types.Object) -> Matrix:
    """From the coordinates of a splat scene to those of the root's parent, also before Blender has evaluated
    them: mostly the world."""
    axes = axes_of(root)
    own = root.matrix_basis
    return own.copy() if axes == root else own @ axes.matrix_parent_inverse @ axes.matrix_basis


def matrix_of(root: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> np.ndarray:
    """(4, 4) float64 from a splat scene's coordinates to Blender's world, with the bits that Blender has.

    Args:
        depsgraph: as it shows them; None: as they are.

    Raises:
        LodgsError: the root is stretched.
    """
    axes = axes_of(root)
    own = axes.evaluated_get(depsgraph) if depsgraph else axes
    matrix = np.array(own.matrix_world, np.float64)
    if not is_similarity(_orthogonal(matrix)):
        raise LodgsError(
            f"'{root.name}' is stretched, which no camera of its files can show.",
            "Give it one scale for all axes.",
        )
    return matrix


def placement_of(root: bpy.types.Object) -> Similarity:
    """The same as it is meant: at right angles to the last bit of float64.

    Raises:
        LodgsError: the root is stretched.
    """
    return Similarity.from_matrix(_orthogonal(matrix_of(root)))


def move(root: bpy.types.Object, further: Similarity) -> None:
    """Places a splat scene elsewhere in Blender's world; the root stays what it is.

    Raises:
        LodgsError: the root is stretched.
    """
    there = further.compose(placement_of(root))
    axes_of(root).matrix_world = Matrix(there.matrix.tolist())


def _orthogonal(matrix: np.ndarray) -> np.ndarray:
    """A matrix (4, 4) whose columns are at right angles as well as float64 can say, where they were so as
    well as Blender's float32 can; others stay as they are."""
    left, scales, right = np.linalg.svd(matrix[:3, :3])
    if scales[2] > 0 and scales[0] < 1.0001 * scales[2]:
        matrix = matrix.copy()
        matrix[:3, :3] = left @ right * scales.mean()
    return matrix
