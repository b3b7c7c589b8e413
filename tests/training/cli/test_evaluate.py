"""Options of ``lodgs evaluate``."""

import pytest

from training.__main__ import main
from training.errors import LodgsError
from training.runs.measure import evaluate_run


def test_pictures_are_png_from_python_too(tmp_path):
    with pytest.raises(LodgsError, match=r"Cannot write .*a\.jpg: unsupported image format"):
        evaluate_run(tmp_path, image=tmp_path / "a.jpg")


def test_other_files_are_not_replaced_by_a_picture(tmp_path, capsys):
    bundle = tmp_path / "bundle.ply"
    bundle.write_text("mine")
    assert main(["evaluate", str(tmp_path), "--picture", str(bundle)]) == 2
    assert "bundle.ply: unsupported image format. End its name with .png." in capsys.readouterr().err
    assert bundle.read_text() == "mine"
