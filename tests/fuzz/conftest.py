"""How many inputs each door gets, and the table at the end of a long round."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings

from tests.fuzz.doors import LONG, RECORDS, Record

REPORT = Path(__file__).resolve().parents[2] / "build" / "fuzz.json"
SHORT = 60
"""Inputs of a test in a short round, where it is not marked otherwise."""

_doors: dict[str, dict] = {}


def pytest_configure(config):
    config.addinivalue_line(
        "markers",
        "cases(short, weight): inputs of a fuzz test in a short round, and its weight in a long one",
    )


def pytest_collection_modifyitems(items):
    """Say how many inputs each test gets; tests say nothing of hypothesis's settings themselves."""
    ours = [item for item in items if item.path.is_relative_to(Path(__file__).parent)]
    for item in ours:
        item.add_marker("slow")
    tests = [item for item in ours if hasattr(item.function, "hypothesis")]
    weights = sum(_cases(item)[1] for item in tests)
    for item in {item.function: item for item in tests}.values():
        short, weight = _cases(item)
        common = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}
        if LONG:
            inputs = max(1, round(LONG * weight / weights))
            chosen = settings(max_examples=inputs, phases=[Phase.generate], **common)
        else:
            chosen = settings(max_examples=short, derandomize=True, **common)
        chosen(item.function)


def _cases(item) -> tuple[int, float]:
    mark = item.get_closest_marker("cases")
    return (SHORT, 1.0) if mark is None else (mark.kwargs.get("short", SHORT), mark.kwargs.get("weight", 1.0))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    """A test of a long round fails at its end, where its door had a defect."""
    before = {name: len(record.defects) for name, record in RECORDS.items()}
    result = yield
    for name, record in RECORDS.items():
        new = list(record.defects)[before.get(name, 0) :]
        assert not new, f"{name}: {', '.join(new)}"
    return result


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    """A worker hands its records to the process that started it."""
    records = {name: asdict(record) for name, record in RECORDS.items()}
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["fuzz"] = json.dumps(records)
    else:
        _collect(records)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    _collect(json.loads(getattr(node, "workeroutput", {}).get("fuzz", "{}")))


def _collect(records: dict[str, dict]) -> None:
    """Add one process's records to all."""
    for name, new in records.items():
        door = _doors.setdefault(name, asdict(Record()))
        for key in ("tried", "clean", "told"):
            door[key] += new[key]
        for key in ("slowest", "growth"):
            door[key] = max(door[key], new[key])
        for place, (count, *what) in new["defects"].items():
            door["defects"].setdefault(place, [0, *what])[0] += count


def pytest_terminal_summary(terminalreporter):
    """The table, and ``build/fuzz.json`` with each defect's traceback and input."""
    if not LONG or not _doors:
        return
    row = "{:<24} {:>8} {:>8} {:>8} {:>8} {:>10} {:>10}"
    terminalreporter.write_sep("=", "fuzz")
    terminalreporter.line(row.format("door", "tried", "clean", "told", "defects", "slowest s", "peak +MiB"))
    for name, door in sorted(_doors.items()):
        defects = sum(found[0] for found in door["defects"].values())
        counts = (door["tried"], door["clean"], door["told"], defects)
        terminalreporter.line(
            row.format(name, *counts, f"{door['slowest']:.2f}", f"{door['growth'] / 2**20:.0f}")
        )
    terminalreporter.line(f"{sum(door['tried'] for door in _doors.values())} inputs; {REPORT}")
    REPORT.parent.mkdir(exist_ok=True)
    REPORT.write_text(json.dumps(_doors, indent=1) + "\n")
