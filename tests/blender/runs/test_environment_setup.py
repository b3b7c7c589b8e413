"""The trainer's environment is made beside the one that serves, which stays until the new one is tried."""

import hashlib
import sys
import zipfile
from pathlib import Path

import pytest

ASKED = [
    Path(__file__).resolve().parents[3] / "requirements" / f"{name}.in" for name in ("trainer", "cluster")
]


@pytest.fixture
def environment_setup(lodgs, tmp_path, monkeypatch):
    module, environment = lodgs("runs.environment_setup"), lodgs("runs.environment")
    monkeypatch.setattr(module, "current", None)
    monkeypatch.setattr(environment, "folder", lambda: tmp_path / "trainer")
    monkeypatch.delenv(environment.VARIABLE, raising=False)
    lodgs("extension").preferences().python = ""

    class App:  # bpy.app.online_access cannot be set
        online_access = True

    class Bpy:
        app = App

    monkeypatch.setattr(module, "bpy", Bpy)
    return module


@pytest.fixture
def fake(environment_setup, tmp_path, monkeypatch):
    """``fake(pip=.., tried=..)`` sets what pip and the trial do in environments that a fake Python makes."""
    python, base = tmp_path / "python", tmp_path / "base"
    python.write_text(
        f'#!/bin/sh\ncd {tmp_path}\ncase "$2" in pip) . ./pip;; import*) . ./tried;; *) . ./work;; esac\n'
    )
    base.write_text(f'#!/bin/sh\nmkdir -p "$3/bin" && cp {python} "$3/bin/python"\n')
    for program in (python, base):
        program.chmod(0o755)
    monkeypatch.setattr(environment_setup, "find_base", lambda: base)

    def behave(pip="true", tried="true", work="true"):
        for name, script in {"pip": pip, "tried": tried, "work": work}.items():
            (tmp_path / name).write_text(script + "\n")

    behave()
    return behave


@pytest.fixture
def there(tmp_path):
    """``there()`` names what lies where environments are made."""
    return lambda: sorted(path.name for path in (tmp_path / "trainer").iterdir())


def test_nothing_is_downloaded_without_leave(bpy, lodgs, environment_setup, monkeypatch):
    monkeypatch.setattr(environment_setup, "bpy", bpy)
    assert not bpy.app.online_access
    with pytest.raises(RuntimeError, match="Allow Online Access"):
        bpy.ops.lodgs.make_environment()
    assert environment_setup.current is None


def test_what_is_tried_is_what_was_asked_for(environment_setup):
    lines = [line for path in ASKED for line in path.read_text().splitlines()]
    names = {line.split("==")[0] for line in lines if "==" in line}
    assert {"pillow" if name == "PIL" else name for name in environment_setup.MODULES} == names - {"numpy"}


def test_packages_are_those_of_the_lock(bpy, lodgs, environment_setup, fake, there, tmp_path, monkeypatch):
    """A real pip, with a package of our own whose hash decides; first in a real environment."""
    wheel = tmp_path / "tiny-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as file:
        file.writestr("tiny.py", "")
        info = "tiny-1.0.dist-info"
        file.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: tiny\nVersion: 1.0\n")
        file.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        file.writestr(f"{info}/RECORD", "")
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    lock = tmp_path / "lock.txt"
    lock.write_text(f"tiny @ {wheel.as_uri()} --hash=sha256:{digest}\n")
    monkeypatch.setattr(environment_setup, "REQUIREMENTS", lock)
    monkeypatch.setattr(environment_setup, "MODULES", ("tiny",))
    with monkeypatch.context() as real:
        real.setattr(environment_setup, "find_base", lambda: Path(sys.executable))
        assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    assert (
        environment_setup.current.fraction == 1
        and environment_setup.current.message == "The environment is ready"
    )
    python = lodgs("runs.environment").trainer_python()
    assert python == tmp_path / "trainer" / "1" / "bin" / "python" and python.exists()

    lock.write_text(f"tiny @ {wheel.as_uri()} --hash=sha256:{'0' * 64}\n")
    fake(pip=f'exec {sys.executable} "$@" --target={tmp_path}/site')
    with pytest.raises(RuntimeError, match=r"DO NOT MATCH THE HASHES.* The environment .* is kept"):
        bpy.ops.lodgs.make_environment()
    assert there() == ["1"] and lodgs("runs.environment").trainer_python() == python


FAILURES = {
    "network": ({"pip": "echo 'ERROR: No matching distribution found for torch'; exit 1"}, "No matching"),
    "disk": ({"pip": "echo 'ERROR: [Errno 28] No space left on device'; exit 1"}, "No space left on device"),
    "import": (
        {"tried": "echo 'ImportError: libcudart.so.13' >&2; exit 1"},
        "environment failed: Imp",
    ),
    "silent": ({"pip": "kill -9 $$"}, "pip install failed. Check the network"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_the_environment_that_serves_survives_a_failed_making(
    bpy, lodgs, environment_setup, fake, there, case
):
    behaviour, words = FAILURES[case]
    fake(**behaviour)
    with pytest.raises(RuntimeError, match=words) as failed:
        bpy.ops.lodgs.make_environment()
    assert there() == [] and "kept" not in str(failed.value)
    fake()
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"} and there() == ["1"]
    before = lodgs("runs.environment").trainer_python()
    fake(**behaviour)
    with pytest.raises(RuntimeError, match="The environment that was there is kept"):
        bpy.ops.lodgs.make_environment()
    assert there() == ["1"] and before.exists() and lodgs("runs.environment").trainer_python() == before


def test_a_new_environment_takes_the_place_of_the_one_before(
    bpy, lodgs, environment_setup, fake, there, tmp_path
):
    (tmp_path / "trainer" / "bin").mkdir(parents=True)  # as versions before this one made it
    (tmp_path / "trainer" / "pyvenv.cfg").touch()
    cache = Path(lodgs("runs.processes").environment()["PYTHONPYCACHEPREFIX"])
    compiled = cache / (tmp_path / "trainer" / "1" / "lib").relative_to("/")
    compiled.mkdir(parents=True)
    for made in ("1", "2"):
        assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
        assert compiled.exists() == (made == "1")
        assert there() == [made] and lodgs("runs.environment").trainer_python().parts[-3] == made


def test_cancel_keeps_the_environment_that_serves(bpy, lodgs, environment_setup, fake, there):
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    fake(pip="echo Collecting patience; exec sleep 30")
    work = environment_setup.make()
    with pytest.raises(Exception, match="being made already"):
        environment_setup.make()
    assert bpy.ops.lodgs.cancel_environment() == {"FINISHED"}
    work._thread.join(10)
    assert not work.running and work.message == "Cancelled" and work.problem == ""
    assert there() == ["1"] and lodgs("runs.environment").trainer_python().exists()


def test_what_a_killed_making_left_is_removed_by_the_next(
    bpy, lodgs, environment_setup, fake, there, tmp_path
):
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    left = tmp_path / "trainer" / "2" / "lib"
    left.mkdir(parents=True)
    (left / "torch.so").write_text("a part")
    (tmp_path / "trainer" / "2" / lodgs("runs.processes").MARK).touch()
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    assert there() == ["2"] and not left.exists()  # the number is free again
    assert (tmp_path / "trainer" / "2" / lodgs("runs.environment").READY).exists()


def test_the_making_of_another_blender_is_left_alone(bpy, lodgs, environment_setup, fake, there, tmp_path):
    other = tmp_path / "trainer" / "1"
    other.mkdir(parents=True)
    (other / lodgs("runs.processes").MARK).touch()
    with lodgs("runs.processes").using(other):
        assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
        assert there() == ["1", "2"]


@pytest.mark.parametrize("how", ["spawn", "converse"])
def test_no_environment_is_removed_under_a_running_program(
    bpy, lodgs, environment_setup, fake, there, tmp_path, how
):
    processes, environment = lodgs("runs.processes"), lodgs("runs.environment")
    fake(work="exec sleep 60")
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    command, output = [str(environment.trainer_python()), "-m", "training"], {"log": tmp_path / "log"}
    if how == "spawn":
        output["output"] = tmp_path / "out"
    with getattr(processes, how)(command, **output) as trainer:
        assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
        assert environment_setup.current.message.endswith("; what is running goes on with the one before it")
        assert there() == ["1", "2"] and environment.trainer_python().parts[-3] == "2"
        trainer.kill()
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    assert there() == ["3"] and environment_setup.current.message == "The environment is ready"


def test_what_a_gpu_needs_is_installed_where_it_can_be_compiled(
    bpy, environment_setup, fake, tmp_path, monkeypatch
):
    fake(pip=f'echo "$@" > {tmp_path}/said')
    programs = {"nvidia-smi": "/nvidia-smi"}
    monkeypatch.setattr(environment_setup.shutil, "which", programs.get)
    for lock in ("cluster.txt", "cuda.txt"):
        assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
        said = (tmp_path / "said").read_text()
        assert said.strip().endswith(lock) and "--require-hashes --only-binary=:all:" in said
        programs["nvcc"] = "/nvcc"


def test_the_python_that_tests_run_on_goes_first(lodgs, environment_setup, monkeypatch):
    monkeypatch.setattr(environment_setup.shutil, "which", lambda name: f"/bin/{name}")
    versions = {"/bin/python3.11": (3, 8), "/bin/python3.12": (3, 12), "/bin/python3.13": (3, 13)}
    monkeypatch.setattr(
        environment_setup.environment, "version_of", lambda python: versions.get(str(python), (0, 0))
    )
    assert environment_setup.find_base() == Path("/bin/python3.12")
    versions["/bin/python3.11"] = (3, 11)
    assert environment_setup.find_base() == Path("/bin/python3.11")
    versions.clear()
    with pytest.raises(Exception, match=r"No Python from 3\.11 to 3\.14"):
        environment_setup.find_base()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("Collecting typing-extensions>=4.10 (from torch->-r x)", "Collecting typing-extensions"),
        (
            "Downloading nvidia_nccl_cu13-2.29.7-py3-none-any.whl (206.0 MB)",
            "Downloading nvidia_nccl_cu13 (206.0 MB)",
        ),
        ("Downloading torch-2.13.0-cp314-cp314.whl.metadata (31 kB)", "Downloading torch (31 kB)"),
        ("Installing collected packages: mpmath, torch", "Installing the packages"),
    ],
)
def test_what_pip_does_in_few_words(environment_setup, line, words):
    assert environment_setup.brief(line) == words
