"""Atomic writes: the old file or the new one, never a part. Blocks that are entered one after the other."""

import errno
import os
from threading import Thread

import pytest

from training import files
from training.errors import LodgsError
from training.files import atomic_write


def test_appears_whole_and_leaves_nothing_beside(tmp_path):
    path = tmp_path / "made" / "a.txt"
    with atomic_write(path) as temporary:
        assert temporary.parent == path.parent
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert os.listdir(path.parent) == ["a.txt"]


def test_a_failure_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyError), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise KeyError("stop")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_full_disk_is_one_sentence(tmp_path):
    with (
        pytest.raises(LodgsError, match=r"a\.txt could not be written: No space left.* Free some space"),
        atomic_write(tmp_path / "a.txt"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert os.listdir(tmp_path) == []


def test_a_place_that_is_a_file_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(LodgsError, match="could not be written"), atomic_write(tmp_path / "file" / "a.txt"):
        pass


def test_space_does_not_help_where_a_folder_has_the_name(tmp_path):
    (tmp_path / "a.ply").mkdir()
    with (
        pytest.raises(LodgsError, match=r"Is a directory\. Choose another name or folder"),
        atomic_write(tmp_path / "a.ply") as temporary,
    ):
        temporary.write_text("new")
    assert os.listdir(tmp_path) == ["a.ply"]


def test_an_error_about_another_file_passes_through(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "a.txt"):
        (tmp_path / "elsewhere" / "missing.txt").read_bytes()


def test_blocks_of_a_name_are_entered_one_after_the_other(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "cache_folder", lambda: tmp_path / "cache")
    done = []

    def second():
        with files.exclusive("work"):
            done.append("second")

    with files.exclusive("work"):
        other = Thread(target=second)
        other.start()
        other.join(0.3)
        done.append("first")
    other.join(10)
    assert done == ["first", "second"]


def test_nobody_waits_where_nothing_can_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(files, "cache_folder", lambda: tmp_path / "file")
    with files.exclusive("work"), files.exclusive("work"):
        pass
