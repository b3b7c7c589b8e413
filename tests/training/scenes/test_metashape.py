"""Metashape's XML, written from its manual and compared with pycolmap's projections."""

from pathlib import Path

import numpy as np
import pytest

from training.scenes.colmap_model import rotation_matrix
from training.scenes.formats import convert_export

from .export_helpers import HEIGHT, NAMES, WIDTH, check, pixels, poses, project, write_photos


def test_metashape(tmp_path):
    """P1 and P2 are swapped with respect to OpenCV, and the chunk's scale converts to metres."""
    write_photos(tmp_path / "images")
    k1, k2, k3, p1, p2, b1 = 0.1, -0.02, 0.01, -0.004, 0.005, 2.0
    cameras = ""
    for number, (name, pose) in enumerate(zip(NAMES, poses(), strict=True)):
        pose = pose @ np.diag([1, -1, -1, 1])
        pose[:3, 3] /= 2
        label = name.removesuffix(".png") if number else name
        numbers = " ".join(map(repr, pose.ravel().tolist()))
        cameras += (
            f'<camera id="{number}" sensor_id="0" label="{label}"><transform>{numbers}</transform></camera>'
        )
    cameras += '<camera id="7" sensor_id="0" label="lost.png"></camera>'
    (tmp_path / "cameras.xml").write_text(f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1"><sensors next_id="1">
<sensor id="0" label="unknown" type="frame"><resolution width="{WIDTH}" height="{HEIGHT}"/>
<calibration type="frame" class="initial"><resolution width="96" height="72"/><f>50</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>
<f>80</f><cx>1.5</cx><cy>-2</cy><k1>{k1}</k1><k2>{k2}</k2><k3>{k3}</k3><p1>{p1}</p1><p2>{p2}</p2><b1>{b1}</b1>
</calibration></sensor></sensors>
<cameras><group label="g">{cameras}</group></cameras>
<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>4e6 5e5 4e6</translation>
<scale>2</scale></transform>
</chunk></document>""")
    scene = convert_export(tmp_path)
    assert scene.warnings[0] == "Skipped lost.png: Metashape did not align it."
    expected = []
    for pose in poses():
        x, y = project(pose)
        r = x * x + y * y
        radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
        distorted_x = x * radial + p1 * (r + 2 * x * x) + 2 * p2 * x * y
        distorted_y = y * radial + p2 * (r + 2 * y * y) + 2 * p1 * x * y
        expected.append(pixels(distorted_x, distorted_y, (80 + b1, 80), (WIDTH / 2 + 1.5, HEIGHT / 2 - 2)))
    check(tmp_path, expected)


def similarity(seed: int, scale: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation_matrix(rng.normal(size=4))
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def as_text(matrix: np.ndarray) -> str:
    return " ".join(map(repr, matrix.ravel().tolist()))


def write_metashape(folder: Path, cameras: str, components: str = "", kind="frame", lens="<f>80</f>") -> None:
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    (folder / "cameras.xml").write_text(f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1"><sensors><sensor id="0" type="{kind}">{size}
<calibration type="{kind}" class="adjusted">{size}{lens}</calibration></sensor></sensors>
<components>{components}</components><cameras>{cameras}</cameras></chunk></document>""")


def metashape_camera(name: str, pose: np.ndarray, attributes: str = "") -> str:
    """Return the element of a camera with a pose (4, 4) in its component, in OpenGL axes."""
    transform = as_text(pose @ np.diag([1, -1, -1, 1]))
    return f'<camera sensor_id="0" label="{name}" {attributes}><transform>{transform}</transform></camera>'


def test_metashape_merges_components_and_skips_disabled_cameras(tmp_path):
    """Each component has its own axes; the scene has those of the largest one, in metres."""
    write_photos(tmp_path / "images", [*NAMES, "off.png", "separate.png"])
    first, second = similarity(1, 2.5), similarity(2, 0.7)
    components = "".join(
        f'<component id="{number}"><transform><rotation>{as_text(matrix[:3, :3] / scale)}</rotation>'
        f"<translation>{as_text(matrix[:3, 3])}</translation><scale>{scale}</scale></transform></component>"
        for number, (matrix, scale) in enumerate([(first, 2.5), (second, 0.7)])
    )
    world = first @ np.diag([1 / 2.5, 1 / 2.5, 1 / 2.5, 1])  # the first component's axes in metres
    cameras = ""
    for name, pose, number in zip(NAMES, poses(), (0, 1, 0), strict=True):
        local = np.linalg.inv((first, second)[number]) @ world @ pose
        local[:3, :3] /= np.cbrt(np.linalg.det(local[:3, :3]))
        cameras += metashape_camera(name, local, f'component_id="{number}"')
    cameras += metashape_camera("off.png", poses()[0], 'component_id="0" enabled="false"')
    cameras += metashape_camera("separate.png", poses()[0], 'component_id="2"')
    write_metashape(tmp_path, cameras, components + '<component id="2"/>')
    scene = convert_export(tmp_path)
    assert scene.warnings[:2] == [
        "Skipped off.png: it is disabled in Metashape.",
        "Skipped separate.png: Metashape did not align it with the largest group of photos.",
    ]
    check(tmp_path, [pixels(*project(pose), (80, 80), (WIDTH / 2, HEIGHT / 2)) for pose in poses()])


def test_metashape_photos_in_folders_named_after_groups(tmp_path):
    names = "left/0001.png", "right/0001.png", "right/0002.png"
    write_photos(tmp_path / "images", names)
    cameras = [metashape_camera(name[-8:-4], pose) for name, pose in zip(names, poses(), strict=True)]
    left, right = cameras[0], cameras[1] + cameras[2]
    write_metashape(tmp_path, f'<group label="left">{left}</group><group label="right">{right}</group>')
    convert_export(tmp_path)
    expected = [pixels(*project(pose), (80, 80), (WIDTH / 2, HEIGHT / 2)) for pose in poses()]
    check(tmp_path, expected, names)
    write_metashape(tmp_path, "".join(cameras))
    (tmp_path / "sparse").rename(tmp_path / "old")
    assert "Skipped 0001: several photos have this name" in convert_export(tmp_path).warnings[0]


@pytest.mark.parametrize(("p1", "p2"), [(0.0, 0.0), (0.004, -0.003)])
def test_metashape_fisheye(tmp_path, p1, p2):
    """The formula of a frame camera, applied to a radius equal to the angle to the axis."""
    write_photos(tmp_path / "images")
    k = 0.03, -0.01, 0.004, -0.001
    distortion = (
        "".join(f"<k{n}>{value}</k{n}>" for n, value in enumerate(k, 1)) + f"<p1>{p1}</p1><p2>{p2}</p2>"
    )
    cameras = "".join(metashape_camera(name, pose) for name, pose in zip(NAMES, poses(), strict=True))
    write_metashape(tmp_path, cameras, kind="fisheye", lens=f"<f>80</f><cx>1.5</cx>{distortion}")
    convert_export(tmp_path)
    expected = []
    for pose in poses():
        x, y = project(pose)
        radius = np.hypot(x, y)
        x, y = x * np.arctan(radius) / radius, y * np.arctan(radius) / radius
        r = x * x + y * y
        radial = 1 + sum(value * r**n for n, value in enumerate(k, 1))
        distorted_x = x * radial + p1 * (r + 2 * x * x) + 2 * p2 * x * y
        distorted_y = y * radial + p2 * (r + 2 * y * y) + 2 * p1 * x * y
        expected.append(pixels(distorted_x, distorted_y, (80, 80), (WIDTH / 2 + 1.5, HEIGHT / 2)))
    check(tmp_path, expected)
