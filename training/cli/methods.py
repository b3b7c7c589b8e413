"""``lodgs methods``: list methods and their parameters. Needs no torch."""

from __future__ import annotations

import argparse
import json
from textwrap import fill

from ..methods import METHODS, PRESETS, method_info
from ..settings import describe_values

_WIDTH = 110


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="method whose parameters to list")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    print(describe_method(options.name) if options.name else describe_methods())
    return 0


def describe_methods() -> str:
    """Return a line for each method: its name in jobs and commands, its label, its result."""
    width = max(map(len, METHODS))
    return "\n".join(f"{m.name:<{width}}  {m.label}: {m.about}" for m in METHODS.values())


def describe_method(name: str) -> str:
    """Return a method's result, its presets, and the values and help of each parameter.

    Raises:
        LodgsError: unknown method.
    """
    method = method_info(name)
    lines = [f"{method.label}: {method.about}.", f"Starts from points{' or a base' * method.from_base}.", ""]
    lines += [f"  {preset:<9} {text}" for preset, text in PRESETS.items()]
    for field in method.fields:
        unit = f" ({field.metadata['unit']})" if field.metadata["unit"] else ""
        per_level = ", for each level" if isinstance(field.default, tuple) else ""
        values = {preset: json.dumps(getattr(method.preset(preset), field.name)) for preset in PRESETS}
        equal = len(set(values.values())) == 1
        text = values["draft"] if equal else ", ".join(f"{key} {value}" for key, value in values.items())
        lines += ["", f"{field.name}: {describe_values(field)}{unit}{per_level}", f"    {text}"]
        lines += [fill(field.metadata["about"], _WIDTH, initial_indent="    ", subsequent_indent="    ")]
    return "\n".join(lines)
