"""Messages for the end of a trainer."""

import pytest

from training.runs.events import event_line
from training.runs.folder import RunFolder
from training.runs.outcome import run_outcome


@pytest.fixture
def run(tmp_path) -> RunFolder:
    run = RunFolder(tmp_path / "run")
    run.create()
    return run


def test_error_event_of_the_run_or_its_output_is_reported(run):
    run.output.write_text(event_line("error", what="It is another job's.", remedy="Choose another.") + "\n")
    assert run_outcome(run, 2) == ("failed", "It is another job's. Choose another.")
    run.events_file.write_text(event_line("error", what="The disk is full.", remedy="Free some.") + "\n")
    assert run_outcome(run, 2) == run_outcome(run, None) == ("failed", "The disk is full. Free some.")


@pytest.mark.parametrize(("kind", "state"), [("done", "done"), ("cancelled", "cancelled")])
def test_rejected_second_trainer_is_no_failure_of_the_run(run, kind, state):
    """Two Blenders resume one run: the trainer of one of them ends with exit code 2."""
    run.events_file.write_text(event_line(kind) + "\n")
    run.output.write_text(event_line("error", what="Another trainer is running.") + "\n" + event_line(kind))
    assert run_outcome(run, 2) == (state, "")
    run.events_file.write_text(event_line("hello") + "\n")
    assert run_outcome(run, 2) == ("failed", "Another trainer is running.")


def test_unwritable_run_is_reported_from_the_exit_code(run):
    run.events_file.write_text(event_line("hello") + '\n{"event": "prog')
    state, problem = run_outcome(run, 2)
    assert state == "failed" and "could not write to" in problem and "Free some space" in problem


def test_missing_folder_is_reported(run, tmp_path):
    run.path.rename(tmp_path / "moved")
    state, problem = run_outcome(run, 2)
    assert state == "interrupted" and problem.startswith(f"The run folder {run.path} does not exist")


@pytest.mark.parametrize(
    ("code", "message"), [(-9, "signal 9"), (1, "exit code 1"), (None, "without a message")]
)
def test_crash_without_error_event_is_explained_by_the_exit_code(run, code, message):
    run.events_file.write_text(event_line("hello") + "\n")
    run.log.write_text("Traceback\nRuntimeError: the card caught fire\n")
    state, problem = run_outcome(run, code)
    assert state == "interrupted" and message in problem and "the card caught fire" in problem
    run.events_file.write_text(event_line("done") + "\n")
    assert run_outcome(run, 0) == ("done", "")
