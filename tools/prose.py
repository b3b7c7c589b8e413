"""Check that texts and names in the packages are plain English, as CONTRIBUTING asks (``make lint``).

Four counts stand for the style: the word "what", texts that open with a question word, names that are
function words, and class names with more than one meaning. ``--list N`` shows N texts of each kind that raise
a count.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("blender_lodgs", "training")
QUESTION_WORDS = frozenset(
    {"what", "how", "where", "which", "whether", "whose", "who", "when", "by", "whatever"}
)
FUNCTION_WORDS = frozenset(
    re.findall(
        r"\w+",
        """
        found each some told there here made given begun anew alone itself apart beside asked said seen left
        taken known gone wanted meant elsewhere others other rest one these those them such most least whole
        upto towards behind before after again still held kept put shown had ones both none all_ what
        """,
    )
)
MAX_WHAT, MAX_OPENINGS, MAX_NAMES = 1.0, 2.0, 1.0
"""Limits: "what" per 1000 words, and percentages of texts and of bound names."""


def texts(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield (kind, text) of docstrings, user interface texts and errors of a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            if doc := ast.get_docstring(node):
                yield "docstrings", doc
        elif isinstance(node, ast.Call):
            for keyword in node.keywords:
                if keyword.arg in ("description", "help", "about") and _text(keyword.value) is not None:
                    yield "interface", _text(keyword.value) or ""
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if name in ("setting", "Control"):
                yield from (("interface", text) for arg in node.args if (text := _text(arg)) is not None)
            elif name.endswith(("Error", "warn", "warning")):
                yield from (("errors", _message(arg)) for arg in node.args if _message(arg))


def bound_names(tree: ast.AST) -> Iterator[str]:
    """Yield the names of arguments and assigned variables of a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.arg):
            yield node.arg


def problems(sources: dict[str, str], listed: int = 0) -> list[str]:
    """Return the limits that sources, by path, exceed, with some of the texts that exceed them."""
    rows_by_kind = defaultdict(list)
    names, classes = Counter(), Counter()
    for path, source in sources.items():
        tree = ast.parse(source)
        for kind, text in texts(tree):
            rows_by_kind[kind].append((path, text))
        names.update(bound_names(tree))
        public = (node.name for node in tree.body if isinstance(node, ast.ClassDef))
        classes.update(name for name in public if name[0] != "_" and name != "Method")
    report = []
    for kind, rows in rows_by_kind.items():
        words = [_words(text) for _, text in rows]
        total = sum(map(len, words))
        what_rate = 1000 * sum(row.count("what") for row in words) / max(total, 1)
        openings = [
            row for row, first in zip(rows, words, strict=True) if first[:1] and first[0] in QUESTION_WORDS
        ]
        share = 100 * len(openings) / len(rows)
        examples = [f"  {path}: {' '.join(text.split())[:90]}" for path, text in openings[:listed]]
        if what_rate > MAX_WHAT:
            report.append(f'{kind}: {what_rate:.1f} "what" per 1000 words (limit {MAX_WHAT:g})')
        if share > MAX_OPENINGS:
            report += [f"{kind}: {share:.1f} % open with a question word (limit {MAX_OPENINGS:g})", *examples]
    poor = {name: count for name, count in names.items() if name.rstrip("_") in FUNCTION_WORDS}
    share = 100 * sum(poor.values()) / max(names.total(), 1)
    if share > MAX_NAMES:
        worst = ", ".join(f"{name} {count}" for name, count in Counter(poor).most_common(8))
        report.append(f"names: {share:.1f} % are function words (limit {MAX_NAMES:g}): {worst}")
    report += [f"class {name} is defined {count} times" for name, count in classes.items() if count > 1]
    return report


def _text(node: ast.expr) -> str | None:
    """Return the value of a string constant, else None."""
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def _message(node: ast.expr) -> str:
    """Return the constant parts of a string or f-string of at least three words, else an empty string."""
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    text = "".join("X" if (value := _text(part)) is None else value for part in parts)
    return text if len(_words(text)) > 2 else ""


def _words(text: str) -> list[str]:
    return [word.lower() for word in re.findall(r"[A-Za-z][A-Za-z'-]*", text)]


def main() -> int:
    parser = argparse.ArgumentParser(description="check the plain English of texts and names")
    parser.add_argument("--list", type=int, default=3, metavar="N", help="number of examples of each problem")
    listed = parser.parse_args().list
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    report = problems({str(path.relative_to(ROOT)): path.read_text() for path in paths}, listed)
    print("\n".join(report) or "prose: all limits kept")
    return 1 if report else 0


if __name__ == "__main__":
    sys.exit(main())
