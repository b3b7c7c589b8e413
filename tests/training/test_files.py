"""Atomic writes and named locks."""

import errno
import os
import re
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from training.errors import LodgsError, system_reason
from training.files import (
    atomic_folder,
    atomic_write,
    create_folder,
    names_device,
    network_share,
    open_regular,
)
from training.render.wire import write_set
from training.scenes.images import write_png
from training.scenes.write_colmap import write_model

ROOT = Path(__file__).resolve().parents[2]


def test_file_appears_complete_and_temporary_is_removed(tmp_path):
    path = tmp_path / "folder" / "a.txt"
    with atomic_write(path) as temporary:
        assert temporary.parent == path.parent
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert os.listdir(path.parent) == ["a.txt"]


def test_failure_keeps_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyError), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise KeyError("stop")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_full_disk_raises_one_sentence(tmp_path):
    with (
        pytest.raises(LodgsError, match=r"Cannot write .*a\.txt: No space left.* Free some space"),
        atomic_write(tmp_path / "a.txt"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert os.listdir(tmp_path) == []


def test_folder_appears_complete_and_replaces_the_former_one(tmp_path):
    for text in ("old", "new"):
        with atomic_folder(tmp_path / "parent" / "a") as folder:
            (folder / text).touch()
        assert os.listdir(tmp_path / "parent") == ["a"] and os.listdir(tmp_path / "parent" / "a") == [text]


def test_interrupted_exchange_keeps_the_former_folder(tmp_path, monkeypatch):
    (tmp_path / "a" / "old").mkdir(parents=True)
    rename = os.rename

    def interrupt(source, target):
        if Path(source).name == "new":
            raise KeyboardInterrupt
        rename(source, target)

    monkeypatch.setattr(os, "rename", interrupt)
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "a") as folder:
        (folder / "new").touch()
    assert os.listdir(tmp_path) == ["a"] and os.listdir(tmp_path / "a") == ["old"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows stores halves of surrogate pairs")
@pytest.mark.parametrize("name", ["a\0b", "a\ud800b"])
def test_impossible_names_raise_one_sentence(tmp_path, name):
    for action in (atomic_write, atomic_folder):
        with pytest.raises(LodgsError, match="not a valid file name"), action(tmp_path / name):
            pass
    with pytest.raises(LodgsError, match="not a valid file name"):
        create_folder(tmp_path / name)
    assert not os.listdir(tmp_path)


def test_nested_writes_name_the_final_file(tmp_path):
    with (
        pytest.raises(LodgsError, match=rf"^Cannot write {re.escape(str(tmp_path / 'a.b.ply'))}: No space"),
        atomic_write(tmp_path / "a.b.ply") as temporary,
        atomic_write(temporary),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextmanager
def file_size_limit(size: int):
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def write_points(folder: Path) -> None:
    write_model(folder / "0", [], [], np.zeros((99, 3)), np.zeros((99, 3), np.uint8))


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (write_points, "0/points3D.bin"),
        (lambda folder: write_png(folder / "a.png", np.zeros((50, 50, 3), np.uint8)), "a.png"),
        (lambda folder: write_set(folder / "a.set", [np.zeros(500)]), "a.set"),
    ],
)
def test_failed_writes_name_their_file(tmp_path, monkeypatch, write, name):
    monkeypatch.setattr("training.scenes.images.zlib.compress", lambda data, level: data)  # a large file
    with pytest.raises(OSError) as caught, file_size_limit(1000):
        write(tmp_path)
    assert system_reason(caught.value) == f"File too large ({tmp_path / name})"
    assert not (tmp_path / "0").exists()


def test_reason_names_the_target_of_a_failed_copy(tmp_path):
    with pytest.raises(OSError) as caught:
        os.replace(tmp_path, tmp_path / "nowhere" / "a")
    assert system_reason(caught.value) == f"No such file or directory ({tmp_path / 'nowhere' / 'a'})"
    assert system_reason(OSError("lost")) == "lost"


def test_parent_that_is_a_file_raises_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(LodgsError, match="Cannot write"), atomic_write(tmp_path / "file" / "a.txt"):
        pass


def test_path_that_is_a_folder_asks_for_another_name(tmp_path):
    (tmp_path / "a.ply").mkdir()
    with (
        pytest.raises(LodgsError, match=r"a folder has this name\. Choose another name or folder"),
        atomic_write(tmp_path / "a.ply"),
    ):
        pytest.fail("the work begins before the error")
    assert os.listdir(tmp_path) == ["a.ply"]


@pytest.mark.skipif(os.name != "posix", reason="no named pipes or links to devices")
@pytest.mark.parametrize("kind", ["pipe", "loop", "link to a pipe"])
@pytest.mark.parametrize("write", [atomic_write, atomic_folder])
def test_pipes_devices_and_endless_links_are_not_replaced(tmp_path, kind, write):
    path = tmp_path / "a"
    if kind == "loop":
        path.symlink_to("a")
    else:
        os.mkfifo(tmp_path / "pipe" if kind == "link to a pipe" else path)
    if kind == "link to a pipe":  # root could replace /dev/null by such a link
        path.symlink_to("pipe")
    before = sorted((name, (tmp_path / name).lstat().st_mode) for name in os.listdir(tmp_path))
    with pytest.raises(LodgsError, match="a pipe, device or endless link has this name"), write(path):
        pytest.fail("the work begins before the error")
    assert before == sorted((name, (tmp_path / name).lstat().st_mode) for name in os.listdir(tmp_path))


def test_folder_does_not_replace_a_file(tmp_path):
    (tmp_path / "tiles").write_text("mine")
    with pytest.raises(LodgsError, match="a file has this name"), atomic_folder(tmp_path / "tiles"):
        pytest.fail("the work begins before the error")
    assert (tmp_path / "tiles").read_text() == "mine"


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
@pytest.mark.parametrize("former", [False, True])
def test_folder_behind_a_link_is_replaced(tmp_path, former):
    target = tmp_path / "other disk" / "a"
    (target if former else target.parent).mkdir(parents=True)
    (tmp_path / "a").symlink_to(target, target_is_directory=True)
    with atomic_folder(tmp_path / "a") as folder:
        (folder / "new").touch()
    assert (tmp_path / "a").is_symlink() and os.listdir(target) == ["new"]


def test_error_about_another_file_passes_through(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "a.txt"):
        (tmp_path / "folder" / "missing.txt").read_bytes()


KILLED = """
import os, pathlib, signal, sys
from training import files
folder = pathlib.Path(sys.argv[1])
with files.atomic_write(folder / "a.ply") as temporary, files.temporary_folder(folder) as inside:
    temporary.write_text("half")
    (inside / "level.ply").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps leftovers for a day")
def test_leftovers_of_killed_processes_are_removed_by_the_next_write(tmp_path, monkeypatch):
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], cwd=ROOT, check=False)
    leftovers = list(tmp_path.iterdir())
    assert len(leftovers) == 2
    (temporary,) = [path for path in leftovers if path.is_file()]
    pid = temporary.name.split("-")[1]
    remaining = [
        tmp_path / temporary.name.replace(f"-{pid}-", f"-{os.getppid()}-"),  # a running process
        tmp_path / f".b.ply.{'0000' if '.0000-' not in temporary.name else '0001'}-{pid}-abcd.tmp",
        tmp_path / "notes.tmp",
        tmp_path / ".lodgs-notes",
    ]
    for path in remaining:
        path.touch()
    with atomic_write(tmp_path / "b.ply") as target:
        target.touch()
    assert sorted(tmp_path.iterdir()) == sorted([*remaining, tmp_path / "b.ply"])


def test_long_names_can_be_written(tmp_path):
    path = tmp_path / ("ä" * 120 + ".ply")
    with atomic_write(path) as temporary:
        temporary.touch()
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize(
    "path",
    [
        r"\\.\PhysicalDrive0", r"\\.\C:", "//./pipe/lodgs", r"\\?\GLOBALROOT\Device", r"\??\PIPE\x", "CON",
        "nul.txt", r"C:\photos\Aux.jpg", "photos/lpt3", "prn .png", "nul. .", "com\N{SUPERSCRIPT ONE}",
        "CONIN$", "con:x",
    ],
)  # fmt: skip
def test_names_of_windows_devices(path):
    """The names are those of Microsoft's "Naming Files, Paths, and Namespaces"."""
    assert names_device(path, windows=True)


@pytest.mark.parametrize(
    "path",
    [
        "console.png",
        "a/com10",
        "aux_1.png",
        r"\\?\C:\long\a.ply",
        r"\\?\UNC\server\share\a",
        r"\\server\share\a",
        "/con_",
    ],
)
def test_names_of_files_are_no_devices(path):
    assert not names_device(path, windows=True)


def test_files_of_other_systems_may_have_the_names_of_windows_devices():
    assert not names_device("/photos/con.png", windows=False)


@pytest.mark.parametrize(
    ("path", "share"),
    [
        (r"\\Server\Share\a", r"\\server\share"), ("//server/share/a", r"\\server\share"),
        (r"/\server\share", r"\\server\share"), (r"\\?\UNC\server\share\a", r"\\?\unc\server\share"),
        (r"\??\UNC\server\share\a", r"\\?\unc\server\share"), (r"C:\a", ""), (r"\\?\C:\a", ""), (r"\a\b", ""),
        ("/a/b", ""), ("a/b", ""), ("", ""),
    ],
)  # fmt: skip
def test_network_share_of_a_path(path, share):
    assert network_share(path) == share


@pytest.mark.skipif(os.name != "posix", reason="no named pipes or devices as files")
def test_devices_and_pipes_are_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero", "/dev/stdin", tmp_path, r"\\.\pipe\x"):
        with pytest.raises(OSError, match=r"not a file|a device"):
            open_regular(path)
