"""Comparison of runs: measures equal those of evaluate, answers, and the page in a browser."""

import errno
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from training.__main__ import main
from training.errors import DISK, LodgsError, system_remedy
from training.methods import METHODS
from training.runs.comparison.measures import (
    ComparedRun,
    Point,
    collect_measures,
    compared_run,
    label_runs,
    measure_run,
    merge_baseline,
    recommend_runs,
)
from training.runs.comparison.page import build_page, compare
from training.runs.estimate import Estimate
from training.runs.events import event_line
from training.runs.finished import open_finished
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.runs.measure import evaluate_run
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


CAPTURED = {"scene": "", "capture": "dome", "base": "a.ply"}


@pytest.fixture(autouse=True)
def costs(monkeypatch):
    """Estimates two seconds a step."""
    costs = Estimate(100.0, 0, 0, 0, 0, 0, steps=50, views=8, size=(64, 48))
    monkeypatch.setattr("training.runs.several.estimate", lambda job, scratch: costs)


@pytest.fixture(scope="module")
def runs(tiny_scene, splats, tmp_path_factory):
    """A finished FLoD run of two levels, and a 3DGS run of one."""
    folder = tmp_path_factory.mktemp("compared")
    levels = [Level(1, splats.select(slice(0, 20)), {"s_min": 0.1}), Level(2, splats, {"s_min": 0.0})]
    bundles = {"flod": Bundle("flod", levels, "bands"), "3dgs": Bundle("3dgs", [Level(1, splats)])}
    for method, bundle in bundles.items():
        run = RunFolder(folder / method)
        run.create()
        run.events_file.write_text(event_line("done", bundle="bundle.ply", seconds=5.5, memory=10**9) + "\n")
        values = {"scene": str(tiny_scene), "out": str(run.path), "method": method, "image_scale": 1.0}
        Job.from_dict(values | {"backend": "cpu", "test_every": 4}).write(run.job)
        write_bundle(run.bundle, bundle)
    return [folder / method for method in bundles]


@pytest.fixture(scope="module")
def report(runs, tmp_path_factory):
    out = tmp_path_factory.mktemp("page")
    return compare(runs, out), out


def page_data(out) -> dict:
    """Return the data of a page."""
    return json.loads(re.findall(r"^const data = (.*);$", (out / "index.html").read_text(), re.M)[0])


@pytest.mark.parametrize("number", [0, 1], ids=["flod", "3dgs"])
def test_page_has_the_numbers_of_evaluate(runs, report, number):
    measured = page_data(report[1])["runs"][number]
    expected = evaluate_run(runs[number], far=True)
    for name in ("splats", "drawn", "psnr", "ssim"):
        assert [point[name] for point in measured["points"]] == [row[name] for row in expected["levels"]]
    assert measured["megabytes"] == expected["bytes"] / 1e6
    assert (measured["seconds"], measured["memory"]) == (5.5, 10**9)
    if number:
        assert measured["by_distance"] is None and measured["farther"] == [] and measured["merged"] == []
        return
    coarse, fine = expected["levels"]
    assert measured["merged"] == [[coarse["splats"], coarse["merged"][0]], [fine["splats"], fine["psnr"]]]
    for name in ("splats", "drawn", "psnr", "ssim"):
        assert measured["by_distance"][name] == expected["selective"][0][name]
    for name in ("factor", "drawn", "drawn_full", "psnr"):
        assert [row[name] for row in measured["farther"]] == [row[name] for row in expected["farther"]]
    assert measured["largest_jump"] == expected["jumps"]["by distance"] == max(measured["jumps"])
    assert measured["jumps"] == expected["flight"]
    assert measured["loaded"] == expected["loaded"]
    assert (measured["frame_memory"] is None) == (expected["frame_memory"]["by_distance"] is None)


def test_page_has_the_numbers_of_its_json_file(report):
    data, file = page_data(report[1]), json.loads((report[1] / "compare.json").read_text())
    assert {name: data[name] for name in file} == file


def test_single_level_is_also_compared_with_merged_neighbours(report, splats):
    _, plain, merged = report[0]["runs"]
    assert plain["by_distance"] is None and not plain["baseline"]
    assert merged["baseline"] and merged["label"] == f"{plain['label']}, merged"
    counts = [round(len(splats) * share) for share in (0.0625, 0.125, 0.25, 0.5, 1)]
    assert [point["splats"] for point in merged["points"]] == counts
    assert merged["points"][-1]["psnr"] == plain["points"][-1]["psnr"]


@pytest.mark.parametrize(
    ("count", "names"),
    [(1, ["Finest level"]), (3, ["Merged to 25%", "Merged to 50%", "Finest level"])],
)
def test_baseline_of_few_splats_has_each_number_once(splats, count, names):
    row = {"psnr": 1.0, "ssim": 1.0, "drawn": 1, "frame_s": 1.0}
    evaluation = SimpleNamespace(prefix="", measure_splats=lambda part: {**row, "splats": len(part)})
    run, _ = merge_baseline(evaluation, splats.select(slice(0, count)), "3DGS")
    assert [point.name for point in run.points] == names


def test_report_newer_than_the_bundle_is_not_measured_again(runs, report, monkeypatch):
    monkeypatch.setattr("training.runs.comparison.measures.evaluate_run", None)
    measured = measure_run(runs[0], "FLoD", {"gamma": 1.0})
    assert measured.finest.psnr == report[0]["runs"][0]["points"][-1]["psnr"]


def test_report_with_other_control_values_is_measured_again(runs, report, tmp_path):
    run = shutil.copytree(runs[0], tmp_path / "run")
    evaluate_run(run, {"gamma": 50.0})
    measured = measure_run(run, "FLoD", {"gamma": 1.0})
    assert measured.by_distance.psnr == report[0]["runs"][0]["by_distance"]["psnr"]


@pytest.mark.parametrize(
    "text", ['{"rule": "", "levels": [{"level": "x"}], "test_views": []}', '{"rule":' * 20_000]
)
def test_damaged_report_is_measured_again(runs, tmp_path, text):
    run = shutil.copytree(runs[1], tmp_path / "run")
    RunFolder(run).metrics.write_text(text)
    assert measure_run(run, "3DGS", {}).finest.psnr > 0


def test_finest_set_is_the_level_with_lpips(runs):
    """The sweep of a rule has the same set without LPIPS."""
    row = {"splats": 50, "drawn": 40, "psnr": 30.0, "ssim": 0.9, "frame_s": 0.1}
    report = {
        "rule": "decay", "test_views": ["a"], "levels": [{**row, "level": 1, "lpips_vgg": 0.2}],
        "curve": [{**row, "s_v": 1.0}], "selective": [], "bytes": 1, "frame_memory": {"full": None},
    }  # fmt: skip
    folder = RunFolder(runs[0])
    finest = compared_run(folder, Job.from_file(folder.job), report, "CLoD-GS").finest
    assert (finest.name, finest.lpips_vgg) == ("Level 1", 0.2)


def test_quality_between_sets_is_interpolated_over_the_logarithm():
    points = [Point("a", 100, 20.0, 0.5, 0.1), Point("b", 10_000, 30.0, 0.6, 0.1)]
    run = ComparedRun("run", "", points)
    assert run.psnr_at(1000) == pytest.approx(25.0)  # halfway between 10^2 and 10^4
    assert run.psnr_at(99) is None and run.psnr_at(20_000) == 30.0
    assert run.nearest(900).name == "a" and run.nearest(1100).name == "b"


def test_answers_name_the_best_run_and_ignore_baselines():
    def run(label, splats, psnr, seconds, **values):
        return ComparedRun(
            label, "", [Point("", splats, psnr, 0.9, 0.01)], loaded=splats, seconds=seconds, **values
        )

    rows = recommend_runs(
        [run("A", 100, 30, 50), run("B", 200, 31, 60), run("C", 200, 40, None, baseline=True)]
    )
    best = {row["purpose"]: row["best"] for row in rows}
    assert best["Quality at full detail"] == "B" and best["Short training"] == "A"
    assert best["Few splats to load"] == "A"  # 100 splats, all without levels
    assert rows[0] == {
        "purpose": "Quality at full detail", "best": "B", "measure": "31.00 dB",
        "why": "31.00 dB with 200 splats", "next": "A (30.00 dB)",
    }  # fmt: skip
    assert "Speed from far away" not in best  # neither has levels


def test_single_splats_are_compared():
    run = ComparedRun("run", "", [Point("", 1, 20.0, 0.5, 0.1)], loaded=1)
    assert collect_measures([run])["compared_splats"] == 1


def test_page_loads_nothing_and_escapes_names(report):
    text = (report[1] / "index.html").read_text()
    assert not re.search(r"@[A-Z]+@", text)
    assert not re.search(r"""(?:src|href)=["']http|@import|fetch\(""", text)
    named = {**report[0], "scene": "<b>&", "views": ["</script><script>alert(1)"]}
    page = build_page(named, [], [])
    assert "<b>&" not in page.split("<script>")[0] and page.count("</script>") == 1


def test_page_of_one_run_shows_all_of_its_levels(runs, report, tmp_path):
    compare(runs[:1], tmp_path)
    data = page_data(tmp_path)
    (images,) = data["images"]
    assert list(images["variants"]) == ["Level 2", "Level 1", "By distance", "Level colours"]
    assert all(len(variant["images"]) == len(data["photos"]) for variant in images["variants"].values())


def test_comparison_of_captured_views_is_named_after_the_captured_splats(runs, tmp_path, monkeypatch):
    folder, job, data = open_finished(runs[1], print)
    captured = replace(job, scene="", capture="dome", base="/files/statue.ply")
    monkeypatch.setattr(
        "training.runs.comparison.page.open_finished", lambda run, warn: (folder, captured, data)
    )
    assert compare(runs[1:], tmp_path)["scene"] == "statue.ply"
    assert "statue.ply" in (tmp_path / "index.html").read_text()


def test_runs_of_other_scenes_are_refused(runs, tmp_path):
    other = shutil.copytree(runs[1], tmp_path / "run")
    job = Job.from_file(RunFolder(other).job)
    scene = shutil.copytree(job.scene, tmp_path / "scene")
    text = RunFolder(other).job.read_text().replace(job.scene, str(scene))
    RunFolder(other).job.write_text(text)
    with pytest.raises(LodgsError):
        compare([runs[0], other], tmp_path / "out")


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"validation": False}, {"validation": True}),
        (CAPTURED, CAPTURED | {"base": "b.ply"}),
        (CAPTURED, CAPTURED | {"views": 12}),
    ],
)
def test_runs_with_other_held_out_views_are_refused(first, second, runs, monkeypatch):
    """Runs on captured views have no scene, which does not make them runs of one scene."""
    job = Job.from_file(RunFolder(runs[0]).job)
    jobs = {"a": replace(job, **first), "b": replace(job, **second)}
    monkeypatch.setattr(
        "training.runs.comparison.measures.open_finished", lambda run, warn: (None, jobs[run.name], None)
    )
    label_runs([Path("a")])
    with pytest.raises(LodgsError, match="held-out"):
        label_runs([Path("a"), Path("b")])


def test_runs_with_photos_of_another_size_are_compared_with_a_warning(runs, monkeypatch):
    job = Job.from_file(RunFolder(runs[0]).job)
    jobs = {"a": job, "b": replace(job, image_scale=0.5)}
    monkeypatch.setattr(
        "training.runs.comparison.measures.open_finished", lambda run, warn: (None, jobs[run.name], None)
    )
    warnings = []
    label_runs([Path("a")], warnings.append)
    assert warnings == []
    label_runs([Path("a"), Path("b")], warnings.append)
    assert len(warnings) == 1 and "b is measured on photos of another size" in warnings[0]


def test_labels_tell_runs_apart(runs, tmp_path):
    for parent in ("a", "b"):
        shutil.copytree(runs[1], tmp_path / parent / "run")
    copies = [tmp_path / "a" / "run", tmp_path / "b" / "run"]
    plain = label_runs([runs[1]])[0]
    assert label_runs([runs[1], copies[0]]) == [f"{plain} (3dgs)", f"{plain} (run)"]
    assert label_runs(copies) == [f"{plain} ({copies[0]})", f"{plain} ({copies[1]})"]
    with pytest.raises(LodgsError, match="twice"):
        label_runs([runs[1], runs[1]])


def test_command_trains_the_methods_of_a_scene(tiny_scene, runs, tmp_path, capsys, monkeypatch):
    """A method that fails is left out and named."""

    def train(job, events):
        if job.method == "tree":
            events.write('{"event": "error", "what": "Cannot train: no reason."}\n')
            return 2
        run = RunFolder(job.out)
        run.create()
        job.write(run.job)
        shutil.copy(RunFolder(runs[1]).bundle, run.bundle)
        return 0

    monkeypatch.setattr("training.runs.train.train", train)
    arguments = ["compare", str(tiny_scene), "--out", str(tmp_path), "--methods", "tree", "3dgs"]
    assert main([*arguments, "--backend", "cpu", "--test-every", "4", "--image-scale", "1"]) == 0
    output = capsys.readouterr()
    assert "is left out: Cannot train: no reason." in output.err and "index.html" in output.out
    run, merged = json.loads((tmp_path / "compare.json").read_text())["runs"]
    assert Job.from_file(tmp_path / "runs" / "3dgs" / "job.toml").test_every == 4
    assert run["points"][-1]["splats"] == merged["points"][-1]["splats"]


NO_SPACE = OSError(errno.ENOSPC, "No space left")


@pytest.mark.parametrize(
    "error", [NO_SPACE, LodgsError("Cannot write a.ply.", system_remedy(NO_SPACE), DISK)]
)
def test_full_disk_ends_the_command(tiny_scene, tmp_path, capsys, monkeypatch, error):
    """A method is not left out because of the disk: the same command resumes."""

    def fail(*_):
        raise error

    monkeypatch.setattr("training.runs.train._train", fail)
    assert main(["compare", str(tiny_scene), "--out", str(tmp_path), "--methods", "tree", "3dgs"]) == 2
    output = capsys.readouterr().err
    assert "left out" not in output and "Training 3DGS" not in output and "Free some space" in output


def test_several_scenes_share_a_page_of_results(tiny_scene, runs, tmp_path, monkeypatch):
    """Each method is finished at once; the second scene is a copy."""
    scenes = [shutil.copytree(tiny_scene, tmp_path / name) for name in ("first", "second")]
    jobs = []

    def train(job, events):
        jobs.append(job)
        run = RunFolder(job.out)
        run.create()
        job.write(run.job)
        source = runs[0] if job.method == "flod" else runs[1]
        shutil.copy(RunFolder(source).bundle, run.bundle)
        return 0

    monkeypatch.setattr("training.runs.train.train", train)
    out = tmp_path / "out"
    arguments = ["compare", *map(str, scenes), "--out", str(out), "--methods", "flod", "3dgs"]
    arguments += [
        "--backend",
        "cpu",
        "--test-every",
        "4",
        "--image-scale",
        "1",
        "--effort",
        "0.1",
        "--lpips",
        "none",
    ]
    assert main(arguments) == 0
    assert [(job.scene, job.method) for job in jobs] == [
        (str(scene), method) for scene in scenes for method in ("flod", "3dgs")
    ]
    assert jobs[1].resolved_parameters().steps == round(0.1 * METHODS["3dgs"].preset("draft").steps)
    text = (out / "results.md").read_text()
    assert all((out / name / "index.html").is_file() for name in ("first", "second"))
    assert re.findall("^## (.*)", text, re.M) == [
        "Choice of a method", "Means over the scenes", "first", "second",
    ]  # fmt: skip
    flod = json.loads((out / "first" / "compare.json").read_text())["runs"][0]
    row = next(line for line in text.splitlines() if line.startswith(f"| {flod['label']} "))
    assert f" {flod['points'][-1]['psnr']:.2f} " in row  # both scenes are equal
    assert "LPIPS" not in text  # not measured


def test_scenes_of_the_same_name_are_refused(tiny_scene, tmp_path, capsys):
    scenes = [shutil.copytree(tiny_scene, tmp_path / name / "scene") for name in ("first", "second")]
    assert main(["compare", *map(str, scenes), "--out", str(tmp_path / "out")]) == 2
    assert "several folders are named scene" in capsys.readouterr().err


def test_scene_and_run_together_are_refused(tiny_scene, runs, tmp_path, capsys):
    assert main(["compare", str(tiny_scene), str(runs[0]), "--out", str(tmp_path)]) == 2
    assert "Name scenes only, or runs only." in capsys.readouterr().err


def test_missing_scene_and_unwritable_folder_are_named_before_any_work(runs, tmp_path, capsys):
    assert main(["compare", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert f"Cannot open {tmp_path / 'none'}: the folder does not exist." in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").touch()
    assert main(["compare", str(runs[0]), "--out", str(tmp_path / "file" / "out")]) == 2
    assert f"Cannot write to {tmp_path / 'file' / 'out'}: " in capsys.readouterr().err


@pytest.mark.skipif(not BROWSER, reason="needs Chromium")
def test_page_fills_its_tables_in_a_browser(report):
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    command += ["--virtual-time-budget=2000", "--dump-dom", (report[1] / "index.html").as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=200, check=True)
    assert "CONSOLE" not in shown.stderr
    labels = [run["label"] for run in report[0]["runs"]]
    table = re.search(r'<table id="table">.*?</table>', shown.stdout, re.S)
    assert table and all(f'<td class="">{label}</td>' in table[0] for label in labels)
    assert shown.stdout.count("<circle") == 2 + 1 + 5
