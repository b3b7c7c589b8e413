"""Pages to share, of corrupt splats and with unusual titles: written completely, or refused."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted, corrupted_value
from tests.training.splats.test_formats import random_splats
from training.runs.page import write
from training.scenes.cameras import Camera
from training.scenes.view_tables import make_view_tables
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply

META = {"up_rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "antialias": True, "origin": [5e5, 4.2e6, 300.0]}
LEVELS = [Level(1, random_splats(6, 1)), Level(2, random_splats(12, 1, seed=1))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder, with a small stand-in for the viewer and small posters."""
    folder = tmp_path_factory.mktemp("pages")
    (folder / "viewer").mkdir()
    for name in ("index.js", "index.css", "LICENSE"):
        (folder / "viewer" / name).write_text("export { createViewer };\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "VIEWER", folder / "viewer")
        patch.setattr(write, "POSTER_WIDTH", 32)
        yield folder


def tables() -> dict:
    camera = Camera("a.png", 32, 24, 30.0, 30.0, 16.0, 12.0, np.eye(4))
    camera.world_to_camera[:3, 3] = 0, 0, 4
    return make_view_tables([camera], 0.1)


@pytest.fixture(scope="module")
def seeds(folder) -> list[bytes]:
    contents = []
    write_bundle(folder / "a.ply", Bundle("flod", LEVELS, meta=META, tables=tables()))
    contents.append((folder / "a.ply").read_bytes())
    write_ply(folder / "a.ply", random_splats(9, 2))
    return [*contents, (folder / "a.ply").read_bytes()]


def check(folder, single: bool, title: str, content: object) -> None:
    target = folder / ("page.html" if single else "page")
    arguments = {"single": single, "title": title, "backend": "cpu"}
    written = attempt("page", lambda: write.write_page(folder / "a.ply", target, **arguments), content)
    assert not list(folder.glob(".*"))
    if written is None:
        return
    text = (target if single else target / "index.html").read_text("utf-8")
    page = json.loads(re.search(r"^const page = (.*);$", text, re.MULTILINE)[1])  # type: ignore[index]
    for annotation in page["settings"]["annotations"]:
        assert np.isfinite([*annotation["camera"]["initial"]["position"], *annotation["position"]]).all()


@pytest.mark.cases(short=40, weight=0.4)
@given(data=st.data(), single=st.booleans(), title=st.text(max_size=9))
def test_corrupt_splats(folder, seeds, data, single, title):
    content = data.draw(corrupted(seeds))
    (folder / "a.ply").write_bytes(content)
    check(folder, single, title, content)


@pytest.mark.cases(short=20, weight=0.2)
@given(meta=corrupted_value(META), single=st.booleans())
def test_unusual_meta(folder, seeds, meta, single):
    text = json.dumps({"meta": META})[1:-1]
    replacement = json.dumps({"meta": meta})[1:-1].encode("utf-8", "surrogatepass")
    (folder / "a.ply").write_bytes(seeds[0].replace(text.encode(), replacement))
    check(folder, single, "", meta)
