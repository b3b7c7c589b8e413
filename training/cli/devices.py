"""``lodgs devices``: list and test the devices that this computer can train on."""

from __future__ import annotations

import argparse
import json

from .options import require_effect


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--time", action="store_true", help="also time a training step on each device")
    parser.add_argument(
        "--json", action="store_true", help="print only the choice of auto and its reason, as JSON"
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..rasterize.devices import Devices, describe

    if options.json:
        require_effect({"--time": options.time}, "the list of devices")
    print(json.dumps(Devices.detect().as_json()) if options.json else describe(options.time))
    return 0
