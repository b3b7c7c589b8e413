"""Number of inputs per entry point, and the table at the end of a long round."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings

from tests.fuzz.entry_points import LONG, RECORDS, Record

BUILD = Path(__file__).resolve().parents[2] / "build"
SHORT = 60
"""Default number of inputs of a test in a short round."""

_entry_points: dict[str, dict] = {}


def pytest_configure(config):
    config.addinivalue_line(
        "markers",
        "cases(short, weight): inputs of a fuzz test in a short round, and its weight in a long one",
    )


def pytest_collection_modifyitems(items):
    """Set hypothesis's settings, including the number of inputs, for each test."""
    fuzz_items = [item for item in items if item.path.is_relative_to(Path(__file__).parent)]
    for item in fuzz_items:
        item.add_marker("slow")
    tests = [item for item in fuzz_items if hasattr(item.function, "hypothesis")]
    weights = sum(_cases(item)[1] for item in tests)
    for item in {item.function: item for item in tests}.values():
        short, weight = _cases(item)
        common = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}
        if LONG:
            inputs = max(1, round(LONG * weight / weights))
            profile = settings(max_examples=inputs, phases=[Phase.generate], **common)
        else:
            profile = settings(max_examples=short, derandomize=True, **common)
        profile(item.function)


def _cases(item) -> tuple[int, float]:
    mark = item.get_closest_marker("cases")
    return (SHORT, 1.0) if mark is None else (mark.kwargs.get("short", SHORT), mark.kwargs.get("weight", 1.0))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    """Let a test of a long round fail at its end if its entry point had a defect."""
    counts = {name: len(record.defects) for name, record in RECORDS.items()}
    result = yield
    for name, record in RECORDS.items():
        new = list(record.defects)[counts.get(name, 0) :]
        assert not new, f"{name}: {', '.join(new)}"
    return result


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    """Pass a worker's records to the main process."""
    records = {name: asdict(record) for name, record in RECORDS.items()}
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["fuzz"] = json.dumps(records)
    else:
        _collect(records)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    _collect(json.loads(getattr(node, "workeroutput", {}).get("fuzz", "{}")))


def _collect(records: dict[str, dict]) -> None:
    """Add one process's records to the totals."""
    for name, new in records.items():
        totals = _entry_points.setdefault(name, asdict(Record()))
        for key in ("tried", "accepted", "rejected"):
            totals[key] += new[key]
        for key in ("slowest", "growth"):
            totals[key] = max(totals[key], new[key])
        for location, (count, *details) in new["defects"].items():
            totals["defects"].setdefault(location, [0, *details])[0] += count


def pytest_terminal_summary(terminalreporter):
    """Print the table, and write each defect's traceback and input to ``build/fuzz.json``.

    The file of Blender's import operators is ``build/fuzz_blender.json``.
    """
    if not LONG or not _entry_points:
        return
    row = "{:<24} {:>8} {:>8} {:>8} {:>8} {:>10} {:>10}"
    terminalreporter.write_sep("=", "fuzz")
    terminalreporter.line(
        row.format("entry point", "tried", "accepted", "rejected", "defects", "slowest s", "peak +MiB")
    )
    for name, totals in sorted(_entry_points.items()):
        defects = sum(defect[0] for defect in totals["defects"].values())
        counts = (totals["tried"], totals["accepted"], totals["rejected"], defects)
        terminalreporter.line(
            row.format(name, *counts, f"{totals['slowest']:.2f}", f"{totals['growth'] / 2**20:.0f}")
        )
    in_blender = all(name.startswith("Blender ") for name in _entry_points)
    report = BUILD / ("fuzz_blender.json" if in_blender else "fuzz.json")
    terminalreporter.line(f"{sum(totals['tried'] for totals in _entry_points.values())} inputs; {report}")
    report.parent.mkdir(exist_ok=True)
    report.write_text(json.dumps(_entry_points, indent=1) + "\n")
