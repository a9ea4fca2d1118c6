"""Commands about this checkout and machine: speed, doctor, test."""

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from ash.files import InputError
from benchmarks.commands.arguments import DONE, FAILED, File, Folder, Positional
from benchmarks.commands.devices import CPU, DeviceName, chosen_device


@dataclass(frozen=True, kw_only=True)
class SpeedCommand:
    """Time the kernels, or whole frames by stage, beside their definitions."""

    what: Positional[Literal["kernels", "frame"]]  # kernels or frame
    profile: bool = False  # frame: the parts of a training step, of ASH and the mesh
    capture: Folder | None = None  # frame: on this capture; default: the mannequin of the suite ci
    avatar: Folder | None = None  # frame: this trained avatar in its held-out motion; a cell, or a run with one avatar
    trust: bool = False  # --avatar may be of a method that is not ours: its code runs here, without isolation
    device: DeviceName = CPU  # what is timed: cpu, cuda, cuda:1, or auto
    json: File | None = None  # write the rows there as well

    def __call__(self) -> int:
        """Measure and print."""
        self._require_flags_that_go_together()
        if self.avatar:
            return self._measure_avatar(self.avatar)
        from ash.devices import device_named

        device = device_named(chosen_device(self.device))
        if self.profile:
            from benchmarks.speed.profile import main as profile

            return profile(self.json, self.capture, device)
        if self.what == "frame":
            from benchmarks.speed.frames import main as measure_frames

            return measure_frames(self.json, self.capture, device)
        from benchmarks.speed.kernels import main as measure

        return measure(self.json, device)

    def _require_flags_that_go_together(self) -> None:
        if (self.profile or self.capture or self.avatar) and self.what != "frame":
            raise InputError(f"speed: --profile, --capture and --avatar go with frame, got {self.what}")
        if self.avatar and (self.profile or self.capture):
            raise InputError(
                "speed: --avatar has its capture and trains nothing: expected neither --capture nor --profile"
            )
        if self.trust and not self.avatar:
            raise InputError("speed: --trust goes with --avatar")

    def _measure_avatar(self, folder: Path) -> int:
        from benchmarks.play.avatars import open_avatars
        from benchmarks.speed.frames import main_of_avatar

        with open_avatars(folder, device=chosen_device(self.device), trust=self.trust) as avatars:
            loaded = avatars.only()
            config = loaded.cell.config
            return main_of_avatar(loaded.avatar, avatars.capture, f"{config.method}:{config.preset}", self.json)


@dataclass(frozen=True, kw_only=True)
class DoctorCommand:
    """What this machine has, and what follows from it."""

    def __call__(self) -> int:
        """Look and print."""
        from benchmarks.commands.doctor import examine, table

        findings = examine(Path())
        print(table(findings))
        return DONE if all(finding.good for finding in findings) else FAILED


@dataclass(frozen=True, kw_only=True)
class TestCommand:
    """Run every check that CI runs; what follows -- goes to pytest."""

    pytest: Positional[tuple[str, ...]] = ()  # arguments for pytest

    def __call__(self) -> int:
        """Run them on the checkout."""
        from benchmarks.provenance import cores

        root = Path(__file__).parents[2]
        if not (root / "tests").is_dir() or not (root / "pyproject.toml").is_file():
            raise InputError(f"{root}: expected a checkout with tests/; an installed package has none")
        module = [sys.executable, "-m"]
        brief = {  # Beside pytest, in what time that leaves: some tests take times.
            "ruff check": [*module, "ruff", "check", "."],
            "ruff format": [*module, "ruff", "format", "--check", "."],
            "import-linter": [sys.executable, "-c", "from importlinter.cli import lint_imports_command as f; f()"],
            "mypy": [*module, "mypy"],
        }
        # A worker that dies ends the run and names its test: xdist would wait for ever for what it was given.
        spread = ["-n", str(cores()), "--dist", "loadfile", "--no-loadscope-reorder", "--max-worker-restart", "0"]
        spread += ["--durations", "15"]  # The slowest, told at the end.
        # Hundreds of processes import the same modules, so their bytecode is kept whatever is set outside.
        settings = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        run = partial(subprocess.run, cwd=root, env={**settings, "OMP_NUM_THREADS": "1"}, check=False)
        with ThreadPoolExecutor() as beside:
            piped = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
            running = {name: beside.submit(run, ["nice", *command], **piped) for name, command in brief.items()}
            print("--- pytest", flush=True)
            failed = ["pytest"] if run([*module, "pytest", *spread, *self.pytest]).returncode else []
            for name, done in running.items():
                print(f"--- {name}\n{done.result().stdout}", end="", flush=True)
                failed += [name] if done.result().returncode else []
        if not self.pytest:
            failed += _test_without_namespaces(root, run)
        print(f"--- failed: {', '.join(failed)}" if failed else "--- all checks passed")
        return FAILED if failed else DONE


def _test_without_namespaces(root: Path, run: Callable[..., "subprocess.CompletedProcess[str]"]) -> list[str]:
    """Run the tests of isolation where the kernel refuses namespaces, as in a container; says so where it cannot.

    Returns what failed.
    """
    from benchmarks.cell.sandbox import problem
    from benchmarks.provenance import cores

    name = "isolation tests without namespaces"
    place = ["sh", str(root / "tests" / "helpers" / "without_namespaces.sh")]
    why_not = "all tests ran so" if problem() else "only root can" if os.geteuid() != 0 else ""
    if not why_not and run([*place, "true"], capture_output=True).returncode:
        why_not = "no file system of its own can be mounted here"
    if why_not:
        print(f"--- {name}: not run, {why_not}", flush=True)
        return []
    print(f"--- {name}", flush=True)
    spread = ["-n", str(cores()), "--max-worker-restart", "0", "-m", "not slow and not both_ways"]
    pytest = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *spread]
    return [name] if run([*place, *pytest, "tests/benchmarks/cell/test_isolation.py"]).returncode else []
