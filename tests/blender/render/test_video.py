"""Extraction of sharp video frames."""

import struct
from pathlib import Path

import numpy as np
import pytest

from tests.training.scenes.walls import CAMERA_POSITIONS, render_photo
from training.scenes.images import write_png

pytestmark = pytest.mark.one_blender


BLURRED = (1, 2, 4, 7, 8, 10, 11)


def blurred(pixels: np.ndarray) -> np.ndarray:
    """Return the mean over 9x9 pixels."""
    total = np.zeros(pixels.shape)
    for y in range(-4, 5):
        for x in range(-4, 5):
            total += np.roll(pixels, (y, x), (0, 1))
    return (total / 81).astype(np.uint8)


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """Twelve frames along a path, some of them blurred."""
    path = np.linspace(0, len(CAMERA_POSITIONS) - 1, 12)
    indices = range(len(CAMERA_POSITIONS))
    positions = np.stack([np.interp(path, indices, column) for column in CAMERA_POSITIONS.T], axis=1)
    images = [render_photo(position) for position in positions]
    return [blurred(image) if number in BLURRED else image for number, image in enumerate(images)]


def encode(bpy, lodgs, frames: list[np.ndarray], path: Path, kind: str, codec: str) -> Path:
    """Encode frames losslessly as a video with Blender."""
    for number, pixels in enumerate(frames):
        write_png(path.parent / f"{number:02d}.png", pixels)
    scene = bpy.data.scenes.new("encode")
    compat = lodgs("compat")
    strip = compat.sequencer_strips(scene).new_image(
        "a", str(path.parent / "00.png"), channel=1, frame_start=1
    )
    for number in range(1, len(frames)):
        strip.elements.append(f"{number:02d}.png")
    strip.frame_final_duration = len(frames)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 320, 240, 100
    scene.view_settings.view_transform = "Standard"
    scene.frame_start, scene.frame_end = 1, len(frames)
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = "VIDEO"
    render.image_settings.file_format = "FFMPEG"
    render.ffmpeg.format, render.ffmpeg.codec = kind, codec
    render.ffmpeg.constant_rate_factor = "LOSSLESS"
    render.filepath = str(path)
    bpy.ops.render.render(animation=True, scene=scene.name)
    bpy.data.scenes.remove(scene)
    return path


@pytest.fixture
def video(bpy, lodgs, frames, tmp_path) -> Path:
    return encode(bpy, lodgs, frames, tmp_path / "walk.mkv", "MKV", "FFV1")


def test_frames_of_a_rotated_video_are_upright(bpy, lodgs, frames, tmp_path):
    """The track header has the rotation matrix (ISO/IEC 14496-12)."""
    path = encode(bpy, lodgs, frames[:3], tmp_path / "phone.mp4", "MPEG4", "H264")
    data = bytearray(path.read_bytes())
    offset = data.index(b"tkhd") + 44
    assert struct.unpack_from(">9i", data, offset) == (65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, offset, 0, -65536, 0, 65536, 0, 0, 0, 0, 1 << 30)  # 90 degrees to the left
    path.write_bytes(data)
    lodgs("render.video").extract_frames(path, tmp_path / "out", 3)
    for number in range(3):
        image = bpy.data.images.load(str(tmp_path / "out" / f"frame_{number + 1:06d}.png"))
        assert tuple(image.size) == (240, 320)
        pixels = np.array(image.pixels[:]).reshape(320, 240, -1)[::-1, :, :3]
        bpy.data.images.remove(image)
        assert np.abs(pixels - np.rot90(frames[number]) / 255).mean() < 0.05


def test_sharpest_frame_of_each_interval_is_kept(bpy, lodgs, video, frames, tmp_path):
    scenes, images = len(bpy.data.scenes), len(bpy.data.images)
    calls = []
    extract = lodgs("render.video").extract_frames
    assert extract(video, tmp_path / "out", 4, lambda *arguments: calls.append(arguments)) == 4
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert len(names) == 4
    for name in names:
        number = int(name[6:12]) - 1
        assert number not in BLURRED
        image = bpy.data.images.load(str(tmp_path / "out" / name))
        pixels = np.array(image.pixels[:]).reshape(240, 320, -1)[::-1, :, :3]
        bpy.data.images.remove(image)
        assert np.abs(pixels - frames[number] / 255).mean() < 0.01
    assert calls == [(number, 4) for number in (1, 2, 3, 4)]
    assert (len(bpy.data.scenes), len(bpy.data.images)) == (scenes, images)


def test_existing_frames_are_kept(lodgs, video, tmp_path):
    extract = lodgs("render.video").extract_frames
    extract(video, tmp_path / "out", 4)
    first, *_, last = sorted((tmp_path / "out").iterdir())
    last.unlink()
    first.write_bytes(b"unchanged")
    extract(video, tmp_path / "out", 4)
    assert first.read_bytes() == b"unchanged" and last.is_file()


def test_short_video_gives_all_its_frames(lodgs, video, tmp_path):
    assert lodgs("render.video").extract_frames(video, tmp_path / "out", 500) == 12
    assert len(list((tmp_path / "out").iterdir())) == 12


@pytest.mark.parametrize("content", [b"", b"no video", None])
def test_unreadable_videos_are_reported(lodgs, tmp_path, content, capfd):
    path = tmp_path / "a.mp4"
    if content is not None:
        path.write_bytes(content)
    assert lodgs("commands").main(["frames", str(path), "--out", str(tmp_path / "out")]) == 2
    errors = capfd.readouterr().err
    assert "as a video" in errors or str(path) in errors
    assert not (tmp_path / "out").exists()


def test_folder_that_is_not_writable_is_reported(lodgs, video, tmp_path, capfd):
    (tmp_path / "out").write_text("no folder")
    assert lodgs("commands").main(["frames", str(video), "--out", str(tmp_path / "out")]) == 2
    assert "out: File exists. Choose another folder." in capfd.readouterr().err


def test_video_becomes_a_scene(bpy, lodgs, video, blender, tmp_path):
    assert bpy.ops.lodgs.find_cameras(filepath=str(video)) == {"FINISHED"}
    work = lodgs("runs.photo_preparation").current
    assert work.root.lodgs.scene_folder == str(tmp_path / "walk_scene")
    assert len(work.root.lodgs.cameras.objects) >= 4
