"""Pages of results: their texts remain, and their tables are replaced."""

import pytest

from tools.results import MARK, PAGES, split_comparison, write_results
from training.runs.reproduction.run import PAPERS

COMPARISON = """## Choice of a method

| purpose | a |

## Means over the scenes

| method |

## a

2 photos.

## b

3 photos.
"""


def test_every_paper_has_a_page():
    pages = {page.stem for page in PAGES.glob("results*.md") if MARK in page.read_text(encoding="utf-8")}
    assert pages == {"results", "results-scenes", *(f"results-{paper}" for paper in PAPERS)}


def test_scenes_are_separated_from_the_summary():
    summary, scenes = split_comparison(COMPARISON)
    assert f"{summary}\n{scenes}" == COMPARISON and scenes.startswith("## a\n")


def test_tables_replace_those_of_the_last_results(tmp_path):
    results, pages = tmp_path / "results", tmp_path / "pages"
    (results / "flod").mkdir(parents=True)
    pages.mkdir()
    (results / "results.md").write_text(COMPARISON)
    (results / "flod" / "tables.md").write_text("## FLoD\n")
    for name in ("results", "results-scenes", "results-flod", "results-tree"):
        (pages / f"{name}.md").write_text(f"# Title\n\nText.\n\n{MARK}\n\nOld.\n")
    written = write_results(results, pages, "Effort 0.1.")
    assert sorted(page.stem for page in written) == ["results", "results-flod", "results-scenes"]
    flod, tree = ((pages / f"results-{name}.md").read_text() for name in ("flod", "tree"))
    assert flod == f"# Title\n\nText.\n\n{MARK}\n\nEffort 0.1.\n\n## FLoD\n" and tree.endswith("Old.\n")
    assert "## b" in (pages / "results-scenes.md").read_text()


def test_page_without_mark_is_refused(tmp_path):
    (tmp_path / "results-flod.md").write_text("# Title\n")
    (tmp_path / "flod").mkdir()
    (tmp_path / "flod" / "tables.md").write_text("")
    with pytest.raises(SystemExit, match="results-flod"):
        write_results(tmp_path, tmp_path, "")
