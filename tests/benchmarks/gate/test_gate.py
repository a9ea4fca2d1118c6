"""The gate: what it compares, what it says, and what it refuses."""

import json
import subprocess
import sys
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
from benchmarks.cell.schema import CHECKPOINT, Cell, CellResult, Summary, Timing, ViewScore
from benchmarks.commands import arguments
from benchmarks.gate import against, history, summary
from benchmarks.gate.baseline import Accepted, Baseline, Entry, GateFile, read_baseline, row_of, write_baseline
from benchmarks.gate.checks import FAILING, Check, of_exact_change, outcome
from benchmarks.gate.exact import equal_seeds, first_steps_check
from benchmarks.gate.gate import Judgement, _times_again
from benchmarks.gate.starting import start
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


def test_two_seeds_with_equal_pictures_are_told() -> None:
    assert equal_seeds(ROW, entries([25.0, 25.1])) is None
    check = equal_seeds(ROW, entries([25.0, 25.0]))
    assert check is not None and check.verdict == "worse"


def test_costs() -> None:
    base = entries([25.0, 25.1])
    assert [c.verdict for c in count_checks(ROW, base[0].result, entry(0, 25.0, params=1001.0).result)] == ["worse"]
    assert [c.verdict for c in count_checks(ROW, base[0].result, entry(0, 25.0, params=900.0).result)] == ["not worse"]
    assert memory_check(ROW, base, entries([25.0], mb=800.0)).verdict == "worse"
    old = least_times(e.result.timing for e in base if e.result.timing)
    assert old["frame"] == 2.0 and old["stg4"] == 1.0
    for ms, verdict in ((12.0, "worse"), (11.0, "unchanged")):
        new = least_times(e.result.timing for e in entries([25.0], ms=ms) if e.result.timing)
        checks = {check.name: check.verdict for check in time_checks(ROW, old, new)}
        assert checks == {"time of frame": verdict, "time of stg4": verdict}, "stg1 is too short to be timed"
    times = training_time(base)
    found = {f: time_checks(ROW, times, {"training": f * times["training"]})[0].verdict for f in (0.5, 1.1, 1.4)}
    assert found == {0.5: "better than explained", 1.1: "unchanged", 1.4: "worse"}


@pytest.mark.parametrize(
    ("quiet_at", "drawn", "verdict"), [(0, 1, "unchanged"), (3, 4, "unchanged"), (99, 11, "worse")]
)
def test_a_time_that_fails_is_measured_again_before_it_is_believed(quiet_at: int, drawn: int, verdict: str) -> None:
    asked: list[int] = []

    def results() -> Iterator[CellResult]:
        while True:
            asked.append(1)
            yield entry(0, 25.0, ms=10.0 if len(asked) > quiet_at else 15.0).result

    old = least_times([entry(0, 25.0).result.timing])
    checks, _ = _times_again(ROW, old, {}, results())
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


def test_a_method_in_another_repository(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Unchanged, changed in its rendering alone, accepted, and another suite."""
    monkeypatch.chdir(tmp_path)
    fakes.use(tmp_path, monkeypatch)
    source = tmp_path / "dimmable.py"
    source.write_text(METHOD)
    suite = fakes.write_suite(tmp_path, capture, "dimmable:mine", name="gate")
    command = ["gate", "--baseline", "base"]
    assert cli.main([*command, "--suite", str(suite), "--seeds", "4", "--update-baseline"]) == arguments.DONE
    told = read_json(tmp_path / "base" / "gate.json")
    write_json(tmp_path / "base" / "gate.json", {**told, "machine": "another"})  # Others may be at work beside us.
    assert cli.main([*command, "--history", "history"]) == arguments.DONE
    told = capsys.readouterr().out
    assert "gate: passed, unchanged" in told
    assert "not judged             cost: memory and times: the baseline was made on another" in told
    assert (tmp_path / "history" / "index.html").read_text().count("<svg") == 2

    source.write_text(METHOD + "\nclass Dim(FakeAvatar):\n    def render(self, *args, **more):\n"
        "        return 0.9 * super().render(*args, **more)\n"
        "\ndef mine(capture, *, seed, preset):\n    return Dim(capture, detail=0.9, seed=seed)\n")  # fmt: skip
    assert cli.main([*command, "--out", "dim", "--markdown", "m.md", "--junit", "j.xml"]) == arguments.FAILED
    told = capsys.readouterr().out
    assert "rendering changed: 26 of 26 pictures" in told and "exact" in told
    assert (tmp_path / "dim" / "rendering_0.png").read_bytes()[:4] == b"\x89PNG"
    assert "worse" in (tmp_path / "m.md").read_text() and "<failure" in (tmp_path / "j.xml").read_text()
    row = "boxes · dimmable:mine"
    assert cli.main([*command, "--out", "dim", "--accept", row, "--because", "darker is wanted"]) == arguments.DONE
    assert cli.main([*command, "--out", "dim"]) == arguments.DONE
    told = capsys.readouterr().out
    assert "Accepted at" in told and "darker is wanted" in told

    fakes.write_suite(tmp_path, capture, "dimmable:mine", "fake_good", name="gate")
    assert cli.main([*command, "--suite", str(suite)]) == arguments.WRONG_INPUT
    assert "expected the content of base/gate.toml" in capsys.readouterr().err
    assert cli.main([*command, "--accept", "nothing", "--because", "x"]) == arguments.WRONG_INPUT
    assert cli.main([*command, "--accept", row]) == arguments.WRONG_INPUT


def test_a_gate_is_started_in_a_repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    fakes.use(tmp_path, monkeypatch)
    suite = start("helpers.fakes:good", Path("gate"))
    assert [row.of for row in read_suite(suite).methods] == ["helpers.fakes:good"]
    workflow = (tmp_path / ".github/workflows/gate.yml").read_text()
    assert "gate --baseline gate/baseline" in workflow and "{{ github.token }}" in workflow
    with pytest.raises(InputError, match="is there already"):
        start("helpers.fakes:good", Path("gate"))


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


def test_times_are_interleaved_with_another_checkout(
    base: Baseline, capture: Path, installed_fakes: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other checkout is this one: what it draws is read back, and what it cannot draw is told."""
    monkeypatch.setattr(against, "ROUNDS", 1)
    entry = next(iter(base.rows.values()))[0]
    tree = tmp_path / "tree"
    tree.mkdir()
    launcher = tree / "ash-bench"
    launcher.write_text(f'#!/bin/sh\nexec {sys.executable} -m benchmarks.cli "$@"\n')
    launcher.chmod(0o755)
    here = replace(entry.cell, capture_folder=capture)
    checks = against.interleaved("row", entry, here, tmp_path / "frozen", tree)
    assert "time of frame" in {check.name for check in checks}
    launcher.write_text("#!/bin/sh\necho it broke >&2\nexit 1\n")
    with pytest.raises(InputError, match=r"tree cannot draw .*: it broke"):
        against.interleaved("row", entry, here, tmp_path / "frozen", tree)
    with pytest.raises(InputError, match="expected a revision that git knows"):
        against.checkout_of("no-such-revision", tmp_path)


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
    def git(*words: str) -> str:
        who = ("-c", "user.name=a", "-c", "user.email=a@b")
        return subprocess.run(["git", *who, *words], cwd=tmp_path, check=True, capture_output=True, text=True).stdout

    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "benchmarks" / "provenance.py"))
    git("init", "-q")
    for name in ("same.py", "edited.py", "committed.py"):
        (tmp_path / name).write_text("1\n")
    git("add", ".")
    git("commit", "-qm", "base")
    base = git("rev-parse", "--short=12", "HEAD").strip()
    assert provenance.changed_since(base) == ()
    (tmp_path / "committed.py").write_text("2\n")
    git("commit", "-qam", "one more")
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
