"""Corpus of small inputs after public bug reports, imported by Blender's operator."""

from pathlib import Path

import pytest

pytest.importorskip("PIL", reason="Pillow generates the photos")

from tests.training.scenes.test_cases import NAMES, write_case


@pytest.mark.parametrize("name", NAMES)
def test_case_is_imported(bpy, lodgs, tmp_path, name):
    folder, case = write_case(name, tmp_path)
    try:
        assert bpy.ops.lodgs.import_colmap(directory=str(folder)) == {"FINISHED"}
    except RuntimeError as error:
        assert "error" in case and case["error"] in " ".join(str(error).split()), error
        return
    assert "error" not in case
    (root,) = lodgs("data.roots").roots(bpy.context.scene)
    views = [Path(view.data.lodgs.photograph).name for view in lodgs("data.photographs").views(root)]
    assert len(views) == len(case["views"]), views
