"""CSV and XMP files of RealityCapture and RealityScan.

Expected values follow RealityScan's document of its coordinate systems (see ``formats/realitycapture.py``),
and one camera that RealityCapture exported in both formats.
"""

import numpy as np
import pytest

from training.errors import LodgsError
from training.scenes.colmap import read_scene
from training.scenes.formats import convert_export
from training.scenes.formats.realitycapture import attitude

from .export_helpers import POINTS, check, opencv, poses, project, write_photos

HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
OPENCV_HEADER = (
    "#name,tx,ty,tz,R00,R01,R02,R10,R11,R12,R20,R21,R22,f_pix,px_pix,py_pix,k1,k2,t2,t1,k3,k4 (R = [Rij] "
    "provided in row major ordering and t = (tx,ty,tz) are the rotation matrix R and the translation t)"
)
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xcr:Version="3" xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" {attributes}
 xcr:FocalLength35mm="30" xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="0.01"
 xcr:PrincipalPointV="-0.02"><xcr:Rotation>{rotation}</xcr:Rotation><xcr:Position>{position}</xcr:Position>
<xcr:DistortionCoeficients>{coefficients}</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"""
MODEL = 'xcr:DistortionModel="brown3t2" xcr:Coordinates="absolute"'
COEFFICIENTS = "0.1 -0.02 0.01 0 0.003 0.005"
NAMES = "first.png", "second photo.png", "third.png"


def text(values) -> str:
    return " ".join(f"{value:.15g}" for value in np.ravel(values))


def expected() -> list[np.ndarray]:
    """Return pixels in photos of 72x96: s = 96, f = 30 / 36 s, c = (0.01, -0.02) s + size / 2, p1 = t2."""
    result = []
    for pose in poses():
        x, y = opencv(*project(pose), k1=0.1, k2=-0.02, k3=0.01, p1=0.005, p2=0.003)
        result.append(np.stack([80 * x + 36.96, 80 * y + 46.08], axis=1))
    return result


def angles(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return yaw, pitch, roll of a camera in OpenGL axes, from the elements of its matrix."""
    return tuple(
        np.degrees(
            [
                np.arctan2(rotation[0, 1], rotation[1, 1]),
                np.arcsin(rotation[2, 1]),
                np.arctan2(-rotation[2, 0], rotation[2, 2]),
            ]
        )
    )


def test_one_camera_in_both_formats():
    """Values: forums.unrealengine.com/t/different-rotation-of-cameras-in-xmp-and-csv/710449."""
    rotation = [
        [0.982594073038806, 0.185426733553445, -0.0112166890261935],
        [-0.032113633044729, 0.11008102707942, -0.993403685341366],
        [-0.18296886582437, 0.976472781986697, 0.114],
    ]
    world_to_camera = attitude(163.736597399311, 83.4154313461628, 174.386496244756).T
    np.testing.assert_allclose(world_to_camera[:2], rotation[:2], atol=1e-9)
    np.testing.assert_allclose(world_to_camera[2], rotation[2], atol=2e-4)  # the post cuts its last number


def test_angles_by_hand():
    down, east = attitude(0, 0, 0), attitude(90, 90, 0)
    np.testing.assert_allclose(down, np.diag([1, -1, -1]), atol=1e-15)  # upper side north, looks down
    np.testing.assert_allclose(east[:, 2], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(east[:, 1], [0, 0, -1], atol=1e-15)  # the photo's lower side is below
    banked = attitude(0, 0, 30)
    np.testing.assert_allclose(banked[:, 0], [np.cos(np.pi / 6), 0, -0.5], atol=1e-15)


@pytest.mark.parametrize("delimiter", [",", ";"])
@pytest.mark.parametrize(
    "header", [HEADER, HEADER.replace("heading", "yaw").replace(",f,px,py", ",f_35mm,px_norm,py_norm")]
)
def test_table(tmp_path, header, delimiter):
    write_photos(tmp_path / "images", size=(72, 96))
    rows = ["#cameras 3", header]
    for name, pose in zip(NAMES, poses(), strict=True):
        numbers = [*pose[:3, 3], *angles(pose[:3, :3]), 30, 0.01, -0.02, 0.1, -0.02, 0.01, 0, 0.003, 0.005]
        rows.append(f"{name},{','.join(f'{number:.12g}' for number in numbers)}")
    (tmp_path / "cameras.csv").write_text("\r\n".join(rows).replace(",", delimiter), encoding="utf-8-sig")
    cloud = "\n".join(f"{text(point)} 0.2 0.4 1.0" for point in POINTS)
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    (tmp_path / "sparse points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\n{properties}end_header\n{cloud}\n"
    )
    result = convert_export(tmp_path)
    assert result.warnings == []
    check(tmp_path, expected())
    scene = read_scene(tmp_path)
    np.testing.assert_allclose(np.sort(scene.points, axis=0), np.sort(POINTS, axis=0), atol=1e-6)
    assert scene.point_colors[0].tolist() == [51, 102, 255]


def test_table_of_matrices(tmp_path):
    write_photos(tmp_path / "photos", size=(72, 96))
    rows = [OPENCV_HEADER]
    for name, pose in zip(NAMES, poses(), strict=True):
        rotation = (pose[:3, :3] @ np.diag([1, -1, -1])).T
        numbers = [
            *(-rotation @ pose[:3, 3]),
            *rotation.ravel(),
            80,
            36.96,
            46.08,
            0.1,
            -0.02,
            0.005,
            0.003,
            0.01,
            0,
        ]
        rows.append(f"{name},{','.join(map(repr, map(float, numbers)))}")
    (tmp_path / "registration.csv").write_text("\n".join(rows))
    assert convert_export(tmp_path).warnings == []
    check(tmp_path, expected())


def write_sidecars(folder, attributes=MODEL, coefficients=COEFFICIENTS) -> None:
    write_photos(folder, size=(72, 96))
    for name, pose in zip(NAMES, poses(), strict=True):
        rotation = (pose[:3, :3] @ np.diag([1, -1, -1])).T
        content = XMP.format(
            attributes=attributes,
            rotation=text(rotation),
            position=text(pose[:3, 3]),
            coefficients=coefficients,
        )
        (folder / name).with_suffix(".xmp").write_text(content)


def test_sidecars(tmp_path):
    write_sidecars(tmp_path / "images")
    (tmp_path / "images" / "_common.xmp").write_text(
        XMP.partition("<xcr:Rotation>")[0].format(attributes="") + "</rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    assert convert_export(tmp_path).warnings == []
    check(tmp_path, expected())


def test_sidecars_with_attributes_of_another_component(tmp_path):
    relative = 'xcr:Coordinates="relative" xcr:ComponentId="{%s}" xcr:DistortionModel="perspective"'
    write_sidecars(tmp_path, relative % "A")
    path = tmp_path / "third.xmp"
    path.write_text(path.read_text().replace("{A}", "{B}"))
    (tmp_path / "adobe.xmp").write_text('<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
    warnings = convert_export(tmp_path).warnings
    assert warnings == [f"Skipped 1 photos of other components in {tmp_path}."]
    assert [camera.name for camera in read_scene(tmp_path).cameras] == ["first.png", "second photo.png"]


@pytest.mark.parametrize(
    "attributes, coefficients, reason",
    [
        ('xcr:DistortionModel="division"', "0.2 0 0 0 0 0", "division has no equivalent"),
        ('xcr:DistortionModel="brown4"', "0.2 0.1 0 0.1 0 0", "its k4 has no equivalent"),
    ],
)
def test_lenses_that_colmap_lacks_are_refused(tmp_path, attributes, coefficients, reason):
    write_sidecars(tmp_path, attributes, coefficients)
    with pytest.raises(LodgsError, match=reason) as error:
        convert_export(tmp_path)
    assert "choose Brown3" in str(error.value)


def write_table(folder, *rows) -> None:
    write_photos(folder, size=(72, 96))
    (folder / "cameras.csv").write_text("\n".join([HEADER, *rows]))


def test_longitudes_and_latitudes_are_refused(tmp_path):
    write_table(
        tmp_path,
        *(f"{name},1{number / 1e4},-34.82,87,0,0,0,30{',0' * 8}" for number, name in enumerate(NAMES)),
    )
    with pytest.raises(LodgsError, match="longitudes and latitudes"):
        convert_export(tmp_path)


def test_doubtful_tables_give_warnings(tmp_path):
    rows = [
        f"{name},{500_000 + number},5400000,87,0,0,0,30,0,0,0.1{',0' * 5}"
        for number, name in enumerate(NAMES)
    ]
    write_table(tmp_path, *rows[:2], rows[2] + ",0")
    (tmp_path / "grid.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n"
    )
    warnings = "\n".join(convert_export(tmp_path).warnings)
    for part in (
        "has projected coordinates",
        "only k1",
        "row has 17 values instead of 16",
        "no photo shows most",
    ):
        assert part in warnings
    assert read_scene(tmp_path).points.shape == (0, 3)


def test_tables_without_lenses_are_named(tmp_path):
    write_photos(tmp_path)
    (tmp_path / "cameras.csv").write_text("#name,x,y,alt,heading,pitch,roll\nfirst.png,0,0,0,0,0,0\n")
    with pytest.raises(LodgsError, match=r"table without lenses(.|\n)*Internal/External"):
        convert_export(tmp_path)
