"""A real scheduler with real workers on this machine, one of which is killed in the middle of a run."""

import io
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import fakes
from helpers.waiting import wait_for

from ash.files import InputError
from benchmarks.cell.schema import read_result
from benchmarks.suites.engine import Limits, make_executor, plan_cells, run_cells
from benchmarks.suites.gpus import VISIBLE
from benchmarks.suites.progress import Progress
from benchmarks.suites.runs import cell_for
from benchmarks.suites.suites import CaptureSpec, CellSpec

pytest.importorskip("distributed", reason="Dask is an optional extra: pip install ash-bench[dask]")


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler's address and two workers of one thread each."""
    fakes.use(tmp_path / "plugins", monkeypatch)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port)]
    log = (tmp_path / "dask.log").open("wb")
    processes = [subprocess.Popen([*dask, "--no-dashboard"], stdout=log, stderr=log, cwd=tmp_path)]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", f"tcp://127.0.0.1:{port}", "--nthreads", "1"]
    options = ["--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path)]
    gpu = {**os.environ, VISIBLE: "7"}  # One of the two has a GPU.
    started = [(options, None), ([*options, "--resources", "GPU=1"], gpu)]
    processes += [
        subprocess.Popen([*worker, *more], stdout=log, stderr=log, cwd=tmp_path, env=environment)
        for more, environment in started
    ]
    try:
        yield f"dask://127.0.0.1:{port}", processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()
        log.close()


def test_a_killed_worker_loses_no_cell(cluster, tmp_path: Path) -> None:
    address, workers = cluster
    capture = fakes.write_capture(tmp_path / "capture")
    spec = CaptureSpec(scene="boxes", size="ci")
    cells = [
        cell_for(CellSpec(capture=spec, method="fake_good", preset="ci", seed=seed), capture, tmp_path / "run")
        for seed in range(4)
    ]
    progress = Progress("cells", 4, expected_s=1.0, workers=2, stream=io.StringIO())
    victim = subprocess.Popen([sys.executable, "-c", KILL_WHEN_BUSY, str(workers[0].pid)])
    with make_executor(address, workers=2) as executor:
        run_cells(plan_cells(cells), executor, Limits(seconds=60.0, memory_mb=4096), progress)
    victim.wait(10)
    assert workers[0].poll() == -signal.SIGKILL, "the worker was killed while a cell ran on it"
    assert [read_result(cell.folder).status for cell in cells] == ["done"] * 4
    assert len({read_result(cell.folder).views[0].prediction for cell in cells}) == 4, "every seed has its own result"


def test_cells_that_learn_on_cuda_go_where_a_gpu_is(cluster, tmp_path: Path) -> None:
    address, workers = cluster
    capture = fakes.write_capture(tmp_path / "capture")
    spec = CellSpec(
        capture=CaptureSpec(scene="boxes", size="ci"),
        method="fake_placed",
        preset="ci",
        seed=0,
        changes=(("device", "cuda"),),
    )
    cells = [cell_for(replace(spec, seed=seed), capture, tmp_path / "run") for seed in range(2)]
    progress = Progress("cells", 2, expected_s=1.0, workers=2, stream=io.StringIO())
    with make_executor(address, workers=2, gpu=True) as executor:
        run_cells(plan_cells(cells), executor, Limits(seconds=60.0, memory_mb=4096), progress)
        for cell in cells:
            assert "sees 7\n" in (cell.folder / "output.log").read_text()
        workers[1].kill()
        workers[1].wait()

        def refused() -> bool:
            try:
                with make_executor(address, workers=2, gpu=True):
                    return False
            except InputError as error:
                return "--resources GPU=1" in str(error)

        wait_for(refused)


KILL_WHEN_BUSY = """
import os, signal, sys, time, psutil
worker = psutil.Process(int(sys.argv[1]))
while not any("benchmarks.cell.run" in " ".join(child.cmdline()) for child in worker.children()):
    time.sleep(0.02)
worker.kill()
"""
