"""The trainer's command line: ``lodgs --help``, or ``python -m training --help`` beside ``training``."""

from __future__ import annotations

import argparse
import io
import os
import sys
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from . import VERSION
from .cli import COMMANDS, PROGRAM, check
from .errors import LodgsError, is_out_of_memory
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
    if arguments == ["check"]:  # needs no packages
        return check.run()
    processes.stop_with_parent()
    try:
        options = _parser(arguments).parse_args(arguments)
        code = _module(options.command).run(options)
        if options.command not in ("train", "blocks"):  # their output is in the run folder, too
            sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of our output has stopped
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        return 0
    except LodgsError as error:
        return _fail(str(error))
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        return _fail("Not enough memory. Close other programs, or reduce the size of the task.")
    except OSError as error:
        return _fail(str(error.strerror or error) + (f" ({error.filename})" if error.filename else ""))
    except KeyboardInterrupt:
        return 3
    except ModuleNotFoundError:
        if not (problems := check.environment()["problems"]):
            raise
        return _fail(f"{problems[0]} {check.INSTALL}")


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
    print(f"error: {message}", file=sys.stderr)
    return 2


def run() -> NoReturn:
    """Run this process's command, and end the process with its exit code."""
    code = main()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # a full disk
            stream.flush()
    os._exit(code)  # native thread pools can hang a normal exit


if __name__ == "__main__":
    run()
