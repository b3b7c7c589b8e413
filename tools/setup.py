"""Create the environments for `make`. Standard library only; runs on the system's Python.

python3 tools/setup.py            .venv (Python 3.11: trainer, Blender 4.5 as a module, checks) and, if
                                  Python 3.13 is installed, .venv-blender-5.3 (Blender 5.3 as a module)
python3 tools/setup.py 5.0        .venv-blender-5.0 (Blender 5.0, Python 3.11)
python3 tools/setup.py 5.2        .venv-blender-5.2 (Blender 5.2, Python 3.13)
"""

from __future__ import annotations

import argparse
import ctypes.util
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools import viewer  # noqa: E402
from training import packages  # noqa: E402


def find_python(version: str) -> str | None:
    """Find an interpreter of a version such as "3.11" that can create virtual environments, or None."""
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
        launcher = subprocess.run(
            ["py", f"-{version}", "-c", "import sys; print(sys.executable)"],
            capture_output=True,
            text=True,
            check=False,
        )
        candidates.append(launcher.stdout.strip())
    numbers = tuple(map(int, version.split(".")))
    test = f"import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != {numbers})"
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
    """Create a virtual environment with the packages of a lock file, unless it is up to date."""
    environment, requirements = ROOT / folder, ROOT / "requirements" / lock
    texts = [requirements.read_text(encoding="utf-8")]
    if "\ntorch==" in texts[0]:
        texts.append(packages.TORCH_CPU.read_text(encoding="utf-8"))
    digest = hashlib.sha256("".join(texts).encode()).hexdigest()
    stamp = environment / "requirements.sha256"
    if stamp.exists() and stamp.read_text() == digest:
        return
    print(f"setup: {folder} with {python} (a minute or two on first use)", flush=True)
    scripts = environment / ("Scripts" if os.name == "nt" else "bin")
    if not (scripts / "pip").exists() and not (scripts / "pip.exe").exists():
        subprocess.run([python, "-m", "venv", "--clear", str(environment)], check=True)
    install(scripts, texts, requirements)
    loaded = subprocess.run(
        [str(scripts / "python"), "-c", "import os, sys, bpy; sys.stdout.flush(); os._exit(0)"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if loaded.returncode:
        message = (loaded.stderr.strip().splitlines() or ["no error message"])[-1]
        print(f"setup: Cannot load Blender's module ({message}).", file=sys.stderr)
        print(
            "setup: Install its system libraries, on Debian: libx11-6 libxi6 libxrender1",
            file=sys.stderr,
        )
        print("setup: libxfixes3 libgl1 libxkbcommon0 libsm6 libice6.", file=sys.stderr)
        sys.exit(1)
    stamp.write_text(digest)


def install(scripts: Path, texts: list[str], requirements: Path) -> None:
    """Install the packages of a lock file, by uv if it can be had and else by pip.

    Without an NVIDIA driver, PyTorch is its CPU build, if this system needs another one and it can be
    downloaded.

    Args:
        scripts: folder of the environment's programs.
        texts: text of the lock, and TORCH_CPU's if the lock contains PyTorch.
        requirements: the lock file.
    """
    pip = [str(scripts / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    cpu_only = len(texts) > 1 and packages.has_cpu_build() and shutil.which("nvidia-smi") is None
    if cpu_only:
        torch = subprocess.run([*pip, *packages.torch_cpu_options()], check=False, capture_output=True)
        cpu_only = torch.returncode == 0
        if not cpu_only:
            print("setup: no CPU build of PyTorch available; the CUDA build needs 4 GB more.", flush=True)
    uv = find_uv(pip)
    with tempfile.TemporaryDirectory() as work:
        if cpu_only:
            requirements = Path(work, requirements.name)
            requirements.write_text(packages.without_cuda(texts[0]), encoding="utf-8")
        options = [*packages.HASHED, *["--no-deps"] * cpu_only, f"--requirement={requirements}"]
        fast = [str(uv), "pip", "install", "--quiet", f"--python={scripts / 'python'}", *options]
        if uv is None or subprocess.run(fast, check=False).returncode:  # uv ignores pip's configuration
            subprocess.run([*pip, *options], check=True)


def find_uv(pip: list[str]) -> str | None:
    """Return the path of uv, which installs packages in parallel. Install the locked one if it is missing."""
    program = shutil.which("uv") or str(Path(pip[0]).with_name("uv"))
    if shutil.which(program):
        return program
    lock = ROOT / "requirements" / "uv.txt"
    subprocess.run([*pip, *packages.HASHED, f"--requirement={lock}"], check=False, capture_output=True)
    return shutil.which(program)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("blender", nargs="?", choices=["5.0", "5.2"], help="only this Blender")
    blender = parser.parse_args().blender
    python = find_python("3.11")
    if python is None:
        print(
            "setup: Python 3.11 with pip and venv not found. Install it and run make again.", file=sys.stderr
        )
        return 1
    try:
        if blender == "5.0":
            make(".venv-blender-5.0", python, "blender-5.0.txt")
            return 0
        newer = find_python("3.13")
        if blender == "5.2":
            if newer is None:
                print("setup: Blender 5.2 needs Python 3.13; install it.", file=sys.stderr)
                return 1
            make(".venv-blender-5.2", newer, "blender-5.2.txt")
            return 0
        with ThreadPoolExecutor() as pool:  # the network is the limit
            tasks = [pool.submit(make, ".venv", python, "develop.txt"), pool.submit(viewer.fetch)]
            if newer is not None:
                tasks.append(pool.submit(make, ".venv-blender-5.3", newer, "blender-5.3.txt"))
            elif not (ROOT / ".venv-blender-5.3").exists():
                print("setup: Python 3.13 not found; tests in Blender 5.3 will be skipped.", file=sys.stderr)
            for task in tasks:
                task.result()
        if sys.platform.startswith("linux") and not ctypes.util.find_library("vulkan"):
            print(
                "setup: Vulkan not found; tests of the gpu backend will be skipped. On Debian, install",
                file=sys.stderr,
            )
            print("setup: mesa-vulkan-drivers for software rendering.", file=sys.stderr)
    except subprocess.CalledProcessError as error:
        print(f"setup: Command failed: {' '.join(error.cmd)}", file=sys.stderr)
        print("setup: Check the network and the free disk space.", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
