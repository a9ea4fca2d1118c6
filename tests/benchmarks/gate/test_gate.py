"""The gate: what it compares, what it says, and what it refuses."""

import json
import math
import os
import subprocess
import sys
import textwrap
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import fakes
from helpers.cells import config
from helpers.hostile import HOSTILE, Text
from markdown_it import MarkdownIt

from ash.files import InputError, read_json, write_json
from benchmarks import cli, provenance
from benchmarks.cell.sandbox import METHOD_PATH
from benchmarks.cell.schema import CHECKPOINT, Cell, CellResult, Summary, Timing, ViewScore
from benchmarks.commands import arguments
from benchmarks.gate import against, gate, history, summary
from benchmarks.gate.baseline import Accepted, Baseline, Entry, GateFile, read_baseline, row_of, write_baseline
from benchmarks.gate.checks import FAILING, Check, of_exact_change, outcome
from benchmarks.gate.exact import first_steps_check
from benchmarks.gate.gate import Judgement, _times_again
from benchmarks.gate.starting import WORKFLOW_TEXT, start
from benchmarks.gate.statistical import (
    count_checks,
    judge_quality,
    least_times,
    memory_check,
    time_checks,
    training_time,
)
from benchmarks.report import escaping
from benchmarks.suites.files import read_suite
from benchmarks.suites.runs import Run, RunOptions, read_run

ROW = "loose · ash"


def entry(seed: int, psnr: float, *, ms: float = 10.0, params: float = 1000.0, mb: float = 400.0) -> Entry:
    """A cell that nobody ran; it drew what its PSNR says."""
    rows = [Summary(split=s, region="foreground", metric="psnr", value=psnr) for s in ("novel_view", "novel_pose")]
    costs = (("memory", "params", params), ("memory", "peak_rss_mb", mb), ("speed", "train_cpu_s", 8.0))
    rows += [Summary(split=split, region="", metric=metric, value=value) for split, metric, value in costs]
    view = ViewScore(split="novel_view", camera="a", frame=0, prediction=f"{psnr}", scores={})
    timing = Timing(frame_ms=(ms * 1.1, ms), stage_ms={"stg4": (ms / 2,), "stg1": (0.01,)}, reference_ms=(5.0, 6.0))
    told = config("ash", seed)
    result = CellResult(config=told, status="done", summary=tuple(rows), views=(view,), timing=timing)
    return Entry(cell=Cell(config=told, folder=Path()), result=result)


def entries(psnrs: Sequence[float], **costs: float) -> list[Entry]:
    return [entry(seed, psnr, **costs) for seed, psnr in enumerate(psnrs)]


def quality(before: Sequence[float], after: Sequence[float], *, looks: int = 1) -> dict[str, str]:
    judged = judge_quality({ROW: (entries(before), entries(after))}, looks=looks)
    return {check.name: check.verdict for check in judged.checks}


def test_identical_predictions_need_no_statistics() -> None:
    judged = judge_quality({ROW: (entries([25.0, 25.1, 24.9]), entries([25.0, 25.1]))}, looks=5)
    (check,) = judged.checks
    assert (check.verdict, check.detail) == ("unchanged", "identical predictions of 2 seeds")
    assert judged.undecided == ()


def test_scores_are_compared_in_pairs_of_the_same_seed() -> None:
    """Seeds differ by 1 dB, and the change of 0.3 dB is found all the same."""
    before = [25.0, 26.0, 24.0, 25.5]
    worse = quality(before, [psnr - 0.3 + 0.01 * k for k, psnr in enumerate(before)])
    assert set(worse.values()) == {"worse"}
    better = quality(before, [psnr + 0.3 + 0.01 * k for k, psnr in enumerate(before)])
    assert set(better.values()) == {"better than explained"}
    within = quality(before, [psnr + 0.02 * (-1) ** k for k, psnr in enumerate(before)])
    assert set(within.values()) == {"not worse"}


def test_what_is_not_decided_asks_for_another_seed() -> None:
    one = judge_quality({ROW: (entries([25.0, 25.1]), entries([24.0]))}, looks=1)
    assert one.undecided == (ROW,) and {check.verdict for check in one.checks} == {"not judged"}
    noisy = judge_quality({ROW: (entries([25.0, 25.1]), entries([24.9, 25.6]))}, looks=1)
    assert noisy.undecided == (ROW,) and {check.verdict for check in noisy.checks} == {"not worse"}
    assert "would have been seen" in noisy.checks[0].detail


def test_a_further_seed_that_fails_is_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    def trained(by_row: object, rows: Sequence[str], count: int, *_: object) -> dict[str, list[Entry]]:
        *good, last = entries([24.9, 25.6, 25.2])
        return {ROW: [*good, replace(last, result=replace(last.result, status="diverged", reason="NaN"))]}

    monkeypatch.setattr(gate, "_train", trained)
    pairs = {ROW: (entries([25.0, 25.1, 24.9]), entries([24.9, 25.6]))}
    cells = {ROW: [each.cell for each in entries([1.0, 2.0, 3.0])]}
    checks = gate._judge_quality(pairs, cells, None, None, until=math.inf, seeds=3)  # type: ignore[arg-type]
    assert [(check.verdict, check.detail) for check in checks] == [("worse", "1 of 3 trainings failed: diverged: NaN")]


def test_false_alarms_of_a_run_that_is_judged_after_every_seed() -> None:
    """Trainings that came out different for no reason: at most 5 % of runs are called worse or better at any look."""
    rng = np.random.default_rng(0)
    rounds, seeds, alarms, found = 100, 6, 0, 0
    for _ in range(rounds):
        before = rng.normal(25, 0.3, seeds)
        same, worse = before + rng.normal(0, 0.15, seeds), before - 0.4 + rng.normal(0, 0.1, seeds)
        looks = [quality(before[:n], same[:n], looks=seeds - 1) for n in range(2, seeds + 1)]
        alarms += any(verdict in FAILING for look in looks for verdict in look.values())
        found += "worse" in quality(before, worse, looks=seeds - 1).values()
    assert alarms / rounds <= 0.05
    assert found / rounds > 0.9


def test_lpips_is_judged_where_it_can_be_measured() -> None:
    def scored(lpips: Sequence[float]) -> list[Entry]:
        found = entries([25.0 + 0.01 * value for value in lpips])
        rows = [Summary(split="novel_view", region="full", metric="lpips", value=value) for value in lpips]
        return [
            replace(e, result=replace(e.result, summary=(*e.result.summary, row)))
            for e, row in zip(found, rows, strict=True)
        ]

    base, name = scored([12.0, 12.1, 11.9]), "novel_view/full/lpips"
    for values, verdict in (([17.0, 17.1, 16.95], "worse"), ([12.1, 12.15, 11.95], "not worse")):
        checks = judge_quality({ROW: (base, scored(values))}, looks=1).checks
        assert {check.name: check.verdict for check in checks}[name] == verdict
    without = judge_quality({ROW: (base, entries([25.0, 25.1, 25.2]))}, looks=1).checks
    told = next(check for check in without if check.name == name)
    assert (told.verdict, told.detail) == ("not judged", "n/a: no weights for LPIPS here")


def test_exact_changes_of_a_frozen_avatar() -> None:
    verdicts = [of_exact_change(x, 0.1, higher_is_better=True) for x in (-0.03, -0.01, 0.01, 0.05, 0.2)]
    assert verdicts == ["worse", "unchanged", "unchanged", "not worse", "better than explained"]
    assert of_exact_change(0.03, 0.1, higher_is_better=False) == "worse"


def log(path: Path, *rows: dict[str, float]) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_the_first_step_that_differs_is_named(tmp_path: Path) -> None:
    rows = [{"step": k, "seconds": 0.1 * k, "loss": 1 / k, "gradient": 2.0} for k in range(1, 5)]
    before = log(tmp_path / "a", *rows)
    equal = first_steps_check(ROW, before, log(tmp_path / "b", *({**row, "seconds": 9.0} for row in rows)))
    assert equal is not None and equal.verdict == "unchanged"
    for index, what, said in (
        (0, "loss", "from the loss of step 1 on (loss 1.0 -> 7.0)"),
        (2, "loss", "from the loss of step 3 on, so in the update before it"),
        (1, "gradient", "from the gradient of step 2 on, whose loss is equal"),
    ):
        changed = [{**row, what: 7.0} if k == index else row for k, row in enumerate(rows)]
        check = first_steps_check(ROW, before, log(tmp_path / "c", *changed))
        assert check is not None and check.verdict == "not worse" and said in check.detail
    near = [{**row, "loss": row["loss"] * (1 + 1e-6)} for row in rows]
    check = first_steps_check(ROW, before, log(tmp_path / "d", *near))
    assert check is not None and "it may be rounding" in check.detail
    assert first_steps_check(ROW, before, tmp_path / "none") is None


def test_costs() -> None:
    base = entries([25.0, 25.1])
    assert [c.verdict for c in count_checks(ROW, base[0].result, entry(0, 25.0, params=1001.0).result)] == ["worse"]
    assert [c.verdict for c in count_checks(ROW, base[0].result, entry(0, 25.0, params=900.0).result)] == ["not worse"]
    assert memory_check(ROW, base, entries([25.0], mb=800.0)).verdict == "worse"
    old = least_times(e.result.timing for e in base if e.result.timing)
    assert old["frame"] == 2.0 and old["stg4"] == 1.0
    for ms, in_turn, stored in ((5.0, "unchanged", "unchanged"), (11.0, "unchanged", "unchanged"),
                                (11.5, "worse", "not judged"), (15.5, "worse", "not judged"),
                                (16.5, "worse", "worse")):  # fmt: skip
        new = least_times(e.result.timing for e in entries([25.0], ms=ms) if e.result.timing)
        for told, verdict in ((False, in_turn), (True, stored)):
            checks = {check.name: check.verdict for check in time_checks(ROW, old, new, stored=told)}
            names = ("frame",) if told else ("frame", "stg4")  # stg1 is too short to be timed
            assert checks == {f"time of {name}": verdict for name in names}
    assert "--against REV does" in time_checks(ROW, {"frame": 2.0}, {"frame": 2.5}, stored=True)[0].detail
    times = {name: 1e3 * value for name, value in training_time(base).items()}
    found = [time_checks(ROW, times, {"training": f * times["training"]}, stored=True)[0] for f in (0.5, 1.1, 1.4, 1.7)]
    assert [check.verdict for check in found] == ["unchanged", "unchanged", "not judged", "worse"]
    assert "--against" not in found[2].detail, "trainings are not repeated in turn"
    short = time_checks(ROW, {"training": 12.0}, {"training": 20.0}, stored=True)
    assert short == [], "trainings of a fraction of a second are not compared"


@pytest.mark.parametrize(
    ("quiet_at", "drawn", "slow_ms", "verdict"),
    [(0, 1, 17.0, "unchanged"), (3, 4, 17.0, "unchanged"), (99, 11, 17.0, "worse"), (99, 1, 13.0, "not judged")],
)
def test_a_time_that_has_risen_is_measured_again_before_it_is_believed(
    quiet_at: int, drawn: int, slow_ms: float, verdict: str
) -> None:
    asked: list[int] = []

    def measured() -> Iterator[Timing]:
        while True:
            asked.append(1)
            yield entry(0, 25.0, ms=10.0 if len(asked) > quiet_at else slow_ms).result.timing

    old = least_times([entry(0, 25.0).result.timing])
    checks, _ = _times_again(ROW, old, {}, measured())
    assert len(asked) == drawn and {check.verdict for check in checks} == {verdict}


@pytest.fixture
def base(finished: Path, tmp_path: Path) -> Baseline:
    """The finished run of the suite boxes as a baseline."""
    suite = next(finished.parent.glob("*.toml"), None) or fakes.write_suite(tmp_path, tmp_path / "capture")
    write_baseline(tmp_path / "base", suite, read_run(finished), GateFile(machine="m", times={}))
    return read_baseline(tmp_path / "base")


def test_a_baseline_is_a_run_that_keeps_one_avatar_of_each_row(base: Baseline, finished: Path) -> None:
    run = read_run(finished)
    assert set(base.rows) == {row_of(cell.config) for cell in run.cells}
    for (first, *_), cell in zip(base.rows.values(), run.cells, strict=True):
        assert (first.cell.folder / CHECKPOINT).read_bytes() == (cell.folder / CHECKPOINT).read_bytes()
        assert len(list(first.cell.folder.glob("images/**/*.png"))) == 6
        assert str(finished) not in (first.cell.folder / "config.json").read_text()


def test_damaged_baselines_are_refused_in_one_line(base: Baseline, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a baseline of the gate; make one"):
        read_baseline(tmp_path / "nothing")
    path = base.folder / "gate.json"
    for damaged in ("", "[]", '{"machine": 3}', path.read_text().replace("times", "time")):
        path.write_text(damaged)
        with pytest.raises(InputError, match=r"gate\.json"):
            read_baseline(base.folder)


def test_a_baseline_loses_no_row_silently_and_is_not_made_of_failed_cells(base: Baseline, finished: Path) -> None:
    run, file = read_run(finished), base.file
    with pytest.raises(InputError, match=r"holds boxes · fake_bad, which this run lacks"):
        write_baseline(base.folder, base.suite, replace(run, cells=run.cells[:1]), file)
    path = run.cells[0].folder / "result.json"
    write_json(path, {**read_json(path), "status": "crashed"})
    with pytest.raises(InputError, match="needs cells that are done, and cells of boxes · fake_good failed"):
        write_baseline(base.folder, base.suite, run, file)
    assert read_baseline(base.folder).rows.keys() == base.rows.keys(), "what was there is there"


def test_nothing_else_is_overwritten(base: Baseline, finished: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="expected a baseline, an empty folder or none"):
        write_baseline(tmp_path / "mine", base.suite, read_run(finished), base.file)


def test_the_committed_baseline_can_be_read() -> None:
    baseline = read_baseline(Path(__file__).parents[3] / "reports" / "baseline")
    assert baseline.suite.name == "ci.toml"
    assert all(len(seeds) >= 4 and baseline.file.times[row] for row, seeds in baseline.rows.items())


METHOD = """
from helpers.fakes import FakeAvatar

def mine(capture, *, seed, preset):
    return FakeAvatar(capture, detail=0.9, seed=seed)
"""


def test_a_baseline_of_another_machine_and_a_suite_that_it_is_not_of(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The tutorial of the gate (docs/gate.md), which a test runs, has the usual course."""
    monkeypatch.chdir(tmp_path)
    fakes.use(tmp_path, monkeypatch)
    (tmp_path / "dimmable.py").write_text(METHOD)
    suite = fakes.write_suite(tmp_path, capture, "dimmable:mine", name="gate")
    both, options = read_suite(suite).narrowed(seeds=2), RunOptions(out=Path("runs/gate"), data=Path("data"), workers=2)
    run, by_row = gate.cells_of(both, options)
    gate.trained(by_row, both, options)
    write_baseline(Path("base"), suite, run, GateFile(machine="another", times={}))
    command = ["gate", "--baseline", "base"]
    assert cli.main([*command, "--history", "history"]) == arguments.DONE
    told = capsys.readouterr().out
    assert "gate: passed, unchanged" in told
    assert "not judged             cost: memory and stored times: the baseline was made on another" in told
    assert (tmp_path / "history" / "index.html").read_text().count("<svg") == 2

    fakes.write_suite(tmp_path, capture, "dimmable:mine", "fake_good", name="gate")
    assert cli.main([*command, "--suite", str(suite)]) == arguments.WRONG_INPUT
    assert "expected the content of base/gate.toml" in capsys.readouterr().err
    assert cli.main([*command, "--accept", "nothing", "--because", "x"]) == arguments.WRONG_INPUT
    assert cli.main([*command, "--accept", "boxes · dimmable:mine"]) == arguments.WRONG_INPUT


def test_a_gate_is_started_in_a_repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    fakes.use(tmp_path / "plugins", monkeypatch)
    package = tmp_path / "src" / "started_here"
    package.mkdir(parents=True)
    (package / "avatar.py").write_text(METHOD)
    monkeypatch.syspath_prepend(str(package.parent))
    suite = start("started_here.avatar:mine", Path("gate"))
    assert [row.of for row in read_suite(suite).methods] == ["started_here.avatar:mine"]
    workflow = (tmp_path / ".github/workflows/gate.yml").read_text()
    assert "--method-path src gate --baseline gate/baseline" in workflow and "{{ github.token }}" in workflow
    assert "--against ${{ github.event.pull_request.base.sha }}" in workflow and "fetch-depth: 0" in workflow
    with pytest.raises(InputError, match="is there already"):
        start("started_here.avatar:mine", Path("gate"))
    with pytest.raises(InputError, match="expected a module of the repository"):
        start("helpers.fakes:good", Path("other"))


def test_the_workflow_keeps_the_history_on_a_branch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its last step, in two clones after each other; the gate is a script that finds something worse."""
    script = "set -e\n" + textwrap.dedent(WORKFLOW_TEXT.rpartition("- run: |\n")[2])
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    monkeypatch.setenv("GITHUB_SHA", "abc")

    def git(*words: str | Path) -> str:
        command = ["git", "-c", "user.name=me", "-c", "user.email=me@example.org", *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    origin, first = tmp_path / "origin.git", tmp_path / "first"
    git("init", "--quiet", "--bare", "--initial-branch=main", origin)
    git("clone", "--quiet", origin, first)
    (first / "method.py").write_text("")
    git("-C", first, "add", "method.py")
    git("-C", first, "commit", "--quiet", "--message", "a method")
    git("-C", first, "push", "--quiet", "origin", "HEAD:main")
    for name in ("first", "second"):
        clone = tmp_path / name
        if not clone.exists():
            git("clone", "--quiet", origin, clone)
        (clone / "ash-bench").mkdir()
        gate = clone / "ash-bench" / "ash-bench"
        gate.write_text("#!/bin/sh\necho line >> history/history.jsonl\necho page > history/index.html\nexit 1\n")
        gate.chmod(0o755)
        subprocess.run(["bash", "-c", script], cwd=clone, check=True, capture_output=True)
    assert git("-C", origin, "ls-tree", "--name-only", "gate-history").split() == ["history.jsonl", "index.html"]
    assert git("-C", origin, "show", "gate-history:history.jsonl") == "line\nline\n"


def test_history_marks_a_step_with_its_commit_and_refuses_damage(tmp_path: Path) -> None:
    values = [25.0, 25.01, 24.99, 25.0, 25.01, 24.5, 24.51]
    lines = [
        {"commit": f"c{k}", "when": "now", "outcome": "unchanged", "rows": {ROW: {"novel_view/foreground/psnr": value}}}
        for k, value in enumerate(values)
    ]
    found = history.table(lines)
    assert found[found["step"]]["commit"].tolist() == ["c5"]
    assert "c5" in history.page(lines)
    path = log(tmp_path / "history.jsonl", *lines)
    assert [line["commit"] for line in history.read(path)] == [f"c{k}" for k in range(7)]
    for damaged in ('{"rows": 3}', "[]", '{"commit": "a", "when": "b", "outcome": "c", "rows": {"r": {"x": 1e999}}}'):
        path.write_text(damaged)
        with pytest.raises(InputError, match=r"history\.jsonl:1: expected a line that the gate wrote"):
            history.read(path)


def git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    return subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True, text=True).stdout


def repository(folder: Path, module: str) -> Path:
    """A git repository that holds a method."""
    folder.mkdir()
    (folder / f"{module}.py").write_text(METHOD)
    git(folder, "init", "-q")
    git(folder, "add", ".")
    git(folder, "commit", "-qm", "the method")
    return folder


@pytest.mark.parametrize(
    ("quiet_at", "rounds", "slow_ms", "verdict"),
    [(0, 5, 11.5, "unchanged"), (6, 7, 11.5, "unchanged"), (99, 10, 11.5, "worse"), (99, 5, 20.0, "worse")],
)
def test_a_revision_and_today_draw_in_turns_and_longer_while_a_time_barely_fails(
    quiet_at: int, rounds: int, slow_ms: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[str] = []

    def draw(of: Entry, here: Cell, out: Path, by: object = None) -> CellResult:
        drawn.append("before" if by else "today")
        result = entry(0, 25.0, ms=slow_ms if not by and drawn.count("today") <= quiet_at else 10.0).result
        assert result.timing is not None
        busy = replace(result.timing, reference_ms=(50.0,))  # The reference workload was disturbed on one side.
        return result if by else replace(result, timing=busy)

    monkeypatch.setattr(against, "drawn_again", draw)
    revision = against.Revision(name="r", command=(), method_path="", methods=frozenset())
    old = entry(0, 25.0)
    checks, times = against.interleaved(ROW, old, old.cell, Path(), revision)
    assert {check.verdict for check in checks} == {verdict} and times["frame"] == (
        slow_ms / 5 if verdict == "worse" else 2.0
    )
    turns = [drawn[2 * k : 2 * k + 2] for k in range(rounds)]
    assert len(drawn) == 2 * rounds
    assert turns[::2] == [["before", "today"]] * len(turns[::2])
    assert turns[1::2] == [["today", "before"]] * len(turns[1::2])


def test_they_draw_longer_while_a_stage_alone_barely_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []

    def draw(of: Entry, here: Cell, out: Path, by: object = None) -> CellResult:
        drawn.append("before" if by else "today")
        result = entry(0, 25.0).result
        assert result.timing is not None
        slow = replace(result.timing, stage_ms={"stg4": (5.8,)})
        return result if by or drawn.count("today") > 6 else replace(result, timing=slow)

    monkeypatch.setattr(against, "drawn_again", draw)
    revision = against.Revision(name="r", command=(), method_path="", methods=frozenset())
    checks, _ = against.interleaved(ROW, entry(0, 25.0), entry(0, 25.0).cell, Path(), revision)
    assert len(drawn) == 14 and {check.verdict for check in checks} == {"unchanged"}


def test_what_a_revision_cannot_draw_is_not_judged(base: Baseline, capture: Path, tmp_path: Path) -> None:
    """A change of the checkpoint's format, say, which comes with a baseline of its own."""
    entry = next(iter(base.rows.values()))[0]
    command = ("sh", "-c", "echo it broke >&2; exit 1")
    revision = against.Revision(name="abc", command=command, method_path="", methods=frozenset())
    (check,), _ = against.interleaved(ROW, entry, replace(entry.cell, capture_folder=capture), tmp_path, revision)
    assert check.layer == "cost" and check.verdict == "not judged"
    assert check.detail.startswith("--against: abc cannot draw") and check.detail.endswith(": it broke")


def test_revisions_that_cannot_be_told_apart_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def paths(*folders: Path) -> None:
        monkeypatch.setenv(METHOD_PATH, os.pathsep.join(map(str, folders)))
        monkeypatch.setattr(sys, "path", [*map(str, reversed(folders)), *before])

    before, out = list(sys.path), tmp_path / "out"
    theirs, second, plain = (tmp_path / name for name in ("theirs", "second", "plain"))
    repository(theirs, "first_own")
    repository(second, "second_own")
    plain.mkdir()
    (plain / "plain_own.py").write_text(METHOD)
    paths(theirs, second, plain)
    with pytest.raises(InputError, match="expected plain_own:mine in a checkout of ash-bench or under a --method-path"):
        against.revision_of("HEAD", ["first_own:mine", "plain_own:mine"], out)
    with pytest.raises(InputError, match="expected methods in one repository"):
        against.revision_of("HEAD", ["first_own:mine", "second_own:mine"], out)
    for unknown in ("no-such-revision", "--all"):
        with pytest.raises(InputError, match="expected a revision that git knows"):
            against.revision_of(unknown, ["first_own:mine"], out)
    (plain / "first_own.py").write_text(METHOD)
    paths(plain, theirs)  # As what is installed, `plain` comes first in every process but this one.
    with pytest.raises(InputError, match="expected it not to be installed"):
        against.revision_of("HEAD", ["first_own:mine"], out)


def judgement(*checks: Check, suite: str = "boxes") -> Judgement:
    run = Run(folder=Path(), suite=suite, about="", command="", cells=())
    return Judgement(checks=checks, run=run)


BASE = Baseline(folder=Path(), suite=Path("ci.toml"), rows={}, file=GateFile(machine="m", times={}), commit="a" * 12)


def check(verdict: str, *, row: str = ROW, layer: str = "quality", name: str = "", detail: str = "1 -> 2") -> Check:
    return Check(row=row, layer=layer, verdict=verdict, detail=detail, name=name)  # type: ignore[arg-type]


def test_the_outcome_is_the_worst_of_the_checks() -> None:
    for verdicts, expected in (
        (("unchanged", "not worse"), "not worse"),
        (("unchanged", "better than explained", "not worse"), "better than explained"),
        (("not judged", "worse", "better than explained"), "worse"),
        (("not judged", "unchanged"), "unchanged"),
        (("not judged",), "not judged"),
    ):
        assert outcome([check(verdict) for verdict in verdicts]) == expected


@pytest.mark.parametrize(
    ("bad", "suspect"),
    [
        ([check("worse")], "ash/model.py"),
        ([check("worse", row="loose · ddc")], "baselines/ddc.py"),
        ([check("worse"), check("worse", row="loose · ddc")], "synth/posing.py"),
        ([check("worse", layer="cost", name="time of stg4")], "ash/gaussians/splatting.py"),
        ([check("worse", layer="protocol")], "benchmarks/cell/metrics.py"),
    ],
)
def test_the_terminal_says_what_moved_and_where_to_look(bad: list[Check], suspect: str) -> None:
    changed = ("README.md", "baselines/ddc.py", "synth/posing.py", "benchmarks/cell/metrics.py", "ash/model.py")
    changed = (*changed, "ash/gaussians/splatting.py")
    lines = summary.terminal(BASE, judgement(*bad, check("unchanged", name="other")), changed).splitlines()
    assert lines[0] == lines[-1] and lines[0].startswith("gate: FAILED, worse")
    near = [line.removeprefix("  * ") for line in lines if line.startswith("  * ")]
    assert suspect in near and not any("README" in line or "other" in line for line in lines)


def test_the_terminal_of_a_run_without_changes_shows_every_check() -> None:
    file = replace(BASE.file, accepted=(Accepted(row=ROW, because="wanted", commit="abc"),))
    text = summary.terminal(replace(BASE, file=file), judgement(check("unchanged")), ())
    assert text.splitlines()[0] == "gate: passed, unchanged (1 checks)" and f"{ROW}: quality" in text
    assert f"Accepted at abc: {ROW}: wanted" in text


def test_every_source_that_is_named_exists() -> None:
    root = Path(__file__).parents[3]
    named = {name for places in summary.STAGES.values() for name in places}
    named |= {*summary.TEMPLATE, *summary.SHARED, *summary.SOURCES}
    assert [name for name in sorted(named) if not (root / name).exists()] == []


def test_git_tells_which_files_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "benchmarks" / "provenance.py"))
    git(tmp_path, "init", "-q")
    for name in ("same.py", "edited.py", "committed.py"):
        (tmp_path / name).write_text("1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "base")
    base = git(tmp_path, "rev-parse", "--short=12", "HEAD").strip()
    assert provenance.changed_since(base) == ()
    (tmp_path / "committed.py").write_text("2\n")
    git(tmp_path, "commit", "-qam", "one more")
    (tmp_path / "edited.py").write_text("2\n")
    (tmp_path / "new.py").write_text("1\n")
    assert provenance.changed_since(f"{base}+") == ("committed.py", "edited.py", "new.py")
    assert provenance.changed_since("0" * 12) is None and provenance.changed_since("unknown; rm -rf") is None


@pytest.mark.parametrize("text", HOSTILE)
def test_names_and_details_are_texts_in_every_form(text: str) -> None:
    words = " ".join(escaping.one_line(text).split())
    verdicts = ("unchanged", "worse", "not judged")
    checks = [check(verdict, row=text, name=text, detail=text) for verdict in verdicts]
    reader = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    named = replace(
        BASE, commit=text, file=replace(BASE.file, accepted=(Accepted(row=text, because=text, commit=text),))
    )
    page = Text(reader.render(summary.markdown(named, judgement(*checks, suite=text))))
    ours = {"h2", "p", "strong", "details", "summary", "table", "thead", "tbody", "tr", "th", "td"}
    assert set(page.tags) <= ours and page.tags.count("td") == 3 * (2 + len(checks))
    assert " ".join(page.text.split()).count(words) >= 2 * len(checks)
    suite = ElementTree.fromstring(summary.junit(checks).split("\n", 1)[1])
    assert len(suite) == 3 and suite[1][0].text == suite[2][0].get("message") == escaping.one_line(text)
    shown = summary.terminal(named, judgement(*checks), None)
    assert all(line.isprintable() or not escaping.CONTROLS.search(line) for line in shown.split("\n"))
