"""The launcher, tried on a tiny stand-in project: same launcher, no downloads."""

import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

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


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Wheels instead of an index, and neither apt nor sudo can do anything."""
    folder = tmp_path_factory.mktemp("machine")
    for name in ("tiny", "cmake", "ninja"):
        write_wheel(folder, name)
    write_program(folder / "bin" / "apt-get", f'echo "$@" >> {folder}/apt.log; exit 100')
    write_program(folder / "bin" / "sudo", "exit 1")
    settings = {
        "PIP_NO_INDEX": "1",
        "PIP_FIND_LINKS": str(folder),
        "PIP_CONFIG_FILE": os.devnull,
        "APT_LOG": f"{folder}/apt.log",
        "PYTHONDONTWRITEBYTECODE": "1",  # Environments that are thrown away.
    }
    # The base interpreter, because the tests' own environment may lie in a folder that a launcher would have to remake.
    python = Path(sys._base_executable).parent  # type: ignore[attr-defined]
    return {**os.environ, **settings, "PATH": f"{folder / 'bin'}:{python}:{os.environ['PATH']}"}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory, environment: dict[str, str]) -> Path:
    """A project, set up once, in a folder whose name has a space."""
    folder = tmp_path_factory.mktemp("some where")
    shutil.copy(ROOT / "ash-bench", folder)
    (folder / "pyproject.toml").write_text(PYPROJECT)
    (folder / "constraints.txt").write_text("tiny==1.0\n")
    (folder / "backend.py").write_text(BACKEND)
    (folder / "program.py").write_text(PROGRAM)
    done = launch(folder, "first", "0", env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{folder} first\n"
    assert "setting up" in done.stderr and str(folder / ".venv" / "setup.log") in done.stderr
    return folder


def launch(project: Path, *arguments: str, env: dict[str, str], **options: object) -> subprocess.CompletedProcess[str]:
    command = [str(project / "ash-bench"), *arguments]
    return subprocess.run(command, env=env, text=True, capture_output=True, timeout=100, **options)  # type: ignore[call-overload]


def change(project: Path) -> None:
    """Make the next use set up again."""
    with (project / "pyproject.toml").open("a") as file:
        file.write("# changed\n")


def builds(project: Path) -> int:
    return len((project / "builds").read_text())


def test_second_use_starts_at_once_from_anywhere(project: Path, environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(project / "ash-bench")
    before, started = builds(project), time.monotonic()
    done = subprocess.run(
        [tmp_path / "link", "a b", "3"], env=environment, cwd=tmp_path, text=True, capture_output=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (3, f"{project} a b\n", "")
    assert time.monotonic() - started < 2
    assert builds(project) == before


def test_two_setups_at_once_make_one(project: Path, environment: dict[str, str]) -> None:
    change(project)
    before = builds(project)
    command = [str(project / "ash-bench"), "x", "0"]
    both = [subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    stderr = [process.communicate(timeout=100)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], stderr
    assert builds(project) == before + 1
    assert sum("waiting for it" in text for text in stderr) <= 1


def test_failed_step_points_at_the_log_and_is_tried_again(project: Path, environment: dict[str, str]) -> None:
    change(project)
    wanted = (project / "pyproject.toml").read_text()
    (project / "broken").touch()
    done = launch(project, "x", "0", env=environment)
    assert (done.returncode, done.stdout) == (1, "")
    last = done.stderr.splitlines()[-1]
    assert "no such kernel" in last and str(project / ".venv" / "setup.log") in last
    (project / "broken").unlink()
    (project / "pyproject.toml").write_text(wanted.replace('"tiny"', '"tiny", "not_there"'))
    done = launch(project, "x", "0", env=environment)
    assert (done.returncode, done.stdout) == (1, "")
    last = done.stderr.splitlines()[-1]
    assert "packages (" in last and "not_there" in last
    (project / "pyproject.toml").write_text(wanted)
    assert launch(project, "x", "0", env=environment).returncode == 0


def test_killed_setup_goes_on(project: Path, environment: dict[str, str]) -> None:
    change(project)
    before = builds(project)
    (project / "hang").touch()
    command = [str(project / "ash-bench"), "x", "0"]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL, start_new_session=True)
    while builds(project) == before:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    (project / "hang").unlink()
    # A package that was cut off while pip unpacked it: its files are incomplete although its metadata is there.
    (site,) = (project / ".venv" / "lib").glob("python*/site-packages")
    (site / "tiny.py").unlink()
    (site / "tiny-1.0.dist-info" / "INSTALLER").unlink()
    done = launch(project, "x", "0", env=environment)
    assert done.returncode == 0, done.stderr


def test_missing_compiler_is_one_line_to_type_and_no_system_leaves_apt_alone(
    project: Path, environment: dict[str, str]
) -> None:
    change(project)
    log, without = Path(environment["APT_LOG"]), {**environment, "CXX": "/nowhere/c++"}
    done = launch(project, "x", "0", env=without)
    assert done.returncode == 1
    assert "apt-get install -y g++" in done.stderr.splitlines()[-1]
    if os.geteuid() == 0:
        assert "install --no-install-recommends g++" in log.read_text()
    log.write_text("")
    done = launch(project, "--no-system", "x", "0", env=without)
    assert done.returncode == 1 and "g++" in done.stderr.splitlines()[-1]
    assert log.read_text() == ""
    done = launch(project, "--no-system", "x", "0", env=environment)
    assert done.returncode == 0 and done.stdout == f"{project} x\n" and "will install into" in done.stderr


def test_copied_folder_runs_its_own_code(project: Path, environment: dict[str, str], tmp_path: Path) -> None:
    copy = shutil.copytree(project, tmp_path / "copy", symlinks=True)
    done = launch(copy, "x", "0", env=environment)
    assert done.stdout == f"{copy} x\n", done.stderr


def test_old_python_is_refused(project: Path, environment: dict[str, str], tmp_path: Path) -> None:
    for name in ("python3", "python3.11", "python3.12", "python3.13"):
        write_program(tmp_path / "bin" / name, 'case $1 in --version) echo "Python 3.9.2"; exit 0;; esac; exit 1')
    change(project)
    done = launch(project, "x", "0", env={**environment, "PATH": f"{tmp_path / 'bin'}:{environment['PATH']}"})
    assert done.returncode == 1
    assert done.stderr == "ash-bench: Python 3.11 or newer is needed, and Python 3.9.2 was found\n"


def test_the_command_test_wants_a_browser_and_goes_on_without(
    project: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    for program in [*Path("/usr/bin").iterdir(), *Path("/bin").iterdir()]:
        if not program.name.startswith(("chromium", "google-chrome")) and not (tmp_path / program.name).exists():
            (tmp_path / program.name).symlink_to(program)
    machine = environment["APT_LOG"].removesuffix("apt.log") + "bin"
    python = Path(sys._base_executable).parent  # type: ignore[attr-defined]
    write_program(tmp_path / "bin" / "apt-cache", 'echo "  Candidate: 150.0-1"')
    path = f"{tmp_path / 'bin'}:{machine}:{tmp_path}" + ("" if python == Path("/usr/bin") else f":{python}")
    Path(environment["APT_LOG"]).write_text("")
    assert launch(project, "x", "0", env={**environment, "PATH": path}).returncode == 0
    done = launch(project, "test", "0", env={**environment, "PATH": path})
    assert done.returncode == 0 and done.stdout == f"{project} test\n"
    assert "tests of pages are skipped" in done.stderr
    if os.geteuid() == 0:
        assert "install --no-install-recommends chromium" in Path(environment["APT_LOG"]).read_text()
    write_program(tmp_path / "bin" / "chromium", "exit 0")
    assert launch(project, "test", "0", env={**environment, "PATH": path}).stderr == ""


def bare_project(folder: Path, project: Path) -> Path:
    """The stand-in project without an environment."""
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


def test_an_environment_behind_a_link_is_left_alone(project: Path, environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "ours").mkdir()
    ours = bare_project(tmp_path / "ours", project)
    other = environment_of_another(tmp_path / "other")
    before = contents(other)
    (ours / ".venv").symlink_to(other)
    done = launch(ours, "x", "0", env=environment)
    assert (done.returncode, done.stdout) == (1, "")
    assert "is a link to" in done.stderr and len(done.stderr.splitlines()) == 1
    assert contents(other) == before and (ours / ".venv").is_symlink()


def test_a_folder_that_we_did_not_make_is_left_alone(
    project: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    other = environment_of_another(bare_project(tmp_path, project) / ".venv")
    before = contents(other)
    done = launch(tmp_path, "x", "0", env=environment)
    assert done.returncode == 1
    assert "was not made by this launcher" in done.stderr and len(done.stderr.splitlines()) == 1
    assert contents(other) == before


@pytest.mark.parametrize("part", ["bin", "lib", "lib/python3.11", "lib/python3.11/site-packages"])
def test_links_inside_the_environment_are_not_followed(
    project: Path, environment: dict[str, str], tmp_path: Path, part: str
) -> None:
    (tmp_path / "ours").mkdir()
    ours = bare_project(tmp_path / "ours", project)
    other = environment_of_another(tmp_path / "other")
    before = contents(other)
    link = ours / ".venv" / part
    link.parent.mkdir(parents=True)
    (ours / ".venv" / "made-by-ash-bench").touch()
    link.symlink_to(other / part)
    done = launch(ours, "x", "0", env=environment)
    assert done.returncode == 1 and f"{part} is a link to" in done.stderr
    assert contents(other) == before


def test_an_environment_of_an_older_launcher_is_ours(project: Path, environment: dict[str, str]) -> None:
    assert launch(project, "x", "0", env=environment).returncode == 0
    (project / ".venv" / "made-by-ash-bench").unlink()
    change(project)
    done = launch(project, "x", "0", env=environment)
    assert done.returncode == 0, done.stderr
    assert (project / ".venv" / "made-by-ash-bench").is_file()


def test_help_and_version_need_no_set_up(tmp_path: Path, environment: dict[str, str]) -> None:
    shutil.copy(ROOT / "ash-bench", tmp_path)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "benchmarks").mkdir()
    shutil.copy(ROOT / "benchmarks" / "help.txt", tmp_path / "benchmarks")
    for flag, expected in (
        ("--help", "usage: ./ash-bench COMMAND"),
        ("-h", "exit codes: 0 done"),
        ("--version", "ash-bench 0."),
    ):
        done = launch(tmp_path, flag, env=environment)
        assert (done.returncode, done.stderr) == (0, "") and expected in done.stdout
    done = launch(tmp_path, env=environment)
    assert done.returncode == 2 and "expected a command" in done.stderr
    assert not (tmp_path / ".venv").exists()


def test_an_environment_whose_interpreter_is_gone_is_made_again_whatever_a_user_s_python_settings(
    project: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    python = project / ".venv" / "bin" / "python"
    for path in python.parent.glob("python*"):
        path.unlink()
    python.symlink_to("/nowhere/python3")
    (tmp_path / "random.py").write_text("raise RuntimeError('the wrong module')\n")
    settings = {"PYTHONPATH": str(tmp_path), "PYTHONHOME": "/nowhere", "PIP_USER": "1", "PYTHONIOENCODING": "ascii"}
    done = launch(project, "ünïcode", "0", env=environment | settings)
    assert (done.returncode, done.stdout) == (0, f"{project} ünïcode\n"), done.stderr
