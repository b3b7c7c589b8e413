"""What a method says of itself without torch: its name, parameters and presets, for panels and job checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any

from ..documents import quote
from ..errors import LodgsError
from .parameters import Parameters

PRESETS = {
    "draft": "Minutes on two processor cores: a first look",
    "standard": "An evening on a laptop, minutes on a GPU",
    "paper": "The paper's own schedule",
}
"""The presets that every method has, each with what it is for."""


def no_split(parameters: Parameters) -> None:
    """Of methods whose cells make all levels by themselves."""
    return None


@dataclass(frozen=True)
class MethodInfo:
    """A method, as its folder declares it in ``METHOD``.

    Attributes:
        name: what jobs, command lines and bundles call it.
        number: its place in lists, and what a .blend stores of it: the next free one, for good.
        label: what a panel calls it.
        about: what it makes, as the end of a sentence that begins with the label.
        parameters: the class of its parameters.
        presets: the parameters of each of PRESETS.
        rule: the name of the rule that chooses its detail (``training.lod``); "" for none.
        offered: the parameters that a panel shows, beside the presets.
        from_base: whether training can begin with splats (a job's ``base``) instead of the scene's points.
        base_in_parts: whether a base may stay in its file (``SplatRows``).
        for_splats: whether it is what to offer first for splats that are there already.
        captured: values of parameters that are others where the photographs are the base's own pictures, by
            name, whatever the preset.
        in_cells: the method that trains cells of a scene that is too large for one run: its own name, or one
            whose splats, put together, are then its base; "" where cells cannot be put together.
        divided: of the parameters of a scene in cells, those of a run of all of it that makes the coarser
            levels once, and those of the cells' runs, which go on from them; None: cells make all levels.
        unused: names of inherited parameters that this method ignores.
        package: the folder as a module, set where the method is found.
    """

    name: str
    number: int
    label: str
    about: str
    parameters: type[Parameters]
    presets: Mapping[str, Parameters]
    rule: str = ""
    panel_parameters: tuple[str, ...] = ()
    from_base: bool = False
    streams_base: bool = False
    suggested_for_base: bool = False
    cell_method: str = ""
    split_parameters: Callable[[Any], tuple[Parameters, Parameters] | None] = no_split
    capture_values: Mapping[str, Any] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    package: str = ""

    @property
    def fields(self) -> list[Field]:
        """The parameters that can be set."""
        return [each for each in fields(self.parameters) if each.name not in self.unused]

    def preset(self, name: str) -> Parameters:
        """The parameters of a preset.

        Raises:
            LodgsError: there is no such preset.
        """
        if name not in self.presets:
            raise LodgsError(
                f"There is no preset {quote(name)}.", f"Choose one of: {', '.join(self.presets)}."
            )
        return self.presets[name]
