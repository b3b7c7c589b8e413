"""Makes the environments that `make` uses. Standard library only; runs on the Python that a machine has.

python3 tools/setup.py            .venv (Python 3.11: the trainer, Blender 4.5 as a module, the checks) and,
                                  where Python 3.13 is found, .venv-blender-5.3 (Blender 5.3 as a module)
python3 tools/setup.py 5.0        .venv-blender-5.0 (Blender 5.0, Python 3.11)
python3 tools/setup.py 5.2        .venv-blender-5.2 (Blender 5.2, Python 3.13)
"""

from __future__ import annotations

import ctypes.util
import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def find_python(version: str) -> str | None:
    """An interpreter of this version ("3.11") that can make virtual environments, or None."""
    home = Path.home()
    candidates = [
        sys.executable,
        shutil.which(f"python{version}"),
        shutil.which("python3"),
        shutil.which("python"),
    ]
    candidates += sorted(map(str, home.glob(f".pyenv/versions/{version}*/bin/python")), reverse=True)
    candidates += sorted(
        map(str, home.glob(f".local/share/uv/python/cpython-{version}*/bin/python3")), reverse=True
    )
    candidates += [
        f"/usr/bin/python{version}",
        f"/usr/local/bin/python{version}",
        f"/opt/homebrew/bin/python{version}",
    ]
    if os.name == "nt" and shutil.which("py"):
        found = subprocess.run(
            ["py", f"-{version}", "-c", "import sys; print(sys.executable)"],
            capture_output=True,
            text=True,
            check=False,
        )
        candidates.append(found.stdout.strip())
    wanted = tuple(map(int, version.split(".")))
    test = f"import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != {wanted})"
    for candidate in filter(None, candidates):
        try:
            if (
                subprocess.run(
                    [candidate, "-c", test], capture_output=True, check=False, timeout=60
                ).returncode
                == 0
            ):
                return candidate
        except (OSError, subprocess.TimeoutExpired):
            continue
    return None


def make(folder: str, python: str, lock: str) -> None:
    """A virtual environment with the packages of a lock; nothing happens when it is as it should be."""
    environment, requirements = ROOT / folder, ROOT / "requirements" / lock
    wanted = hashlib.sha256(requirements.read_bytes()).hexdigest()
    stamp = environment / "requirements.sha256"
    if stamp.exists() and stamp.read_text() == wanted:
        return
    print(f"setup: {folder} with {python} (a few minutes the first time)", flush=True)
    scripts = environment / ("Scripts" if os.name == "nt" else "bin")
    if not (scripts / "pip").exists() and not (scripts / "pip.exe").exists():
        subprocess.run([python, "-m", "venv", "--clear", str(environment)], check=True)
    subprocess.run(
        [str(scripts / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check",
         "--require-hashes", "--only-binary=:all:", "-r", str(requirements)],
        check=True,
    )  # fmt: skip
    loaded = subprocess.run(
        [str(scripts / "python"), "-c", "import os, sys, bpy; sys.stdout.flush(); os._exit(0)"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if loaded.returncode:
        said = (loaded.stderr.strip().splitlines() or ["it ended without a word"])[-1]
        print(f"setup: Blender's module cannot be loaded ({said}).", file=sys.stderr)
        print(
            "setup: it wants the usual desktop libraries; on Debian: libx11-6 libxi6 libxrender1",
            file=sys.stderr,
        )
        print("setup: libxfixes3 libgl1 libxkbcommon0 libsm6 libice6.", file=sys.stderr)
        sys.exit(1)
    stamp.write_text(wanted)


def main() -> int:
    python = find_python("3.11")
    if python is None:
        print(
            "setup: Python 3.11 with pip and venv is missing; install it and run make again.", file=sys.stderr
        )
        return 1
    try:
        if sys.argv[1:] == ["5.0"]:
            make(".venv-blender-5.0", python, "blender-5.0.txt")
            return 0
        newer = find_python("3.13")
        if sys.argv[1:] == ["5.2"]:
            if newer is None:
                print("setup: Blender 5.2 needs Python 3.13; install it.", file=sys.stderr)
                return 1
            make(".venv-blender-5.2", newer, "blender-5.2.txt")
            return 0
        make(".venv", python, "develop.txt")
        if newer is not None:
            make(".venv-blender-5.3", newer, "blender-5.3.txt")
        elif not (ROOT / ".venv-blender-5.3").exists():
            print("setup: no Python 3.13 here, so the tests in Blender 5.3 are left out.", file=sys.stderr)
        if sys.platform.startswith("linux") and not ctypes.util.find_library("vulkan"):
            print(
                "setup: no Vulkan here, so tests of the gpu backend are left out; on Debian software",
                file=sys.stderr,
            )
            print("setup: Vulkan is in mesa-vulkan-drivers.", file=sys.stderr)
    except subprocess.CalledProcessError as error:
        print(f"setup: this command failed: {' '.join(error.cmd)}", file=sys.stderr)
        print("setup: is the package index reachable, and is there room on the disk?", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
