"""Nothing that a method does reaches truth, scores, times or other cells; however it ends, its cell has a result."""

import io
import json
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from helpers import fakes, thieves
from helpers.sharing import Shared

from ash.capture.formats import load_capture
from ash.capture.manifest import verify_capture
from ash.files import InputError, sha256_of
from benchmarks.cell import sandbox, worker
from benchmarks.cell.registry import find_method
from benchmarks.cell.sandbox import seen_by_method
from benchmarks.cell.schema import Cell, MethodFailed, View, failed_result, read_result, result_of, write_result
from benchmarks.suites import engine
from benchmarks.suites.engine import Limits, make_executor, plan_cells, run_cells
from benchmarks.suites.progress import Progress
from benchmarks.suites.runs import cell_for
from benchmarks.suites.suites import CaptureSpec, CellSpec

LIMITS = Limits(seconds=300.0, memory_mb=4096)
BOTH_WAYS = pytest.mark.both_ways  # Sets isolation itself, so that a kernel without namespaces changes nothing.
ENDS = {  # how a method ends: the reason that its cell crashed
    "exit_2": "exit code 2", "exit_0": "exit code 0", "os_error": "No space left", "input_error": "own refusal",
    "keyboard": "KeyboardInterrupt",
}  # fmt: skip
ALONE = ("sleeps", "works", "clock", "prepares_elsewhere", "loud", *thieves.SHOWN, *ENDS)


@pytest.fixture
def own_capture(capture: Path, tmp_path: Path) -> Path:
    """A copy, for methods that reach for it: they damage it where nothing isolates them."""
    return Path(shutil.copytree(capture, tmp_path / "own"))


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path / "plugins", monkeypatch)


def install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fakes and thieves, as two installed distributions."""
    fakes.use(folder, monkeypatch)
    fakes.install(folder, monkeypatch, "thieves", thieves.METHODS)


@pytest.fixture(scope="session")
def all_run(capture: Path, shared: Shared) -> Path:
    """Where an honest method, and those that reach for nothing of others, were run once, side by side."""

    def make(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            install(folder / "plugins", patch)
            run([cell(method, capture, folder) for method in ("fake_good", *ALONE)])

    return shared("isolation", make)


@pytest.fixture
def ran(all_run: Path, capture: Path) -> Callable[[str], Cell]:
    """The cell of one of them; nothing in its folder may be changed."""
    return lambda method: cell(method, capture, all_run)


@pytest.fixture
def honest(ran: Callable[[str], Cell], own_capture: Path, tmp_path: Path) -> Cell:
    """A finished cell of an honest method on a capture of its own."""
    shutil.copytree(ran("fake_good").folder, (made := cell("fake_good", own_capture, tmp_path)).folder)
    return made


def cell(method: str, capture: Path, out: Path, *, seed: int = 0) -> Cell:
    spec = CaptureSpec(scene="boxes", size="ci")
    return cell_for(CellSpec(capture=spec, method=method, preset="ci", seed=seed), capture, out)


def run(cells: list[Cell], limits: Limits = LIMITS, *, workers: int = 2) -> str:
    """Run the cells, and return what the progress said."""
    plan, lines = plan_cells(cells), io.StringIO()
    with make_executor("local", workers=workers) as executor:
        run_cells(plan, executor, limits, Progress("", len(cells), expected_s=1.0, workers=workers, stream=lines))
    return "\n".join([*plan.reasons, lines.getvalue()])


def _left_behind() -> list[psutil.Process]:
    return [p for p in psutil.process_iter(["cmdline"]) if "left-behind-by-a-method" in (p.info["cmdline"] or ())]


def test_a_thief_finds_nothing_and_scores_what_it_draws(
    honest: Cell, own_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = own_capture
    truth, other = capture / "frames" / "cam4" / "000000.png", honest.folder / "result.json"
    before = {path: sha256_of(path) for path in (truth, other)}
    monkeypatch.setenv("ASH_BENCH_TEST_TRUTH", str(truth))
    monkeypatch.setenv("ASH_BENCH_TEST_OTHER", str(other))
    cheat = cell("thief", capture, tmp_path)
    if sandbox.problem():  # Nothing stops it: what it damaged is named, and its own row fails.
        with pytest.raises(InputError, match=r"own: frames/cam4/000000\.png: "):
            run([honest, cheat])
        result = read_result(cheat.folder)
        assert result is not None and result.status == "crashed" and "the capture was changed" in result.reason
        return
    run([honest, cheat])
    result, expected = read_result(cheat.folder), read_result(honest.folder)
    assert result is not None and expected is not None and result.status == "done", result.reason
    loot = json.loads((cheat.folder / sandbox.WORK / "loot.json").read_text())
    assert len(loot["fit"]) == len(loot["import"]) == 10
    assert not [name for attempts in loot.values() for name, found in attempts.items() if found not in ("", "''")]
    assert {path: sha256_of(path) for path in before} == before
    assert [view.scores for view in result.views] == [view.scores for view in expected.views]


def test_the_processor_s_time_stands_beside_the_clock_s(ran: Callable[[str], Cell]) -> None:
    """A training that sleeps, as one that was stopped, takes time by the clock and none of the processor."""
    wall, cpu = {}, {}
    for name in ("sleeps", "works"):
        result = result_of(ran(name))
        assert result is not None and result.status == "done", result and result.reason
        wall[name], cpu[name] = (result.value("speed", "", f"train_{clock}_s") for clock in ("wall", "cpu"))
    assert wall["sleeps"] > 1.2 and cpu["sleeps"] < 0.6
    assert wall["works"] > 0.9 and cpu["works"] > 0.9, "a process of the method's counts as well"


def test_what_an_earlier_attempt_left_damaged_is_not_the_method_s_fault(capture: Path, tmp_path: Path) -> None:
    target = cell("resumes", capture, tmp_path)
    (target.folder / sandbox.WORK).mkdir(parents=True)
    (target.folder / sandbox.WORK / "checkpoint.safetensors").write_bytes(b"half of it")
    run([target])
    result = read_result(target.folder)
    assert result is not None and result.status == "done", result and result.reason
    assert "expected a safetensors checkpoint" in (target.folder / "output.log").read_text()


def test_a_clock_that_contradicts_ours_is_told(ran: Callable[[str], Cell]) -> None:
    result = result_of(ran("clock"))
    assert result is not None and result.status == "crashed" and "its clock says" in result.reason


def test_a_slow_clock_gains_nothing_and_a_busy_machine_ends_no_cell() -> None:
    def frames(way: float) -> list[worker.Timed]:
        return [worker.Timed(inside_ms=ms, stage_ms={}, outside_ms=ms + way + ms / 50) for ms in (5.0, 6.0, 9.0)]

    assert worker.frame_times_ms(frames(0.5)) == (5.0, 6.0, 9.0)
    assert worker.frame_times_ms(frames(6.0)) == pytest.approx((11.1, 12.12, 15.18))
    for way in (30.0, -1.0):
        with pytest.raises(MethodFailed, match="its clock says"):
            worker.frame_times_ms(frames(way))


def test_all_work_before_the_first_picture_is_training_and_one_drawn_before_is_not_timed(
    ran: Callable[[str], Cell],
) -> None:
    result = result_of(ran("prepares_elsewhere"))
    assert result.status == "done" and min(result.timing.frame_ms) > 29, result
    assert result.value("speed", "", "train_s") > 1.5 and result.value("speed", "", "train_cpu_s") > 1.4


@BOTH_WAYS
@pytest.mark.parametrize("way", ["on", "off"])
def test_a_result_that_another_cell_changed_is_made_again(
    way: str, honest: Cell, own_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(sandbox.ISOLATION, way)
    cheat = cell("overwrites", own_capture, tmp_path)
    before = result_of(honest)
    lines = run([honest, cheat])
    again = result_of(honest)
    assert result_of(cheat).status == "done"
    assert [view.prediction for view in again.views] == [view.prediction for view in before.views]
    assert ("its result was changed while another cell ran" in lines) == (sandbox.problem() is not None)


def test_methods_that_change_each_other_s_results_end_the_run(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = [cell("overwrites", capture, tmp_path, seed=seed) for seed in (0, 1)]

    def overwrite(folder: str, *_) -> str:
        time.sleep(1)  # The run looks at what has finished before.
        for each in cells:
            write_result(each.folder, failed_result(each.config, "crashed", f"by {folder} at {time.monotonic()}"))
        return "done"

    monkeypatch.setattr(engine, "run_in_process", overwrite)
    with pytest.raises(InputError, match="its result was changed by other cells 2 times"):
        run(cells, workers=1)


def test_a_method_s_folder_has_a_limit(capture: Path, tmp_path: Path) -> None:
    cheat = cell("fills", capture, tmp_path)
    run([cheat], replace(LIMITS, disk_mb=100))
    result = result_of(cheat)
    assert result.status == "crashed" and "MB, the limit is 100 MB" in result.reason


@BOTH_WAYS
@pytest.mark.parametrize("way", ["on", "off"])
def test_what_a_method_started_ends_with_it_when_it_is_ended_for_memory(
    way: str, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(sandbox.ISOLATION, way)
    cheat = cell("forks", capture, tmp_path)
    run([cheat], replace(LIMITS, memory_mb=900))
    assert result_of(cheat).status == "out of memory"
    assert not _left_behind()


@pytest.mark.parametrize(("how", "drawn_by"), [("shown", "display"), ("screenless", "trainer"), ("works", "method")])
def test_frames_are_timed_as_they_are_shown_and_the_result_says_how(
    how: str, drawn_by: str, ran: Callable[[str], Cell]
) -> None:
    result = result_of(ran(how))
    assert result.status == "done" and result.timing is not None, result.reason
    assert (result.timing.drawn_by, result.timing.agreement_db) == (drawn_by, 100.0)


def test_a_display_that_shows_something_else_fails_its_cell(ran: Callable[[str], Cell]) -> None:
    result = result_of(ran("decoy"))
    assert result.status == "crashed" and "a timed picture differs from the one that was scored" in result.reason


@pytest.mark.parametrize("how", ENDS)
def test_however_a_method_ends_its_cell_has_a_result(how: str, ran: Callable[[str], Cell]) -> None:
    result = result_of(ran(how))
    assert result is not None and result.status == "crashed" and ENDS[how] in result.reason, result.reason


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((64, 64, 4), np.uint8), "expected an image float32"),
        (np.zeros((64, 64, 3), np.float32), "expected an image float32"),
        (np.full((64, 64, 4), 255, np.float32), "expected 0 to 1"),
    ],
)
def test_a_picture_of_another_type_or_shape_or_in_other_units_is_refused(
    image: np.ndarray, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = {"dtype": image.dtype.str, "shape": list(image.shape)}, image.tobytes()
    monkeypatch.setattr(worker.MethodClient, "_ask", lambda *_, **__: answer)
    client = worker.MethodClient(None, 0, 0, isolated=False)
    with pytest.raises(MethodFailed, match=message):
        client.draw(View(split="novel_view", camera="cam0", frame=0), fakes.cameras()[0])


@pytest.mark.parametrize("count", [-5, 2.0, True, "two"])
def test_a_count_that_is_none_is_refused(count: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker.MethodClient, "_ask", lambda *_, **__: ({"params": count, "gaussians": 1}, b""))
    with pytest.raises(MethodFailed, match=r"params: .*expected a whole number"):
        worker.MethodClient(None, 0, 0, isolated=False).describe()


@BOTH_WAYS
@pytest.mark.parametrize("way", ["on", "off"])
def test_a_method_that_is_killed_from_outside_is_tried_again_and_then_crashed(
    way: str, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the kernel kills for want of memory."""
    monkeypatch.setenv(sandbox.ISOLATION, way)
    waits = cell("waits", capture, tmp_path)
    with ThreadPoolExecutor(1) as pool:
        killed = pool.submit(_kill_when_it_waits, waits.folder / sandbox.WORK / "waits", times=2)
        run([waits])
        assert killed.result() == 2
    result = result_of(waits)
    assert result.status == "crashed" and "killed from outside in each of 2" in result.reason


def _kill_when_it_waits(sign: Path, *, times: int) -> int:
    """Kill the innermost process of a method that has said by a file that it waits."""
    killed, deadline = 0, time.monotonic() + 120
    while killed < times and time.monotonic() < deadline:
        time.sleep(0.1)
        if not sign.exists():
            continue
        sign.unlink()
        named = [p for p in psutil.Process().children(recursive=True) if "benchmarks.cell.worker" in p.cmdline()]
        named[-1].kill()
        killed += 1
    return killed


def test_printing_is_bounded_and_processes_end_with_their_cell(ran: Callable[[str], Cell]) -> None:
    loud = ran("loud")
    log = loud.folder / "output.log"
    assert log.stat().st_size < 2 << 20 and "last words" in log.read_text() and "bytes left out" in log.read_text()
    deadline = time.monotonic() + 10
    while left := _left_behind():
        assert time.monotonic() < deadline, left
        time.sleep(0.1)
    result = read_result(loud.folder)
    assert result is not None and result.status == "done", result.reason


def test_isolation_costs_a_cell_at_most_half_a_second(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the start of the method's process to its end without work, and with it the copy that it sees; by turns."""
    target, whole = cell("fake_good", capture, tmp_path), load_capture(capture)
    method = find_method("fake_good")

    def seconds(way: str) -> float:
        monkeypatch.setenv(sandbox.ISOLATION, way)
        start = time.perf_counter()
        with seen_by_method(whole, tmp_path / "input", oracle=way == "off") as seen:
            with worker.open_client(target, whole, seen, method, oracle=False) as opened:
                if opened.isolated != (way == "on"):
                    pytest.skip("this kernel gives no namespaces")
            return time.perf_counter() - start

    isolated, exposed = (min(times) for times in zip(*((seconds("on"), seconds("off")) for _ in range(3)), strict=True))
    print(f"isolated {isolated:.3f} s, not isolated {exposed:.3f} s")
    assert isolated - exposed < 0.5


@BOTH_WAYS
@pytest.mark.parametrize(("seeded", "way"), [(True, "on"), (False, "off")])
def test_kernels_are_compiled_once_and_every_cell_has_its_own_copy(
    seeded: bool, way: str, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On Warp's CPU device, as if it were a GPU."""
    monkeypatch.setattr(worker, "runs_kernels", lambda device: seeded)
    monkeypatch.setenv(sandbox.ISOLATION, way)
    target, whole = cell("warps", capture, tmp_path), load_capture(capture)
    method = find_method("warps")
    with (
        seen_by_method(whole, tmp_path / "input", oracle=False) as seen,
        worker.open_client(target, whole, seen, method, oracle=False) as opened,
    ):
        opened.make()
        opened.fit()
    told = json.loads((target.folder / sandbox.WORK / "compiled.json").read_text())
    assert told["seen"] == 16, "the triangle covers the whole picture"
    assert bool(told["before"]) == seeded and bool(told["after"])
    assert (told["after"] == told["before"]) == seeded, "what lies there is not compiled again"
    assert not (target.folder / worker.KERNELS).exists()
    if seeded:
        again = worker.copy_kernel_cache("cpu", tmp_path / "again")
        assert not [path for path in again.rglob("*") if path.is_file() and path.read_bytes() == b"broken"]


def test_without_a_gpu_there_is_nothing_to_compile(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert not any(worker.copy_kernel_cache("cpu", tmp_path).iterdir()) and capfd.readouterr().err == ""
    assert not any(worker.copy_kernel_cache("cuda:99", tmp_path).iterdir())
    assert "device cuda:99: no kernels are compiled, Warp" in capfd.readouterr().err


@BOTH_WAYS
def test_a_capture_that_a_method_changed_is_seen_and_used_no_more(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a way that Python does not see, where no namespace stands in it."""
    mine = Path(shutil.copytree(capture, tmp_path / "mine"))
    truth = mine / "frames" / "cam4" / "000000.png"
    whole = truth.read_bytes()
    monkeypatch.setenv("ASH_BENCH_TEST_TRUTH", str(truth))
    monkeypatch.setenv(sandbox.ISOLATION, "off")
    cheat = cell("spoils", mine, tmp_path)
    run([cheat])
    result = read_result(cheat.folder)
    assert result is not None and result.status == "crashed", result
    assert "the capture was changed: frames/cam4/000000.png: altered" in result.reason
    honest = cell("fake_good", mine, tmp_path)
    with pytest.raises(InputError, match=r"mine: frames/cam4/000000\.png: altered"):
        run([honest])
    assert read_result(honest.folder) is None
    truth.write_bytes(whole)
    run([honest])
    result = read_result(honest.folder)
    assert result is not None and result.status == "done" and not verify_capture(mine)


def test_results_belong_to_their_cell(capture: Path, tmp_path: Path) -> None:
    one, other = cell("fake_good", capture, tmp_path), cell("fake_bad", capture, tmp_path)
    for each in (one, other):
        write_result(each.folder, failed_result(each.config, "crashed", "as an example"))
    assert len(plan_cells([one, other]).done) == 2
    (other.folder / "result.json").write_bytes((one.folder / "result.json").read_bytes())
    plan = plan_cells([one, other])
    assert [c.config.method for c in plan.todo] == ["fake_bad"]
    assert "expected the result of boxes · fake_bad" in plan.reasons[0]


def test_names_in_results_are_no_paths(capture: Path, tmp_path: Path) -> None:
    target = cell("fake_good", capture, tmp_path)
    write_result(target.folder, failed_result(target.config, "crashed", "as an example"))
    path = target.folder / "result.json"
    content = json.loads(path.read_text())
    for name in ("x/../../../ESC", "..", "/etc", "a\nb", "", "a" * 1000):
        path.write_text(json.dumps(content | {"config": content["config"] | {"scene": name}}))
        with pytest.raises(InputError, match="plain name for the scene"):
            read_result(target.folder)
