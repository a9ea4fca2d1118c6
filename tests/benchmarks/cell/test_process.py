"""What is the harness's failure and not the method's, and which code made a result."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from ash.files import InputError
from benchmarks.cell import run, sandbox
from benchmarks.cell.schema import Cell, read_result, write_config
from benchmarks.suites import engine
from benchmarks.suites.engine import Ending, Limits
from benchmarks.suites.runs import cell_for, read_run, require_utf8
from benchmarks.suites.suites import CaptureSpec, CellSpec

pytestmark = pytest.mark.usefixtures("installed_fakes")


def cell(method: str, capture: Path, out: Path) -> Cell:
    spec = CaptureSpec(scene="boxes", size="ci")
    made = cell_for(CellSpec(capture=spec, method=method, preset="ci", seed=0), capture, out)
    write_config(made)
    return made


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    return lambda: monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=0))


def test_a_method_that_fails_on_a_full_disk_has_no_result(
    capture: Path, tmp_path: Path, full_disk: Callable[[], None]
) -> None:
    with_space, without = cell("fake_raising", capture, tmp_path / "a"), cell("fake_raising", capture, tmp_path / "b")
    assert run.run_cell(with_space).status == "crashed"
    full_disk()
    with pytest.raises(OSError, match=r"disk is full .*the method's own mistake") as failure:
        run.run_cell(without)
    assert failure.value.errno == errno.ENOSPC and read_result(without.folder) is None


def test_a_full_disk_stops_the_run_with_one_line(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = cell("fake_good", capture, tmp_path)
    monkeypatch.setattr(run, "read_cell", lambda folder: write_nothing())
    assert run.main([str(made.folder)]) == run.DISK_FULL
    monkeypatch.setattr(engine, "watched_process", lambda *_, **__: Ending(exit_code=run.DISK_FULL))
    with pytest.raises(InputError, match="the disk is full; with more space the same command goes on"):
        engine.run_in_process(str(made.folder), Limits(seconds=60.0, memory_mb=4096))
    assert read_result(made.folder) is None


def write_nothing() -> Cell:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "a file")


def test_eval_names_the_code_that_scored(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = read_run(finished).cells[0]
    assert run.evaluate_cell(made).evaluated_code == ""
    monkeypatch.setattr(run, "code_version", lambda method: "0123456789abcdef")
    run.evaluate_cell(made)
    result = read_result(made.folder)
    assert (result.evaluated_code, result.config.code) == ("0123456789abcdef", made.config.code)


def test_a_folder_whose_path_is_not_utf8_is_refused() -> None:
    require_utf8(Path("runs/ünïcode"))
    with pytest.raises(InputError, match=r"path is UTF-8, got .*\\xff"):
        require_utf8(Path(os.fsdecode(b"runs/\xff")))


def test_a_result_says_whether_the_machine_isolates(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = read_run(finished).cells[0]
    assert read_result(made.folder).isolated is (sandbox.problem() is None)
    monkeypatch.setenv(sandbox.ISOLATION, "off")
    assert sandbox.problem() == "ASH_BENCH_ISOLATION=off"
    (made.folder / "result.json").unlink()
    assert run.run_cell(made).isolated is False
