"""Corpus of small inputs after public bug reports, see CONTRIBUTING.md."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from training.errors import LodgsError
from training.scenes.colmap import read_scene
from training.scenes.formats import ensure_colmap_scene

CASES = Path(__file__).parents[2] / "data" / "cases"


NAMES = sorted(path.name for path in CASES.iterdir())


def write_case(name: str, parent: Path) -> tuple[Path, dict]:
    """Copy a case's export with generated photos to a folder; return its folder and ``case.json``."""
    case = json.loads((CASES / name / "case.json").read_text())
    scene_folder = Path(shutil.copytree(CASES / name / "export", parent / name))
    for path, (width, height, *orientation) in case["photos"].items():
        (scene_folder / path).parent.mkdir(parents=True, exist_ok=True)
        exif = Image.Exif()
        exif[274] = orientation[0] if orientation else 1
        Image.new("RGB", (width, height)).save(scene_folder / path, exif=exif)
    for link, target in case.get("links", {}).items():
        (scene_folder / link).symlink_to(target, target_is_directory=True)
    return scene_folder, case


@pytest.mark.parametrize("name", NAMES)
def test_case(tmp_path, name):
    scene_folder, case = write_case(name, tmp_path)
    warnings = []
    try:
        scene = read_scene(ensure_colmap_scene(scene_folder, warnings.append))
    except LodgsError as error:
        assert "error" in case and case["error"] in str(error), error
        return
    assert "error" not in case
    cameras = {Path(camera.name).name: camera for camera in scene.cameras}
    assert sorted(cameras) == sorted(case["views"]), warnings
    for view, expected in case["views"].items():
        pixels, _ = cameras[view].moved(scene.origin).project(np.array([expected["point"]]))
        tolerance = 1e-6 if scene.origin.any() else 1e-9
        np.testing.assert_allclose(pixels, [expected["pixel"]], rtol=0, atol=tolerance, err_msg=view)
        assert [cameras[view].width, cameras[view].height] == expected["size"]
    for text in case["warnings"]:
        assert any(text in warning for warning in [*warnings, *scene.warnings]), (
            text,
            warnings,
            scene.warnings,
        )
    if "points" in case:
        np.testing.assert_allclose(scene.points + scene.origin, case["points"], atol=1e-6)
    if case.get("georeference", 0) is None:
        assert scene.georeference is None
    if georeference := case.get("georeference"):
        assert scene.georeference.crs == georeference["crs"]
        position = scene.georeference.matrix @ [*georeference["point"], 1]
        np.testing.assert_allclose(position[:3], georeference["position"], atol=1e-6)
    if "distorted" in case:
        assert [Path(name).name for name in scene.distorted] == case["distorted"]
    masked = [Path(camera.name).name for camera in scene.cameras if camera.mask is not None]
    assert masked == case.get("masked", [])
