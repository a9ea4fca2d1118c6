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
from benchmarks import cli
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
from benchmarks.suites.runs import Run, read_run

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
    return Entry(Cell(config=told, folder=Path()), result)


def entries(psnrs: Sequence[float], **costs: float) -> list[Entry]:
    return [entry(seed, psnr, **costs) for seed, psnr in enumerate(psnrs)]


def quality(before: Sequence[float], after: Sequence[float], *, looks: int = 1) -> dict[str, str]:
    checks, _ = judge_quality({ROW: (entries(before), entries(after))}, looks=looks)
    return {check.name: check.verdict for check in checks}


def test_identical_predictions_need_no_statistics() -> None:
    (check,), undecided = judge_quality({ROW: (entries([25.0, 25.1, 24.9]), entries([25.0, 25.1]))}, looks=5)
    assert (check.verdict, check.detail) == ("unchanged", "identical predictions of 2 seeds")
    assert not undecided


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
    for after, verdict in (([24.0], "not judged"), ([24.9, 25.6], "not worse")):
        checks, undecided = judge_quality({ROW: (entries([25.0, 25.1]), entries(after))}, looks=1)
        assert undecided == [ROW] and {check.verdict for check in checks} == {verdict}
    assert "would have been seen" in checks[0].detail


def test_a_further_seed_that_fails_is_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    def trained(*_: object, seeds: int) -> dict[str, list[Entry]]:
        *good, last = entries([24.9, 25.6, 25.2])
        return {ROW: [*good, replace(last, result=replace(last.result, status="diverged", reason="NaN"))]}

    monkeypatch.setattr(gate, "trained", trained)
    pairs = {ROW: (entries([25.0, 25.1, 24.9]), entries([24.9, 25.6]))}
    cells = {ROW: [each.cell for each in entries([1.0, 2.0, 3.0])]}
    checks = gate._quality_checks(pairs, cells, None, None, until=math.inf, seeds=3)  # type: ignore[arg-type]
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
        checks = judge_quality({ROW: (base, scored(values))}, looks=1)[0]
        assert {check.name: check.verdict for check in checks}[name] == verdict
    without = judge_quality({ROW: (base, entries([25.0, 25.1, 25.2]))}, looks=1)[0]
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
def base(finished: Path, capture: Path, tmp_path: Path) -> Baseline:
    """The finished run of the suite boxes as a baseline."""
    suite = fakes.write_suite(tmp_path, capture)
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


def test_only_a_baseline_is_replaced_and_loses_no_row_silently_nor_takes_failed_cells(
    base: Baseline, finished: Path, tmp_path: Path
) -> None:
    run, file = read_run(finished), base.file
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="expected a baseline, an empty folder or none"):
        write_baseline(tmp_path / "mine", base.suite, run, file)
    write_baseline(base.folder, base.suite, run, file)
    with pytest.raises(InputError, match=r"holds boxes · fake_bad, which this run lacks"):
        write_baseline(base.folder, base.suite, replace(run, cells=run.cells[:1]), file)
    path = run.cells[0].folder / "result.json"
    write_json(path, {**read_json(path), "status": "crashed"})
    with pytest.raises(InputError, match="needs cells that are done, and cells of boxes · fake_good failed"):
        write_baseline(base.folder, base.suite, run, file)
    assert not list(tmp_path.glob(".base.*")), "nothing is left behind"
    assert read_baseline(base.folder).rows.keys() == base.rows.keys(), "what was there is there"


def test_the_committed_baseline_can_be_read() -> None:
    baseline = read_baseline(Path(__file__).parents[3] / "reports" / "baseline")
    assert baseline.suite.name == "ci.toml"
    assert all(len(seeds) >= 4 and baseline.file.times[row] for row, seeds in baseline.rows.items())


METHOD = """
from helpers.fakes import FakeAvatar

def mine(capture, *, seed, preset):
    return FakeAvatar(capture, detail=0.9, seed=seed)
"""


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


@pytest.mark.usefixtures("installed_fakes")
def test_the_command_tells_what_was_judged_and_refuses_another_suite_or_row(
    base: Baseline, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The tutorial of the gate (docs/gate.md), which a test runs, has the usual course."""
    monkeypatch.chdir(tmp_path)
    judged = Judgement(checks=(check("unchanged"),), run=read_run(finished), times={"boxes · fake_bad": {"frame": 2.0}})
    monkeypatch.setattr(gate, "judge", lambda *_, **__: judged)
    command = ["gate", "--baseline", str(base.folder)]
    assert cli.main([*command, "--history", "history"]) == arguments.DONE
    assert "gate: passed, unchanged" in capsys.readouterr().out
    assert (tmp_path / "history" / "index.html").read_text().count("<svg") == 2 + 2 + 1, "scores, and one time"
    other = fakes.write_suite(tmp_path / "other", base.folder, "fake_good")
    for words, problem in (
        (["--suite", str(other)], f"expected the content of {base.suite}"),
        (["--accept", "nothing", "--because", "x"], "expected one of boxes · fake_good; boxes · fake_bad"),
        (["--accept", "boxes · fake_bad"], "expected a reason"),
    ):
        assert cli.main([*command, *words]) == arguments.WRONG_INPUT
        assert problem in capsys.readouterr().err


def test_rows_that_are_lacking_new_or_on_another_truth_are_not_compared() -> None:
    before = entry(0, 25.0)
    cells = {row: [before.cell] for row in ("same", "new", "moved")}
    moved = replace(before, result=replace(before.result, config=replace(before.result.config, truth="another")))
    baseline = replace(BASE, rows={"gone": [before], "same": [before], "moved": [moved]})
    checks, comparable = gate._row_checks(baseline, cells)
    assert {each.row: each.verdict for each in checks} == {"gone": "worse", "new": "not judged", "moved": "worse"}
    assert list(comparable) == ["same"]


def test_costs_of_another_machine_are_not_judged_but_for_counts() -> None:
    pairs = {ROW: (entries([25.0, 25.1]), entries([25.0, 25.1], ms=99.0, mb=9000.0))}
    cells = {ROW: [each.cell for each in pairs[ROW][0]]}
    checks, times = gate._cost_checks(BASE, pairs, cells, {}, Path(), None)
    assert [(each.name, each.verdict) for each in checks] == [("params", "unchanged"), ("", "not judged")]
    assert checks[1].detail.startswith("memory and stored times: the baseline was made on m, this run on") and not times


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

    origin, first = tmp_path / "origin.git", repository(tmp_path / "first", "method")
    git(tmp_path, "init", "--quiet", "--bare", "--initial-branch=main", str(origin))
    git(first, "remote", "add", "origin", str(origin))
    git(first, "push", "--quiet", "origin", "HEAD:main")
    for name in ("first", "second"):
        clone = tmp_path / name
        if not clone.exists():
            git(tmp_path, "clone", "--quiet", str(origin), str(clone))
        (clone / "ash-bench").mkdir()
        gate = clone / "ash-bench" / "ash-bench"
        gate.write_text("#!/bin/sh\necho line >> history/history.jsonl\necho page > history/index.html\nexit 1\n")
        gate.chmod(0o755)
        subprocess.run(["bash", "-c", script], cwd=clone, check=True, capture_output=True)
    assert git(origin, "ls-tree", "--name-only", "gate-history").split() == ["history.jsonl", "index.html"]
    assert git(origin, "show", "gate-history:history.jsonl") == "line\nline\n"


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


@pytest.mark.parametrize(
    ("quiet_at", "rounds", "frame_ms", "stg4_ms", "verdict"),
    [
        (0, 5, 11.5, 5.75, "unchanged"),
        (6, 7, 11.5, 5.75, "unchanged"),
        (6, 7, 10.0, 5.8, "unchanged"),  # a stage alone
        (99, 10, 11.5, 5.75, "worse"),
        (99, 5, 20.0, 10.0, "worse"),
    ],
)
def test_a_revision_and_today_draw_in_turns_and_longer_while_a_time_barely_fails(
    quiet_at: int, rounds: int, frame_ms: float, stg4_ms: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, turns = entry(0, 25.0), []
    timing = old.result.timing
    assert timing is not None

    def before(*_: object) -> Timing:
        turns.append("before")
        return timing

    def today(cell: Cell) -> CellResult:
        turns.append("today")
        busy = replace(timing, reference_ms=(50.0,))  # The reference workload was disturbed on one side.
        if turns.count("today") <= quiet_at:
            busy = replace(busy, frame_ms=(frame_ms,), stage_ms={"stg4": (stg4_ms,)})
        return replace(old.result, timing=busy)

    monkeypatch.setattr(against, "copied", lambda of, here, out: of.cell)
    monkeypatch.setattr(against, "_timed_by", before)
    monkeypatch.setattr(against, "evaluate_cell", today)
    revision = against.Revision(name="r", command=(), method_path="", methods=frozenset())
    checks, times = against.interleaved(ROW, old, old.cell, Path(), revision)
    assert {check.verdict for check in checks} == {verdict}
    assert times["frame"] == (frame_ms / 5 if verdict == "worse" else 2.0)
    assert turns == ["before", "today", "today", "before"] * (rounds // 2) + ["before", "today"] * (rounds % 2)


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
    return Check(row, layer, verdict, detail, name)  # type: ignore[arg-type]


def test_the_outcome_is_the_worst_of_the_checks() -> None:
    for verdicts, expected in (
        (("unchanged", "not worse"), "not worse"),
        (("unchanged", "better than explained", "not worse"), "better than explained"),
        (("not judged", "worse", "better than explained"), "worse"),
        (("not judged", "unchanged"), "unchanged"),
        (("not judged",), "not judged"),
    ):
        assert outcome([check(verdict) for verdict in verdicts]) == expected


def test_the_terminal_shows_what_changed_between_two_verdicts() -> None:
    lines = summary.terminal(BASE, judgement(check("worse"), check("unchanged", name="other"))).splitlines()
    assert lines[0] == lines[-1] == "gate: FAILED, worse (1 of 2 checks fail)"
    assert f"worse                  {ROW}: quality: 1 -> 2" in lines[2] and len(lines) == 4


def test_the_terminal_of_a_run_without_changes_shows_every_check() -> None:
    file = replace(BASE.file, accepted=(Accepted(row=ROW, because="wanted", commit="abc"),))
    text = summary.terminal(replace(BASE, file=file), judgement(check("unchanged")))
    assert text.splitlines()[0] == "gate: passed, unchanged (1 checks)" and f"{ROW}: quality" in text
    assert f"Accepted at abc: {ROW}: wanted" in text


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
    shown = summary.terminal(named, judgement(*checks))
    assert all(line.isprintable() or not escaping.CONTROLS.search(line) for line in shown.split("\n"))
