"""The launcher, tried on a tiny stand-in project: same launcher, no downloads."""

import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.waiting import wait_for

ROOT = Path(__file__).parents[1]
# The base interpreter, because the tests' own environment may lie in a folder that a launcher would have to remake.
PYTHON = Path(sys._base_executable).parent  # type: ignore[attr-defined]

PYPROJECT = """
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]
[project]
name = "ash-bench"
version = "0.0.1"
dependencies = ["tiny"]
[project.optional-dependencies]
dev = []
"""

# A build backend that only installs a console script; it counts its builds, and fails or hangs when a file tells it to.
BACKEND = """
import pathlib, time, zipfile
def build_editable(folder, config_settings=None, metadata_directory=None):
    root = pathlib.Path.cwd()
    with open(root / "builds", "a") as file:
        file.write("x")
    if (root / "broken").exists():
        raise SystemExit("fatal error: no such kernel")
    while (root / "hang").exists():
        time.sleep(0.05)
    info = "ash_bench-0.0.1.dist-info"
    name = "ash_bench-0.0.1-py3-none-any.whl"
    with zipfile.ZipFile(pathlib.Path(folder) / name, "w") as wheel:
        wheel.writestr("ash_bench_stub.pth", str(root))
        wheel.writestr(info + "/METADATA", "Metadata-Version: 2.1\\nName: ash-bench\\nVersion: 0.0.1\\n")
        wheel.writestr(info + "/WHEEL", "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n")
        wheel.writestr(info + "/entry_points.txt", "[console_scripts]\\nash-bench = program:main\\n")
        wheel.writestr(info + "/RECORD", "")
    return name
"""

PROGRAM = """
import pathlib, sys
def main():
    import tiny
    print(pathlib.Path(__file__).parent, *sys.argv[1:-1])
    return int(sys.argv[-1])
"""


def write_wheel(folder: Path, name: str) -> None:
    """A wheel with one empty module."""
    info = f"{name}-1.0.dist-info"
    with zipfile.ZipFile(folder / f"{name}-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr(f"{name}.py", "")
        wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        wheel.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        wheel.writestr(f"{info}/RECORD", "")


def write_program(path: Path, script: str) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


@pytest.fixture(scope="module", autouse=True)
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Wheels instead of an index, and neither apt nor sudo can do anything; what apt was asked for is in `apt.log`."""
    folder = tmp_path_factory.mktemp("machine")
    for name in ("tiny", "cmake", "ninja"):
        write_wheel(folder, name)
    write_program(folder / "bin" / "apt-get", f'echo "$@" >> {folder}/apt.log; exit 100')
    write_program(folder / "bin" / "sudo", "exit 1")
    (folder / "apt.log").touch()
    settings = {
        "PIP_NO_INDEX": "1",
        "PIP_FIND_LINKS": str(folder),
        "PIP_CONFIG_FILE": os.devnull,
        "PYTHONDONTWRITEBYTECODE": "1",  # Environments that are thrown away.
        "PATH": f"{folder / 'bin'}:{PYTHON}:{os.environ['PATH']}",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            patch.setenv(name, value)
        yield folder


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory, machine: Path) -> Path:
    """A project, set up once without the system's packages, in a folder whose name has a space."""
    folder = tmp_path_factory.mktemp("some where")
    shutil.copy(ROOT / "ash-bench", folder)
    (folder / "pyproject.toml").write_text(PYPROJECT)
    (folder / "constraints.txt").write_text("tiny==1.0\n")
    (folder / "backend.py").write_text(BACKEND)
    (folder / "program.py").write_text(PROGRAM)
    done = launch(folder, "--no-system", "first", "0")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{folder} first\n"
    assert "setting up" in done.stderr and str(folder / ".venv" / "setup.log") in done.stderr
    assert (machine / "apt.log").read_text() == ""
    return folder


def launch(project: Path, *arguments: str, **settings: str) -> subprocess.CompletedProcess[str]:
    """The launcher, under environment variables besides those of the machine."""
    command = [str(project / "ash-bench"), *arguments]
    return subprocess.run(command, env=os.environ | settings, text=True, capture_output=True, timeout=100)


def started(project: Path) -> subprocess.Popen[str]:
    """The launcher at work."""
    command = [str(project / "ash-bench"), "x", "0"]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def change(project: Path) -> None:
    """Make the next use set up again."""
    with (project / "pyproject.toml").open("a") as file:
        file.write("# changed\n")


def builds(project: Path) -> int:
    return len((project / "builds").read_text())


def test_second_use_starts_at_once_from_anywhere(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ash-bench").symlink_to(project / "ash-bench")
    before, start = builds(project), time.monotonic()
    done = launch(tmp_path, "a b", "3")
    assert (done.returncode, done.stdout, done.stderr) == (3, f"{project} a b\n", "")
    assert time.monotonic() - start < 2
    assert builds(project) == before


def test_two_setups_at_once_make_one(project: Path) -> None:
    change(project)
    before = builds(project)
    both = [started(project) for _ in range(2)]
    stderr = [process.communicate(timeout=100)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], stderr
    assert builds(project) == before + 1
    assert sum("waiting for it" in text for text in stderr) <= 1


def test_missing_compiler_is_one_line_to_type_and_no_system_leaves_apt_alone(project: Path, machine: Path) -> None:
    change(project)
    log = machine / "apt.log"
    done = launch(project, "x", "0", CXX="/nowhere/c++")
    assert done.returncode == 1
    assert "apt-get install -y g++" in done.stderr.splitlines()[-1]
    if os.geteuid() == 0:
        assert "install --no-install-recommends g++" in log.read_text()
    log.write_text("")
    done = launch(project, "--no-system", "x", "0", CXX="/nowhere/c++")
    assert done.returncode == 1 and "g++" in done.stderr.splitlines()[-1]
    assert log.read_text() == ""


def test_a_setup_that_failed_points_at_the_log_and_one_that_failed_or_was_killed_goes_on(project: Path) -> None:
    change(project)
    wanted, log = (project / "pyproject.toml").read_text(), str(project / ".venv" / "setup.log")
    (project / "broken").touch()
    done = launch(project, "x", "0")
    assert (done.returncode, done.stdout) == (1, "")
    last = done.stderr.splitlines()[-1]
    assert "no such kernel" in last and log in last
    (project / "broken").unlink()
    (project / "pyproject.toml").write_text(wanted.replace('"tiny"', '"tiny", "not_there"'))
    done = launch(project, "x", "0")
    assert (done.returncode, done.stdout) == (1, "")
    last = done.stderr.splitlines()[-1]
    assert "packages (" in last and "not_there" in last
    (project / "pyproject.toml").write_text(wanted)
    (project / "hang").touch()
    before, process = builds(project), started(project)
    wait_for(lambda: builds(project) > before, 200)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    (project / "hang").unlink()
    # A package that was cut off while pip unpacked it: its files are incomplete although its metadata is there.
    (site,) = (project / ".venv" / "lib").glob("python*/site-packages")
    (site / "tiny.py").unlink()
    (site / "tiny-1.0.dist-info" / "INSTALLER").unlink()
    done = launch(project, "x", "0")
    assert done.returncode == 0 and "will install into" in done.stderr, done.stderr


def test_copied_folder_runs_its_own_code(project: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(project, tmp_path / "copy", symlinks=True)
    done = launch(copy, "x", "0")
    assert done.stdout == f"{copy} x\n", done.stderr


def test_old_python_is_refused(project: Path, tmp_path: Path) -> None:
    for name in ("python3", "python3.11", "python3.12", "python3.13"):
        write_program(tmp_path / "bin" / name, 'case $1 in --version) echo "Python 3.9.2"; exit 0;; esac; exit 1')
    done = launch(bare_project(tmp_path, project), "x", "0", PATH=f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    assert done.returncode == 1
    assert done.stderr == "ash-bench: Python 3.11 or newer is needed, and Python 3.9.2 was found\n"


def test_the_command_test_wants_a_browser_and_goes_on_without(project: Path, machine: Path, tmp_path: Path) -> None:
    for program in [*Path("/usr/bin").iterdir(), *Path("/bin").iterdir()]:
        if not program.name.startswith(("chromium", "google-chrome")) and not (tmp_path / program.name).exists():
            (tmp_path / program.name).symlink_to(program)
    write_program(tmp_path / "bin" / "apt-cache", 'echo "  Candidate: 150.0-1"')
    path = f"{tmp_path / 'bin'}:{machine / 'bin'}:{tmp_path}" + (
        "" if PYTHON.as_posix() == "/usr/bin" else f":{PYTHON}"
    )
    (machine / "apt.log").write_text("")
    done = launch(project, "test", "0", PATH=path)
    assert done.returncode == 0 and done.stdout == f"{project} test\n"
    assert "tests of pages are skipped" in done.stderr
    if os.geteuid() == 0:
        assert "install --no-install-recommends chromium" in (machine / "apt.log").read_text()
    write_program(tmp_path / "bin" / "chromium", "exit 0")
    assert launch(project, "test", "0", PATH=path).stderr == ""


def bare_project(folder: Path, project: Path) -> Path:
    """The stand-in project without an environment."""
    folder.mkdir(exist_ok=True)
    for name in ("ash-bench", "pyproject.toml", "constraints.txt", "backend.py", "program.py"):
        shutil.copy(project / name, folder)
    return folder


def environment_of_another(folder: Path) -> Path:
    """An environment that is not ours, with the folders that a remake of ours would delete."""
    for name in ("bin", "lib/python3.11/site-packages/half-1.0.dist-info", "lib64", "include"):
        (folder / name).mkdir(parents=True)
    (folder / "pyvenv.cfg").write_text("home = /elsewhere\n")
    (folder / "bin" / "python").write_text("precious\n")
    return folder


def contents(folder: Path) -> dict[str, bytes | None]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


def test_a_folder_that_we_did_not_make_is_left_alone(project: Path, tmp_path: Path) -> None:
    other = environment_of_another(bare_project(tmp_path, project) / ".venv")
    before = contents(other)
    done = launch(tmp_path, "x", "0")
    assert done.returncode == 1
    assert "was not made by this launcher" in done.stderr and len(done.stderr.splitlines()) == 1
    assert contents(other) == before


@pytest.mark.parametrize("part", ["", "bin", "lib", "lib/python3.11", "lib/python3.11/site-packages"])
def test_an_environment_behind_a_link_and_links_inside_of_one_are_left_alone(
    project: Path, tmp_path: Path, part: str
) -> None:
    ours, other = bare_project(tmp_path / "ours", project), environment_of_another(tmp_path / "other")
    before, link = contents(other), ours / ".venv" / part
    link.parent.mkdir(parents=True, exist_ok=True)
    if part:
        (ours / ".venv" / "made-by-ash-bench").touch()
    link.symlink_to(other / part)
    done = launch(ours, "x", "0")
    assert (done.returncode, done.stdout) == (1, "") and len(done.stderr.splitlines()) == 1
    assert f"{part or '.venv'} is a link to" in done.stderr
    assert contents(other) == before and link.is_symlink()


def test_help_and_version_need_no_set_up(tmp_path: Path) -> None:
    shutil.copy(ROOT / "ash-bench", tmp_path)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "benchmarks").mkdir()
    shutil.copy(ROOT / "benchmarks" / "help.txt", tmp_path / "benchmarks")
    for flag, expected in (
        ("--help", "usage: ./ash-bench COMMAND"),
        ("-h", "exit codes: 0 done"),
        ("--version", "ash-bench 0."),
    ):
        done = launch(tmp_path, flag)
        assert (done.returncode, done.stderr) == (0, "") and expected in done.stdout
    done = launch(tmp_path)
    assert done.returncode == 2 and "expected a command" in done.stderr
    assert not (tmp_path / ".venv").exists()


def test_an_environment_whose_interpreter_is_gone_is_made_again_whatever_a_user_s_python_settings(
    project: Path, tmp_path: Path
) -> None:
    python = project / ".venv" / "bin" / "python"
    for path in python.parent.glob("python*"):
        path.unlink()
    python.symlink_to("/nowhere/python3")
    (tmp_path / "random.py").write_text("raise RuntimeError('the wrong module')\n")
    settings = {"PYTHONPATH": str(tmp_path), "PYTHONHOME": "/nowhere", "PIP_USER": "1", "PYTHONIOENCODING": "ascii"}
    done = launch(project, "ünïcode", "0", **settings)
    assert (done.returncode, done.stdout) == (0, f"{project} ünïcode\n"), done.stderr
