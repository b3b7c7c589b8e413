"""Results of ``make interop``: records from which ``make tables`` writes a page of the documentation."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

FILE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "tested-programs.json"
"""Records of the last run of each check, one per line."""
_KEYS = "check", "program", "format", "method"
"""Values that identify a record."""

Record = Mapping[str, Any]


def read_results(file: Path = FILE) -> list[Record]:
    """Return all records."""
    return json.loads(file.read_text("utf-8"))


def store_result(result: Record, file: Path = FILE) -> None:
    """Store the result of a check with today's date, in place of an earlier one.

    Args:
        result: JSON values: ``check``, one of "image", "walk", "values", "usd" and "page"; ``program`` and
            its ``version``; ``format``; ``method``, "" for random splats; ``passed``; and further results.
    """
    key = [result[name] for name in _KEYS]
    others = [old for old in read_results(file) if [old[name] for name in _KEYS] != key]
    rows = sorted(
        [*others, {**result, "date": datetime.now(UTC).date().isoformat()}],
        key=lambda row: [row[name] for name in _KEYS],
    )
    lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in rows)
    file.write_text(f"[\n{lines}\n]\n", "utf-8")
