"""Views of a scene as bundle tables: cameras without their images. numpy only.

The table ``views`` has one row per view: ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy``, ``near``
(near depth for rendering), ``held_out`` (1 for views not used in training) and the first three rows of
``world_to_camera``, ``w2c_00`` to ``w2c_23``. Tables cannot store text, so the table ``view_names`` holds the
concatenated names in UTF-8, each terminated by a 0 byte.
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
"""Names of the tables, which are independent of rules and unaffected by the removal of splats."""
_POSE = tuple(f"w2c_{row}{column}" for row in range(3) for column in range(4))
_LENS = ("fx", "fy", "cx", "cy")


def make_view_tables(
    cameras: Sequence[Camera], near: float, held_out: Collection[str] = ()
) -> dict[str, Columns]:
    """Return the tables of views by table name; empty without views.

    Args:
        near: near depth of all views.
        held_out: names of the views not used in training.
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
    """Return the cameras, near depth and names of held-out views stored by :func:`make_view_tables`.

    Without the tables, there are no cameras.

    Raises:
        LodgsError: the tables are damaged.
    """
    views = tables.get(VIEWS)
    if views is None:
        return [], 0.0, set()
    try:
        text = tables[NAMES]["utf8"].astype(np.uint8).tobytes()
        names = text.decode("utf-8", "surrogateescape").split("\0")[:-1]
        poses = np.stack([views[name] for name in _POSE], axis=1).reshape(-1, 3, 4)
        rows = [dict(zip(views, row, strict=True)) for row in zip(*views.values(), strict=True)]
        cameras = []
        held_out = set()
        for name, row, pose in zip(names, rows, poses, strict=True):
            camera, _ = camera_from_dict(
                row | {"name": name, "world_to_camera": [*pose, (0.0, 0.0, 0.0, 1.0)]}
            )
            cameras.append(camera)
            if row["held_out"]:
                held_out.add(name)
        return cameras, min((float(row["near"]) for row in rows), default=0.0), held_out
    except (KeyError, ValueError, TypeError) as error:
        raise LodgsError(
            f"Cannot read the views of the splats: damaged tables ({type(error).__name__}: {error}).",
            "Export the splats again; another program may have changed the file.",
        ) from error


def transform_views(views: Columns, transform: Similarity) -> Columns:
    """Return the table ``views`` of a transformed scene; the images stay the same."""
    rotation, translation = transform.rotation, transform.translation
    poses = np.stack([views[name] for name in _POSE], axis=1).astype(np.float64).reshape(-1, 3, 4)
    poses[:, :, :3] = poses[:, :, :3] @ rotation.T
    poses[:, :, 3] = transform.scale * poses[:, :, 3] - poses[:, :, :3] @ translation
    columns = dict(zip(_POSE, poses.reshape(-1, 12).T, strict=True))
    return {**views, **columns, "near": views["near"] * transform.scale}
