"""Check on the package index that a lock file can be installed from wheels only on all platforms.

Uses pip's resolver (``--dry-run --platform``) with the lock's hashes. pip evaluates markers for the current
platform, so this script filters lines by marker first. Takes minutes and installs nothing.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.13", "3.14")
GLIBC = (*(f"_2_{minor}" for minor in (39, 34, 31, 28, 27, 25, 24, 18, 17, 14, 12, 5)), "2014")
"""Platform tags of wheels for Linux, by glibc version."""
SYSTEMS = {
    "Windows, x86-64": ("win32", "Windows", "AMD64", ["win_amd64"]),
    "macOS 14, Apple": ("darwin", "Darwin", "arm64", [f"macosx_{v}_0_arm64" for v in (14, 13, 12, 11)]),
    "Linux, x86-64": ("linux", "Linux", "x86_64", [f"manylinux{v}_x86_64" for v in GLIBC]),
}


def pins(lock: Path, system: str, python: str) -> list[str]:
    """Return the lines of a lock that apply to a platform, without their markers."""
    platform, name, machine, _ = SYSTEMS[system]
    environment = {
        "sys_platform": platform, "platform_system": name, "platform_machine": machine,
        "python_version": python, "python_full_version": f"{python}.0", "implementation_name": "cpython",
    }  # fmt: skip
    lines = []
    for line in lock.read_text(encoding="utf-8").replace("\\\n", "").splitlines():
        if line and not line.lstrip().startswith("#"):
            text, *hashes = line.split("--hash=")
            requirement = Requirement(text.strip())
            if requirement.marker is None or requirement.marker.evaluate(environment):
                lines.append(
                    f"{requirement.name}{requirement.specifier} " + " ".join(f"--hash={h}" for h in hashes)
                )
    return lines


def missing(lines: list[str], system: str, python: str) -> str:
    """Return pip's message about missing wheels, or an empty string."""
    with tempfile.TemporaryDirectory() as folder:
        requirements = Path(folder) / "pins.txt"
        requirements.write_text("\n".join(lines), encoding="utf-8")
        answer = subprocess.run(
            [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--dry-run",
             "--no-deps", "--ignore-requires-python", "--only-binary=:all:", "--target", folder,
             "--python-version", python, *(f"--platform={tag}" for tag in SYSTEMS[system][3]),
             "--require-hashes", "-r", str(requirements)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    errors = [line for line in answer.stderr.splitlines() if line.startswith("ERROR: No matching")]
    return "" if answer.returncode == 0 else " ".join(errors) or answer.stderr


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lock", nargs="?", type=Path, default=ROOT / "requirements" / "trainer.txt")
    lock = parser.parse_args().lock
    failed = False
    for system in SYSTEMS:
        for python in PYTHONS:
            lines = pins(lock, system, python)
            problem = missing(lines, system, python)
            print(
                f"{system}, Python {python}: {problem or f'{len(lines)} packages, all available as wheels'}",
                flush=True,
            )
            failed |= bool(problem)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
