"""Tests of method folders: a new folder is discovered, trains its own column and starts from a base."""

import inspect
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from training import methods
from training.errors import LodgsError
from training.evaluate.metrics import psnr
from training.optimize.method import Method
from training.optimize.parameters import override
from training.rasterize import Gaussians, rasterize
from training.runs import train as training_loop
from training.runs.base import read_base
from training.runs.failures import BAD_INPUT
from training.runs.folder import RunFolder
from training.runs.job import KEYS, Job
from training.runs.measure import evaluate_run
from training.scenes.colmap import read_scene
from training.scenes.images import load_image
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.morton import spatial_order
from training.splats.ply import write_ply

ABOUT = """
from dataclasses import dataclass
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import Parameters
from ...settings import setting

@dataclass(frozen=True)
class TinyParameters(Parameters):
    lr_decay: float = setting(0.1, "Learning rate of decays.", above=0)

METHOD = MethodInfo(
    name="tiny", number=99, label="Tiny", about="for tests", parameters=TinyParameters,
    presets={name: TinyParameters(steps=8) for name in ("draft", "standard", "paper")}, from_base=True,
)
"""
TRAIN = '''
import numpy as np
import torch
from ...splats.bundle import Level
from ...optimize import method
from ...optimize.density_control import densify, prune
from ...optimize.method import Drawing
from ...optimize.model import Model, splat_rates
from ...optimize.initialize import drop_duplicates, from_points, from_splats

class Method(method.Method):
    """Draw all splats without and with trained weights; clone in step 4, prune in step 6."""

    def setup(self, base):
        p, scene = self.parameters, self.data.scene
        if base is None:
            points = drop_duplicates(scene.points, scene.point_colors)
            tensors = from_points(*points, p.sh_degree, self.device)
        else:
            tensors = from_splats(base, p.sh_degree, self.device)
        tensors["decay"] = torch.linspace(0.5, 1.5, len(tensors["means"]))
        self.model = Model(tensors, splat_rates(p, self.data.extent) | {"decay": p.lr_decay})

    def levels_after(self, step):
        return [Level(1, self.model.splats())] if step + 1 == self.steps else []

    def draw(self, view, step):
        weights = torch.exp(-self.model["decay"] ** 2)
        return [Drawing(self.rasterize_model(view.camera, step, weights=w)) for w in (None, weights)]

    def set_learning_rates(self, step):
        pass

    def control_density(self, step):
        if step == 4:
            densify(
                self.model, self.model.mean_gradient(), threshold=0.0, clone_below=1e9, max_splats=70,
                rng=np.random.default_rng(0),
            )
        if step == 6:
            prune(self.model, 0.05)
'''


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """Return the description of a method in a new folder ``tiny_folder``."""
    folder = tmp_path / "methods" / "tiny_folder"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text(ABOUT)
    (folder / "train.py").write_text(TRAIN)
    monkeypatch.setattr(methods, "__path__", [*methods.__path__, str(folder.parent)])
    actual = methods.discover()
    monkeypatch.setitem(methods.METHODS, "tiny", actual["tiny"])
    monkeypatch.setitem(KEYS["method"].metadata["choices"], "tiny", "")
    yield actual["tiny"]
    for name in [name for name in sys.modules if name.startswith("training.methods.tiny_folder")]:
        del sys.modules[name]


def base(count: int = 40, sh_degree: int = 1) -> Splats:
    rng = np.random.default_rng(5)

    def random(*shape: int) -> np.ndarray:
        return rng.normal(0, 0.5, (count, *shape)).astype(np.float32)

    return Splats(random(3), random(4), random(3) - 2, random(), random((sh_degree + 1) ** 2, 3))


def job(scene: Path, out: Path, **keys) -> Job:
    values = {"scene": str(scene), "out": str(out), "method": "tiny", "image_scale": 1.0, "test_every": 4}
    return Job.from_dict(values | keys)


def test_method_folders_are_discovered(tiny):
    assert tiny.package == "training.methods.tiny_folder" and list(methods.discover())[-1] == "tiny"
    folders = {path.parent.name for path in Path(methods.__file__).parent.glob("*/train.py")}
    assert folders == {
        method.package.rsplit(".", 1)[1] for method in methods.METHODS.values() if method != tiny
    }


def test_no_other_package_names_a_method():
    """New methods need no changes in other packages."""
    root = Path(methods.__file__).parents[1]
    for path in root.rglob("*.py"):
        inside = path.relative_to(root).parts
        if inside[0] != "methods" or len(inside) == 2:
            text = path.read_text(encoding="utf-8")
            assert not any(f"methods.{name}" in text for name in ("flod", "octree", "threedgs")), path
            assert not any(f"from .{name} " in text for name in ("flod", "octree", "threedgs")), path


def test_two_drawings_train_extra_weights_and_columns(tiny, data):
    method = methods.create("tiny", data, tiny.preset("draft"), seed=0, backend="cpu")
    initial, count = method.model["decay"].detach().clone(), len(method.model)
    loss, image, target = method.train_step(0)
    assert loss() > 0 and image().shape == target.image.shape
    learned = (method.model["decay"].detach() - initial).abs()
    assert (learned > 0).sum() > count / 2
    assert learned.max() == pytest.approx(0.1, rel=1e-3)  # Adam's first step is the rate
    for step in range(1, 8):
        if step == 4:
            parents = method.model["decay"].detach().clone()
        method.train_step(step)
    (level,) = method.levels_after(7)
    assert len(parents) == count and len(level.splats) == len(method.model) > 0
    assert list(level.splats.extras) == ["decay"]


def test_loss_sums_over_drawings(tiny, data):
    method = methods.create("tiny", data, tiny.preset("draft"), seed=0, backend="cpu")
    view = method.choose_view(0)
    drawings = method.draw(view, 0)
    losses = [float(method.loss([drawing], view, 0).detach()) for drawing in drawings]
    assert losses[0] != losses[1]
    assert float(method.loss(drawings, view, 0).detach()) == pytest.approx(sum(losses))


def test_run_with_base_writes_its_column(tiny, tiny_scene, tmp_path):
    write_ply(tmp_path / "base.ply", base())
    created = job(tiny_scene, tmp_path / "run", base=str(tmp_path / "base.ply"))
    assert training_loop.train(created) == 0
    folder = RunFolder(created.out)
    splats = read_bundle(folder.bundle).levels[0].splats
    assert "decay" in splats.extras and splats.extras["decay"].dtype == np.float32
    assert splats.sh_degree == 3
    # splats of the base hardly move in eight steps
    near = np.linalg.norm(splats.means[:, None] - base().means, axis=2).min(1)
    assert np.median(near) < 0.05
    assert training_loop.train(created) == 0, "the same job resumes"


@pytest.mark.parametrize("antialias", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_run_uses_antialiasing_of_its_base(tiny, tiny_scene, tmp_path, antialias):
    """The base overrides the job, with a warning, for the bundle, its levels and its measurements."""
    small = replace(base(), log_scales=base().log_scales - np.float32(2))
    write_ply(tmp_path / "base.ply", small, ["SplatRenderMode: mip"] * antialias)
    created = job(
        tiny_scene, tmp_path / "run", base=str(tmp_path / "base.ply"), parameters={"antialias": not antialias}
    )
    assert training_loop.train(created) == 0
    folder = RunFolder(created.out)
    events, _ = folder.events()
    warnings = [event["message"] for event in events if event["event"] == "warning"]
    warnings = [message for message in warnings if "Antialiasing" in message]
    assert warnings == [f"Antialiasing is {'on' if antialias else 'off'} for this run, as in its base."]
    bundle = read_bundle(folder.bundle)
    assert bundle.antialias is antialias and bundle.meta.get("antialias", False) is antialias
    level = next(event for event in events if event["event"] == "level")
    assert read_bundle(folder.find_file(level["path"])).antialias is antialias
    near, splats = read_scene(tiny_scene).near(), Gaussians.of(bundle.levels[0].splats)
    rows = evaluate_run(folder.path)["levels"], [level]
    for flag in (antialias, not antialias):
        drawn = [
            psnr(
                rasterize(splats, camera, near=near, antialias=flag, backend="reference").image,
                torch.from_numpy(load_image(camera.image, camera.width, camera.height)),
            )
            for camera in read_scene(tiny_scene).cameras[::4]
        ]
        for (row,) in rows:
            assert (abs(row["psnr"] - np.mean(drawn)) < 5e-3) == (flag == antialias)


def test_unusable_base_raises(tiny, tiny_scene, tmp_path):
    with pytest.raises(LodgsError, match=r"'flod' cannot start from a base.*Remove 'base'"):
        job(tiny_scene, tmp_path / "run", method="flod", base=str(tmp_path / "base.ply"))
    created = job(tiny_scene, tmp_path / "run", base=str(tmp_path / "absent.ply"))
    assert training_loop.train(created) == BAD_INPUT
    event = RunFolder(created.out).events()[0][-1]
    assert event["event"] == "error" and "absent.ply" in event["what"] and event["remedy"]


def test_base_path_is_relative_to_the_job(tiny, tmp_path):
    (tmp_path / "job.toml").write_text('scene = "s"\nout = "run"\nmethod = "tiny"\nbase = "before/run"\n')
    created = Job.from_file(tmp_path / "job.toml")
    assert created.base == str(tmp_path / "before" / "run")
    created.resolved().write(tmp_path / "again.toml")
    assert Job.from_file(tmp_path / "again.toml").base == created.base


def test_base_is_finest_complete_level(tmp_path):
    coarse, fine = base(10), base(30)
    run = RunFolder(tmp_path / "run")
    with pytest.raises(LodgsError, match="does not exist"):
        read_base(run.path)
    run.create()
    with pytest.raises(LodgsError, match=r"not a finished run.*Finish training"):
        read_base(run.path)
    levels = [Level(1, coarse), Level(2, fine)]
    write_bundle(run.bundle, Bundle("flod", levels))
    for path in (run.path, run.bundle):
        np.testing.assert_array_equal(read_base(path)[0].means, fine.means)
    write_bundle(run.bundle, Bundle("octree", levels, cumulative=True))
    np.testing.assert_array_equal(read_base(run.path)[0].means, np.concatenate([coarse.means, fine.means]))
    write_ply(tmp_path / "plain.ply", coarse)
    np.testing.assert_array_equal(read_base(tmp_path / "plain.ply")[0].means, coarse.means)
    write_ply(tmp_path / "empty.ply", base(0))
    with pytest.raises(LodgsError, match=r"empty\.ply has none"):
        read_base(tmp_path / "empty.ply")


def test_incomplete_method_cannot_be_created(data, tiny):
    class Incomplete(Method):
        def setup(self, base):
            pass

    assert inspect.isabstract(Method)
    with pytest.raises(TypeError, match="levels_after"):
        Incomplete(data, tiny.preset("draft"), 0, "cpu")


def test_scene_metadata(data, tiny):
    method = methods.create("tiny", data, tiny.preset("draft"), seed=0, backend="cpu")
    meta = method.meta()
    assert meta["focal_px"] == 60
    position, target = np.array(meta["view"])
    central = np.argmin(
        np.linalg.norm([c.center - np.array(meta["camera_center"]) for c in data.train], axis=1)
    )
    assert position == pytest.approx(data.train[central].center)
    assert data.train[central].view_space(target[None])[0] == pytest.approx([0, 0, data.median_depth])
    assert meta["camera_center"] == pytest.approx(np.mean([c.center for c in data.train], 0).tolist())
    assert {"scene_extent", "median_depth"} <= set(meta) and method.facts == {}
    assert torch.device("cpu") == method.device


@pytest.mark.parametrize("name", sorted(methods.METHODS))
def test_step_has_random_background_and_image_has_none(data, name):
    from training.methods import create
    from training.optimize.parameters import override

    presets = methods.method_info(name).presets
    method = create(name, data, presets["draft"], seed=0, backend="cpu")
    view = method.choose_view(3)
    drawn = method.draw(view, 3)[0].rendering
    background = torch.tensor(method.background(3)).float()
    black = create(name, data, override(presets["draft"], {"random_background": False}), 0, "cpu")
    expected = black.draw(view, 3)[0].rendering
    torch.testing.assert_close(drawn.image - expected.image, (1 - drawn.alpha[..., None]) * background)
    torch.testing.assert_close(method.background.remove(drawn.image, drawn.alpha, 3), expected.image)
    assert (drawn.alpha < 0.9).any()
    colors = {method.background(step) for step in range(9)}
    assert len(colors) == 9 and black.background(3) == (0, 0, 0) == tuple(
        create(name, data, presets["paper"], 0, "cpu").background(3)
    )


@pytest.mark.parametrize("name", ["3dgs", "flod", "clod"])
def test_splats_are_in_spatial_order_once_densification_ends(data, name):
    values = {"densify_until": 0.5, "steps": 8}
    if name == "flod":
        values = {"levels": 1, "densify_until": [0.5], "densify_interval": [50], "steps": [8]}
    method = methods.create(name, data, override(methods.METHODS[name].presets["draft"], values), 0, "cpu")
    orders = []
    for step in range(4):
        method.train_step(step)
        orders.append(spatial_order(method.model["means"].detach().numpy()).tolist())
    rows = list(range(len(orders[-1])))
    assert orders[-1] == rows and orders[0] != rows
