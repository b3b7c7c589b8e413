"""Description of methods for panels and job checks: name, parameters and presets. Does not import torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any

from ..documents import quote
from ..errors import LodgsError
from .parameters import Parameters

PRESETS = {
    "draft": "First look: minutes on two CPU cores",
    "standard": "An evening on a laptop, minutes on a GPU",
    "paper": "Schedule of the paper",
}
"""Presets of every method and their purpose."""


def no_split(parameters: Parameters) -> None:
    """Return None: every cell trains all levels."""
    return None


def never(parameters: Parameters) -> bool:
    """Return False."""
    return False


@dataclass(frozen=True)
class MethodInfo:
    """Description of a method, declared as ``METHOD`` by its package.

    Attributes:
        name: name in jobs, command lines and bundles.
        number: position in lists, also stored in .blend files: the next free number, never changed.
        label: label in panels.
        about: result of the method, as the end of a sentence that begins with the label.
        parameters: class of its parameters.
        presets: parameters of each of PRESETS.
        rule: name of its level-of-detail rule (``training.lod``); "" if none.
        merged_rule: name of the rule of merged levels (``parameters.merges``); "" if it is ``rule``.
        panel_parameters: parameters shown in panels, in addition to presets.
        from_base: True if training can start from splats (a job's ``base``) instead of the scene's points.
        streams_base: True if a base may stay on disk (``SplatRows``).
        suggested_for_base: True for the default method of imported splats.
        cell_values: values of parameters, by name, that override the job's in the cells of a large scene.
        capture_values: values of parameters, by name, that override the preset if the images are renders of
            the base.
        cell_method: method that trains the cells of a large scene: the method itself, or one whose merged
            splats are its base. "" if cells cannot be merged.
        split_parameters: split the parameters of a scene in cells into those of a run over the full scene,
            which trains the coarser levels, and those of the cells, which continue them. Returns None if
            every cell trains all levels.
        trains_on_device: return whether the backend gpu can make all steps with given parameters
            (``Method.device_steps``). The backend auto then considers it.
        unused: names of inherited parameters that this method ignores.
        package: package of the method as a module name, set at discovery.
    """

    name: str
    number: int
    label: str
    about: str
    parameters: type[Parameters]
    presets: Mapping[str, Parameters]
    rule: str = ""
    merged_rule: str = ""
    panel_parameters: tuple[str, ...] = ()
    from_base: bool = False
    streams_base: bool = False
    suggested_for_base: bool = False
    cell_method: str = ""
    split_parameters: Callable[[Any], tuple[Parameters, Parameters] | None] = no_split
    cell_values: Mapping[str, Any] = field(default_factory=dict)
    capture_values: Mapping[str, Any] = field(default_factory=dict)
    trains_on_device: Callable[[Any], bool] = never
    unused: tuple[str, ...] = ()
    package: str = ""

    @property
    def fields(self) -> list[Field]:
        """Parameters that can be set."""
        return [f for f in fields(self.parameters) if f.name not in self.unused]

    def rule_for(self, parameters: Any) -> str:
        """Return the name of the rule of a run's levels."""
        return self.merged_rule if self.merged_rule and parameters.merges else self.rule

    def preset(self, name: str) -> Parameters:
        """Return the parameters of a preset.

        Raises:
            LodgsError: unknown preset.
        """
        if name not in self.presets:
            raise LodgsError(f"Unknown preset: {quote(name)}.", f"Choose one of: {', '.join(self.presets)}.")
        return self.presets[name]

    def scaled_steps(self, preset: str, effort: float, changes: Mapping[str, Any]) -> dict[str, Any]:
        """Return changes of a preset with which all numbers of steps are multiplied by ``effort``.

        Steps of 0 stay 0; others are at least 1.

        Args:
            changes: further parameters that differ from the preset. Their steps are multiplied, too.

        Raises:
            LodgsError: unknown preset.
        """
        parameters, scaled = self.preset(preset), dict(changes)

        def scale(steps: int) -> int:
            return max(round(steps * effort), 1) if steps else 0

        for f in self.fields:
            value = changes.get(f.name, getattr(parameters, f.name))
            if f.metadata["unit"] == "steps" and effort != 1:
                is_row = isinstance(value, (tuple, list))
                scaled[f.name] = [scale(x) for x in value] if is_row else scale(value)
        return scaled
