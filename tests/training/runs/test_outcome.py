"""How a trainer ended, as the panel says it."""

import pytest

from training.runs.events import event_line
from training.runs.folder import RunFolder
from training.runs.outcome import run_outcome


@pytest.fixture
def run(tmp_path) -> RunFolder:
    run = RunFolder(tmp_path / "run")
    run.create()
    return run


def test_an_error_is_said_as_the_run_or_its_output_has_it(run):
    run.output.write_text(event_line("error", what="It is another job's.", remedy="Choose another.") + "\n")
    assert run_outcome(run, 2) == ("failed", "It is another job's. Choose another.")
    run.events_file.write_text(event_line("error", what="The disk is full.", remedy="Free some.") + "\n")
    assert run_outcome(run, 2) == run_outcome(run, None) == ("failed", "The disk is full. Free some.")


def test_where_nothing_could_be_written_the_exit_code_says_it(run):
    run.events_file.write_text(event_line("hello") + '\n{"event": "prog')
    state, problem = run_outcome(run, 2)
    assert state == "failed" and "could write nothing more into" in problem and "Free some space" in problem


def test_a_folder_that_is_gone_is_said(run, tmp_path):
    run.path.rename(tmp_path / "moved")
    state, problem = run_outcome(run, 2)
    assert (
        state == "interrupted" and problem == f"The run folder {run.path} is gone: it was moved or deleted."
    )


@pytest.mark.parametrize(("code", "says"), [(-9, "signal 9"), (1, "exit code 1"), (None, "without a word")])
def test_a_death_without_words_is_told_by_its_code(run, code, says):
    run.events_file.write_text(event_line("hello") + "\n")
    run.log.write_text("Traceback\nRuntimeError: the card caught fire\n")
    state, problem = run_outcome(run, code)
    assert state == "interrupted" and says in problem and "the card caught fire" in problem
    run.events_file.write_text(event_line("done") + "\n")
    assert run_outcome(run, 0) == ("done", "")
