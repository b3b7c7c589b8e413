"""Notices of the operating system about finished work, if the preferences enable them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from contextlib import suppress

import bpy

from .. import extension

_WINDOWS = (
    "Add-Type -AssemblyName System.Windows.Forms; $icon = New-Object System.Windows.Forms.NotifyIcon; "
    "$icon.Icon = [System.Drawing.SystemIcons]::Information; $icon.Visible = $true; "
    "$icon.ShowBalloonTip(10000, 'LODGS', $env:LODGS_NOTICE, 'Info'); Start-Sleep 10; $icon.Dispose()"
)


def notify(text: str) -> None:
    """Show a notice if the preferences enable it. Does nothing in background mode or without a program."""
    if bpy.app.background or not extension.preferences().notices:
        return
    command = notice_command(text)
    if shutil.which(command[0]) is None:
        return
    with suppress(OSError):
        subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=os.environ | {"LODGS_NOTICE": text}, creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )  # fmt: skip


def notice_command(text: str) -> list[str]:
    """Return the program of this system that shows a notice, with its arguments."""
    if sys.platform == "win32":
        return ["powershell", "-NoProfile", "-Command", _WINDOWS]
    if sys.platform == "darwin":
        script = 'on run argv\ndisplay notification (item 1 of argv) with title "LODGS"\nend run'
        return ["osascript", "-e", script, text]
    return ["notify-send", "--app-name=LODGS", "--", "LODGS", text]
