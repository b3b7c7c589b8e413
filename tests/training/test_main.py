"""Exit codes of the command line: closed and full outputs, signals, and errors of the system."""

import errno
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from training import __main__
from training.cli import COMMANDS
from training.splats.gaussians import Splats
from training.splats.ply import write_ply

ROOT = Path(__file__).resolve().parents[2]
MISTAKES = {
    "train": "--scene a --out b --set wings=2",
    "blocks": "run missing",
    "methods": "unknown",
    "evaluate": "missing",
    "compare": "missing --out a",
    "reproduce": "flod --scene missing --out a",
    "render": "missing --view a.jpg --out a.png",
    "capture": "missing.ply --out a",
    "scene": "--from missing",
    "undistort": "missing",
    "model": "missing",
    "edit": "missing.ply --out a.ply",
    "compress": "missing.ply --out a.ply",
    "page": "missing.ply --out a",
    "info": "missing.ply",
}

pytestmark = pytest.mark.skipif(os.name == "nt", reason="shell redirections and signals of POSIX")


def shell(command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        f"exec '{sys.executable}' {command}",
        shell=True,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


def test_help_is_printed_without_a_command(capsys):
    with pytest.raises(SystemExit) as end:
        __main__.main([])
    printed = capsys.readouterr().out
    assert end.value.code == 0 and all(re.search(rf"^    {name}\b", printed, re.M) for name in COMMANDS)


@pytest.mark.parametrize("command", MISTAKES)
def test_mistakes_have_exit_code_2_without_standard_output(tmp_path, monkeypatch, command):
    """As under pythonw, and as a daemon."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert __main__.main([command, *MISTAKES[command].split()]) == 2
    assert COMMANDS.keys() - MISTAKES.keys() == {"serve", "check", "devices"}


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (">&-", 0, ""),
        ("<&- >&- 2>&-", 0, ""),
        (">/dev/full", 2, "error: Cannot write to standard output: No space left on device."),
    ],
)
def test_closed_and_full_outputs(words, code, message):
    result = shell(f"-m training methods {words}")
    assert (result.returncode, result.stderr.strip()) == (code, message)


@pytest.mark.parametrize("words", ["info missing 2>/dev/full", "unknown 2>/dev/full", "info missing 2>&-"])
def test_mistakes_keep_their_exit_code_if_they_cannot_be_reported(words):
    assert shell(f"-m training {words}").returncode == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_every_command_is_cancelled_by_signals(number):
    program = (
        "import time, types, training.__main__ as m\n"
        "def run(options): print('started', flush=True); time.sleep(1000)\n"
        "m._module = lambda name: types.SimpleNamespace(run=run, add_arguments=lambda parser: None)\n"
        "import sys; sys.argv[1:] = ['scene']; m.run()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "started\n"
    process.send_signal(number)
    assert process.communicate(timeout=200) == ("", "") and process.returncode == 3


def test_edits_start_without_torch(tmp_path):
    """Its import would take most of the time of an export."""
    rows = np.ones((3, 4), np.float32)
    write_ply(tmp_path / "a.ply", Splats(rows[:, :3], rows, rows[:, :3], rows[:, 0], rows[:, None, :3]))
    words = ["edit", str(tmp_path / "a.ply"), "--plain", str(tmp_path / "b.ply")]
    code = f"import sys; from training import __main__ as m; print(m.main({words}), 'torch' in sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert process.stdout.splitlines()[-1] == "0 False", process.stderr


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            OSError(errno.EMFILE, "Too many open files", "a.jpg"),
            "Cannot use a.jpg: Too many open files.",
        ),
        (OSError(errno.EFBIG, "File too large"), "Cannot continue: File too large. Raise the limit"),
        (
            OSError(errno.ENOSPC, "No space left on device", "b"),
            "Cannot use b: No space left on device.",
        ),
        (MemoryError(), "Not enough memory. Close other programs"),
        (RuntimeError("Symlink loop from 'a'"), "Cannot use 'a': the link leads to itself. Remove"),
    ],
)
def test_system_errors_are_one_message(monkeypatch, capsys, error, message):
    def fail(options):
        raise error

    monkeypatch.setattr("training.cli.info.run", fail)
    assert __main__.main(["info", "a.ply"]) == 2
    assert capsys.readouterr().err.startswith(f"error: {message}")
