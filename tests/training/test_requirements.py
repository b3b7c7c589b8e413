"""Lock files of packages: complete, with hashes, and with one trainer everywhere."""

import hashlib
import re
import tomllib
from pathlib import Path

import pytest

from tools import blender_versions, extension, setup
from training import packages

ROOT = Path(__file__).resolve().parents[2]
REQUIREMENTS = ROOT / "requirements"
LOCKS = ["pip", "uv", "trainer", "cluster", "develop", "blender-5.0", "blender-5.2", "blender-5.3"]

PIN = r"(?P<name>[A-Za-z0-9._-]+)==(?P<version>[^\s;]+)(?P<marker> ; [^\\]+?)?"


def requested(path: Path) -> set[tuple[str, str]]:
    """Return (name, version) of each line of a .in file and its included files."""
    pins = set()
    for line in path.read_text().splitlines():
        if line.startswith("-r "):
            pins |= requested(path.parent / line[3:])
        elif line and not line.startswith(("#", "-c ")):
            pin = re.fullmatch(PIN, line)
            assert pin, f"{path.name} pins no version: {line}"
            pins.add((pin["name"].lower(), pin["version"]))
    return pins


def locked(path: Path) -> set[tuple[str, str]]:
    """Return (name, version) of each package of a .txt file; each needs a hash."""
    pins = set()
    text = path.read_text().replace("\\\n", "")
    for line in text.splitlines():
        if not line.lstrip().startswith("#"):
            pin = re.fullmatch(PIN + r"\s+(--hash=sha256:[0-9a-f]{64}\s*)+", line)
            assert pin, f"{path.name} has no hash for: {line[:80]}"
            pins.add((pin["name"].lower(), pin["version"]))
    return pins


def test_every_lock_has_an_input_file():
    by_hand = packages.TORCH_CPU.stem
    assert {path.stem for path in REQUIREMENTS.glob("*.txt")} == {*LOCKS, by_hand}
    assert {path.stem for path in REQUIREMENTS.glob("*.in")} == {*LOCKS, "tests"}


@pytest.mark.parametrize("name", LOCKS)
def test_locks_contain_requested_versions_and_hashes(name):
    pins = requested(REQUIREMENTS / f"{name}.in")
    assert pins and not pins - locked(REQUIREMENTS / f"{name}.txt"), "run `make pins`"


@pytest.mark.parametrize("name", ["cluster", "develop"])
def test_trainer_versions_are_the_same_everywhere(name):
    """Users and tests have the same versions of all dependencies."""
    trainer, pins = locked(REQUIREMENTS / "trainer.txt"), locked(REQUIREMENTS / f"{name}.txt")
    names = {package for package, _ in trainer}
    assert {pin for pin in pins if pin[0] in names} == trainer


def test_zip_contains_the_tested_wheel(tmp_path, monkeypatch):
    (wheel,) = tomllib.loads((ROOT / "blender_manifest.toml").read_text())["wheels"]
    name, version, *_ = Path(wheel).name.split("-")
    for lock in set(LOCKS) - {"pip", "uv"}:
        assert (name, version) in locked(REQUIREMENTS / f"{lock}.txt")
    monkeypatch.setattr(extension, "ROOT", tmp_path)
    for folder in ("wheels", "requirements"):
        (tmp_path / folder).mkdir()
    (tmp_path / wheel).write_bytes(b"a wheel")
    lock = tmp_path / "requirements" / "trainer.txt"
    lock.write_text(f"{name}=={version} \\\n    --hash=sha256:{hashlib.sha256(b'a wheel').hexdigest()}\n")
    extension.fetch_wheels([wheel])
    (tmp_path / wheel).write_bytes(b"another wheel")
    with pytest.raises(SystemExit, match="differs from the wheel"):
        extension.fetch_wheels([wheel])


def test_setup_installs_a_lock_once_per_change(tmp_path, monkeypatch):
    (tmp_path / "requirements").mkdir()
    lock, log = tmp_path / "requirements" / "some.txt", tmp_path / "log"
    python = tmp_path / "python"  # copies itself into the environment
    python.write_text(
        '#!/bin/sh\nif [ "$2" = venv ]; then mkdir -p "$4/bin"; cp "$0" "$4/bin/python"; fi\n'
        f'if [ "$2" = pip ]; then echo "$@" >> {log}; fi\n'
    )
    python.chmod(0o755)
    monkeypatch.setattr(setup, "ROOT", tmp_path)
    monkeypatch.setattr(setup, "find_uv", lambda pip: None)
    for text, times in (("one", 1), ("one", 1), ("two", 2)):
        lock.write_text(text)
        setup.make(".venv", str(python), "some.txt")
        assert log.read_text().count(f"--require-hashes --only-binary=:all: --requirement={lock}\n") == times


def test_setup_prefers_the_cpu_build_of_torch(tmp_path, monkeypatch):
    monkeypatch.setattr(setup, "find_uv", lambda pip: "uv")
    monkeypatch.setattr(setup.packages, "has_cpu_build", lambda: True)
    monkeypatch.setattr(setup.shutil, "which", lambda name: None)
    lock = REQUIREMENTS / "cluster.txt"
    installed = []

    def run(command, **_):
        texts = [Path(word.partition("=")[2]).read_text() for word in command if "--requirement=" in word]
        installed.append((command[0], *texts))
        failed = command[0] == "uv" or (unreachable and "+cpu" in texts[0])
        return setup.subprocess.CompletedProcess(command, int(failed), "", "")

    monkeypatch.setattr(setup.subprocess, "run", run)
    for unreachable in (False, True):
        installed.clear()
        setup.install(tmp_path, [lock.read_text(), packages.TORCH_CPU.read_text()], lock)
        torch, fast, slow = installed
        assert "torch==2.13.0+cpu" in torch[1] and fast[0] == "uv"
        assert slow[1] == (lock.read_text() if unreachable else packages.without_cuda(lock.read_text()))


def test_newer_blenders_than_those_tested_are_named():
    tested = {(4, 5, 15), (5, 2, 3), (5, 3, 0)}
    assert blender_versions.newer({"5.1.2", "5.2.3", "4.5.1"}, tested) == []
    assert blender_versions.newer({"5.2.10", "5.4.0", "5.3.0"}, tested) == ["5.2.10", "5.4.0"]
    assert (5, 3, 0) in blender_versions.pinned()
