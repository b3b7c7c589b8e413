"""Other programs' exports: converted to a readable COLMAP scene, or rejected."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted, corrupted_value
from tests.training.scenes.synthetic import noise, write_image
from training.scenes.colmap import read_scene
from training.scenes.formats import convert_export

POSE = np.diag([1.0, -1.0, -1.0, 1.0])
TRANSFORMS = {
    "w": 96, "h": 72, "fl_x": 80.0, "fl_y": 82.0, "cx": 47.0, "cy": 37.0, "k1": 0.1, "p1": 0.01,
    "ply_file_path": "points.ply",
    "frames": [{"file_path": f"images/{name}", "transform_matrix": POSE.tolist()} for name in ("a.png", "b")],
}  # fmt: skip
POLYCAM = {f"t_{row}{column}": float(POSE[row, column]) for row in range(3) for column in range(4)} | {
    "fx": 80.0, "fy": 82.0, "cx": 47.0, "cy": 37.0, "width": 96, "height": 72, "blur_score": 90,
}  # fmt: skip
RECORD3D = {
    "poses": [[0, 0, 0, 1, 0, 0, k] for k in range(2)],
    "K": [80, 0, 0, 0, 82, 0, 47, 37, 1],
    "w": 96,
    "h": 72,
    "perFrameIntrinsicCoeffs": [[80, 82, 47, 37], [81, 83, 47, 37]],
}
LENS = {
    "value0": {"width": 96, "height": 72, "focal_length": 80, "principal_point": [47, 37]},
    "disto_k3": [0.1, 0, 0],
}
OPENMVG = {
    "root_path": "",
    "views": [
        {"key": 0, "value": {"ptr_wrapper": {"data": {"filename": "a.png", "id_intrinsic": 0, "id_pose": 0}}}}
    ],
    "intrinsics": [{"key": 0, "value": {"ptr_wrapper": {"data": LENS}}}],
    "extrinsics": [{"key": 0, "value": {"rotation": np.eye(3).tolist(), "center": [0, 0, 1]}}],
    "structure": [{"key": 0, "value": {"X": [0, 0, 5]}}],
}
OPENSFM = [
    {
        "cameras": {"c": {"projection_type": "brown", "width": 96, "height": 72, "focal_x": 0.8, "k1": 0.1}},
        "shots": {"a.png": {"rotation": [0.1, 0, 0], "translation": [0, 0, 1], "camera": "c"}},
        "points": {"1": {"coordinates": [0, 0, 5], "color": [255, 0, 0]}},
    }
]
SPLAT_CAMERAS = [
    {"id": 0, "img_name": "a", "width": 96, "height": 72, "position": [0, 0, 1], "fx": 80, "fy": 82,
     "rotation": np.eye(3).tolist()}
]  # fmt: skip
SCANNER_APP = {"cameraPoseARFrame": POSE.ravel().tolist(), "intrinsics": [80, 0, 47, 0, 82, 37, 0, 0, 1]}
BUNDLER = (
    "# Bundle file v0.3\n1 2\n80 0.1 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n" + "0 0 -5\n9 8 7\n1 0 1 2.5 3\n" * 2
)
METASHAPE = """<document version="2.0.0"><chunk><sensors><sensor id="0" type="frame"><calibration>
<resolution width="96" height="72"/><f>80</f><cx>1</cx><cy>2</cy><k1>0.1</k1><p1>0.01</p1></calibration>
</sensor><sensor id="1" master_id="0"><calibration><resolution width="96" height="72"/><f>80</f></calibration>
<rotation>1 0 0 0 1 0 0 0 1</rotation><location>1 0 0</location></sensor></sensors><cameras>
<camera id="1" sensor_id="1" master_id="0" label="b"/><camera id="0" sensor_id="0" label="a">
<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>
</camera></cameras><transform><scale>2</scale></transform></chunk></document>"""
REALITYCAPTURE = (
    "#cameras 2\n#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    "a.png,0,0,3,0,90,0,30,0.01,0,0.1,0,0,0,0.01,0\nb.png,1,0,3,0,90,0,30,0,0,0,0,0,0,0,0\n"
)
SIDECAR = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:DistortionModel="brown3"
 xcr:FocalLength35mm="30" xcr:Skew="0"><xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation>
<xcr:Position>0 0 1</xcr:Position><xcr:DistortionCoeficients>0.1 0 0 0 0 0</xcr:DistortionCoeficients>
</rdf:Description></rdf:RDF></x:xmpmeta>"""
PLY_HEADER = "ply\nformat ascii 1.0\nelement vertex 2\n"
PLY_HEADER += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
EXPORTS = {
    "transforms.json": json.dumps(TRANSFORMS),
    "keyframes/cameras/a.json": json.dumps(POLYCAM),
    "metadata": json.dumps(RECORD3D),
    "sfm_data.json": json.dumps(OPENMVG),
    "reconstruction.json": json.dumps(OPENSFM),
    "cameras.json": json.dumps(SPLAT_CAMERAS),
    "frame_0.json": json.dumps(SCANNER_APP),
    "bundle.out": BUNDLER,
    "cameras.xml": METASHAPE,
    "registration.csv": REALITYCAPTURE,
    "images/a.xmp": SIDECAR,
}
JSON = {
    "transforms.json": TRANSFORMS,
    "keyframes/cameras/a.json": POLYCAM,
    "metadata": RECORD3D,
    "sfm_data.json": OPENMVG,
    "reconstruction.json": OPENSFM,
    "cameras.json": SPLAT_CAMERAS,
    "frame_0.json": SCANNER_APP,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write photos to the folders of each format, and points."""
    folder = tmp_path_factory.mktemp("export")
    for subfolder in ("images", "rgb", "keyframes/images"):
        for name in ("a.png", "b.png"):
            write_image(folder / subfolder / name, noise())
    write_image(folder / "frame_0.png", noise())
    (folder / "list.txt").write_text("images/a.png\nimages/b.png\n")
    (folder / "points.ply").write_text(PLY_HEADER + "0 0 5\n0 1 5\n")
    return folder


def check(folder, name: str, content: bytes) -> None:
    for export in EXPORTS:
        (folder / export).unlink(missing_ok=True)
    shutil.rmtree(folder / "sparse", ignore_errors=True)
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    result = attempt(f"export {path.suffix}", lambda: convert_export(folder), (name, content))
    if result is None:
        assert not (folder / "sparse" / "0").exists()
    else:
        scene = attempt("COLMAP of an export", lambda: read_scene(folder), (name, content))
        assert scene is None or scene.cameras


def test_seeds_are_valid_exports(folder):
    for name, content in EXPORTS.items():
        check(folder, name, content.encode())
        assert (folder / "sparse" / "0" / "cameras.bin").is_file(), name


@pytest.mark.cases(short=120, weight=2)
@given(data=st.data(), name=st.sampled_from(sorted(EXPORTS)))
def test_corrupt_texts(folder, data, name):
    check(folder, name, data.draw(corrupted([EXPORTS[name].encode()])))


@pytest.mark.cases(short=120, weight=2)
@given(data=st.data(), name=st.sampled_from(sorted(JSON)))
def test_corrupt_values(folder, data, name):
    check(folder, name, json.dumps(data.draw(corrupted_value(JSON[name]))).encode("utf-8", "surrogatepass"))


@pytest.mark.cases(short=60, weight=1)
@given(data=st.data())
def test_corrupt_points(folder, data):
    (folder / "points.ply").write_bytes(data.draw(corrupted([(PLY_HEADER + "0 0 5\n0 1 5\n").encode()])))
    check(folder, "transforms.json", EXPORTS["transforms.json"].encode())
