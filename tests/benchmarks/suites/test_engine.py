import io
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from helpers.running import fake_cell, run
from helpers.waiting import wait_for

from ash.files import InputError
from benchmarks.cell.metrics import PROTOCOL
from benchmarks.cell.schema import Cell, read_result
from benchmarks.suites import engine
from benchmarks.suites.engine import Limits, plan_cells, run_cells, shard_of
from benchmarks.suites.progress import Progress
from benchmarks.suites.runs import read_run

pytestmark = pytest.mark.usefixtures("installed_fakes")


@pytest.fixture
def done(finished: Path) -> Cell:
    """A cell that is finished."""
    return read_run(finished).cells[0]


def test_cells_run_side_by_side_and_failures_are_results(capture: Path, tmp_path: Path) -> None:
    expected = {"good": "done", "nan": "diverged", "raising": "crashed", "dying": "crashed"}
    cells = [fake_cell(method, capture, tmp_path) for method in expected]
    run(cells)
    results = [read_result(c.folder) for c in cells]
    assert [r.status for r in results if r] == list(expected.values())
    assert "the method's own mistake" in results[2].reason
    assert "SIGABRT" in results[3].reason
    assert "RuntimeError: the method's own mistake" in (cells[2].folder / "output.log").read_text()
    for failed in results[1:]:
        assert failed.value("novel_view", "foreground", "psnr") == 0
        assert failed.value("novel_pose", "full", "iou") == 0
        assert failed.value("novel_view", "foreground", "flip") == 1
    assert not plan_cells(cells).todo, "failed cells count as done: they are data"
    assert len(plan_cells(cells, retry_failed=True).todo) == 3


def test_a_cell_beyond_its_time_or_memory_is_ended_and_recorded(capture: Path, tmp_path: Path) -> None:
    slow, large = fake_cell("sleeping", capture, tmp_path), fake_cell("growing", capture, tmp_path)
    run([slow], Limits(seconds=4.0, memory_mb=4096))
    run([large], Limits(seconds=60.0, memory_mb=700))
    assert read_result(slow.folder).status == "timeout"
    assert read_result(large.folder).status == "out of memory"


def test_a_changed_input_runs_again_and_says_why(done: Cell) -> None:
    config = replace(done.config, code="other")
    fresh = replace(done, config=config, folder=done.folder.parent / config.key)
    plan = plan_cells([fresh])
    assert [c.config.key for c in plan.todo] == [config.key]
    assert "the code changed" in plan.reasons[0]


def test_a_cell_with_a_damaged_result_is_run_again_and_the_damaged_one_kept_aside(done: Cell) -> None:
    path = done.folder / "result.json"
    whole = path.read_bytes()
    other_protocol = whole.replace(b'"protocol": "%s"' % PROTOCOL.encode(), b'"protocol": "0"')
    halves = (b"", whole[: len(whole) // 2], b"[]", b'{"status": "done"}', whole.replace(b'"done"', b'"fine"'))
    for content in (*halves, other_protocol):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        plan = plan_cells([done])
        assert plan.todo == (done,) and "run again, its result is damaged" in plan.reasons[0]
        assert (path.parent.with_name(f"{path.parent.name}.damaged") / "result.json").read_bytes() == content


def test_shards_cover_all_cells_once() -> None:
    cells = list(range(11))
    parts = [shard_of(cells, f"{i}/4") for i in range(1, 5)]
    assert sorted(sum(parts, ())) == cells
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    for wrong in ("0/4", "5/4", "x", "1", "1/0", "1/2/3"):
        with pytest.raises(InputError, match="shard"):
            shard_of(cells, wrong)


def test_interrupting_ends_the_children_and_the_cell_can_be_resumed(capture: Path, tmp_path: Path) -> None:
    target = fake_cell("sleeping", capture, tmp_path)
    code = (
        "import io; from pathlib import Path; from benchmarks.cell.schema import read_cell\n"
        "from benchmarks.suites.engine import *\n"
        "from benchmarks.suites.progress import Progress\n"
        f"cell = read_cell(Path({str(target.folder)!r}))\n"
        "with make_executor('local', workers=1) as executor:\n"
        "    run_cells(plan_cells([cell]), executor, Limits(seconds=60.0, memory_mb=4096),"
        " Progress('', 1, expected_s=1.0, workers=1, stream=io.StringIO()))\n"
    )
    for signal_number in (signal.SIGINT, signal.SIGKILL):
        engine.write_config(target)
        parent = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
        child = wait_for_child(parent.pid)
        os.kill(parent.pid, signal_number)
        parent.wait(10)
        wait_for(lambda child=child: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)
        assert read_result(target.folder) is None
        assert len(plan_cells([target]).todo) == 1


def test_a_thread_that_its_executor_forgot_takes_an_interruption_for_no_failure(capture: Path, tmp_path: Path) -> None:
    class Forgetful(ThreadPoolExecutor):
        def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
            """As where SIGINT strikes between the start of a thread and its registration."""

    class Impatient(Progress):
        def tick(self, *, running: Sequence[str] = ()) -> None:
            wait_for_child(os.getpid())
            raise KeyboardInterrupt

    target, executor = fake_cell("sleeping", capture, tmp_path), Forgetful(1)
    progress = Impatient("", 1, expected_s=1.0, workers=1, stream=io.StringIO())
    with pytest.raises(KeyboardInterrupt):
        run_cells(plan_cells([target]), executor, Limits(seconds=60.0, memory_mb=4096), progress)
    ThreadPoolExecutor.shutdown(executor)
    assert read_result(target.folder) is None
    assert len(run([fake_cell("good", capture, tmp_path)]).todo) == 1, "the next run is not stopped"


def test_a_cell_that_was_told_to_stop_is_unfinished_and_not_failed(capture: Path, tmp_path: Path) -> None:
    target = fake_cell("sleeping", capture, tmp_path)

    def stop() -> None:
        wait_for(lambda: list(target.folder.glob("*/log.jsonl")))
        (process,) = (p for p in psutil.Process().children() if target.config.key in " ".join(p.cmdline()))
        process.send_signal(signal.SIGTERM)

    stopper = threading.Thread(target=stop)
    stopper.start()
    plan = run([target])
    stopper.join()
    assert len(plan.todo) == 1 and read_result(target.folder) is None
    assert len(plan_cells([target]).todo) == 1


def test_progress_without_a_terminal_is_one_line_per_cell() -> None:
    stream = io.StringIO()
    progress = Progress("cells", 2, expected_s=10.0, workers=1, stream=stream)
    progress.tick(running=["a"])
    progress.finish("a")
    progress.finish("b", status="crashed")
    progress.close()
    lines = stream.getvalue().splitlines()
    assert lines[0].startswith("[1/2] a (0:00")
    assert lines[1].startswith("[2/2] b: crashed")


def test_time_left_starts_with_the_expectation_and_follows_the_pace() -> None:
    progress = Progress("cells", 4, expected_s=10.0, workers=2, stream=io.StringIO())
    assert progress.seconds_left() == pytest.approx(20, abs=0.5)
    progress.start -= 30
    progress.finish("a")
    assert progress.seconds_left() == pytest.approx(90, abs=1)


def wait_for_child(pid: int) -> psutil.Process:
    found: list[psutil.Process] = []
    wait_for(lambda: bool(found.extend(psutil.Process(pid).children()) or found))
    return found[0]
