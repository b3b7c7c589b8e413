"""Print Blender modules on the package index that are newer than those that the tests run in.

Each Blender needs one Python, and pip lists only the modules of one Python. The newest Blender is therefore
missing from the list of an older Python.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14", "3.15")


def pinned() -> set[tuple[int, ...]]:
    """Return the Blender versions in ``requirements/*.in``."""
    texts = (path.read_text() for path in (ROOT / "requirements").glob("*.in"))
    return {_numbers(version) for text in texts for version in re.findall(r"^bpy==([\d.]+)", text, re.M)}


def newer(available: set[str], tested: set[tuple[int, ...]]) -> list[str]:
    """Return the available versions above the newest tested one, and newer patches of a tested series."""
    latest = {version[:2]: version for version in sorted(tested)}
    return [
        version
        for version in sorted(available, key=_numbers)
        if _numbers(version) > latest.get(_numbers(version)[:2], max(tested))
    ]


def available(python: str) -> set[str]:
    """Return the versions of ``bpy`` on the index for a Python version; empty if there are none."""
    command = [sys.executable, "-m", "pip", "index", "versions", "bpy", "--python-version", python,
               "--only-binary", ":all:"]  # fmt: skip
    listed = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    match = re.search(r"Available versions: (.*)", listed)
    return set(match[1].split(", ")) if match else set()


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version))


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    versions = newer(set().union(*map(available, PYTHONS)), pinned())
    print(f"Newer Blender modules than those tested: {', '.join(versions) or 'none'}.")


if __name__ == "__main__":
    main()
