"""Tables of the papers: declarations, shortened trainings, trends, and the command."""

import json
import shutil
import sys
from pathlib import Path

import pytest

from tests.training.lod.tree.trees import tree_of
from training.__main__ import main
from training.cli import reproduce as command
from training.errors import LodgsError
from training.evaluate.views import Evaluation
from training.methods import METHODS
from training.runs.estimate import Estimate
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.runs.reproduction.run import (
    PAPERS,
    chosen_tables,
    load_paper,
    make_jobs,
    reproduce,
    run_folder,
)
from training.runs.reproduction.subject import Subject
from training.runs.reproduction.tables import PSNR, SPLATS, format_table, increases, loses_little
from training.runs.several import ReducedJobs
from training.scenes.colmap import read_scene
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level

TABLES = [(paper, table) for paper in map(load_paper, PAPERS) for table in paper.tables]


@pytest.mark.parametrize(("paper", "table"), TABLES, ids=lambda item: getattr(item, "name", item.title[:8]))
def test_tables_are_complete_and_trends_hold_for_the_papers_values(paper, table):
    labels = [row.label for row in table.rows]
    assert len(labels) == len(set(labels))
    assert all(row.training in paper.trainings for row in table.rows)
    assert all(len(row.published) <= len(table.columns) for row in table.rows)
    if all(row.published for row in table.rows):
        published = {
            row.label: dict(zip((column.measure for column in table.columns), row.published, strict=False))
            for row in table.rows
        }
        text = format_table(table, published)
        assert text.count("- Holds") == len(table.trends) and "Does not hold" not in text


@pytest.mark.parametrize("name", PAPERS)
def test_trends_need_a_difference(name):
    """With equal values everywhere, only claims of an upper bound hold."""
    trends = [trend for table in load_paper(name).tables for trend in table.trends]
    held = [trend.claim for trend in trends if trend.test(lambda label, column: 5.0)[0]]
    assert all("at most" in claim for claim in held)


@pytest.mark.parametrize("name", PAPERS)
def test_trainings_are_valid_jobs(name, tiny_scene, tmp_path):
    paper = load_paper(name)
    for job in make_jobs(paper, list(paper.trainings), ReducedJobs(tiny_scene, "paper", 0.1, {}), tmp_path):
        full = METHODS[job.method].preset("paper")
        assert job.preset == "paper" and job.resolved_parameters().total_steps < 0.2 * full.total_steps


def test_effort_multiplies_steps_and_keeps_disabled_intervals():
    flod = METHODS["flod"]
    changes = flod.scaled_steps("paper", 0.1, {"overlap_interval": 0})
    assert changes["steps"] == [1000, 1500, 2000, 2500, 3000]  # a tenth of the paper's steps
    assert changes["overlap_interval"] == 0 and changes["sh_interval"] == 100
    assert "densify_until" not in changes  # a fraction
    assert flod.scaled_steps("paper", 1.0, {}) == {}


def test_trends_state_our_numbers():
    values = {("a", "psnr"): 30.0, ("b", "psnr"): 29.5, ("a", "splats"): 100, ("b", "splats"): 40}

    def value(label, column):
        return values[label, column.measure]

    assert loses_little("", "a", "b", 0.6, 0.5).test(value) == (True, "0.50 dB at 40% of the splats")
    assert loses_little("", "a", "b", 0.4, 0.5).test(value)[0] is False
    assert increases("", ("b", "a"), PSNR).test(value) == (True, "29.50, 30.00")
    assert increases("", ("a", "b"), SPLATS).test(value) == (False, "100, 40")


def test_frames_of_lodge_must_be_faster():
    """Values of a small image, where no level was faster."""
    (table,) = load_paper("lodge").tables
    times = {"Full representation": 5.2, "LOD (d=10,28,47)": 5.5}
    holds, text = table.trends[0].test(lambda label, _: times.get(label, 5.1))
    assert not holds and text == "1.0, 1.0, 0.9, 1.0 times as fast"


def test_levels_of_lodge_start_from_its_own_base(tiny_scene, tmp_path):
    """LODGE, Table 3: the full representation includes importance pruning (A.2)."""
    paper = load_paper("lodge")
    base, *others = make_jobs(
        paper, list(paper.trainings), ReducedJobs(tiny_scene, "paper", 0.1, {}), tmp_path
    )
    p = base.resolved_parameters()
    assert (base.method, p.levels, p.least_weight, p.densify_by) == ("lodge", 1, 0.02, "max")
    assert {job.base for job in others} == {base.out}


def test_tables_are_chosen_by_number_or_name():
    paper = load_paper("clod")
    assert [table.name for table in chosen_tables(paper, ["2", "Figure 3"])] == ["Table 2", "Figure 3"]
    assert [table.name for table in chosen_tables(paper, ["3"])] == ["Figure 3"]
    with pytest.raises(LodgsError, match="7"):
        chosen_tables(paper, ["7"])


@pytest.fixture(autouse=True)
def costs(monkeypatch):
    """Estimates two seconds a step."""
    costs = Estimate(100.0, 0, 0, 0, 0, 0, steps=50, views=8, size=(64, 48))
    monkeypatch.setattr("training.runs.several.estimate", lambda job, scratch: costs)


@pytest.fixture
def train(splats):
    """Writes a finished FLoD run of five levels in place of a training, and lists the jobs."""
    count = len(splats)
    jobs = []

    def write(job: Job, text: str) -> str:
        run = RunFolder(job.out)
        if run.state() == "done":
            return ""
        jobs.append(text)
        run.create()
        job.write(run.job)
        run.events_file.write_text('{"event": "done"}\n')
        levels = [
            Level(number, splats.select(slice(0, count * number // 5)), {"s_min": 0.2 / 4**number})
            for number in range(1, 6)
        ]
        write_bundle(run.bundle, Bundle("flod", levels, "bands"))
        return ""

    write.jobs = jobs
    return write


KEYS = {"image_scale": 1.0, "test_every": 4, "backend": "cpu"}


def test_tables_are_measured_on_each_scene_and_resumed(tiny_scene, train, tmp_path):
    text = reproduce("flod", [tiny_scene], tmp_path, train, tables=["2", "4"], effort=0.1, keys=KEYS)
    assert len(train.jobs) == 1 and train.jobs[0].endswith("FLoD (1 of 1, about 5 h 33 min left)")
    assert (tmp_path / "tables.md").read_text() == text and "### Table 4" in text
    rows = json.loads((tmp_path / "tables.json").read_text())
    assert rows["Table 2"]["5"]["psnr"] > rows["Table 2"]["3"]["psnr"]
    assert rows["Table 4"]["max level"]["splats"] == len(read_scene(tiny_scene).points)
    assert "(64x48 pixels), 0.1 times the steps" in text and "| FLoD | 10,000 |" in text
    reproduce("flod", [tiny_scene], tmp_path, train, tables=["2"], effort=0.1, keys=KEYS)
    assert len(train.jobs) == 1


def test_tables_share_measures(tiny_scene, train, tmp_path, monkeypatch):
    """Tables 2 and 4 have the finest level and the range of levels 3 to 5 in common."""
    counts = {"level": 0, "range": 0}

    def count(name, function):
        def counted(*arguments):
            counts[name] += 1
            return function(*arguments)

        return counted

    monkeypatch.setattr(Evaluation, "measure_level", count("level", Evaluation.measure_level))
    monkeypatch.setattr(Evaluation, "measure_by_distance", count("range", Evaluation.measure_by_distance))
    reproduce("flod", [tiny_scene], tmp_path, train, tables=["2", "4"], effort=0.1, keys=KEYS)
    assert counts == {"level": 3, "range": 3}


def test_memory_and_image_sizes_of_a_subject(tiny_scene, train, tmp_path):
    (job,) = make_jobs(load_paper("flod"), ["FLoD"], ReducedJobs(tiny_scene, "paper", 0.1, KEYS), tmp_path)
    train(job, "")
    subject = Subject(Path(job.out))
    sizes = subject.by_size()
    assert list(sizes) == ["psnr_1", "psnr_2", "psnr_4", "psnr_8"]
    measured = subject.level_with_memory(5)
    assert sizes["psnr_1"] == measured["psnr"] == subject.level()["psnr"]
    assert sys.platform != "linux" or 0 <= measured["memory"] < 1


def test_cache_of_a_streamed_tree(tiny_scene, train, splats, tmp_path):
    """The second view needs the nodes of the first one."""
    (job,) = make_jobs(load_paper("flod"), ["FLoD"], ReducedJobs(tiny_scene, "paper", 0.1, KEYS), tmp_path)
    train(job, "")
    write_bundle(RunFolder(job.out).bundle, tree_of(splats))
    subject = Subject(Path(job.out))
    cached, uncached, small = subject.streamed(), subject.streamed(reuse=False), subject.streamed(0.1)
    nodes = sum(len(level.rows) for level in subject.bundle.levels)
    assert 0 <= cached["loaded"] < uncached["loaded"] <= nodes
    assert small["loaded"] <= nodes
    assert cached["fps"] == pytest.approx(1e3 / cached["ms"])


def test_scenes_of_one_name_are_refused_before_training(tiny_scene, tmp_path):
    """Their runs would have the same folders."""
    scenes = [tiny_scene, Path(shutil.copytree(tiny_scene, tmp_path / tiny_scene.name))]
    with pytest.raises(LodgsError, match="several folders are named"):
        reproduce("clod", scenes, tmp_path, lambda job, text: pytest.fail(text), keys=KEYS)


def test_failed_training_is_named(tiny_scene, tmp_path):
    with pytest.raises(LodgsError, match="no reason"):
        reproduce("clod", [tiny_scene], tmp_path, lambda job, text: "no reason", keys=KEYS)


def test_command_prints_the_tables(tiny_scene, train, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command, "train", train)
    arguments = ["reproduce", "flod", "--scene", str(tiny_scene), "--out", str(tmp_path), "--tables", "2"]
    arguments += ["--effort", "0.01", "--image-scale", "1", "--test-every", "4", "--backend", "cpu"]
    assert main(arguments) == 0
    assert "| 5-4-3 |" in capsys.readouterr().out
    job = Job.from_file(RunFolder(run_folder(tmp_path / tiny_scene.name, "FLoD")).job)
    assert job.resolved_parameters().steps == (100, 150, 200, 250, 300)
    with pytest.raises(SystemExit):
        main(["reproduce", "flod", "--out", str(tmp_path), "--effort", "0"])
