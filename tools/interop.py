"""Check that another program reads our files. Part of ``make interop``.

Passes bundles, a plain PLY and a folder of levels to PlayCanvas' splat-transform (from npm, run on the CPU),
and compares its counts and rewritten values with ours. Exit code 0: all agree; 1: differences; 2: nothing was
checked.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from plyfile import PlyData

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.interop_results import store_result  # noqa: E402
from training.evaluate.level_errors import measure_level_errors  # noqa: E402
from training.splats.bundle import read_bundle, write_bundle  # noqa: E402
from training.splats.compressed_ply import read_compressed_ply, write_compressed_ply  # noqa: E402
from training.splats.gaussians import Splats  # noqa: E402
from training.splats.level_folder import write_folder  # noqa: E402
from training.splats.levels import Bundle, Level  # noqa: E402
from training.splats.ply import read_ply, write_ply  # noqa: E402
from training.splats.similarity import Similarity  # noqa: E402
from training.splats.sog import decode_sog, read_sog, write_sog  # noqa: E402
from training.splats.spz import read_spz, write_spz  # noqa: E402
from training.splats.streamed_levels import (  # noqa: E402
    STREAMED_FILE,
    read_streamed_levels,
    write_streamed_levels,
)

PACKAGE = "@playcanvas/splat-transform"
VERSION = "3.7.0"
MIN_NODE = 22
"""Oldest major version of Node.js that splat-transform runs in."""
NODE_VERSION = "22.23.3"
"""Version of Node.js that is installed from npm next to an older one."""
FOLDER = ROOT / "build" / "interop"


def main(given: Path | None = None) -> int:
    if problem := node_problem():
        print(f"interop: {problem} Install Node.js {MIN_NODE} or newer with npm (nodejs.org) and repeat.")
        return 2
    if not install():
        print(f"interop: npm cannot install {PACKAGE} {VERSION}, see above.")
        return 2
    bundle = read_bundle(given) if given else random_bundle()
    if bundle.levels[0].splats.sh_degree > 3:
        print(f"interop: {PACKAGE} only reads spherical harmonics up to degree 3.")
        return 2
    rows = [(check, expected, actual, expected == actual) for check, expected, actual in checks(bundle)]
    print(f"{'splat-transform ' + VERSION:<50}  {'ours':<34}  {'theirs':<34}")
    for check, expected, actual, same in rows:
        print(f"{check:<50}  {expected!s:<34}  {actual!s:<34}  {'ok' if same else 'DIFFERENT'}")
    if given is None:
        store_results(rows)
    return 0 if all(same for *_, same in rows) else 1


def store_results(rows: Sequence[tuple[str, object, object, bool]]) -> None:
    """Store one result for each format, the part of a check's name before ":" or ","."""
    formats = groupby(rows, lambda row: re.split("[,:]", row[0])[0])
    for kind, group in formats:
        checks = [(check.removeprefix(kind).lstrip(",: "), same) for check, *_, same in group]
        facts = {"format": kind, "method": "", "checks": [check for check, _ in checks]}
        passed = all(same for _, same in checks)
        store_result(
            {"check": "values", "program": "splat-transform", "version": VERSION, "passed": passed, **facts}
        )


def node_problem() -> str:
    """Return a sentence if Node.js or npm is missing or too old for the programs from npm, else "".

    A newer Node.js is installed from npm into build/interop, and put first in PATH, if this one is too old.
    """
    if not shutil.which("node") or not shutil.which("npm"):
        return "Node.js or npm is not installed."
    if (problem := _version_problem()) and install("node", NODE_VERSION):
        own = FOLDER / "node_modules" / "node" / "bin"
        os.environ["PATH"] = f"{own}{os.pathsep}{os.environ['PATH']}"
        problem = _version_problem()
    return problem


def _version_problem() -> str:
    """Return a sentence if Node.js is too old, else ""."""
    version = subprocess.run(
        ["node", "--version"], capture_output=True, text=True, check=False
    ).stdout.strip()
    major = version.removeprefix("v").split(".")[0]
    if not major.isdecimal() or int(major) < MIN_NODE:
        return f"Node.js {version or 'of unknown version'} is too old."
    return ""


def install(name: str = PACKAGE, version: str = VERSION) -> bool:
    """Install a pinned version from npm into build/interop, unless installed."""
    package = FOLDER / "node_modules" / name / "package.json"
    if package.exists() and json.loads(package.read_text("utf-8"))["version"] == version:
        return True
    FOLDER.mkdir(parents=True, exist_ok=True)
    command = ["npm", "install", "--prefix", str(FOLDER), "--no-audit", "--no-fund", f"{name}@{version}"]
    if not (FOLDER / "package.json").exists():  # otherwise npm uses a project in a parent folder
        (FOLDER / "package.json").write_text('{"private": true}\n')
    return subprocess.run([shutil.which("npm") or "npm", *command[1:]]).returncode == 0


def splat_transform(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = FOLDER / "node_modules" / PACKAGE / "bin" / "cli.mjs"
    return subprocess.run(["node", str(program), *arguments], capture_output=True, text=True)


def random_bundle() -> Bundle:
    """Five levels of random splats with SH degree 3 and two extras."""
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    levels = []
    for number, count in enumerate((100, 300, 1000, 3000, 10000), 1):
        extras = {"decay": normal(count), "label": random.integers(0, 200, count).astype(np.uint8)}
        sh = 0.3 * normal(count, 16, 3)
        splats = Splats(normal(count, 3), normal(count, 4), normal(count, 3) - 3, normal(count), sh, extras)
        levels.append(Level(number, splats, {"s_min": 0.2 * 4.0 ** (1 - number) if number < 5 else 0.0}))
    return Bundle("flod", levels, "bands", meta={"focal_px": 600.0})


def checks(bundle: Bundle):
    """Yield name, our result and splat-transform's result of each check."""
    counts = [len(level.splats) for level in reversed(bundle.levels)]
    finest = bundle.levels[-1].splats
    total = sum(counts) if bundle.cumulative else counts[0]

    path = FOLDER / "bundle.ply"
    write_bundle(path, bundle)
    yield "bundle, finest first: splats, SH", (total, finest.sh_degree), info(path)
    yield "bundle: values of the finest level", "equal", values(path)

    # splat-transform must be able to reject a file
    short = FOLDER / "short.ply"
    short.write_bytes(path.read_bytes()[:-1])
    yield "bundle, one byte short", "rejected", "rejected" if info(short) is None else "accepted"

    path = FOLDER / "stream.ply"
    write_bundle(path, bundle, order="stream")
    first = total if bundle.cumulative else counts[-1]
    yield "bundle, coarsest first: splats, SH", (first, finest.sh_degree), info(path)

    path = FOLDER / "plain.ply"
    write_ply(path, finest)
    yield "PLY: splats, SH", (counts[0], finest.sh_degree), info(path)
    yield "PLY: values", "equal", values(path)

    write_spz(FOLDER / "ours.spz", turned(finest), {})  # in the file, axes are then those of PLY
    yield "SPZ: values that both read", "equal", read_by_both(FOLDER / "ours.spz", True)
    for version in (3, 4):
        path = FOLDER / f"theirs{version}.spz"
        splat_transform("-w", "--spz-version", str(version), str(FOLDER / "plain.ply"), str(path))
        yield f"SPZ {version} of splat-transform: values that both read", "equal", read_by_both(path, True)
    write_sog(FOLDER / "ours.sog", finest, {})
    yield "SOG: values that both read", "equal", read_by_both(FOLDER / "ours.sog", False)
    write_compressed_ply(FOLDER / "ours.compressed.ply", finest, {})
    splat_transform("-w", str(FOLDER / "plain.ply"), str(FOLDER / "theirs.compressed.ply"))
    for owner, name in (("ours", ""), ("theirs", " of splat-transform")):
        both = read_by_both(FOLDER / f"{owner}.compressed.ply", False)
        yield f"compressed PLY{name}: values that both read", "equal", both

    folder = FOLDER / "folder"
    shutil.rmtree(folder, ignore_errors=True)
    write_folder(folder, bundle)
    web = FOLDER / "web"
    shutil.rmtree(web, ignore_errors=True)
    write_streamed_levels(web, bundle, measure_level_errors)
    shutil.rmtree(FOLDER / "read", ignore_errors=True)
    read_streamed_levels(web / STREAMED_FILE, FOLDER / "read")
    environment = len(read_environment(web))
    ours = [len(read_ply(FOLDER / "read" / f"lod{lod}.ply")) - environment for lod in range(len(counts))]
    theirs = []
    for lod in range(len(counts)):
        plain = FOLDER / f"lod{lod}.ply"
        plain.unlink(missing_ok=True)
        result = splat_transform("-w", "-g", "cpu", "-L", str(lod), str(web / STREAMED_FILE), str(plain))
        theirs.append(len(read_ply(plain)) if plain.exists() else failure(result))
    declared = json.loads((web / STREAMED_FILE).read_text("utf-8"))["counts"]
    yield "streamed levels: splats", declared, theirs
    yield "streamed levels: splats that we read", theirs, ours


def read_environment(folder: Path) -> Splats:
    """Return the surroundings of streamed levels, which splat-transform leaves out."""
    name = json.loads((folder / STREAMED_FILE).read_text("utf-8")).get("environment")
    if name is None:
        return read_ply(FOLDER / "plain.ply").select(slice(0, 0))
    return decode_sog(lambda file: (folder / name).with_name(file).read_bytes())[0]


def read_by_both(path: Path, turns: bool) -> str:
    """Compare the values of a file that LODGS and splat-transform read, to single precision.

    Args:
        turns: LODGS turns the axes of the file.
    """
    plain = path.with_suffix(".both.ply")
    plain.unlink(missing_ok=True)
    result = splat_transform("-w", str(path), str(plain))
    if result.returncode or not plain.exists():
        return failure(result)
    readers = {".spz": read_spz, ".sog": read_sog, ".ply": read_compressed_ply}
    theirs, (rows, _) = read_ply(plain), readers[path.suffix](path)
    ours = rows.select(slice(None))
    if turns:
        ours = turned(ours)
    ours.quats, theirs.quats = (unit_quats(splats.quats) for splats in (ours, theirs))
    # opacities are left out: those of 0 and 1 have no finite logit, so that each program chooses another one
    limits = {"means": 1e-5, "quats": 1e-5, "log_scales": 1e-4, "sh": 1e-5}
    same = {name: np.abs(getattr(ours, name) - getattr(theirs, name)).max() for name in limits}
    different = [f"{name} {same[name]:.2g}" for name in limits if same[name] > limits[name]]
    return f"different: {', '.join(different)}" if different else "equal"


def turned(splats: Splats) -> Splats:
    """Return splats turned by half a turn about x; each one's own axes are turned, too."""
    result = Similarity(np.diag([1.0, -1, -1]), 1.0, np.zeros(3)).transform_splats(splats)
    result.quats = splats.quats * np.float32([1, 1, -1, -1])
    return result


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Return quats (N, 4) of length 1 whose largest component is positive."""
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.take_along_axis(unit, np.abs(unit).argmax(axis=1)[:, None], axis=1)
    return unit * np.sign(largest)


def failure(result: subprocess.CompletedProcess[str]) -> str:
    """Return splat-transform's error message on one line."""
    return " ".join(result.stderr.split())[:200] or f"exit code {result.returncode}"


def info(path: Path) -> tuple[int, int] | None:
    """Return splats and SH degree as read by splat-transform; None if it rejects the file."""
    result = splat_transform("-q", str(path), "--info", "json", "null")
    if result.returncode:
        return None
    facts = json.loads(result.stdout)
    return facts["numGaussians"], facts["shBands"]


def values(path: Path) -> str:
    """Compare the values of ``vertex`` with those that splat-transform writes back."""
    rewritten = path.with_suffix(".back.ply")
    rewritten.unlink(missing_ok=True)
    result = splat_transform("-w", str(path), str(rewritten))
    if result.returncode or not rewritten.exists():
        return failure(result)
    ours = PlyData.read(str(path))["vertex"].data
    theirs = PlyData.read(str(rewritten))["vertex"].data
    different = [name for name in ours.dtype.names if not np.array_equal(ours[name], theirs[name])]
    return f"different: {', '.join(different)}" if different else "equal"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "bundle", nargs="?", type=Path, metavar="BUNDLE.ply", help="default: five levels of random splats"
    )
    sys.exit(main(parser.parse_args().bundle))
