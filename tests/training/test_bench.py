"""Benchmark of the rasterizer: rejected results of earlier runs."""

import pytest

from tools import bench


@pytest.mark.parametrize("content", [None, "x", "{}", "[]"])
def test_comparison_needs_the_results_of_a_run(content, tmp_path, monkeypatch, capsys):
    if content is not None:
        (tmp_path / "bench.json").write_text(content)
    base = tmp_path if content is None else tmp_path / "bench.json"
    monkeypatch.setattr(bench, "bench", lambda seconds: pytest.fail("measured before the check"))
    monkeypatch.setattr("sys.argv", ["bench.py", "--base", str(base)])
    with pytest.raises(SystemExit) as error:
        bench.main()
    assert error.value.code == 2
    assert f"{base} is not the bench.json of an earlier run" in capsys.readouterr().err
