"""Where a scene was photographed from, as a table of a bundle: cameras without their pictures. numpy only.

The table ``views`` has a row for each view: ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy``, ``near``
(the depth at which drawing begins), ``held_out`` (1 where training did not see it) and the first three rows
of ``world_to_camera``, ``w2c_00`` to ``w2c_23``. Tables hold no text, so the names of the views are one after
another in the table ``view_names``: UTF-8, each ended by a 0.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from ..errors import LodgsError
from ..splats.ply import Columns
from ..splats.similarity import Similarity
from .cameras import Camera, camera_from_dict

VIEWS, NAMES = "views", "view_names"
VIEW_TABLES = (VIEWS, NAMES)
"""What no rule reads, and removing splats does not touch."""
_POSE = tuple(f"w2c_{row}{column}" for row in range(3) for column in range(4))
_LENS = ("fx", "fy", "cx", "cy")


def make_view_tables(
    cameras: Sequence[Camera], near: float, held_out: Collection[str] = ()
) -> dict[str, Columns]:
    """The tables of views by name; none where there are no views.

    Args:
        near: depth at which drawing begins in all of them.
        held_out: names of those that training did not see.
    """
    if not cameras:
        return {}
    poses = np.array([camera.world_to_camera[:3].ravel() for camera in cameras])
    sizes = np.array([(camera.width, camera.height) for camera in cameras], np.int32)
    lenses = np.array([[getattr(camera, name) for name in _LENS] for camera in cameras])
    views = {
        "width": sizes[:, 0], "height": sizes[:, 1],
        **dict(zip(_LENS, lenses.T, strict=True)),
        "near": np.full(len(cameras), near),
        "held_out": np.array([camera.name in held_out for camera in cameras], np.uint8),
        **dict(zip(_POSE, poses.T, strict=True)),
    }  # fmt: skip
    names = b"".join(camera.name.encode("utf-8", "surrogateescape") + b"\0" for camera in cameras)
    return {VIEWS: views, NAMES: {"utf8": np.frombuffer(names, np.uint8)}}


def read_view_tables(tables: dict[str, Columns]) -> tuple[list[Camera], float, set[str]]:
    """What :func:`make_view_tables` was told: the views of a bundle, the depth at which drawing begins, and which of
    them by name training did not see. No views where the tables are missing.

    Raises:
        LodgsError: they are damaged.
    """
    views = tables.get(VIEWS)
    if views is None:
        return [], 0.0, set()
    try:
        text = tables[NAMES]["utf8"].astype(np.uint8).tobytes()
        names = text.decode("utf-8", "surrogateescape").split("\0")[:-1]
        poses = np.stack([views[name] for name in _POSE], axis=1).reshape(-1, 3, 4)
        rows = [dict(zip(views, row, strict=True)) for row in zip(*views.values(), strict=True)]
        found, held_out = [], set()
        for name, row, pose in zip(names, rows, poses, strict=True):
            camera, _ = camera_from_dict(
                row | {"name": name, "world_to_camera": [*pose, (0.0, 0.0, 0.0, 1.0)]}
            )
            found.append(camera)
            if row["held_out"]:
                held_out.add(name)
        return found, min((float(row["near"]) for row in rows), default=0.0), held_out
    except (KeyError, ValueError, TypeError) as error:
        raise LodgsError(
            f"The views of these splats are damaged ({type(error).__name__}: {error}).",
            "Another program may have changed the file; export it again.",
        ) from error


def transform_views(views: Columns, placement: Similarity) -> Columns:
    """The table ``views`` of a scene that stands elsewhere: the pictures stay the same."""
    found, (turn, shift) = dict(views), (placement.rotation, placement.translation)
    poses = np.stack([views[name] for name in _POSE], axis=1).astype(np.float64).reshape(-1, 3, 4)
    poses[:, :, :3] = poses[:, :, :3] @ turn.T
    poses[:, :, 3] = placement.scale * poses[:, :, 3] - poses[:, :, :3] @ shift
    found |= dict(zip(_POSE, poses.reshape(-1, 12).T, strict=True))
    return found | {"near": views["near"] * placement.scale}
