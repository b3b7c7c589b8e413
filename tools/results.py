"""Write results of ``lodgs compare`` and ``lodgs reproduce`` to the documentation: ``make results``.

Each page keeps its text up to the line MARK, and gets the tables of a folder after it.
"""

from __future__ import annotations

import argparse
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "methods"
MARK = "<!-- results -->"
SUMMARY = ("Choice of a method", "Means over the scenes")
"""Sections of a comparison on the page *Results*. Those of single scenes are on a page of their own."""


def split_comparison(text: str) -> tuple[str, str]:
    """Split the Markdown of a comparison into the summary and the sections of scenes."""
    parts = [part.strip() for part in ("\n" + text).split("\n## ") if part.strip()]
    groups = [[], []]
    for part in parts:
        groups[part.split("\n")[0] not in SUMMARY].append(f"## {part}\n")
    summary, scenes = ("\n".join(group) for group in groups)
    return summary, scenes


def write_page(page: Path, text: str) -> None:
    """Replace the text after the line MARK of a page."""
    head, mark, _ = page.read_text(encoding="utf-8").partition(MARK)
    if not mark:
        raise SystemExit(f"Cannot write {page}: it has no line {MARK}.")
    page.write_text(f"{head}{MARK}\n\n{text.rstrip()}\n", encoding="utf-8")


def write_results(results: Path, pages: Path, condition: str) -> list[Path]:
    """Write the pages whose results exist, and return them.

    Args:
        results: folder of a comparison, with the folder of a reproduction for each paper.
        pages: folder of the pages.
        condition: a sentence about the trainings.
    """
    texts: dict[str, str] = {}
    if (comparison := results / "results.md").is_file():
        texts["results"], texts["results-scenes"] = split_comparison(comparison.read_text(encoding="utf-8"))
    for tables in sorted(results.glob("*/tables.md")):
        texts[f"results-{tables.parent.name}"] = tables.read_text(encoding="utf-8")
    written = []
    for name, text in texts.items():
        write_page(pages / f"{name}.md", f"{condition}\n\n{text}")
        written.append(pages / f"{name}.md")
    return written


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, help="folder of results")
    parser.add_argument("--effort", required=True, help="effort of the trainings")
    options = parser.parse_args()
    for page in write_results(options.results, PAGES, f"{date.today()}, effort {options.effort}."):
        print(page)


if __name__ == "__main__":
    main()
