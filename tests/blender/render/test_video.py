"""Frames of a video: those that are sharp, as they were drawn."""

import struct
from pathlib import Path

import numpy as np
import pytest

from tests.training.scenes.walls import CAMERA_POSITIONS, render_photo
from training.scenes.images import write_png

BLURRED = (1, 2, 4, 7, 8, 10, 11)


def blurred(pixels: np.ndarray) -> np.ndarray:
    """The mean over 9x9 pixels."""
    total = np.zeros(pixels.shape)
    for y in range(-4, 5):
        for x in range(-4, 5):
            total += np.roll(pixels, (y, x), (0, 1))
    return (total / 81).astype(np.uint8)


@pytest.fixture(scope="module")
def drawn() -> list[np.ndarray]:
    """Twelve frames of a walk along EYES; some are blurred."""
    along = np.linspace(0, len(CAMERA_POSITIONS) - 1, 12)
    eyes = np.stack(
        [np.interp(along, range(len(CAMERA_POSITIONS)), column) for column in CAMERA_POSITIONS.T], axis=1
    )
    frames = [render_photo(eye) for eye in eyes]
    return [blurred(frame) if number in BLURRED else frame for number, frame in enumerate(frames)]


def coded(bpy, lodgs, drawn: list[np.ndarray], path: Path, kind: str, codec: str) -> Path:
    """A video of these frames, losslessly coded by Blender."""
    for number, pixels in enumerate(drawn):
        write_png(path.parent / f"{number:02d}.png", pixels)
    scene, compat = bpy.data.scenes.new("made"), lodgs("compat")
    strip = compat.strips(scene).new_image("a", str(path.parent / "00.png"), channel=1, frame_start=1)
    for number in range(1, len(drawn)):
        strip.elements.append(f"{number:02d}.png")
    strip.frame_final_duration = len(drawn)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 320, 240, 100
    scene.view_settings.view_transform = "Standard"
    scene.frame_start, scene.frame_end = 1, len(drawn)
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
def video(bpy, lodgs, drawn, tmp_path) -> Path:
    return coded(bpy, lodgs, drawn, tmp_path / "walk.mkv", "MKV", "FFV1")


def test_a_phone_that_was_held_upright(bpy, lodgs, drawn, tmp_path):
    """Its video says by how much it is turned: the matrix of the track's header, ISO/IEC 14496-12."""
    path = coded(bpy, lodgs, drawn[:3], tmp_path / "phone.mp4", "MPEG4", "H264")
    data = bytearray(path.read_bytes())
    place = data.index(b"tkhd") + 44
    assert struct.unpack_from(">9i", data, place) == (65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, place, 0, -65536, 0, 65536, 0, 0, 0, 0, 1 << 30)  # a quarter to the left
    path.write_bytes(data)
    lodgs("render.video").extract_frames(path, tmp_path / "out", 3)
    for number in range(3):
        image = bpy.data.images.load(str(tmp_path / "out" / f"frame_{number + 1:06d}.png"))
        assert tuple(image.size) == (240, 320)
        pixels = np.array(image.pixels[:]).reshape(320, 240, -1)[::-1, :, :3]
        bpy.data.images.remove(image)
        assert np.abs(pixels - np.rot90(drawn[number]) / 255).mean() < 0.05


def test_of_each_part_the_sharpest_frame_is_kept(bpy, lodgs, video, drawn, tmp_path):
    scenes, images, told = len(bpy.data.scenes), len(bpy.data.images), []
    extract = lodgs("render.video").extract_frames
    assert extract(video, tmp_path / "out", 4, lambda *each: told.append(each)) == 4
    kept = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert len(kept) == 4
    for name in kept:
        number = int(name[6:12]) - 1
        assert number not in BLURRED
        image = bpy.data.images.load(str(tmp_path / "out" / name))
        pixels = np.array(image.pixels[:]).reshape(240, 320, -1)[::-1, :, :3]
        bpy.data.images.remove(image)
        assert np.abs(pixels - drawn[number] / 255).mean() < 0.01
    assert told == [(number, 4) for number in (1, 2, 3, 4)]
    assert (len(bpy.data.scenes), len(bpy.data.images)) == (scenes, images)


def test_it_goes_on_where_it_was(lodgs, video, tmp_path):
    extract = lodgs("render.video").extract_frames
    extract(video, tmp_path / "out", 4)
    first, *_, last = sorted((tmp_path / "out").iterdir())
    last.unlink()
    first.write_bytes(b"kept")
    extract(video, tmp_path / "out", 4)
    assert first.read_bytes() == b"kept" and last.is_file()


def test_all_frames_of_a_short_video(lodgs, video, tmp_path):
    assert lodgs("render.video").extract_frames(video, tmp_path / "out", 500) == 12
    assert len(list((tmp_path / "out").iterdir())) == 12


@pytest.mark.parametrize("content", [b"", b"no video", None])
def test_what_is_no_video(lodgs, tmp_path, content, capfd):
    path = tmp_path / "a.mp4"
    if content is not None:
        path.write_bytes(content)
    assert lodgs("commands").main(["frames", str(path), "--out", str(tmp_path / "out")]) == 2
    said = capfd.readouterr().err
    assert "cannot be read as a video" in said or "does not exist" in said
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written(lodgs, video, tmp_path, capfd):
    (tmp_path / "out").write_text("no folder")
    assert lodgs("commands").main(["frames", str(video), "--out", str(tmp_path / "out")]) == 2
    assert "out could not be written: File exists. Choose another folder." in capfd.readouterr().err


def test_a_video_becomes_a_scene(bpy, lodgs, video, blender, tmp_path):
    assert bpy.ops.lodgs.find_cameras(filepath=str(video)) == {"FINISHED"}
    work = lodgs("runs.photo_preparation").current
    assert work.root.lodgs.scene_folder == str(tmp_path / "walk_scene")
    assert len(work.root.lodgs.cameras.objects) >= 4
