"""Tables of what methods and rules declare: ``make tables`` writes docs/parameters.md and docs/controls.md.

A test fails where the pages are not what this writes, so a parameter or a control is described in one place.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import Field
from inspect import getdoc, getmodule
from math import inf
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from training.lod.rule import Control, Rule, rules  # noqa: E402
from training.methods import METHODS, PRESETS, MethodInfo  # noqa: E402

_WRITTEN = "<!-- Written by `make tables` from the declarations in {}; do not edit. -->\n"
_EXAMPLE = range(1, 6)
"""The levels of a scene that defaults are shown for."""


def parameters_page() -> str:
    """docs/parameters.md: what a job can set, method by method."""
    parts = [
        "# Parameters",
        _WRITTEN.format("training/methods/*/__init__.py")
        + "\nWhat a job's `[parameters]` and `--set NAME=VALUE` can change, and the value that each preset "
        "gives. Where a parameter has a value for each level (coarse to fine), a single one serves all.",
        _table(["preset", "what for"], PRESETS.items()),
    ]
    for method in METHODS.values():
        parts += [f"## {method.label}", _about(method)]
        rows = [
            [f"`{f.name}`", f.metadata["about"], _possible(f), f.metadata["unit"] or "",
             *(_value(getattr(method.preset(preset), f.name)) for preset in PRESETS)]
            for f in method.fields
        ]  # fmt: skip
        parts.append(_table(["parameter", "what", "possible", "unit", *PRESETS], rows))
    return "\n\n".join(parts) + "\n"


def controls_page() -> str:
    """docs/controls.md: what an eye can be told, rule by rule."""
    parts = [
        "# Controls",
        _WRITTEN.format("training/lod/rules/")
        + "\nWhat decides the detail that an eye sees: sliders in Blender (**By Distance**), options of "
        "`render` and `evaluate`, numbers in a bundle. What a bundle records of them is its own default, as "
        "FLoD's `gamma` is. Each method has one rule, and options that the rule "
        "does not have are refused. [The bundle](bundle.md#choosing-by-distance) has the formulas.",
    ]
    for rule in rules().values():
        users = [method.label for method in METHODS.values() if method.rule == rule.name]
        about = (getdoc(getmodule(rule)) or "").split("\n\n")[0].replace("\n", " ")
        parts += [f"## {rule.name}", f"{about} Used by: {', '.join(users) or 'no method'}."]
        rows = [
            [f"`--{control.name.replace('_', '-')}`", control.label, f"{control.about}.",
             _range(control), _default(rule, control)]
            for control in rule.controls
        ]  # fmt: skip
        parts.append(_table(["option", "in Blender", "what", "range", "default"], rows))
        needs = {
            "facts of the scene": rule.scene_facts,
            "facts of each level": rule.level_facts,
            "columns of the splats": rule.columns,
        }
        listed = [
            f"{what}: {', '.join(f'`{name}`' for name in names)}" for what, names in needs.items() if names
        ]
        adds = "add up" if rule.cumulative else "replace one another" if rule.complete else "belong together"
        always = " Its weights always count, for one level too." if rule.always_active else ""
        parts.append(f"Levels {adds}.{always} It needs {'; '.join(listed) or 'nothing else'}.")
    return "\n\n".join(parts) + "\n"


PAGES = {"parameters.md": parameters_page, "controls.md": controls_page}


def _about(method: MethodInfo) -> str:
    begins = "the scene's points or a base" if method.from_base else "the scene's points"
    rule = f"its detail is chosen by the rule [{method.rule}](controls.md#{method.rule})"
    return (
        f"`{method.name}`: {method.about}. It begins with {begins}; "
        f"{rule if method.rule else 'there is no detail to choose'}. "
        f"Blender's panel shows {', '.join(f'`{name}`' for name in method.offered)}."
    )


def _possible(f: Field) -> str:
    low, high, above, choices = (f.metadata[key] for key in ("low", "high", "above", "choices"))
    default, each = (f.default[0], ", each level") if isinstance(f.default, tuple) else (f.default, "")
    if isinstance(default, bool):
        return f"true, false{each}"
    if isinstance(default, str):
        return ", ".join(choices) + each
    least = f"{_value(low)} or more" if above is None else f"above {_value(above)}"
    if high < inf:
        least = f"{_value(low)} to {_value(high)}" if above is None else f"{least} to {_value(high)}"
    return least + (", whole" if isinstance(default, int) else "") + each


def _range(control: Control) -> str:
    if control.follows:
        return "the levels that there are"
    text = f"{_value(control.low)} to {_value(control.high)}" + (", whole" if control.whole else "")
    return text + (" pixels" if control.unit == "PIXEL" else "")


def _default(rule: Rule, control: Control) -> str:
    value = _value(rule.defaults(_EXAMPLE)[control.name])
    return f"of {len(_EXAMPLE)} levels {value}" if control.follows else value


def _value(value: object) -> str:
    if isinstance(value, tuple):
        return _value(value[0]) if len(set(value)) == 1 else ", ".join(map(_value, value))
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    for name, page in PAGES.items():
        (ROOT / "docs" / name).write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
