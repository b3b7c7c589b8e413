"""Report of ``make demo``, without its training."""

import pytest

from examples import demo
from training.runs.folder import RunFolder


@pytest.mark.parametrize("viewer", [False, True])
def test_demo_writes_a_page_only_with_a_viewer(viewer, tmp_path, monkeypatch):
    run, commands = RunFolder(tmp_path / "flod"), []
    run.path.mkdir()
    run.metrics.write_text('{"levels": [], "selective": []}')
    run.sheet.touch()

    def run_command(words: list[str]) -> int:
        commands.append(words[0])
        return 2 * (words[0] == "page" and not viewer)

    monkeypatch.setattr(demo, "lodgs", run_command)
    monkeypatch.setattr(demo, "fetch", lambda: viewer)
    assert demo.write_report(tmp_path / "scene", run, tmp_path) == 0
    assert commands == ["evaluate", "compare", *(["page"] if viewer else [])]
