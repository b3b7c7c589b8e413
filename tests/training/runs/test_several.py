"""Several trainings in turn: image sizes of an effort, and the time left."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from training.errors import LodgsError
from training.runs import several
from training.runs.estimate import Estimate
from training.runs.events import event_line
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.runs.several import NamedJob, ReducedJobs, train_in_turn

COSTS = Estimate(100.0, 0, 0, 0, 0, 0, steps=50, views=8, size=(64, 48))
"""Two seconds a step."""


@pytest.mark.parametrize(
    ("preset", "effort", "width", "expected"),
    [
        ("paper", 1.0, 960, 960),
        ("paper", 2.0, 960, 960),
        ("paper", 0.25, 960, 480),  # a quarter of the pixels
        ("paper", 0.01, 960, 200),
        ("paper", 0.01, 150, 150),
        ("draft", 0.25, 960, 240),  # draft has half of the photos' side
    ],
)
def test_effort_multiplies_pixels_down_to_a_minimum(monkeypatch, tmp_path, preset, effort, width, expected):
    camera = SimpleNamespace(width=width, height=width // 2)
    monkeypatch.setattr(several, "read_scene", lambda folder: SimpleNamespace(cameras=[camera]))
    job = ReducedJobs(tmp_path, preset, effort, {}).job("3dgs", tmp_path / "run")
    assert round(job.image_scale * width) == expected
    job = ReducedJobs(tmp_path, preset, effort, {"image_scale": 0.5}).job("3dgs", tmp_path / "run")
    assert job.image_scale == 0.5


def test_effort_limits_splats_by_pixels(tiny_scene, tmp_path):
    """Images of 64x48 pixels have at most 6,144 splats, and the draft's limit remains below it."""

    def parameters(preset, effort, scale):
        jobs = ReducedJobs(tiny_scene, preset, effort, {"image_scale": scale})
        return jobs.job("3dgs", tmp_path / "run").resolved_parameters()

    paper = parameters("paper", 0.1, 1.0)
    assert (paper.max_splats, paper.scale_threshold) == (2 * 64 * 48, True)
    assert parameters("paper", 0.1, 0.5).max_splats == 2 * 32 * 24
    assert parameters("draft", 0.1, 1.0).max_splats == 2 * 64 * 48
    full = parameters("paper", 1.0, 1.0)
    assert (full.max_splats, full.scale_threshold) == (0, False)


@pytest.mark.parametrize(
    ("method", "parameter", "size"),
    [("tree", "pixels", 3.0), ("flod", "footprint", 40.0), ("flod_scaffold", "coarsest", 40.0),
     ("octree_neural", "footprint", 1.0)],
)  # fmt: skip
def test_effort_keeps_sizes_in_pixels_the_same_in_the_scene(tiny_scene, tmp_path, method, parameter, size):
    def trained(effort, scale, changes=None):
        jobs = ReducedJobs(tiny_scene, "paper", effort, {"image_scale": scale})
        return getattr(jobs.job(method, tmp_path / "run", changes).resolved_parameters(), parameter)

    assert trained(0.1, 0.25) == size / 4  # images with a quarter of the side
    assert trained(1.0, 0.25) == trained(0.1, 1.0) == size
    assert trained(0.1, 0.25, {parameter: 2.0}) == 2.0


def test_effort_keeps_sizes_in_pixels_above_their_minimum(tiny_scene, tmp_path):
    jobs = ReducedJobs(tiny_scene, "draft", 0.01, {"image_scale": 0.05})
    assert jobs.job("tree", tmp_path / "run").resolved_parameters().pixels == 0.1


@pytest.fixture
def jobs(tiny_scene, tmp_path):
    keys = {"scene": str(tiny_scene), "method": "3dgs", "image_scale": 1.0, "backend": "cpu"}
    made = [
        Job.from_dict({**keys, "out": str(tmp_path / str(steps)), "parameters": {"steps": steps}})
        for steps in (30, 60, 90)
    ]
    return [NamedJob(f"{job.steps} steps", job) for job in made]


def test_time_left_follows_the_estimate_and_the_time_so_far(jobs, monkeypatch):
    clock, texts, sentences, estimates = [0.0], [], [], []

    def estimate(job, scratch):
        estimates.append(job)
        return COSTS

    def train(job, text):
        texts.append(text)
        return ""

    monkeypatch.setattr(several, "estimate", estimate)
    monkeypatch.setattr(several.time, "monotonic", lambda: clock[0])
    for problem in train_in_turn(jobs, train, sentences.append):
        assert problem == ""
        clock[0] += 30  # half of the estimate of the first training, with the caller's work
    assert len(estimates) == 1  # all have one method
    assert sentences[-1] == "3 trainings take about 6 min."
    assert texts == [
        "Training 30 steps (1 of 3, about 6 min left)",
        "Training 60 steps (2 of 3, about 2 min left)",  # half of 300 s
        "Training 90 steps (3 of 3, about 60 s left)",  # 60 of 180 s so far, 180 s left
    ]


def test_finished_and_unestimated_trainings_have_no_time(jobs, monkeypatch):
    def fail(job, scratch):
        raise LodgsError("Cannot read scene: no cameras.", "Export it again.")

    sentences, texts = [], []
    run = RunFolder(jobs[0].job.out)
    run.create()
    run.events_file.write_text(event_line("done", bundle="bundle.ply", seconds=1.0) + "\n")
    monkeypatch.setattr(several, "estimate", fail)

    def train(job, text):
        texts.append(text)
        return "no reason"

    assert list(train_in_turn(jobs, train, sentences.append)) == ["no reason"] * 3
    assert sentences == ["Estimating the time of 2 trainings.", "No estimate: Cannot read scene: no cameras."]
    assert texts[0] == "Training 30 steps (1 of 3)"


def test_one_training_is_no_plural(jobs, monkeypatch):
    sentences = []
    monkeypatch.setattr(several, "estimate", lambda job, scratch: COSTS)
    assert list(train_in_turn(jobs[:1], lambda job, text: "", sentences.append)) == [""]
    assert sentences == ["Estimating the time of 1 training.", "1 training takes about 60 s."]


def test_steps_of_a_base_are_not_trained_again(jobs, tmp_path):
    job = replace(jobs[0].job, method="lodge", parameters={"steps": 500, "tune_steps": 20, "levels": 3})
    alone = job.steps
    assert alone - replace(job, base=str(tmp_path / "base.ply")).steps == 500
