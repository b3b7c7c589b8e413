"""Levels of detail as USD: one ``ParticleField3DGaussianSplat`` per level below a root of the schema UsdLod.

Only the process of the trainer or of the command line loads usd-core: Blender has another copy of the same
libraries. Files are read in a process of their own (``usd_process``), because damaged ones may abort it.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ..documents import open_file, parse_json
from ..errors import LodgsError, printable
from ..files import atomic_write, temporary_folder
from .levels import Level
from .portable_levels import PortableLevels, PortableView, portable_batches
from .sh import coefficient_count
from .splat_format import NeedsTrainer

DESCRIPTION = "lodgs"
"""Key of the layer's custom data with the levels' rule and meta, as JSON."""
MAX_DEGREE = 3
_APERTURE = 0.36
"""Width of the sensor of written cameras in tenths of a metre, that of a full-frame camera."""
_FAR = 1e6
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the axes of OpenCV's cameras to those of USD's."""
_SIGMAS = 3.0
"""Extent of a splat in the bounds of levels, in standard deviations."""
_SECONDS = 600
_MIN_FREE_BYTES = 1 << 16
"""Free space below which a failure is that of a full disk."""
_PACKAGE_TIME = 946_684_800
"""Time of the file in a package, 1 January 2000, so that equal levels give equal packages."""
_INSTALL = "Install it with: pip install usd-core (or lodgs[usd])."


def load_usd() -> SimpleNamespace:
    """Return the modules of usd-core.

    Raises:
        NeedsTrainer: it is not installed or too old, or this process is Blender's.
    """
    if "bpy" in sys.modules:
        raise NeedsTrainer(
            "Cannot open USD files in Blender's own process, which has another USD library.",
            "Use the command line: lodgs edit SCENE.usdc --out SCENE.ply.",
        )
    try:
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLod, UsdUtils, UsdVol, Vt
    except ImportError as error:
        raise NeedsTrainer(
            f"Cannot open USD files: the package usd-core 26.11 or newer is missing ({error}).", _INSTALL
        ) from error
    return SimpleNamespace(
        Gf=Gf,
        Sdf=Sdf,
        Tf=Tf,
        Usd=Usd,
        UsdGeom=UsdGeom,
        UsdLod=UsdLod,
        UsdUtils=UsdUtils,
        UsdVol=UsdVol,
        Vt=Vt,
    )


def write_usd(path: Path, levels: PortableLevels) -> None:
    """Write a ``.usdc`` file, or a ``.usdz`` package with one.

    Level by level is saved, so that memory holds one level at a time.

    Raises:
        LodgsError: usd-core is missing, or the file cannot be written.
    """
    usd = load_usd()
    if printable(path.parent) != str(path.parent):
        raise LodgsError(
            f"Cannot write {path}: its path is not UTF-8, as USD requires.", "Choose another folder."
        )
    with atomic_write(path) as temporary, temporary_folder(temporary.parent) as folder:
        scene = folder / "scene.usdc"
        try:
            _write_stage(usd, scene, levels)
            if path.suffix.lower() == ".usdz":
                os.utime(scene, (_PACKAGE_TIME, _PACKAGE_TIME))
                package = folder / "scene.usdz"
                written = usd.UsdUtils.CreateNewUsdzPackage(usd.Sdf.AssetPath(str(scene)), str(package))
                if not (written and _is_intact(package)):  # usd-core reports no full disk
                    raise _full_disk(folder) or OSError(0, "the package cannot be written")
                scene = package
        except usd.Tf.ErrorException as error:
            if full := _full_disk(folder):
                raise full from error
            raise LodgsError(
                f"Cannot write {path}: {error_reason(error)}.", "Check the free space."
            ) from error
        os.replace(scene, temporary)


def _is_intact(package: Path) -> bool:
    """Return whether all files of a package are complete."""
    try:
        with zipfile.ZipFile(package) as archive:
            return archive.testzip() is None
    except (OSError, zipfile.BadZipFile):
        return False


def _full_disk(folder: Path) -> OSError | None:
    """Return the error of a full disk if a folder's disk has hardly any space left."""
    if shutil.disk_usage(folder).free >= _MIN_FREE_BYTES:
        return None
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _write_stage(usd: SimpleNamespace, path: Path, levels: PortableLevels) -> None:
    """Write a stage with the levels as one prim with levels of detail, and the views as cameras."""
    stage = usd.Usd.Stage.CreateNew(str(path))
    usd.UsdGeom.SetStageUpAxis(stage, usd.UsdGeom.Tokens.z)
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    world = usd.UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    stage.GetRootLayer().customLayerData = {DESCRIPTION: levels.describe()}
    _add_transform(usd, world, levels.placement)
    root = usd.UsdGeom.Xform.Define(stage, "/World/Splats").GetPrim()
    lod = usd.UsdLod.RootAPI.Apply(root)
    lod.CreateLodDefaultIndexAttr(0)
    override = usd.UsdLod.OverrideAPI.Apply(root)
    if levels.distances:
        heuristic = _add_heuristic(usd, stage, levels)
        lod.CreateLodHeuristicsRel().AddTarget(heuristic.GetPath())
    else:  # a fixed level
        override.CreateLodOverrideModeAttr(usd.UsdLod.Tokens.indexedLOD)
        override.CreateLodOverrideIndexAttr(0.0)
    for level in levels.fine_to_coarse:
        _add_level(usd, stage, level)
        stage.GetRootLayer().Save()
    if levels.views:
        usd.UsdGeom.Scope.Define(stage, "/World/Cameras")
        names: set[str] = set()
        for view in levels.views:
            _add_camera(usd, stage, view, _unique(usd.Tf.MakeValidIdentifier(Path(view.name).stem), names))
    stage.GetRootLayer().Save()


def _add_transform(usd: SimpleNamespace, prim, matrix: np.ndarray) -> None:
    """Add a transform (4, 4) in double precision; USD multiplies rows by matrices."""
    if not np.array_equal(matrix, np.eye(4)):
        usd.UsdGeom.Xformable(prim).AddTransformOp().Set(usd.Gf.Matrix4d(matrix.T.tolist()))


def _add_heuristic(usd: SimpleNamespace, stage, levels: PortableLevels):
    """Add the distances, from the centre, that leave the nearest splats of most of the scene fine enough."""
    center, radius = levels.sphere()
    begins = [radius + distance / levels.fade for distance in levels.distances[-2::-1]]
    heuristic = usd.UsdLod.DistanceHeuristic.Define(stage, "/World/SplatDistances")
    heuristic.CreateLodDomainAttr(usd.UsdLod.Tokens.imaging)
    heuristic.CreateCenterAttr(usd.Gf.Vec3f(*center.tolist()))
    heuristic.CreateThresholdsAttr(usd.Vt.FloatArray(begins))
    if levels.fade > 1:
        ends = [radius + distance for distance in levels.distances[-2::-1]]
        heuristic.CreateBlendThresholdsAttr(usd.Vt.FloatArray(ends))
    return heuristic


def _add_level(usd: SimpleNamespace, stage, level: Level) -> None:
    """Add the splats of a level."""
    prim = usd.UsdVol.ParticleField3DGaussianSplat.Define(
        stage, f"/World/Splats/Level_{level.number}"
    ).GetPrim()
    prim.SetDisplayName(f"Level {level.number}")
    columns = _columns(level)
    vectors = usd.Vt.Vec3fArray
    usd.UsdGeom.Boundable(prim).CreateExtentAttr(vectors.FromNumpy(columns.pop("extent")))
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(level.sh_degree)
    for name in list(columns):
        column = columns.pop(name)  # so that only one of them is in memory twice
        kind = {"orientations": usd.Vt.QuatfArray, "opacities": usd.Vt.FloatArray}.get(name, vectors)
        prim.GetAttribute(name).Set(kind.FromNumpy(column))


def _columns(level: Level) -> dict[str, np.ndarray]:
    """Return the attributes of all splats of a level, and their extent (2, 3), float32."""
    rows, count, coefficients = level.rows, len(level.rows), coefficient_count(level.sh_degree)
    columns = {
        "positions": np.empty((count, 3), np.float32),
        "scales": np.empty((count, 3), np.float32),
        "orientations": np.empty((count, 4), np.float32),
        "opacities": np.empty(count, np.float32),
        "radiance:sphericalHarmonicsCoefficients": np.empty((count * coefficients, 3), np.float32),
    }
    corners = [np.zeros((0, 3))]
    for begin, splats in portable_batches(rows):
        end, scales = begin + len(splats), np.exp(splats.log_scales)
        reach = _SIGMAS * scales.max(axis=1, keepdims=True)
        corners += [(splats.means - reach).min(axis=0)[None], (splats.means + reach).max(axis=0)[None]]
        batch = (
            splats.means, scales,
            splats.quats[:, [1, 2, 3, 0]],  # the real part is last
            splats.opacities,
        )  # fmt: skip
        for column, values in zip(columns.values(), batch, strict=False):
            column[begin:end] = values
        sh = columns["radiance:sphericalHarmonicsCoefficients"]
        sh[begin * coefficients : end * coefficients] = splats.sh.reshape(-1, 3)
    box = np.concatenate(corners) if count else np.zeros((1, 3))
    return {"extent": np.array([box.min(axis=0), box.max(axis=0)], np.float32), **columns}


def _add_camera(usd: SimpleNamespace, stage, view: PortableView, name: str) -> None:
    camera = usd.UsdGeom.Camera.Define(stage, f"/World/Cameras/{name}")
    camera.GetPrim().SetDisplayName(view.name)
    scale = _APERTURE / view.width
    camera.CreateHorizontalApertureAttr(_APERTURE)
    camera.CreateVerticalApertureAttr(view.height * scale * view.fx / view.fy)
    camera.CreateFocalLengthAttr(view.fx * scale)
    camera.CreateHorizontalApertureOffsetAttr((view.width / 2 - view.cx) * scale)
    camera.CreateVerticalApertureOffsetAttr((view.cy - view.height / 2) * scale * view.fx / view.fy)
    near = max(view.near, 1e-4)
    camera.CreateClippingRangeAttr(usd.Gf.Vec2f(near, max(_FAR, 1e3 * near)))
    _add_transform(usd, camera, view.camera_to_world @ _FLIP)


def _unique(name: str, names: set[str]) -> str:
    """Return a name that is not among the names yet, and add it to them."""
    unique, number = name, 1
    while unique in names:
        number += 1
        unique = f"{name}_{number}"
    names.add(unique)
    return unique


def read_usd(path: Path, bundle: Path) -> None:
    """Convert the splats of a USD file to a bundle, in another process.

    Raises:
        LodgsError: usd-core is missing, or the file is damaged, has no splats or refers to other files.
    """
    load_usd()
    open_file(path).close()  # reports an unreadable file
    package = Path(__file__).resolve().parents[1]  # training, or lodgs after pip install
    command = [sys.executable, "-m", f"{package.name}.splats.usd_process", path.resolve(), bundle.resolve()]
    read_end, write_end = os.pipe()  # closed when this process ends, and with it the other one
    try:
        result = subprocess.run(
            [str(word) for word in command], cwd=package.parent, stdin=read_end,
            capture_output=True, encoding="utf-8", errors="replace", timeout=_SECONDS, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired as error:
        raise LodgsError(f"Cannot read {path}: it takes over {_SECONDS} s.", "Split the file.") from error
    finally:
        os.close(read_end)
        os.close(write_end)
    for line in result.stdout.splitlines():
        if line.startswith("{"):
            answer = parse_json(line, "The report of the USD reader")
            raise LodgsError(str(answer["what"]), str(answer["remedy"]))
    if result.returncode or not bundle.exists():
        raise LodgsError(f"Cannot read {printable(path)}: it is damaged.", "Export or copy it again.")


def report_error(error: LodgsError) -> None:
    """Send an error from the reading process to :func:`read_usd`."""
    print(json.dumps({"what": error.what, "remedy": error.remedy}), flush=True)


def error_reason(error: Exception) -> str:
    """Return the message of an exception, without the lines of usd-core's source that its text contains."""
    texts = [part.commentary for part in error.args if hasattr(part, "commentary")]
    text = "; ".join(texts) or str(error)
    return printable(" ".join(text.split()))[:300] or type(error).__name__
