"""Comparisons of one or several scenes as a page of Markdown."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .measures import PURPOSES, SHARE

_DISTANCE_HEAD = "8 times as far (ms)"


def _number(value: float | None, decimals: int = 0, factor: float = 1.0) -> str:
    return "–" if value is None else f"{factor * value:,.{decimals}f}"


_COLUMNS: tuple[tuple[str, Callable[[dict], str]], ...] = (
    ("steps", lambda run: _number(run["steps"] or None)),
    ("splats", lambda run: _number(run["points"][-1]["splats"])),
    ("PSNR (dB)", lambda run: _number(run["points"][-1]["psnr"], 2)),
    ("SSIM", lambda run: _number(run["points"][-1]["ssim"], 3)),
    ("LPIPS (VGG)", lambda run: _number(run["points"][-1]["lpips_vgg"], 3)),
    ("PSNR with N splats", lambda run: _number(run["at_share"], 2)),
    ("PSNR by distance", lambda run: _number(_selected(run, "psnr"), 2)),
    ("splats by distance", lambda run: _number(_selected(run, "splats"))),
    ("drawn by distance", lambda run: _number(_selected(run, "drawn"))),
    (_DISTANCE_HEAD, lambda run: _number(run["farther"][-1]["frame_s"], 1, 1e3) if run["farther"] else "–"),
    ("loaded", lambda run: _number(run["loaded"])),
    ("largest jump", lambda run: _number(run["largest_jump"], 2)),
    ("file (MB)", lambda run: _number(run["megabytes"], 1)),
    ("memory to draw (MB)", lambda run: _number(run["frame_memory"], 0, 1e-6)),
    ("training (s)", lambda run: _number(run["seconds"])),
)
"""Columns of a scene's table: head, and text of a run of ``compare.json``."""


def _selected(run: dict, name: str) -> float | None:
    return run["by_distance"][name] if run["by_distance"] else None


def format_results(reports: Sequence[dict]) -> str:
    """Format the contents of ``compare.json`` of scenes as Markdown.

    It begins with the best method for each purpose. Of several scenes, the mean comes before each scene.
    """
    lines = ["## Choice of a method", "", *_choice(reports), ""]
    if len(reports) > 1:
        lines += ["## Means over the scenes", "", *_means(reports), ""]
    for report in reports:
        width, height = report["size"]
        photos = "held-out photos" if report["held_out"] else "training photos (none are held out)"
        lines += [
            f"## {report['scene']}",
            "",
            f"{report['measured_views']} {photos} of {width}x{height} pixels. "
            f"N = {report['compared_splats']:,} splats, a quarter of the median finest level.",
            "",
        ]
        columns = [(head, [text(run) for run in report["runs"]]) for head, text in _COLUMNS]
        columns = [(head, cells) for head, cells in columns if any(cell != "–" for cell in cells)]
        lines += _table(
            ["method", *(head for head, _ in columns)],
            [[run["label"], *(cells[row] for _, cells in columns)] for row, run in enumerate(report["runs"])],
        )
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _choice(reports: Sequence[dict]) -> list[str]:
    """Return a table of the best method of each scene for each purpose."""
    answers = [
        {row["purpose"]: f"{row['best']} ({row['measure']})" for row in report["answers"]}
        for report in reports
    ]
    rows = [[purpose.name, *(scene.get(purpose.name, "–") for scene in answers)] for purpose in PURPOSES]
    return _table(["purpose", *(report["scene"] for report in reports)], rows, "|---" * (len(reports) + 1))


def _means(reports: Sequence[dict]) -> list[str]:
    """Return a table of means over the scenes, of methods that were trained on all of them."""
    scenes = [{run["label"]: run for run in report["runs"] if not run["baseline"]} for report in reports]
    labels = [label for label in scenes[0] if all(label in scene for scene in scenes)]
    counts = [report["compared_splats"] for report in reports]
    rows = []
    for label in labels:
        runs = [scene[label] for scene in scenes]
        finest = [run["points"][-1] for run in runs]
        loss = [run["at_share"] - point["psnr"] if run["at_share"] is not None else None
                for run, point in zip(runs, finest, strict=True)]  # fmt: skip
        distance = [(_selected(run, "psnr"), _selected(run, "splats")) for run in runs]
        has_rule = all(psnr is not None for psnr, _ in distance)
        shares = (
            [splats / point["splats"] for (_, splats), point in zip(distance, finest, strict=True)]
            if has_rule
            else []
        )
        rows.append([
            label,
            _number(np.mean([point["psnr"] for point in finest]), 2),
            _mean([run["at_share"] for run in runs], 2),
            _mean(loss, 2),
            _mean([psnr for psnr, _ in distance], 2),
            f"{np.mean(shares):.0%}" if has_rule else "–",
            _mean([run["farther"][-1]["frame_s"] * 1e3 if run["farther"] else None for run in runs], 1),
            _mean([run["loaded"] / count * SHARE for run, count in zip(runs, counts, strict=True)], 2),
            _mean([run["largest_jump"] for run in runs], 2),
            _mean([run["seconds"] for run in runs], 0),
        ])  # fmt: skip
    heads = [
        "method", "PSNR (dB)", "PSNR with N splats", "change to N splats (dB)", "PSNR by distance",
        "splats by distance", _DISTANCE_HEAD, "loaded, of the median finest level", "largest jump",
        "training (s)",
    ]  # fmt: skip
    return _table(heads, rows)


def _mean(values: Sequence[float | None], decimals: int) -> str:
    numbers = [value for value in values if value is not None]
    return _number(float(np.mean(numbers)), decimals) if len(numbers) == len(values) else "–"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], alignment: str = "") -> list[str]:
    alignment = alignment or "|---" + "|---:" * (len(heads) - 1)
    return [f"| {' | '.join(heads)} |", f"{alignment}|", *(f"| {' | '.join(row)} |" for row in rows)]
