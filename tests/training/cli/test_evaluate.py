"""Options of ``lodgs evaluate``."""

from training.__main__ import main


def test_other_files_are_not_replaced_by_a_picture(tmp_path, capsys):
    bundle = tmp_path / "bundle.ply"
    bundle.write_text("mine")
    assert main(["evaluate", str(tmp_path), "--picture", str(bundle)]) == 2
    assert "bundle.ply: it is not a PNG. Use the ending .png." in capsys.readouterr().err
    assert bundle.read_text() == "mine"
