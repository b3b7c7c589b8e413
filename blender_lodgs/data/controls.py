"""Values of the controls of a scene's rule: set by the user, recorded, or default."""

from __future__ import annotations

import json

import bpy

from ...training.lod.rule import Control, find_rule
from . import metadata


def changed_controls(root: bpy.types.Object) -> dict[str, float]:
    """Return the values of the rule's controls that differ from the rule's defaults, by name."""
    rule = find_rule(root.lodgs.rule)
    if rule is None:
        return {}
    defaults = rule.defaults([item.number for item in root.lodgs.existing_levels])
    values = {control.name: control.validate(_value(root, control)) for control in rule.controls}
    return {name: value for name, value in values.items() if value != defaults[name]}


def update_controls(root: bpy.types.Object, recorded: dict[str, float] | None = None) -> None:
    """Set controls that the user has not set to recorded values, or to the rule's defaults for the levels.

    Args:
        recorded: values by name from a bundle or run; None keeps the previous ones.

    Raises:
        LodgsError: a value is invalid.
    """
    settings, rule = root.lodgs, find_rule(root.lodgs.rule)
    previous = metadata.read_facts(settings.recorded_controls)
    recorded = previous if recorded is None else recorded
    if rule is not None:
        numbers = [item.number for item in settings.existing_levels]
        defaults = {control.name: control.default for control in rule.controls}
        old_values = defaults | previous | metadata.read_facts(settings.initial_controls)
        new_values = (rule.defaults(numbers) if numbers else defaults) | recorded
        new_values = {control.name: control.validate(new_values[control.name]) for control in rule.controls}
        unset = [
            control
            for control in rule.controls
            if new_values[control.name] != old_values[control.name]
            and _value(root, control) == _short(old_values[control.name])
        ]
        unset.sort(key=lambda control: control.follows != "finest")  # setting it moves the coarsest along
        for control in unset:
            setattr(settings.controls, control.name, new_values[control.name])
        settings.initial_controls = json.dumps(new_values)
    settings.recorded_controls = json.dumps(recorded)


def _value(root: bpy.types.Object, control: Control) -> float:
    """Return the current value of a control."""
    return _short(getattr(root.lodgs.controls, control.name))


def _short(value: float) -> float:
    """Round a number to the digits of Blender's floats, which have fewer than those of the files."""
    return value if isinstance(value, int) else float(f"{value:.7g}")
