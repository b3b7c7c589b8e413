"""Results of checks with other programs, and the page made from them."""

import json
import os

import pytest

from tools import interop, interop_page, interop_results, interop_usd, interop_viewers, tables

RESULT = {
    "check": "image", "program": "Viewer", "version": "1", "format": "PLY", "method": "flod", "passed": True,
    "psnr": 31.25, "min_psnr": 30.0,
}  # fmt: skip


@pytest.fixture
def file(tmp_path, monkeypatch):
    file = tmp_path / "results.json"
    file.write_text("[]")
    monkeypatch.setattr(tables, "read_results", lambda: interop_results.read_results(file))
    return file


def test_new_results_replace_old_ones_of_the_same_check(file):
    for changes in ({}, {"method": "clod"}, {"version": "2", "psnr": 32.0}):
        interop_results.store_result({**RESULT, **changes}, file)
    rows = json.loads(file.read_text())
    assert [(row["method"], row["version"], row["psnr"]) for row in rows] == [
        ("clod", "1", 31.25),
        ("flod", "2", 32.0),
    ]
    assert len(file.read_text().splitlines()) == len(rows) + 2


def test_page_has_a_column_for_each_method_and_names_failures(file):
    interop_results.store_result(RESULT, file)
    interop_results.store_result({**RESULT, "method": "clod", "passed": False}, file)
    interop_results.store_result({**RESULT, "format": "SPZ"}, file)
    date = json.loads(file.read_text())[0]["date"]
    page = tables.programs_page()
    assert "| program | format | at least | FLoD | CLoD-GS | date |" in page
    assert f"| Viewer 1 | PLY | 30 | 31.2 | failed | {date} |" in page
    assert f"| Viewer 1 | SPZ | 30 | 31.2 |  | {date} |" in page


def test_committed_results_are_complete_and_passed():
    """Every viewer opened every format of every method, in the versions that the tools install."""
    methods, rows = interop_viewers.METHODS, interop_results.read_results()
    images = {
        (viewer.label, viewer.version, interop_viewers.FORMATS[kind].label, method)
        for viewer in interop_viewers.VIEWERS.values() for kind in viewer.formats for method in methods
    }  # fmt: skip
    usd = {
        (program, f".{ending}", method)
        for program in ("Blender", "usd-core") for ending in interop_usd.ENDINGS for method in methods
    }  # fmt: skip
    assert all(row["passed"] for row in rows)
    assert _keys("image", "program", "version", "format", "method") == images
    assert _keys("usd", "program", "format", "method") == usd
    assert len(_keys("walk", "program")) == len(interop_viewers.WALKS)
    assert len(_keys("page", "format")) == 2
    assert _keys("values", "version") == {(interop.VERSION,)}


def _keys(check, *names):
    rows = interop_results.read_results()
    return {tuple(row[name] for name in names) for row in rows if row["check"] == check}


@pytest.mark.skipif(os.name == "nt", reason="the fake browser is a shell script")
@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (["SuperSplat Viewer v1.36.2 | Engine v2.22.6", "Renderer: webgl2", "loaded"], (1.5, [])),
        (["TypeError: x is null", "loaded"], (1.5, ["TypeError: x is null"])),
        (["Renderer: webgl2"], (interop_page.TIMEOUT, [])),
    ],
)
def test_time_and_messages_of_a_page_are_read(tmp_path, monkeypatch, lines, expected):
    monkeypatch.setattr(interop_page, "cpu_time", lambda pid: 1.5)
    browser = tmp_path / "chromium"
    texts = [f'[1:2:1129/174336.2:INFO:CONSOLE:99] "{line}", source: file:///page.html (9)' for line in lines]
    browser.write_text("#!/bin/sh\ncat >&2 <<'END'\nother output\n" + "\n".join(texts) + "\nEND\n")
    browser.chmod(0o755)
    assert interop_page.open_page(str(browser), "file:///page.html") == expected
