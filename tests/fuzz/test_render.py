"""Render process: frame requests and splat files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted, corrupted_value
from training.editing.look import Look, looks_as_dicts
from training.lod.crop import Crop
from training.render import wire
from training.render.blur import Blur, draw_blurred
from training.render.lens import ORTHOGRAPHIC, Aperture, LensProjection
from training.render.requests import FrameRequest, parse_line, parse_request
from training.render.scene import Instance, SplatSet
from training.scenes.cameras import MAX_PIXELS, Camera, camera_to_dict
from training.splats.dialects import drop_undrawable
from training.splats.gaussians import Splats

POSE = np.eye(4)
POSE[2, 3] = 4
ONE = {"file": "set-1", "count": 20, "matrix": np.diag([2.0, 1.0, 1.0, 1.0]).tolist(), "level": 2}
LOOKS = looks_as_dicts([(None, Look(0.5)), (Crop.sphere((0, 0, 0), 1), Look(opacity=0.5))])
REQUEST = {
    "frame": 7, "out": "frame-7", "background": [0.1, 0.2, 0.3], "depth": True, "levels": True,
    "camera": camera_to_dict(Camera("", 32, 24, 30.0, 30.0, 16.0, 12.0, POSE), 0.1),
    "window": [2, 3, 20, 16], "photograph": None, "mask": None, "holdout": None,
    "sets": [
        ONE | {"looks": LOOKS, "motion": [np.eye(4).tolist(), np.diag([1.0, 2.0, 1.0, 1.0]).tolist()]},
        ONE | {"matrix": np.eye(4).tolist(), "level": 0},
    ],
    "projection": LensProjection(ORTHOGRAPHIC, 4.0).as_dict(), "samples": 2,
    "aperture": Aperture(0.1, 3.0, 5, 0.2, 1.5).as_dict(),
    "cameras": [camera_to_dict(Camera("", 32, 24, 30.0, 30.0, 16.0, 12.0, POSE), 0.1)] * 2,
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("render")


@pytest.fixture(scope="module")
def splats() -> Splats:
    rng = np.random.default_rng(0)
    columns = [rng.normal(0, 0.7, (20, width)).astype(np.float32) for width in (3, 4, 3, 1, 12)]
    means, quats, log_scales, logits, sh = columns
    return Splats(means, quats, log_scales - 2, logits[:, 0], sh.reshape(20, 4, 3))


def render(request, splats: Splats) -> None:
    """Render the requested frame if it is small."""
    if isinstance(request, FrameRequest):
        width, height = (
            request.window[2:] if request.window else (request.camera.width, request.camera.height)
        )
        assert 1 <= width * height <= MAX_PIXELS
        if width * height <= 10_000:
            splat_set = SplatSet(splats, backend="cpu")
            instances = [
                Instance(splat_set, entry.matrix, entry.level, looks=entry.looks, motion=entry.motion)
                for entry in request.sets
            ]
            blur = Blur(min(request.samples, 3), request.aperture, request.cameras)
            image = draw_blurred(
                instances, request.camera, request.projection, blur, near=request.near,
                background=request.background, depth=request.depth, levels=request.levels,
                window=request.window, backend="cpu",
            )  # fmt: skip
            assert image is not None and image.alpha.shape == (height, width)


@pytest.mark.cases(short=120, weight=2)
@given(values=corrupted_value(REQUEST))
def test_requests_with_unusual_values(splats, values):
    line = json.dumps(values).encode()
    attempt("render request", lambda: render(parse_request(parse_line(line)), splats), values)


@given(data=st.data())
def test_corrupt_lines(data):
    line = data.draw(corrupted([json.dumps(REQUEST).encode(), b'{"cancel": 7}']))
    attempt("render request", lambda: parse_request(parse_line(line)), line)


@pytest.mark.cases(short=60, weight=1)
@given(data=st.data(), count=st.sampled_from([20, 20, 20, 0, 1, 19, 21, 1 << 29]))
def test_corrupt_sets(folder, splats, data, count):
    path = folder / "set-1"
    wire.write_set(path, wire.pack_set(splats, None))
    content = data.draw(corrupted([path.read_bytes()]))
    path.write_bytes(content)
    request = parse_request(REQUEST)
    attempt(
        "render set", lambda: render(request, drop_undrawable(wire.read_set(path, count)[0], path)), content
    )
