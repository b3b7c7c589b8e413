"""The trainer's command line: ``lodgs --help``, or ``python -m training --help`` beside ``training``."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import traceback
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from . import VERSION
from .cli import COMMANDS, PROGRAM, check
from .errors import LodgsError, describe_system_error
from .runs import processes


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: the words after the program's name; None for this process's own.

    Returns:
        Exit code: 0 done, 1 crash, 2 bad input, 3 cancelled. Bad input is reported in one sentence.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # other programs read UTF-8, whatever the console uses
            stream.reconfigure(encoding=None if stream.isatty() else "utf-8", errors="backslashreplace")
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        return _run_command(arguments)
    except BrokenPipeError:  # the reader of our output has stopped
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        return 0
    except LodgsError as error:
        return _fail(str(error))
    except (OSError, MemoryError, RuntimeError) as error:
        if (described := describe_system_error(error)) is None:
            raise
        unnamed = isinstance(error, OSError) and error.filename is None
        return _fail((_output_error() if unnamed else "") or str(described))
    except KeyboardInterrupt:
        return 3
    except ModuleNotFoundError:
        if not (problems := check.environment()["problems"]):
            raise
        return _fail(f"{problems[0]} {check.INSTALL}")


def _run_command(arguments: list[str]) -> int:
    """Run one command and write its output; return its exit code."""
    if arguments == ["check"]:  # needs no packages
        code = check.run()
    else:
        processes.stop_with_parent()
        options = _parser(arguments).parse_args(arguments or ["--help"])
        code = _module(options.command).run(options)
        if options.command in ("train", "blocks"):  # their output is in the run folder, too
            return code
    if sys.stdout is not None:  # None: closed, or there is no console
        sys.stdout.flush()
    return code


def _output_error() -> str:
    """Return a sentence if standard output cannot be written, else ""."""
    try:
        print(flush=True)
    except OSError as error:
        return f"Cannot write to standard output: {error.strerror}."
    return ""


def _parser(arguments: list[str]) -> argparse.ArgumentParser:
    """Return the parser of all commands; only commands named in the arguments are imported."""
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Gaussian splats with levels of detail.")
    parser.add_argument("--version", action="version", version=f"lodgs {VERSION}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, about in COMMANDS.items():
        command = commands.add_parser(name, help=about)
        if name in arguments:
            _module(name).add_arguments(command)
    return parser


def _module(command: str):
    return import_module(f".cli.{command}", __package__)


def _fail(message: str) -> int:
    with suppress(OSError):  # a full disk
        print(f"error: {message}", file=sys.stderr)
    return 2


def run() -> NoReturn:
    """Run this process's command, and end the process with its exit code."""
    _open_streams()
    for name in ("SIGINT", "SIGTERM", "SIGBREAK"):  # SIGBREAK: Windows' CTRL_BREAK_EVENT
        if hasattr(signal, name):  # shells start background programs with SIGINT ignored
            signal.signal(getattr(signal, name), _interrupt)
    try:
        code = main()
    except SystemExit as stop:  # argparse has printed help or an error
        code = int(stop.code or 0)
    except KeyboardInterrupt:  # a second signal
        code = 3
    except Exception:
        with suppress(OSError):
            traceback.print_exc()
        code = 1
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, AttributeError):  # a full disk, or there is no console
            stream.flush()
    os._exit(code)  # native thread pools can hang a normal exit


def _interrupt(number: int, frame: object) -> NoReturn:
    """Stop the command; libraries that are interrupted in a call print no errors about unfinished objects."""
    sys.unraisablehook = lambda error: None
    raise KeyboardInterrupt


def _open_streams() -> None:
    """Open closed standard streams on the null device, so that no other file takes their numbers."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number


if __name__ == "__main__":
    run()
