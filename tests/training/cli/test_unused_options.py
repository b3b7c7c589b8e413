"""Options without effect, which commands refuse before they work."""

import pytest

from training.__main__ import main


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("compare run --out page --effort 0.5", "--effort"),
        ("compare run --out page --methods flod", "--methods"),
        ("compare run --out page --image-scale 1", "--image-scale"),
        ("capture a.ply --out scene --cameras views --views 5", "--views"),
        ("blocks run run --only block-1 --on local:2", "--on"),
        ("blocks run run --only block-1 --takes GPU=1", "--takes"),
        ("devices --json --time", "--time"),
        ("scene --from export --preset standard", "--preset"),
    ],
)
def test_options_without_effect_are_refused(tmp_path, monkeypatch, capsys, command, option):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "job.toml").touch()
    assert main(command.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: Cannot use {option}: it applies only to ")
    assert error.endswith(f". Omit {option}.\n")
