"""What must be known about a run so that someone else can repeat it: commit, machine, versions."""

import contextlib
import math
import os
import platform
import shutil
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

PACKAGES = (
    "ash-bench",
    "numpy",
    "scipy",
    "torch",
    "mitsuba",
    "drjit",
    "scikit-image",
    "flip-evaluator",
    "pandas",
    "warp-lang",
)


def commit(root: Path | None = None) -> str:
    """The commit of a checkout (ours), with `+` where files differ from it; `unknown` outside a checkout."""
    root = root or Path(__file__).parent.parent
    if not (root / ".git").exists() or shutil.which("git") is None:
        return "unknown"
    revision = _git(root, "rev-parse", "--short=12", "HEAD")
    changed = _git(root, "status", "--porcelain", "--untracked-files=no")
    return revision + ("+" if changed else "") if revision else "unknown"


def machine() -> dict[str, str]:
    """Processor, cores, memory, operating system, GPU."""
    return {
        "processor": processor_name(),
        "cores": str(cores()),
        "memory_gb": f"{psutil.virtual_memory().total / 2**30:.0f}",
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "gpu": gpu_name() or "none",
    }


def versions() -> dict[str, str]:
    """Versions of the packages that numbers depend on."""
    facts = {}
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            facts[package] = version(package)
    return facts


def cores() -> int:
    """Cores that this process may use: those that it may run on, and as much of them as its cgroup allows."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.floor(min(count, cpu_quota())))


def cpu_quota(mount: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> float:
    """Cores that the limits of this process's cgroup and of those around it allow; infinite where there is no limit.

    `own` names the cgroup: `0::/PATH` in version 2, `N:cpu,cpuacct:/PATH` in version 1.
    """
    try:
        lines = [line.split(":", 2) for line in own.read_text().splitlines()]
    except OSError:
        lines = []
    paths = {line[2].strip("/") for line in lines if len(line) == 3 and line[1] in ("", "cpu", "cpu,cpuacct")}
    roots = {mount, mount / "cpu"}
    groups = {
        root.joinpath(*Path(path).parts[:depth]) for root in roots for path in paths | {""} for depth in range(32)
    }
    return min(_quota_of(group) for group in groups)


def _quota_of(cgroup: Path) -> float:
    for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        try:
            quota, period = " ".join((cgroup / name).read_text() for name in names).split()
            return int(quota) / int(period) if int(quota) > 0 else math.inf
        except (OSError, ValueError, ZeroDivisionError):  # No such file; "max".
            continue
    return math.inf


def processor_name() -> str:
    """The processor as the system names it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def gpu_name() -> str | None:
    """The first NVIDIA GPU, or None."""
    if shutil.which("nvidia-smi") is None:
        return None
    return _output("nvidia-smi", "--query-gpu=name", "--format=csv,noheader").split("\n")[0] or None


def _git(root: Path, *arguments: str) -> str:
    """What git says of a checkout, also of one that somebody else owns."""
    return _output("git", "-c", f"safe.directory={root}", "-C", str(root), *arguments)


def _output(*command: str) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
