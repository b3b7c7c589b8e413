"""The check of other programs."""

import os

import pytest

from tools import interop

pytestmark = pytest.mark.skipif(os.name == "nt", reason="fake programs are shell scripts")


@pytest.mark.parametrize(
    ("version", "problem"),
    [
        ("v20.20.2", "Node.js v20.20.2 is too old."),
        ("v22.0.0", ""),
        ("", "Node.js of unknown version is too old."),
        (None, "Node.js or npm is not installed."),
    ],
)
def test_old_node_is_refused(tmp_path, monkeypatch, capsys, version, problem):
    for name in ("npm", *(["node"] if version is not None else [])):
        (tmp_path / name).write_text(f"#!/bin/sh\necho {version}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert interop.node_problem() == problem
    if problem:
        assert interop.main() == 2
        assert capsys.readouterr().out == (
            f"interop: {problem} Install Node.js 22 or newer with npm (nodejs.org) and repeat.\n"
        )
