"""Training and measurement of a paper's tables."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LodgsError
from ...evaluate.lpips import missing_line
from ...files import atomic_write, create_folder
from ...methods import method_info
from ...splats.dialects import Warn, ignore
from ..folder import RunFolder
from ..job import Job
from .subject import Subject
from .tables import Measured, Paper, Table, format_table

PAPERS = ("flod", "octree", "clod", "lodge", "tree")
"""Names of the papers; each has a module."""

Train = Callable[[Job, str], str]
"""Trains or resumes a job, with a text for its progress; returns the reason of a failure, or ""."""


def load_paper(name: str) -> Paper:
    """Return the declaration of a paper."""
    return import_module(f".{name}", __package__).PAPER


def chosen_tables(paper: Paper, names: Collection[str]) -> list[Table]:
    """Return the tables with these numbers or names, such as "2" or "Figure 3"; all without any.

    Raises:
        LodgsError: there is no such table.
    """
    tables = {table.name: table for table in paper.tables}
    requested = [name if name in tables else f"Table {name}" for name in names]
    requested = [name if name in tables else name.replace("Table", "Figure") for name in requested]
    if unknown := [name for name, table in zip(names, requested, strict=True) if table not in tables]:
        raise LodgsError(
            f"Cannot reproduce table {unknown[0]}: it is not declared.", f"Choose of {', '.join(tables)}."
        )
    return [tables[name] for name in requested] if requested else list(paper.tables)


def make_job(paper: Paper, name: str, scene: Path, out: Path, effort: float, keys: Mapping[str, Any]) -> Job:
    """Return the job of a training of a paper on a scene.

    Args:
        out: folder of the runs of the scene.
        keys: further keys of the job.
    """
    training = paper.trainings[name]
    base = str(run_folder(out, training.base)) if training.base else ""
    parameters = method_info(training.method).scaled_steps("paper", effort, training.changes)
    return Job.from_dict({
        "scene": str(scene), "out": str(run_folder(out, name)), "method": training.method, "base": base,
        "preset": "paper", "parameters": parameters, **keys,
    })  # fmt: skip


def run_folder(out: Path, name: str) -> Path:
    """Return the run folder of a training by its name."""
    return out / "".join(letter if letter.isalnum() else "_" for letter in name.lower())


def reproduce(
    name: str,
    scenes: Sequence[Path],
    out: Path,
    train: Train,
    *,
    tables: Collection[str] = (),
    effort: float = 1.0,
    keys: Mapping[str, Any] | None = None,
    warn: Warn = ignore,
    notify: Callable[[str], object] = ignore,
) -> str:
    """Train the runs behind tables of a paper, measure them, and write ``tables.md`` and ``tables.json``.

    Args:
        name: one of PAPERS.
        scenes: COLMAP scenes. Values are means over them.
        out: folder of the runs and of the results. The same call resumes.
        train: trains a job.
        tables: numbers or names of tables; all without any.
        effort: factor on all numbers of steps of the preset *paper*.
        keys: further keys of the jobs, such as ``image_scale``.
        warn, notify: receive warnings, and sentences about progress.

    Returns:
        The contents of ``tables.md``.

    Raises:
        LodgsError: there is no such table, or a training fails.
    """
    paper = load_paper(name)
    chosen = chosen_tables(paper, tables)
    measured: dict[str, dict[str, dict[str, float]]] = {}
    values: dict[tuple[str, str], list[Measured]] = {}
    for scene in scenes:
        folder = out / scene.resolve().name
        needed = _needed_trainings(paper, chosen)
        for number, training in enumerate(needed, 1):
            job = make_job(paper, training, scene, folder, effort, keys or {})
            text = f"{scene.resolve().name}, {training} ({number} of {len(needed)})"
            if RunFolder(job.out).state() != "done" and (problem := train(job, f"Training {text}")):
                raise LodgsError(f"Cannot train {text}: {problem}", f"See {job.out}.")
            notify(f"Measuring {text}")
            subject = Subject(Path(job.out), warn)
            for table in chosen:
                for row in table.rows:
                    if row.training == training:
                        values.setdefault((table.name, row.label), []).append(row.measure(subject))
    for table in chosen:
        rows = {row.label: _mean(values[table.name, row.label]) for row in table.rows}
        measured[table.name] = rows
    text = format_paper(paper, chosen, measured, scenes, effort)
    create_folder(out)
    with atomic_write(out / "tables.json") as temporary:
        Path(temporary).write_text(json.dumps(measured, indent=1), encoding="utf-8")
    with atomic_write(out / "tables.md") as temporary:
        Path(temporary).write_text(text, encoding="utf-8")
    return text


def _needed_trainings(paper: Paper, tables: Sequence[Table]) -> list[str]:
    """Return the names of the trainings that tables measure, after those that they start from."""
    names: list[str] = []
    for training in (row.training for table in tables for row in table.rows):
        for name in (paper.trainings[training].base, training):
            if name and name not in names:
                names.append(name)
    return names


def _mean(rows: Sequence[Measured]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def format_paper(
    paper: Paper,
    tables: Sequence[Table],
    measured: Mapping[str, Mapping[str, Measured]],
    scenes: Sequence[Path],
    effort: float,
) -> str:
    """Format tables with their values, and the parts of the paper that are missing, as Markdown."""
    names = ", ".join(scene.resolve().name for scene in scenes)
    lines = [f"## {paper.title}", "", f"Our values: {names}, {effort:g} times the steps of the paper."]
    lines += ["Published values are from other scenes, so only the trends can be compared.", ""]
    lines += [format_table(table, measured[table.name]) for table in tables]
    lines += ["Not reproduced:", "", *(f"- {text}" for text in paper.missing)]
    if missing := missing_line(None):
        lines.append(f"- {missing}")
    return "\n".join(lines) + "\n"
