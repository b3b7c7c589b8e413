"""Coloured points of other programs' PLY files."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from training.scenes.point_cloud import read_points

EXPECTED = [[255, 0, 51], [0, 153, 255]]


@pytest.mark.parametrize(
    "names", [("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")]
)
@pytest.mark.parametrize(
    "kind, full", [("u1", 255), ("u2", 65535), ("f4", 1), ("f8", 1), ("f4", 255), ("i4", 255), ("u2", 255)]
)
def test_colours_of_any_type(tmp_path, kind, full, names):
    rows = np.zeros(
        3, [("x", "f8"), ("y", "f4"), ("z", "f4"), *((name, kind) for name in names), ("alpha", "u1")]
    )
    rows["x"][2] = np.nan
    for name, values in zip(names, np.array(EXPECTED).T / 255 * full, strict=True):
        rows[name][:2] = values.round() if full > 1 else values
    PlyData([PlyElement.describe(rows, "vertex")]).write(tmp_path / "a.ply")
    points, colors = read_points(tmp_path / "a.ply")
    assert len(points) == 2 and colors.tolist() == EXPECTED


def test_float_colours_that_are_not_finite_or_exceed_white(tmp_path):
    rows = np.zeros(3, [(name, "f4") for name in ("x", "y", "z", "red", "green", "blue")])
    rows["red"], rows["blue"] = [0.5, np.nan, np.inf], [1.2, -0.1, 0]
    PlyData([PlyElement.describe(rows, "vertex")]).write(tmp_path / "a.ply")
    assert read_points(tmp_path / "a.ply")[1].tolist() == [[128, 0, 255], [0, 0, 0], [255, 0, 0]]
