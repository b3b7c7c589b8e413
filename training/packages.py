"""Packages of the trainer's environment: the CPU build of PyTorch in place of the CUDA build.

Used before any package is installed, by ``tools/setup.py`` and by the extension: standard library only.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

TORCH_CPU = Path(__file__).resolve().parent.parent / "requirements" / "torch-cpu.txt"
"""Lock of the CPU build of PyTorch. It replaces CUDA_PACKAGES of the other locks."""
TORCH_INDEX = "https://download.pytorch.org/whl/cpu"
"""Package index that has the builds of TORCH_CPU."""
CUDA_PACKAGES = re.compile(r"torch|triton|(nvidia|cuda)-[a-z0-9-]+")
"""Names of packages that a lock has for the CUDA build of PyTorch."""

HASHED = ("--require-hashes", "--only-binary=:all:")
"""Options of pip for a lock file."""


def has_cpu_build() -> bool:
    """Return whether TORCH_CPU has builds for this system. Elsewhere PyPI's own build is one for the CPU."""
    return sys.platform == "linux"


def torch_cpu_options() -> list[str]:
    """Return pip's arguments after ``install`` for the CPU build of PyTorch, without its dependencies."""
    return [*HASHED, "--no-deps", "--retries=1", f"--index-url={TORCH_INDEX}", f"--requirement={TORCH_CPU}"]


def without_cuda(lock: str) -> str:
    """Return the text of a lock without CUDA_PACKAGES. Install it with ``--no-deps``.

    Args:
        lock: text of a requirements file with one entry per package, its hashes on indented lines.
    """
    lines, keep = [], True
    for line in lock.splitlines(keepends=True):
        if not line[:1].isspace():
            keep = not CUDA_PACKAGES.fullmatch(re.split(r"[\s=<>;@\[]", line, maxsplit=1)[0])
        if keep:
            lines.append(line)
    return "".join(lines)
