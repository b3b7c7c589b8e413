"""Methods and their parameters as text: ``lodgs methods``. No torch."""

from __future__ import annotations

import json
from textwrap import fill

from ..methods import METHODS, PRESETS, method_info
from ..optimize.parameters import possible

_WIDTH = 110


def describe_methods() -> str:
    """A line for each method: its name for jobs and commands, and what it makes."""
    widest = max(map(len, METHODS))
    return "\n".join(f"{m.name:<{widest}}  {m.label}: {m.about}" for m in METHODS.values())


def describe_method(name: str) -> str:
    """What a method makes, its presets, and each parameter's possible values, presets and help.

    Raises:
        LodgsError: there is no such method.
    """
    method = method_info(name)
    lines = [f"{method.label}: {method.about}.", f"Begins with points{' or a base' * method.from_base}.", ""]
    lines += [f"  {preset:<9} {text}" for preset, text in PRESETS.items()]
    for field in method.fields:
        unit = f" ({field.metadata['unit']})" if field.metadata["unit"] else ""
        each = ", for each level" if isinstance(field.default, tuple) else ""
        values = {preset: json.dumps(getattr(method.preset(preset), field.name)) for preset in PRESETS}
        alike = len(set(values.values())) == 1
        shown = values["draft"] if alike else ", ".join(f"{key} {value}" for key, value in values.items())
        lines += ["", f"{field.name}: {possible(field)}{unit}{each}", f"    {shown}"]
        lines += [fill(field.metadata["about"], _WIDTH, initial_indent="    ", subsequent_indent="    ")]
    return "\n".join(lines)
