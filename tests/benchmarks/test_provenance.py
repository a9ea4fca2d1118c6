"""What a result says about where it was made."""

import math
import os
import subprocess
from pathlib import Path

import pytest

from benchmarks import provenance


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"cpu.max": "150000 100000"}, 1.5),
        ({"cpu.max": "max 100000"}, math.inf),
        ({"cpu/cpu.cfs_quota_us": "400000", "cpu/cpu.cfs_period_us": "100000"}, 4.0),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, math.inf),
        ({}, math.inf),
    ],
)
def test_a_container_s_limit_on_cores_is_read(files: dict[str, str], expected: float, tmp_path: Path) -> None:
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"{content}\n")
    assert provenance.cpu_quota(tmp_path, tmp_path / "none") == expected


def test_the_limit_of_a_cgroup_within_another_is_read(tmp_path: Path) -> None:
    (tmp_path / "own").write_text("0::/pod/job\n")
    (tmp_path / "pod" / "job").mkdir(parents=True)
    (tmp_path / "pod" / "job" / "cpu.max").write_text("200000 100000\n")
    assert provenance.cpu_quota(tmp_path, tmp_path / "own") == 2.0
    (tmp_path / "pod" / "cpu.max").write_text("150000 100000\n")
    assert provenance.cpu_quota(tmp_path, tmp_path / "own") == 1.5


def test_workers_follow_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    for quota, cores in ((math.inf, 8), (2.5, 2), (0.5, 1)):
        monkeypatch.setattr(provenance, "cpu_quota", lambda quota=quota: quota)
        assert provenance.cores() == cores


@pytest.mark.skipif(os.getuid() != 0, reason="gives a folder to another user, which root alone can")
def test_the_commit_of_a_checkout_that_somebody_else_owns_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run([*git, *command], check=True)
    expected = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True)
    for path in (tmp_path, *tmp_path.rglob("*")):
        os.chown(path, 12345, 12345)
    (tmp_path / "benchmarks").mkdir()
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "benchmarks" / "provenance.py"))
    assert provenance.commit() == expected.stdout.strip()
