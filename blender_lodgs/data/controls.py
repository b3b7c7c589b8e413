"""Values of the controls of a scene's rule: the user's, else recorded ones, else defaults."""

from __future__ import annotations

import json

import bpy

from ...training.lod.rule import Control, find_rule
from . import selection


def changed_controls(root: bpy.types.Object) -> dict[str, float]:
    """The values of the rule's controls that are not the rule's own, by name."""
    rule = find_rule(root.lodgs.rule)
    if rule is None:
        return {}
    own = rule.defaults([item.number for item in root.lodgs.levels if item.exists])
    values = {control.name: control.validate(_value(root, control)) for control in rule.controls}
    return {name: value for name, value in values.items() if value != own[name]}


def update_controls(root: bpy.types.Object, recorded: dict[str, float] | None = None) -> None:
    """Controls that nobody has set take what a bundle or a run records, else the rule's own for these levels.

    Args:
        recorded: values by name; None: those of before.

    Raises:
        LodgsError: a value is not possible.
    """
    settings, rule = root.lodgs, find_rule(root.lodgs.rule)
    before = selection.read_facts(settings.recorded)
    recorded = before if recorded is None else recorded
    if rule is not None:
        numbers = [item.number for item in settings.levels if item.exists]
        own = {control.name: control.default for control in rule.controls}
        begun = own | before | selection.read_facts(settings.begun)
        begins = (rule.defaults(numbers) if numbers else own) | recorded
        begins = {control.name: control.validate(begins[control.name]) for control in rule.controls}
        unset = [
            control
            for control in rule.controls
            if begins[control.name] != begun[control.name]
            and _value(root, control) == _short(begun[control.name])
        ]
        unset.sort(key=lambda control: control.follows != "finest")  # which takes the coarsest along
        for control in unset:
            setattr(settings.controls, control.name, begins[control.name])
        settings.begun = json.dumps(begins)
    settings.recorded = json.dumps(recorded)


def _value(root: bpy.types.Object, control: Control) -> float:
    """What a control is set to."""
    return _short(getattr(root.lodgs.controls, control.name))


def _short(value: float) -> float:
    """A number to as many digits as Blender's floats have, which are shorter than the files'."""
    return value if isinstance(value, int) else float(f"{value:.7g}")
