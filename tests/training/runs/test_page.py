"""Pages to share, with a stand-in for the viewer."""

import base64
import io
import json
import re
import sys
import zipfile
from math import atan, degrees

import numpy as np
import pytest
from PIL import Image

from training.__main__ import main
from training.errors import LodgsError
from training.runs.page import write
from training.runs.page.write import write_page
from training.scenes.cameras import Camera
from training.scenes.view_tables import make_view_tables
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.sog import decode_sog
from training.splats.streamed_levels import STREAMED_FILE


@pytest.fixture(autouse=True)
def viewer(tmp_path, monkeypatch):
    folder = tmp_path / "viewer"
    folder.mkdir()
    script = (
        "const createViewer = async () => {};\nexport { createViewer };\n//# sourceMappingURL=index.js.map\n"
    )
    for name, text in {"index.js": script, "index.css": "a {}", "LICENSE": "MIT */ licence"}.items():
        (folder / name).write_text(text, "utf-8")
    monkeypatch.setattr(write, "VIEWER", folder)
    return folder


def splats(count: int, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(count, 3)).astype(np.float32)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    return Splats(
        normal, quats, normal * 0 - 3, normal[:, 0], rng.normal(size=(count, 1, 3)).astype(np.float32)
    )


@pytest.fixture
def bundle(tmp_path):
    """Two levels and a camera 5 units above the origin (COLMAP axes: y is down) that looks to +z."""
    camera = Camera("<first>.jpg", 64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    camera.world_to_camera[:3, 3] = 0, 5, 3
    levels = [Level(1, splats(100)), Level(2, splats(400, 1))]
    meta = {"up_rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}
    path = tmp_path / "garden" / "bundle.ply"
    path.parent.mkdir()
    write_bundle(path, Bundle("flod", levels, meta=meta, tables=make_view_tables([camera], 0.1)))
    return path


def page_of(text: str) -> dict:
    return json.loads(re.search(r"^const page = (.*);$", text, re.MULTILINE)[1])


def test_folder_has_levels_viewer_and_cameras(bundle, tmp_path):
    write_page(bundle, tmp_path / "out", backend="cpu")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"index.html", "levels", "poster.png", "viewer"}
    meta = json.loads((tmp_path / "out" / "levels" / STREAMED_FILE).read_text("utf-8"))
    assert meta["lodLevels"] == 2
    text = (tmp_path / "out" / "index.html").read_text("utf-8")
    page = page_of(text)
    assert "<title>garden</title>" in text and "2 levels, 400 splats" in text
    assert page["budgets"] == [40, 100, 200, 400] and page["streamed"]
    pose = page["settings"]["cameras"][0]["initial"]
    # y is down and the viewer turns files by half a turn about z: (x, y, z) is at (-x, -y, z)
    np.testing.assert_allclose(pose["position"], [0, 5, -3], atol=1e-6)
    forward = np.subtract(pose["target"], pose["position"])
    np.testing.assert_allclose(forward / np.linalg.norm(forward), [0, 0, 1], atol=1e-6)
    assert pose["fov"] == pytest.approx(degrees(2 * atan(16 / 9 * 24 / 60)))
    assert page["settings"]["annotations"][0]["title"] == "<first>.jpg" and "<first>" not in text
    (tmp_path / "out" / ".DS_Store").touch()  # of macOS, once the folder was viewed
    write_page(bundle, tmp_path / "out", backend="cpu")  # replaces the page
    assert {path.name for path in tmp_path.iterdir()} == {"garden", "out", "viewer"}


def test_splats_without_cameras_have_an_overview(tmp_path):
    """The start view sees most splats of a scene far from the origin, and so does the poster."""
    far = splats(2000)
    far.means += 50
    far.opacity_logits[:] = 3
    write_bundle(tmp_path / "far.ply", Bundle("", [Level(1, far)]))
    write_page(tmp_path / "far.ply", tmp_path / "out", backend="cpu")
    page = page_of((tmp_path / "out" / "index.html").read_text("utf-8"))
    (entry,) = page["settings"]["annotations"]
    assert entry["title"] == "Overview"
    pose = page["settings"]["cameras"][0]["initial"]
    distance = np.linalg.norm(np.subtract(pose["position"], pose["target"]))
    assert 1 < distance < 20 and np.linalg.norm(pose["target"]) > 50
    assert np.asarray(Image.open(tmp_path / "out" / "poster.png")).std() > 10
    assert (tmp_path / "out" / "levels" / STREAMED_FILE).is_file()


def test_single_file_contains_everything(bundle, tmp_path):
    write_page(bundle, tmp_path / "page.html", single=True, title="A & B", backend="cpu")
    text = (tmp_path / "page.html").read_text("utf-8")
    page = page_of(text)
    with zipfile.ZipFile(io.BytesIO(base64.b64decode(page["content"].split(",")[1]))) as archive:
        assert len(decode_sog(archive.read)[0]) == 400
    assert page["poster"].startswith("data:image/png") and not page["streamed"]
    assert "A &amp; B" in text and "export {" not in text and "src=" not in text and "href=" not in text
    assert {path.name for path in tmp_path.iterdir()} == {"garden", "page.html", "viewer"}


def test_errors_name_the_cause_and_leave_nothing(bundle, tmp_path, viewer, monkeypatch):
    with pytest.raises(LodgsError, match="HTML"):
        write_page(bundle, tmp_path / "page", single=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").touch()
    with pytest.raises(LodgsError, match="other files"):
        write_page(bundle, tmp_path / "other")
    (tmp_path / "other" / "index.html").touch()  # another page
    with pytest.raises(LodgsError, match="other files"):
        write_page(bundle, tmp_path / "other")
    with pytest.raises(LodgsError, match="not a folder"):
        write_page(bundle, tmp_path / "other" / "thesis.txt")
    assert {path.name for path in (tmp_path / "other").iterdir()} == {"index.html", "thesis.txt"}
    monkeypatch.setattr(write, "MAX_SINGLE", 10)
    with pytest.raises(LodgsError, match="more than 10"):
        write_page(bundle, tmp_path / "page.html", single=True, backend="cpu")
    (viewer / "index.js").unlink()
    with pytest.raises(LodgsError, match="no viewer"):
        write_page(bundle, tmp_path / "page")
    assert {path.name for path in tmp_path.iterdir()} == {"garden", "other", "viewer"}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("missing.ply", None),
        ("empty.ply", b""),
        ("text.ply", b"hello"),
        ("photo.jpg", b"\xff\xd8\xff"),
        (
            "cut.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n",
        ),
        ("empty.spz", b""),
        ("empty.sog", b""),
        ("empty.splat", b""),
        ("unknown.xyz", b"0 0 0"),
        ("x" * 300 + ".ply", None),
        ("folder", "folder"),
        ("loop.ply", "link"),
    ],
)
def test_wrong_inputs_end_with_a_message(tmp_path, capsys, name, content):
    path = tmp_path / name
    if content == "folder":
        path.mkdir()
    elif content == "link":
        path.symlink_to(path)
    elif content is not None:
        path.write_bytes(content)
    assert main(["page", str(path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("error: Cannot ") and not (tmp_path / "out").exists()


@pytest.mark.parametrize("out", ["file", "file/below", "n" * 300, "loop"])
def test_unusable_places_end_with_a_message(bundle, tmp_path, capsys, out):
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    before = sorted(tmp_path.iterdir())
    assert main(["page", str(bundle), "--out", str(tmp_path / out)]) == 2
    assert capsys.readouterr().err.startswith("error: Cannot ") and sorted(tmp_path.iterdir()) == before


def test_title_that_is_not_utf8(bundle, tmp_path):
    write_page(bundle, tmp_path / "out", title="caf\udce9", backend="cpu")
    assert "caf\\xdce9" in (tmp_path / "out" / "index.html").read_text("utf-8")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows stores halves of surrogate pairs")
def test_names_that_are_not_utf8(bundle, tmp_path):
    folder = tmp_path / "caf\udce9"
    assert str(folder) in write_page(bundle, folder, backend="cpu") and (folder / "index.html").is_file()
    with pytest.raises(LodgsError, match="not a valid file name"):
        write_page(bundle, tmp_path / "caf\ud800", backend="cpu")
    with pytest.raises(LodgsError, match="not a valid file name"):
        write_page(bundle, tmp_path / "caf\ud800.html", single=True, backend="cpu")
