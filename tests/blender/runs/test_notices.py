"""Notices of the operating system: only in a window, and if the preferences enable them."""

import subprocess
import sys
from types import SimpleNamespace

import pytest


@pytest.mark.parametrize(
    ("background", "enabled", "program", "count"),
    [(False, True, "x", 1), (True, True, "x", 0), (False, False, "x", 0), (False, True, None, 0)],
)
def test_notices_need_a_window_the_preference_and_a_program(
    bpy, lodgs, monkeypatch, background, enabled, program, count
):
    notices, started = lodgs("runs.notices"), []
    monkeypatch.setattr(notices, "bpy", SimpleNamespace(app=SimpleNamespace(background=background)))
    monkeypatch.setattr(notices.extension, "preferences", lambda: SimpleNamespace(notices=enabled))
    monkeypatch.setattr(notices.shutil, "which", lambda name: program)
    monkeypatch.setattr(subprocess, "Popen", lambda command, **options: started.append(options["env"]))
    notices.notify("Garden: Finished")
    assert [env["LODGS_NOTICE"] for env in started] == ["Garden: Finished"] * count


@pytest.mark.parametrize(
    ("platform", "program"), [("linux", "notify-send"), ("darwin", "osascript"), ("win32", "powershell")]
)
def test_texts_are_not_executed(lodgs, monkeypatch, platform, program):
    """The text is an argument or an environment variable, never a part of a script."""
    monkeypatch.setattr(sys, "platform", platform)
    first, *arguments = lodgs("runs.notices").notice_command('"; rm -rf ~')
    assert first == program
    assert all(argument == '"; rm -rf ~' or "rm -rf" not in argument for argument in arguments)


def test_notices_are_off_by_default(bpy, lodgs):
    assert not lodgs("extension").preferences().notices
