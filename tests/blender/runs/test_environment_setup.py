"""Installation of the trainer's environment. The previous one is kept until the new one passes its test."""

import hashlib
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_blender


INPUTS = [
    Path(__file__).resolve().parents[3] / "requirements" / f"{name}.in" for name in ("trainer", "cluster")
]
STILL_IN_USE = r"The\s+previous\s+environment\s+is\s+still\s+in\s+use"


@pytest.fixture
def environment_setup(lodgs, tmp_path, monkeypatch):
    module, environment = lodgs("runs.environment_setup"), lodgs("runs.environment")
    monkeypatch.setattr(module, "current", None)
    monkeypatch.setattr(module.packages, "has_cpu_build", lambda: False)
    monkeypatch.setattr(environment, "environments_folder", lambda: tmp_path / "trainer")
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
    """``fake(pip=.., imports=..)`` sets the shell scripts that replace pip and the import test."""
    python, base = tmp_path / "python", tmp_path / "base"
    python.write_text(
        f'#!/bin/sh\ncd {tmp_path}\ncase "$2" in pip) . ./pip;; import*) . ./imports;; *) . ./work;; esac\n'
    )
    base.write_text(f'#!/bin/sh\nmkdir -p "$3/bin" && cp {python} "$3/bin/python"\n')
    for program in (python, base):
        program.chmod(0o755)
    monkeypatch.setattr(environment_setup, "find_base_python", lambda: base)

    def behave(pip="true", imports="true", work="true"):
        for name, script in {"pip": pip, "imports": imports, "work": work}.items():
            (tmp_path / name).write_text(script + "\n")

    behave()
    return behave


@pytest.fixture
def environments(tmp_path):
    """``environments()`` lists the names in the folder of environments."""
    return lambda: sorted(path.name for path in (tmp_path / "trainer").iterdir())


def test_nothing_is_downloaded_without_online_access(bpy, lodgs, environment_setup, monkeypatch):
    monkeypatch.setattr(environment_setup, "bpy", bpy)
    assert not bpy.app.online_access
    with pytest.raises(RuntimeError, match="Allow Online Access"):
        bpy.ops.lodgs.make_environment()
    assert environment_setup.current is None


def test_all_required_packages_are_imported_in_the_test(environment_setup):
    lines = [line for path in INPUTS for line in path.read_text().splitlines()]
    names = {line.split("==")[0] for line in lines if "==" in line}
    packages = {"PIL": "pillow", "pxr": "usd-core"}
    assert {packages.get(name, name) for name in environment_setup.MODULES} == names - {"numpy"}


def test_packages_must_match_the_lock_file(
    bpy, lodgs, environment_setup, fake, environments, tmp_path, monkeypatch
):
    """Use a real pip and a package with a known hash."""
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
    monkeypatch.setattr(environment_setup, "PIP_REQUIREMENTS", lock)  # keeps the pip of this Python
    monkeypatch.setattr(environment_setup, "PIP_OPTIONS", ())
    monkeypatch.setattr(environment_setup, "MODULES", ("tiny",))
    with monkeypatch.context() as real:
        real.setattr(environment_setup, "find_base_python", lambda: Path(sys.executable))
        assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    assert (
        environment_setup.current.fraction == 1
        and environment_setup.current.message == "The trainer is ready"
    )
    python = lodgs("runs.environment").trainer_python()
    assert python == tmp_path / "trainer" / "1" / "bin" / "python" and python.exists()

    lock.write_text(f"tiny @ {wheel.as_uri()} --hash=sha256:{'0' * 64}\n")
    fake(pip=f'exec {sys.executable} "$@" --target={tmp_path}/site')
    with pytest.raises(RuntimeError, match=rf"DO NOT MATCH THE HASHES(.|\n)*{STILL_IN_USE}"):
        bpy.ops.lodgs.make_environment()
    assert environments() == ["1"] and lodgs("runs.environment").trainer_python() == python


NO_PACKAGE = "; echo ERROR: No matching distribution found for pip==26.3; exit 1"
FAILURES = {
    "network": ({"pip": "echo 'ERROR: No matching distribution found for torch'; exit 1"}, "No matching"),
    "disk": ({"pip": "echo 'ERROR: [Errno 28] No space left on device'; exit 1"}, "No space left on device"),
    "import": (
        {"imports": "echo 'ImportError: libcudart.so.13' >&2; exit 1"},
        "packages failed: Imp",
    ),
    "offline": (
        {"pip": "echo WARNING: Retrying after connection broken by OSError" + NO_PACKAGE},
        "pip install failed: no connection to the package index. Check the network",
    ),
    "proxy": (
        {"pip": "echo connection broken by CERTIFICATE_VERIFY_FAILED" + NO_PACKAGE},
        "the certificate of the package index or of a proxy is not trusted",
    ),
    "unstable": (
        {"pip": "echo connection broken by OSError; echo ERROR: Disk is full; exit 1"},
        "ERROR: Disk is full",
    ),
    "silent": ({"pip": "kill -9 $$"}, "pip install failed. Check the network"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_failed_installation_keeps_the_previous_environment(
    bpy, lodgs, environment_setup, fake, environments, case
):
    behaviour, message = FAILURES[case]
    fake(**behaviour)
    with pytest.raises(RuntimeError, match=message) as failed:
        bpy.ops.lodgs.make_environment()
    assert environments() == [] and "previous" not in str(failed.value)
    fake()
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"} and environments() == ["1"]
    previous = lodgs("runs.environment").trainer_python()
    fake(**behaviour)
    with pytest.raises(RuntimeError, match=STILL_IN_USE):
        bpy.ops.lodgs.make_environment()
    assert (
        environments() == ["1"]
        and previous.exists()
        and lodgs("runs.environment").trainer_python() == previous
    )


def test_new_environment_replaces_the_previous_one(
    bpy, lodgs, environment_setup, fake, environments, tmp_path
):
    (tmp_path / "trainer" / "bin").mkdir(parents=True)  # layout of older versions
    (tmp_path / "trainer" / "pyvenv.cfg").touch()
    cache = Path(lodgs("runs.processes").environment()["PYTHONPYCACHEPREFIX"])
    compiled = cache / (tmp_path / "trainer" / "1" / "lib").relative_to("/")
    compiled.mkdir(parents=True)
    for number in ("1", "2"):
        assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
        assert compiled.exists() == (number == "1")
        assert environments() == [number] and lodgs("runs.environment").trainer_python().parts[-3] == number


def test_cancelled_installation_keeps_the_previous_environment(
    bpy, lodgs, environment_setup, fake, environments, monkeypatch
):
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    fake(pip="echo Collecting patience; exec sleep 1000")
    work = environment_setup.start()
    with pytest.raises(Exception, match="already being installed"):
        environment_setup.start()
    remove, messages = environment_setup.shutil.rmtree, []
    monkeypatch.setattr(
        environment_setup.shutil, "rmtree", lambda *a, **k: messages.append(work.message) or remove(*a, **k)
    )
    assert bpy.ops.lodgs.cancel_environment() == {"FINISHED"}
    work._thread.join(200)
    assert messages[0].startswith("Cancelling, 0:")  # removing a gigabyte takes seconds
    assert not work.running and work.message == "Cancelled" and work.problem == ""
    assert environments() == ["1"] and lodgs("runs.environment").trainer_python().exists()


def test_incomplete_environment_of_a_killed_installation_is_removed(
    bpy, lodgs, environment_setup, fake, environments, tmp_path
):
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    incomplete = tmp_path / "trainer" / "2" / "lib"
    incomplete.mkdir(parents=True)
    (incomplete / "torch.so").write_text("a part")
    (tmp_path / "trainer" / "2" / lodgs("runs.processes").MARK).touch()
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    assert environments() == ["2"] and not incomplete.exists()  # the number is free again
    assert (tmp_path / "trainer" / "2" / lodgs("runs.environment").READY).exists()


def test_installation_of_another_blender_is_not_removed(
    bpy, lodgs, environment_setup, fake, environments, tmp_path
):
    locked = tmp_path / "trainer" / "1"
    locked.mkdir(parents=True)
    (locked / lodgs("runs.processes").MARK).touch()
    with lodgs("runs.processes").hold_environment(locked):
        assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
        assert environments() == ["1", "2"]


@pytest.mark.parametrize("start", ["spawn", "spawn_piped"])
def test_environment_of_a_running_program_is_not_removed(
    bpy, lodgs, environment_setup, fake, environments, tmp_path, start
):
    processes, environment = lodgs("runs.processes"), lodgs("runs.environment")
    fake(work="exec sleep 1000")
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    command, output = [str(environment.trainer_python()), "-m", "training"], {"log": tmp_path / "log"}
    if start == "spawn":
        output["output"] = tmp_path / "out"
    with getattr(processes, start)(command, **output) as trainer:
        assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
        assert environment_setup.current.message.endswith("; running programs keep the previous environment")
        assert environments() == ["1", "2"] and environment.trainer_python().parts[-3] == "2"
        trainer.kill()
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    assert environments() == ["3"] and environment_setup.current.message == "The trainer is ready"


def test_cuda_build_is_installed_if_a_driver_exists(bpy, environment_setup, fake, tmp_path, monkeypatch):
    fake(pip=f'echo "$@" >> {tmp_path}/arguments')
    monkeypatch.setattr(environment_setup.packages, "has_cpu_build", lambda: True)
    monkeypatch.setattr(environment_setup.shutil, "which", {"nvidia-smi": "/nvidia-smi"}.get)
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    arguments = (tmp_path / "arguments").read_text()
    assert arguments.strip().endswith(f"{environment_setup.REQUIREMENTS}")
    assert "--require-hashes --only-binary=:all:" in arguments and "torch-cpu" not in arguments


def test_cpu_build_of_torch_replaces_the_cuda_build(bpy, environment_setup, fake, tmp_path, monkeypatch):
    log = f"for last; do :; done; cat ${{last#*=}} >> {tmp_path}/installed"
    monkeypatch.setattr(environment_setup.packages, "has_cpu_build", lambda: True)
    fake(pip=f'echo "$@" >> {tmp_path}/arguments; {log}')
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    assert f"--index-url={environment_setup.packages.TORCH_INDEX}" in (tmp_path / "arguments").read_text()
    installed = (tmp_path / "installed").read_text()
    assert "torch==2.13.0+cpu" in installed and "numba==" in installed
    assert "nvidia-" not in installed and "\ntorch==2.13.0 " not in installed

    (tmp_path / "installed").unlink()
    unreachable = 'case "$*" in *torch-cpu*) echo "ERROR: no network"; exit 1;; esac'
    fake(pip=f"{unreachable}; {log}")
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    installed = (tmp_path / "installed").read_text()
    assert "nvidia-cublas==" in installed and "\ntorch==2.13.0 " in installed


def test_progress_shows_size_and_time(bpy, environment_setup, fake, monkeypatch):
    now = iter(range(1000))
    monkeypatch.setattr(environment_setup.time, "monotonic", lambda: next(now))
    messages = []
    monkeypatch.setattr(
        environment_setup.EnvironmentSetup,
        "step",
        lambda self: messages.append(self.message) or self.running,
    )
    lines = ("'Downloading torch-2.13.0-cp311.whl (191.8 MB)'", "Progress 96000000 of 191800000")
    fake(pip="".join(f"echo {line}; sleep 0.4; " for line in lines))
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    assert any(text.startswith("Downloading torch (191.8 MB), 0:") for text in messages)
    repeated = [text for text in messages if text.startswith("Downloading torch 96 of 192 MB, 0:")]
    assert len(set(repeated)) == len(repeated) > 1  # the time goes on while pip is silent
    assert messages[-1] == "The trainer is ready"


def test_oldest_supported_python_is_preferred(lodgs, environment_setup, monkeypatch):
    monkeypatch.setattr(environment_setup.shutil, "which", lambda name: f"/bin/{name}")
    versions = {"/bin/python3.11": (3, 8), "/bin/python3.12": (3, 12), "/bin/python3.13": (3, 13)}
    monkeypatch.setattr(
        environment_setup.environment, "python_version", lambda python: versions.get(str(python), (0, 0))
    )
    assert environment_setup.find_base_python() == Path("/bin/python3.12")
    versions["/bin/python3.11"] = (3, 11)
    assert environment_setup.find_base_python() == Path("/bin/python3.11")
    versions.clear()
    with pytest.raises(Exception, match=r"no Python from 3\.11 to 3\.14"):
        environment_setup.find_base_python()


@pytest.mark.parametrize(
    ("line", "text"),
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
def test_pip_lines_are_shortened(environment_setup, line, text):
    assert environment_setup.shorten_pip_line(line) == text
