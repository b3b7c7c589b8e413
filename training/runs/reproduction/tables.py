"""Declarations of a paper's tables, and their texts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

from .subject import Subject


class Column(NamedTuple):
    """A column of a table: its title, the name of its measure, and its number of decimals."""

    title: str
    measure: str
    decimals: int = 2


PSNR, SSIM = Column("PSNR", "psnr"), Column("SSIM", "ssim", 3)
LPIPS = Column("LPIPS", "lpips_vgg", 3)
SPLATS, DRAWN = Column("splats", "splats", 0), Column("drawn", "drawn", 0)
FPS, TIME = Column("FPS", "fps", 0), Column("ms/frame", "ms", 1)
MEMORY = Column("memory (GB)", "memory", 3)
SIZE = Column("size (MB)", "megabytes", 1)

Measured = Mapping[str, float]
Value = Callable[[str, Column], float]
"""Returns our value of a row, by its label, in a column."""


@dataclass(frozen=True)
class Training:
    """A run that tables measure.

    Attributes:
        method: method, trained with the preset *paper*.
        changes: parameters that differ from the preset.
        base: name of the training whose splats it starts from, or "".
    """

    method: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    base: str = ""


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        label: label of the row in the paper.
        training: name of the training.
        measure: returns the measures of the training by name.
        published: the paper's values, one for each column; None where it has none.
    """

    label: str
    training: str
    measure: Callable[[Subject], Measured]
    published: Sequence[float | None] = ()


@dataclass(frozen=True)
class Trend:
    """A claim of a paper about a table.

    Attributes:
        claim: the claim as a sentence, with the paper's numbers.
        test: returns whether our values agree, and our numbers as text.
    """

    claim: str
    test: Callable[[Value], tuple[bool, str]]


@dataclass(frozen=True)
class Table:
    """A table or figure of a paper.

    Attributes:
        name: name in the paper, such as "Table 2".
        title: subject.
        data: scenes of the published numbers.
    """

    name: str
    title: str
    data: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    trends: Sequence[Trend] = ()


@dataclass(frozen=True)
class Paper:
    """A paper: its trainings by name, its tables, and its parts that are not reproduced, with reasons."""

    title: str
    trainings: Mapping[str, Training]
    tables: Sequence[Table]
    missing: Sequence[str]


def increases(claim: str, labels: Sequence[str], column: Column) -> Trend:
    """Return a trend: the values of rows increase in the order of ``labels``."""

    def test(value: Value) -> tuple[bool, str]:
        values = [value(label, column) for label in labels]
        ordered = all(first < second for first, second in pairwise(values))
        return ordered, ", ".join(f"{x:,.{column.decimals}f}" for x in values)

    return Trend(claim, test)


def loses_little(claim: str, full: str, reduced: str, quality: float, share: float) -> Trend:
    """Return a trend: ``reduced`` loses little quality to ``full`` with few of its splats.

    It holds with at most ``quality`` dB of loss and at most ``share`` of the splats.
    """

    def test(value: Value) -> tuple[bool, str]:
        loss = value(full, PSNR) - value(reduced, PSNR)
        ratio = value(reduced, SPLATS) / value(full, SPLATS)
        return loss <= quality and ratio <= share, f"{loss:.2f} dB at {ratio:.0%} of the splats"

    return Trend(claim, test)


def format_table(table: Table, measured: Mapping[str, Measured]) -> str:
    """Format a table with our values, the published ones in brackets, and its trends as Markdown.

    Args:
        measured: our measures by the label of their row.
    """

    def cell(row: Row, number: int, column: Column) -> str:
        ours = _number(measured[row.label].get(column.measure), column.decimals)
        published = row.published[number] if number < len(row.published) else None
        return ours if published is None else f"{ours} ({_number(published, column.decimals)})"

    lines = [f"### {table.name}: {table.title}", "", f"In brackets: published, on {table.data}.", ""]
    lines.append("| | " + " | ".join(column.title for column in table.columns) + " |")
    lines.append("|---|" + "---:|" * len(table.columns))
    for row in table.rows:
        cells = (cell(row, number, column) for number, column in enumerate(table.columns))
        lines.append(f"| {row.label} | " + " | ".join(cells) + " |")
    lines.append("")
    for trend in table.trends:
        holds, numbers = trend.test(lambda label, column: measured[label][column.measure])
        lines.append(f"- {'Holds' if holds else 'Does not hold'}: {trend.claim} Ours: {numbers}.")
    return "\n".join(lines).rstrip() + "\n"


def _number(value: float | None, decimals: int) -> str:
    return "–" if value is None else f"{value:,.{decimals}f}"
