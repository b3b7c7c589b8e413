"""Settings: dataclass fields that declare their values, help and unit. Does not import torch.

Checks, options of commands, properties in Blender and tables in the documentation are generated from the
declarations: parameters of methods, keys of jobs and others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import Field, field, fields
from math import inf, isfinite
from typing import Any

from .documents import quote
from .errors import LodgsError

MAX_INTEGER = 2**31 - 1
"""Maximum value of any integer setting."""
MAX_NUMBER = 1e9
"""Maximum value of any other numeric setting."""


def setting(
    default: Any,
    about: str,
    *,
    label: str = "",
    low: float = 0,
    high: float = inf,
    above: float | None = None,
    soft: tuple[float | None, float | None] = (None, None),
    unit: str = "",
    choices: Iterable[str] | Mapping[str, str] = (),
    path: str = "",
    metavar: str = "",
    **extra: Any,
) -> Any:
    """Create a dataclass field that declares a setting. The arguments are in its ``metadata``, by name.

    Args:
        default: a bool, int, float or str, or a tuple of one of these. Determines the type of values.
        about: help text, one or more sentences.
        label: label in panels; "" derives it from the name.
        low, high: inclusive bounds of a number, further limited by MAX_INTEGER or MAX_NUMBER.
        above: exclusive lower bound, in place of ``low``.
        soft: bounds of sliders; None is the corresponding bound of values.
        unit: "px", "steps", ...; "" for a pure number.
        choices: valid values of a str, possibly with descriptions; empty for any text.
        path: "file" or "folder" if a str is a path.
        metavar: placeholder of the value in the help of commands; "" derives it from the unit.
        extra: additional metadata for the code that owns the setting.
    """
    if not isinstance(choices, Mapping):
        choices = dict.fromkeys(choices, "")
    metadata = {
        "about": about, "label": label, "low": low, "high": high, "above": above, "soft": soft, "unit": unit,
        "choices": choices, "path": path, "metavar": metavar,
    }  # fmt: skip
    return field(default=default, metadata=metadata | extra)


def settings_of(declaration: Any) -> dict[str, Field]:
    """Return the settings of a dataclass or an instance of one, by name."""
    return {f.name: f for f in fields(declaration) if "about" in f.metadata}


def label_of(f: Field) -> str:
    """Return the label of a setting in panels."""
    return f.metadata["label"] or f.name.replace("_", " ").title()


def default_of(f: Field) -> bool | int | float | str:
    """Return the default of a setting, or the first entry of a tuple."""
    return f.default[0] if isinstance(f.default, tuple) else f.default  # pyrefly: ignore[bad-return]


def describe_values(f: Field) -> str:
    """Describe the valid values of a setting or tuple entry, as "a number above 0 and at most 1"."""
    low, high, above, choices = (f.metadata[name] for name in ("low", "high", "above", "choices"))
    default = default_of(f)
    if isinstance(default, bool):
        return "true or false"
    if isinstance(default, str):
        return f"one of: {', '.join(choices)}" if choices else "a text in quotation marks"
    kind = "a whole number" if isinstance(default, int) else "a number"
    minimum = f"of at least {low}" if above is None else f"above {above}"
    return f"{kind} {minimum}" + (f" and at most {high}" if high < inf else "")


def check_value(f: Field, value: Any) -> Any:
    """Convert a value to the type of a setting or of its tuple entries.

    Raises:
        LodgsError: wrong type, or out of bounds.
    """
    default = default_of(f)
    low, high, above, choices = (f.metadata[name] for name in ("low", "high", "above", "choices"))
    if isinstance(default, bool):
        valid = isinstance(value, bool)
    elif isinstance(default, str):
        valid = isinstance(value, str) and (not choices or value in choices)
    else:
        integer = isinstance(value, int) and not isinstance(value, bool)
        valid = integer or (isinstance(default, float) and isinstance(value, float) and isfinite(value))
        valid = valid and value <= high and (value >= low if above is None else value > above)
        limit = MAX_INTEGER if isinstance(default, int) else MAX_NUMBER
        if valid and value > limit:
            raise LodgsError(f"{f.name} = {quote(value)} is too large.", f"Use at most {limit:g}.")
    if not valid:
        raise LodgsError(f"{f.name} = {quote(value)} is invalid.", f"Use {describe_values(f)}.")
    return type(default)(value)
