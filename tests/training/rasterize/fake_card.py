"""The cuda backend's kernels on the CPU, built by a C++ compiler with ``fake_card.hpp``."""

import ctypes
import hashlib
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

from training.rasterize.cuda.driver import Kernels
from training.rasterize.cuda.source import kernel_source

FOLDER = Path(__file__).resolve().parents[3] / "build" / "fake_card"
OPTIONS = (
    "-std=c++17",
    "-O2",
    "-U_FORTIFY_SOURCE",
    "-shared",
    "-fPIC",
    "-ffp-contract=off",
    "-Wno-unknown-pragmas",
)


def find_compiler() -> str | None:
    """Return a C++ compiler; None without one, and on other systems than Linux."""
    return shutil.which("c++") if sys.platform == "linux" else None


class CpuModule:
    """Kernels in a library for the CPU."""

    def __init__(self) -> None:
        names = re.findall(r"__global__ void (\w+)\(", kernel_source())
        header = (Path(__file__).parent / "fake_card.hpp").read_text(encoding="utf-8")
        source = "\n".join([header, kernel_source(), *(f"LAUNCHER({name})" for name in names)])
        library = FOLDER / f"{hashlib.sha256(source.encode()).hexdigest()[:16]}.so"
        if not library.exists():
            FOLDER.mkdir(parents=True, exist_ok=True)
            program, built = library.with_suffix(".cpp"), library.with_suffix(".new")
            program.write_text(source, encoding="utf-8")
            command = [find_compiler() or "c++", *OPTIONS, str(program), "-o", str(built)]
            subprocess.run(command, check=True, capture_output=True, text=True)
            built.replace(library)
        self._library = ctypes.CDLL(str(library))

    def function(self, name: str) -> tuple[int, ctypes._CFuncPtr]:
        return getattr(self._library, f"arity_{name}")(), getattr(self._library, f"launch_{name}")

    def launch(self, function, blocks: int, threads: int, pointers: ctypes.Array) -> None:
        arity, launcher = function
        assert len(pointers) == arity, f"{len(pointers)} arguments instead of {arity}"
        launcher(blocks, threads, pointers)


@cache
def cpu_kernels() -> Kernels:
    """Build the kernels for the CPU."""
    return Kernels(CpuModule())
