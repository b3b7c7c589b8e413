"""Preview of a clean-up: counts and colours of planted splats, the choice of the view, and errors."""

import numpy as np
import pytest
from PIL import Image

from tests.training.conftest import write_tiny_scene
from tests.training.lod.tree.trees import tree_of
from training.__main__ import main
from training.editing.clutter import KINDS
from training.scenes.cameras import Camera, look_at
from training.scenes.view_tables import make_view_tables
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply

FLOATERS = [(3, 0, 0), (3, 0.1, 0), (3, 0.2, 0)]
LARGE = [(-3, 0, 0), (-3, 0.5, 0)]
FAINT = [(0, 1.5, 0), (0.1, 1.5, 0), (0.2, 1.5, 0), (0.3, 1.5, 0)]
CROPPED = [(0, -8, 0)]
TESTS = "--drop-floaters --gap 0.2 --share 0.02 --max-size 0.3 --min-opacity 0.05 --crop-sphere 0 0 0 5"
LINES = ["4 floaters (orange)", "2 large splats (yellow)", "4 faint splats (cyan)", "1 cropped splat (blue)"]
FRONT = Camera(
    "front.jpg", 128, 72, 100.0, 100.0, 64.0, 36.0, look_at(np.array([0, 0, -6.0]), np.zeros(3), (0, -1, 0))
)


def edit(arguments):
    return main(["edit", *arguments.split()])


def wall(step):
    """Return means of a wall of 2 x 2 units."""
    return [(x, y, 0) for x in np.arange(-1, 1, step) for y in np.arange(-1, 1, step)]


def red_splats(means, large=(), faint=()):
    """Return red opaque spheres with standard deviation 0.05; some of 0.5, and some with opacity 0.02."""
    count = len(means)
    sizes = [0.5 if mean in large else 0.05 for mean in means]
    opacities = np.array([0.02 if mean in faint else 0.9999 for mean in means])
    return Splats(
        means=np.array(means, np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.repeat(np.log(np.float32(sizes))[:, None], 3, axis=1),
        opacity_logits=np.log(opacities / (1 - opacities)).astype(np.float32),
        sh=np.tile(np.float32([1.5, -1.5, -1.5]), (count, 1, 1)),
    )


@pytest.fixture
def bundle(tmp_path, monkeypatch):
    """Write two levels with planted splats; the first of two views looks away from them."""
    monkeypatch.chdir(tmp_path)
    fine = red_splats([*wall(0.1), *FLOATERS, *LARGE, *FAINT, *CROPPED], LARGE, FAINT)
    levels = [
        Level(1, red_splats([*wall(0.2), FLOATERS[0]]), {"s_min": 0.2}), Level(2, fine, {"s_min": 0.0}),
    ]  # fmt: skip
    opposite = Camera(
        "away.jpg",
        128,
        72,
        100.0,
        100.0,
        64.0,
        36.0,
        look_at(np.array([0, 0, -6.0]), np.array([0, 0, -9.0]), (0, -1, 0)),
    )
    write_bundle("in.ply", Bundle("flod", levels, "bands", tables=make_view_tables([opposite, FRONT], 0.1)))
    return tmp_path


def pixels(path):
    with Image.open(path) as file:
        return np.asarray(file).astype(int)


def at(image, mean):
    """Return the colour of the pixel at a mean in the image of FRONT."""
    column, row = 10 * FRONT.project(np.array([mean], np.float64))[0][0]
    return image[int(row), int(column)]


def test_removed_splats_are_counted_and_tinted(bundle, capsys):
    assert edit(f"in.ply --preview out.png {TESTS}") == 0
    assert capsys.readouterr().out.splitlines() == [*LINES, "out.png: written, as seen in front.jpg"]
    assert sorted(path.name for path in bundle.iterdir()) == ["in.ply", "out.png"]
    image = pixels("out.png")
    assert image.shape == (720, 1280, 3)
    for name, mean in (("drop_floaters", FLOATERS[0]), ("max_size", LARGE[0])):
        assert np.abs(at(image, mean) - 255 * np.array(KINDS[name].color)).max() <= 5, name
    faint = at(image, FAINT[1])
    assert faint[0] < 3 < faint[1] < 20 and faint[2] > 3, "faint splats stay faint"
    grey = at(image, (0, 0, 0))
    assert np.ptp(grey) <= 1 and grey.min() > 30


def test_written_splats_are_those_without_the_tinted_ones(bundle, capsys):
    assert edit(f"in.ply --preview out.png --out out.ply {TESTS}") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:4] == LINES and lines[-1] == "out.ply: written"
    assert [len(level.splats) for level in read_bundle("out.ply").levels] == [100, 400]


def test_splats_of_two_kinds_count_in_both(bundle, capsys):
    assert edit("in.ply --preview out.png --max-size 0.3 --crop-sphere 0 0 0 2.9") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["2 large splats (yellow)", "7 cropped splats (blue)"]
    assert np.abs(at(pixels("out.png"), LARGE[0]) - 255 * np.array(KINDS["max_size"].color)).max() <= 5


@pytest.mark.parametrize("count", [3, 2000])
def test_views_are_chosen_for_files_without_them(tmp_path, monkeypatch, capsys, count):
    """Few splats are visible from the front, and many from a viewpoint of ``overview.choose_view``."""
    monkeypatch.chdir(tmp_path)
    means = np.random.default_rng(0).normal(size=(count, 3)).tolist()
    write_ply("in.ply", red_splats([tuple(mean) for mean in means]))
    assert edit("in.ply --preview out.png --crop-sphere 0 0 0 0.5") == 0
    outside = int((np.linalg.norm(np.float32(means), axis=1) > 0.5).sum())
    assert capsys.readouterr().out.startswith(f"{outside:,} cropped splats (blue)\nout.png: written\n")
    red, _, blue = pixels("out.png").reshape(-1, 3).T
    assert ((blue > 200) & (red < 60)).sum() > 500


def test_views_are_those_of_a_scene(bundle, capsys):
    """The cameras are on an arc of radius 4, and look at the origin."""
    scene = write_tiny_scene(bundle / "scene")
    far = [(0, 0.1 * n, -20) for n in range(5)]
    write_ply("far.ply", red_splats([*wall(0.5), *far]))
    assert edit("far.ply --preview out.png --max-distance 10 --scene scene") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "5 far splats (magenta)"
    assert (scene / "images" / lines[1].removeprefix("out.png: written, as seen in ")).is_file()
    red, green, blue = pixels("out.png").reshape(-1, 3).T
    assert ((red > 150) & (green < 60) & (blue > 150)).any()


def test_nodes_of_trees_do_not_count(tmp_path, monkeypatch, make_splats, capsys):
    monkeypatch.chdir(tmp_path)
    leaves = make_splats(1500)
    write_bundle("in.ply", tree_of(leaves))
    assert edit("in.ply --preview out.png --crop-sphere 0 0 0 1") == 0
    outside = int((np.linalg.norm(leaves.means, axis=1) > 1).sum())
    assert capsys.readouterr().out.startswith(f"{outside:,} cropped splats")


def test_clutter_is_found_in_one_step(tmp_path, monkeypatch, capsys):
    """A ground of 8 x 8 units with planted clutter; a large distant background stays."""
    monkeypatch.chdir(tmp_path)
    ground = [(x, 0, z) for x in np.arange(-4, 4, 0.1) for z in np.arange(-4, 4, 0.1)]
    large, halos = [(0.5, -0.1, 0), (0, -0.1, 0.5)], [(1, -0.2, 1), (1, -0.2, 0), (0, -0.2, 1)]
    background, distant, floaters = [(30, 0, 0)], [(900, 0, 0)], [(0, -5, 0), (0, -5.01, 0)]
    below = [(x, 2, 0) for x in np.arange(-2, 2, 0.1)]
    means = [*ground, *large, *halos, *background, *distant, *floaters, *below]
    splats = red_splats(means)
    sizes = {mean: 4.0 for mean in [*large, *background]} | dict.fromkeys(halos, 0.8)
    splats.log_scales[:] = np.log([[sizes.get(mean, 0.05)] for mean in means])
    splats.opacity_logits[[mean in halos for mean in means]] = -4
    write_ply("in.ply", splats)
    assert edit("in.ply --preview out.png --out out.ply --clutter") == 0
    assert capsys.readouterr().out.splitlines()[:4] == [
        "2 floaters (orange)", "2 large splats (yellow)", "3 halos (pink)", "1 distant splat (violet)",
    ]  # fmt: skip
    remaining = len(ground) + len(background) + len(below)
    assert len(read_bundle("out.ply").levels[0].splats) == remaining
    assert edit("in.ply --preview out.png --clutter --min-depth 1 --max-reach 1000") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[3:5] == ["0 distant splats (violet)", f"{len(below)} buried splats (red)"]


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("missing.ply --preview out.png --drop-floaters", "missing.ply"),
        ("in.ply --preview out.png", "Cannot preview the clean-up: no splats are tested. Add a crop"),
        ("in.ply --preview out.jpg --drop-floaters", "Cannot write out.jpg: unsupported image format."),
        ("in.ply --preview in.ply/out.png --drop-floaters", "Cannot write in.ply/out.png: "),
        ("in.ply", "--tiles or --preview."),
    ],
)
def test_errors(bundle, capsys, command, message):
    assert edit(command) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    assert sorted(path.name for path in bundle.iterdir()) == ["in.ply"]
