"""The notebook of the examples."""

import json
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "lodgs.ipynb"


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_notebook_trains_selects_and_renders(monkeypatch):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    monkeypatch.chdir(NOTEBOOK.parent)
    names: dict = {}
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert len(names["bundle"].levels) == 3 and names["quality"][-1] > 12
    counts = names["counts"]
    assert counts[0] > counts[-1] > 0  # farther cameras need fewer splats
    finest, by_distance = names["images"]["Level 3"], names["images"]["By distance"]
    assert finest.std() > 0.1 and abs(finest - by_distance).mean() < 0.05
