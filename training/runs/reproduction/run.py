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
from ...splats.dialects import Warn, ignore
from ..folder import RunFolder
from ..job import Job
from ..several import NamedJob, ReducedJobs, Train, check_different_names, train_in_turn
from .subject import Subject
from .tables import Measured, Paper, Table, format_table

PAPERS = ("flod", "octree", "clod", "lodge", "tree")
"""Names of the papers; each has a module."""


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


def make_jobs(paper: Paper, names: Sequence[str], jobs: ReducedJobs, out: Path) -> list[Job]:
    """Return the jobs of trainings of a paper on a scene.

    Args:
        names: names of the trainings.
        out: folder of the runs of the scene.
    """
    result = []
    for name in names:
        training = paper.trainings[name]
        base = str(run_folder(out, training.base)) if training.base else ""
        result.append(jobs.job(training.method, run_folder(out, name), training.changes, base))
    return result


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
        effort: fraction of the work of the preset *paper*, see ``ReducedJobs``.
        keys: further keys of the jobs, such as ``image_scale``.
        warn, notify: receive warnings, and sentences about progress.

    Returns:
        The contents of ``tables.md``.

    Raises:
        LodgsError: there is no such table, two scenes have the same name, or a training fails.
    """
    paper = load_paper(name)
    check_different_names(scenes)
    chosen = chosen_tables(paper, tables)
    needed = _needed_trainings(paper, chosen)
    jobs = []
    for scene in scenes:
        place = scene.resolve().name
        on_scene = make_jobs(paper, needed, ReducedJobs(scene, "paper", effort, keys or {}), out / place)
        jobs += [NamedJob(f"{place}, {label}", job) for label, job in zip(needed, on_scene, strict=True)]
    values: dict[tuple[str, str], list[Measured]] = {}
    sizes: dict[str, str] = {}
    problems = train_in_turn(jobs, train, notify)
    for training, (text, job), problem in zip(needed * len(scenes), jobs, problems, strict=True):
        if problem:
            raise LodgsError(f"Cannot train {text}: {problem}", f"See {job.out}.")
        notify(f"Measuring {text}")
        subject = Subject(Path(job.out), warn)
        sizes[Path(job.scene).name] = subject.size
        for table in chosen:
            for row in table.rows:
                if row.training == training:
                    values.setdefault((table.name, row.label), []).append(row.measure(subject))
    measured = {
        table.name: {row.label: _mean(values[table.name, row.label]) for row in table.rows}
        for table in chosen
    }
    lines = [format_paper(paper, chosen, measured, sizes, effort), *format_trainings(needed, jobs)]
    text = "\n".join(lines) + "\n"
    _write_results(out, measured, text)
    return text


def _write_results(out: Path, measured: Mapping, text: str) -> None:
    create_folder(out)
    with atomic_write(out / "tables.json") as temporary:
        Path(temporary).write_text(json.dumps(measured, indent=1), encoding="utf-8")
    with atomic_write(out / "tables.md") as temporary:
        Path(temporary).write_text(text, encoding="utf-8")


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
    sizes: Mapping[str, str],
    effort: float,
) -> str:
    """Format tables with their values, and the parts of the paper that are missing, as Markdown.

    Args:
        sizes: size of the images by the name of each scene.
    """
    names = ", ".join(f"{name} ({size} pixels)" for name, size in sizes.items())
    lines = [f"## {paper.title}", "", f"Our values: {names}, {effort:g} times the steps of the paper."]
    lines += [
        "Published values are from other scenes, so only the trends can be compared.",
        "A single training varies by about 0.2 dB.",
        "",
    ]
    lines += [format_table(table, measured[table.name]) for table in tables]
    lines += ["Not reproduced:", "", *(f"- {text}" for text in paper.missing)]
    if missing := missing_line(None):
        lines.append(f"- {missing}")
    return "\n".join(lines) + "\n"


def format_trainings(names: Sequence[str], jobs: Sequence[NamedJob]) -> list[str]:
    """Format the steps and seconds of finished trainings, as means over the scenes, as lines of Markdown.

    Args:
        names: names of the trainings.
        jobs: jobs in this order, of one scene after the other.
    """
    lines = ["", "| training | steps | seconds |", "|---|---:|---:|"]
    for number, name in enumerate(names):
        ends = [RunFolder(job.out).end_event() or {} for _, job in jobs[number :: len(names)]]
        seconds = [end["seconds"] for end in ends if "seconds" in end]
        steps = np.mean([end.get("steps", jobs[number].job.steps) for end in ends])
        cells = f"{steps:,.0f} | {np.mean(seconds) if seconds else 0:,.0f}"
        lines.append(f"| {name} | {cells} |")
    return lines
