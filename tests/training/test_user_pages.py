"""Limits of the pages that users read, and the use of all pictures."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [
    DOCS / "index.md",
    *(page for name in ("start", "manual", "methods", "command-line") for page in (DOCS / name).glob("*.md")),
    *(DOCS / "reference" / f"{name}.md" for name in ("controls", "formats", "level-formats", "api")),
]
for generated in ("command-line/commands.md", "methods/results-scenes.md"):
    PAGES.remove(DOCS / generated)
MAX_WORDS = 900


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS).as_posix())
def test_user_page_is_short(page):
    words = [word for word in page.read_text(encoding="utf-8").split() if re.search(r"\w", word)]
    assert len(words) <= MAX_WORDS


def test_readme_fits_two_screens():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 80


def test_every_picture_is_on_a_page():
    text = "".join(page.read_text(encoding="utf-8") for page in DOCS.rglob("*.md"))
    pictures = {path.name for path in (DOCS / "images").iterdir()} - {"panels.json"}
    assert pictures == set(re.findall(r"images/([\w.-]+)\)", text))


def test_changelog_has_versions_and_three_kinds_of_changes():
    lines = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()
    versions = [line for line in lines if line.startswith("## ")]
    assert all(re.fullmatch(r"## (Unreleased|\d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\))", line) for line in versions)
    assert {line for line in lines if line.startswith("### ")} <= {"### Added", "### Changed", "### Fixed"}
