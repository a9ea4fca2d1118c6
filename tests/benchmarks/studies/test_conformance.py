"""The conformance checker tells planted cheats from an honest method, and what it seals its trials with."""

import re
from pathlib import Path

import pytest
from helpers import cheats, fakes

from ash.capture.formats import load_capture
from ash.capture.manifest import verify_capture
from ash.capture.typed import from_json
from ash.files import read_json, sha256_of
from benchmarks import cli
from benchmarks.cell.sandbox import WORK, InputModifiedError, TruthAccessError, seen_by_method, training_copy, watched
from benchmarks.cell.schema import Cell, CellConfig, read_result
from benchmarks.commands import arguments
from benchmarks.studies import conformance
from benchmarks.studies.conformance import check_method
from benchmarks.studies.conformance_worker import Trial, perform
from benchmarks.suites.engine import Limits, run_in_process, write_config

LIMITS = Limits(seconds=60.0, memory_mb=700)


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return fakes.write_capture(tmp_path_factory.mktemp("boxes") / "capture")


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cheats.use(tmp_path / "site", monkeypatch)
    monkeypatch.chdir(tmp_path)


BREAKS = {
    "peeking": {"leaves held-out views alone"},
    "linking": {"leaves held-out views alone"},
    "unseeded": {"same seed, same bits", "training again in its folder ends the same"},
    "one_seed": {"the seed is what is random"},
    "not_a_number": {"draws as the protocol says"},
    "hoarding": {"keeps to its memory"},
    "mutating": {"leaves its input as it was"},
    "overwriting": {"leaves its input as it was"},
    "careless": {"refuses bad poses"},
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_cheat_is_caught_for_what_it_does_and_for_nothing_else(
    name: str, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name not in ("peeking", "hoarding"):  # The others need no sandbox and no process of their own.
        monkeypatch.setattr(conformance, "_ended", ended_here)
    checks = check_method(name, capture, tmp_path / "trials", preset="ci", limits=LIMITS, workers=1)
    assert {check.rule for check in checks if check.passed is False} == BREAKS[name]
    assert not verify_capture(capture)


def ended_here(place: Path, seed: int, spec: object, limits: Limits) -> conformance.TrialRun:
    """A trial in this process, where it can only be watched."""
    trial = from_json(Trial, read_json(place / WORK / "trial.json"))
    return conformance.TrialRun(outcome=perform(trial, place / WORK), isolated=False)


def test_a_method_that_takes_too_long_is_ended(capture: Path, tmp_path: Path) -> None:
    short = Limits(seconds=1.0, memory_mb=700)
    checks = check_method("sleeping", capture, tmp_path / "trials", preset="ci", limits=short, workers=3)
    assert {check.rule for check in checks if check.passed is False} == {"keeps to its time"}
    assert sum(check.passed is None for check in checks) > 5, "what was not seen is not called kept"


def test_a_crash_is_reported_with_file_and_line(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fakes.use(tmp_path / "fakes", monkeypatch)
    checks = check_method("fake_raising", capture, tmp_path / "trials", preset="ci", limits=LIMITS, workers=2)
    (crash,) = [check.observed for check in checks if check.rule == "comes through"]
    assert re.fullmatch(r"seed 0: RuntimeError: the method's own mistake \(helpers/fakes\.py:\d+\)", crash)


def test_an_honest_method_keeps_all_rules(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["check-method", "honest", "--capture", str(capture), "--memory-mb", "700", "--workers", "2"]
    assert cli.main(command) == arguments.DONE
    out = capsys.readouterr().out
    assert "all rules kept" in out and "BROKEN" not in out
    assert cli.main(["check-method", "nobody", "--capture", str(capture)]) == arguments.WRONG_INPUT


def test_a_training_copy_holds_the_training_part_and_nothing_else(capture: Path, tmp_path: Path) -> None:
    whole = load_capture(capture)
    before = sha256_of(capture / "manifest.json")
    seen = training_copy(whole, tmp_path / "copy")
    assert not verify_capture(seen.folder)
    train = whole.splits["train"]
    assert seen.splits == {"train": train} and set(seen.cameras) == set(train.cameras)
    assert len(seen.motion.dofs) == len(train.frames) < len(whole.motion.dofs)
    images = {path.relative_to(seen.folder).as_posix() for path in seen.folder.rglob("*.png")}
    assert images == {f"frames/{camera}/{frame:06d}.png" for camera, frame in train.views}
    assert not (seen.folder / "truth").exists()
    assert training_copy(whole, tmp_path / "copy").identity == seen.identity
    assert sha256_of(capture / "manifest.json") == before


def test_what_is_closed_cannot_be_opened_listed_or_changed(capture: Path, tmp_path: Path) -> None:
    whole = load_capture(capture)
    image = capture / "frames" / "cam4" / "000000.png"
    with seen_by_method(whole, tmp_path / "copy", oracle=False) as seen:
        for forbidden in (
            lambda: image.read_bytes(),
            lambda: list((capture / "truth").iterdir()),
            lambda: (capture / "frames" / "cam0" / ".." / "cam4" / image.name).read_bytes(),
        ):
            with pytest.raises(TruthAccessError, match="held-out"), watched(whole, seen):
                forbidden()
        own = seen.folder / "frames" / "cam0" / "000000.png"
        with watched(whole, seen):
            assert own.read_bytes() and (tmp_path / "elsewhere").write_bytes(b"fine")
        for change in (lambda: own.write_bytes(b""), own.unlink, lambda: own.rename(tmp_path / "x")):
            with pytest.raises(InputModifiedError), watched(whole, seen):
                change()
        assert image.read_bytes(), "the harness itself may read"
    assert not (tmp_path / "copy").exists()


def test_an_oracle_sees_everything(capture: Path, tmp_path: Path) -> None:
    whole = load_capture(capture)
    with seen_by_method(whole, tmp_path / "copy", oracle=True) as seen, watched(whole, seen):
        assert set(seen.splits) == {"train", "novel_view", "novel_pose"}
        assert (capture / "truth" / "template.npz").read_bytes()


def test_a_short_peak_of_memory_fails_a_real_run_too(capture: Path, tmp_path: Path) -> None:
    config = CellConfig(
        scene="boxes", size="ci", capture_seed=0, capture=load_capture(capture).identity, method="hoarding",
        preset="ci", seed=0, code="test",
    )  # fmt: skip
    cell = Cell(config=config, folder=tmp_path / "cell", capture_folder=capture)
    write_config(cell)
    run_in_process(str(cell.folder), LIMITS)
    result = read_result(cell.folder)
    assert result is not None and result.status == "out of memory" and "700 MB" in result.reason
    assert not (cell.folder / "input").exists()
    assert not verify_capture(capture)
