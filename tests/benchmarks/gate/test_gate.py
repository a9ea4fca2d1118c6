import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.hostile import HOSTILE, Text
from markdown_it import MarkdownIt

from ash.files import InputError
from benchmarks import provenance
from benchmarks.cell.metrics import PROTOCOL
from benchmarks.cell.registry import methods
from benchmarks.cell.schema import CellConfig, CellResult, Summary, Timing, ViewScore, failed_result
from benchmarks.gate import summary
from benchmarks.gate.gate import (
    TIMED_AGAIN,
    Check,
    judge,
    judge_with_retries,
    junit,
    markdown,
    read_baseline,
    replacement,
    summarise,
    write_baseline,
)
from benchmarks.gate.summary import terminal
from benchmarks.report import escaping


def result(
    seed: int, *, psnr: float, ms: float = 10.0, mb: float = 400.0, params: float = 1000.0, train_s: float = 8.0
) -> CellResult:
    config = CellConfig(
        scene="boxes", size="ci", capture_seed=0, capture="c", method="ash", preset="ci", seed=seed, code="0", truth="t"
    )
    rows = [
        Summary(split=split, region="foreground", metric="psnr", value=psnr) for split in ("novel_view", "novel_pose")
    ]
    rows += [
        Summary(split="memory", region="", metric="params", value=params),
        Summary(split="memory", region="", metric="peak_rss_mb", value=mb),
        Summary(split="speed", region="", metric="train_s", value=train_s),
    ]
    view = ViewScore(split="novel_view", camera="a", frame=0, prediction=f"{psnr}", scores={})
    timing = Timing(frame_ms=(ms * 1.1, ms), stage_ms={"stg4": (ms / 2,), "stg1": (0.01,)}, reference_ms=(5.0, 6.0))
    return CellResult(config=config, status="done", summary=tuple(rows), views=(view,), timing=timing)


def run(psnrs: list[float], **costs: float) -> list[CellResult]:
    return [result(seed, psnr=psnr, **costs) for seed, psnr in enumerate(psnrs)]


BASE = summarise("ci", run([25.0, 25.1, 24.9, 25.05, 24.95]))


def verdicts(results: list[CellResult]) -> dict[str, str]:
    return {check.what.split(": ")[1]: check.verdict for check in judge(BASE, summarise("ci", results))}


def test_identical_predictions_pass_at_once() -> None:
    found = judge(BASE, summarise("ci", run([25.0, 25.1, 24.9, 25.05, 24.95])))
    assert {check.verdict for check in found} == {"pass"}
    assert found[0].detail == "identical predictions"


def test_lpips_is_judged_where_it_can_be_measured() -> None:
    def scored(lpips: list[float]) -> list[CellResult]:
        rows = [Summary(split="novel_view", region="full", metric="lpips", value=value) for value in lpips]
        results = run([25.0 + 0.01 * value for value in range(len(lpips))])
        return [replace(r, summary=(*r.summary, row)) for r, row in zip(results, rows, strict=True)]

    base = summarise("ci", scored([12.0, 12.1, 11.9, 12.05]))
    name = "novel_view/full/lpips"
    for values, verdict in (([17.0, 17.1, 16.9], "fail"), ([12.0, 12.2, 11.9], "pass")):
        checks = {check.what.split(": ")[1]: check.verdict for check in judge(base, summarise("ci", scored(values)))}
        assert checks[name] == verdict
    without = {check.what.split(": ")[1]: check for check in judge(base, summarise("ci", run([25.0, 25.2])))}
    assert (without[name].verdict, without[name].detail) == ("not judged", "n/a: no weights for LPIPS here")


def test_a_loss_beyond_margin_and_chance_fails_and_a_small_one_does_not() -> None:
    assert verdicts(run([24.4, 24.5, 24.45]))["novel_view/foreground/psnr"] == "fail"
    assert verdicts(run([24.97, 25.06, 24.93]))["novel_view/foreground/psnr"] == "pass"
    assert verdicts(run([24.0, 25.9, 24.1]))["novel_view/foreground/psnr"] == "pass", "large, but it may be chance"


def test_a_rise_is_flagged_too() -> None:
    assert verdicts(run([26.4, 26.5, 26.45]))["novel_view/foreground/psnr"] == "unexplained improvement"


def test_costs() -> None:
    same = [25.0, 25.1, 24.9]
    assert verdicts(run(same, ms=12.0))["time of frame"] == "fail"
    assert verdicts(run(same, ms=11.0))["time of frame"] == "pass"
    assert "time of stg1" not in verdicts(run(same, ms=12.0)), "too short to be timed"
    assert verdicts(run(same, mb=800.0))["peak memory"] == "fail"
    assert verdicts(run(same, params=1001.0))["params"] == "fail"


@pytest.mark.parametrize(("quiet_at", "asked", "verdict"), [(0, 0, "pass"), (3, 3, "pass"), (99, TIMED_AGAIN, "fail")])
def test_a_time_that_fails_is_measured_again_before_it_is_believed(quiet_at: int, asked: int, verdict: str) -> None:
    def ms(attempt: int) -> float:
        return 10.0 if attempt >= quiet_at else 15.0

    def again(slow: Collection[tuple[str, str]], attempt: int) -> list[CellResult]:
        assert set(slow) == {("boxes", "ash")}
        calls.append(attempt)
        return [result(3 + attempt, psnr=0.0, ms=ms(attempt + 1))]

    calls: list[int] = []
    head, checks = judge_with_retries(BASE, "ci", run([25.0, 25.1, 24.9], ms=ms(0)), again)
    assert calls == list(range(asked))
    assert {check.verdict for check in checks if check.name in ("frame", "stg4")} == {verdict}
    assert len(head.entries[0].seeds) == 3, "of the others nothing counts but their times"


def test_training_time_is_judged_both_ways() -> None:
    found = {
        train_s: verdicts(run([25.0, 25.1, 24.9], train_s=train_s))["time of training"] for train_s in (4.0, 8.5, 11.0)
    }
    assert found == {4.0: "unexplained improvement", 8.5: "pass", 11.0: "fail"}


def test_on_another_machine_qualities_are_judged_and_costs_are_not() -> None:
    worse = run([24.4, 24.5, 24.45], ms=30.0, mb=900.0)
    rendered_there = [replace(r, config=replace(r.config, capture="other bytes")) for r in worse]
    checks = judge(BASE, replace(summarise("ci", rendered_there), machine="another"))
    found = {check.what.split(": ")[1]: check.verdict for check in checks}
    assert found["novel_view/foreground/psnr"] == "fail" and found["memory and times"] == "not judged"
    assert "peak memory" not in found and "time of frame" not in found and found["params"] == "pass"
    suite = ElementTree.fromstring(junit(checks).split("\n", 1)[1])
    assert len(suite.findall("testcase/skipped")) == 1 == int(suite.attrib["skipped"])


def test_failed_and_missing_cells() -> None:
    failed = [*run([25.0, 25.1]), failed_result(result(2, psnr=0.0).config, "diverged", "nan")]
    assert verdicts(failed)["came through"] == "fail"
    both, ash = two({PLACES[0]: GOOD, PLACES[1]: GOOD}), two({PLACES[0]: GOOD})
    missing = judge(summarise("ci", both), summarise("ci", ash))
    assert [(c.what, c.verdict) for c in missing if c.kind == "presence"] == [("boxes · ddc: present", "fail")]
    crashed = [failed_result(r.config, "crashed", "") for r in run([25.0, 25.1, 24.9])]
    assert verdicts(crashed) == {"came through": "fail"}


def test_a_row_that_the_baseline_lacks_is_named_and_not_judged() -> None:
    base, head = summarise("ci", two({PLACES[0]: GOOD})), summarise("ci", two({PLACES[0]: GOOD, PLACES[1]: WORSE}))
    checks = judge(base, head)
    assert [c.what for c in checks if c.verdict == "not judged"] == ["boxes · ddc: present"]
    assert "Not judged: boxes · ddc: the baseline has no results of this row" in terminal(base, head, checks, ())


def test_a_gate_that_compares_nothing_is_refused() -> None:
    other = summarise("ci", two({PLACES[1]: GOOD}))
    crashed = summarise("ci", [failed_result(r.config, "crashed", "") for r in run([25.0, 25.1])])
    for base, head, said in (
        (replace(BASE, entries=()), BASE, "the baseline has no finished cell; the run has boxes · ash"),
        (BASE, other, "the baseline has boxes · ash; the run has boxes · ddc"),
        (crashed, crashed, "the baseline has no finished cell"),
    ):
        with pytest.raises(InputError, match=f"^nothing was compared: {said}"):
            judge(base, head)


def test_a_baseline_is_not_made_of_failed_cells_and_loses_no_row_silently(tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    half = [*run([25.0, 25.1]), failed_result(result(2, psnr=0.0).config, "crashed", "killed")]
    with pytest.raises(InputError, match="needs cells that are done, and cells of boxes · ash failed"):
        replacement(path, summarise("ci", half))
    both, ash = summarise("ci", two(dict.fromkeys(PLACES, GOOD))), summarise("ci", two({PLACES[0]: GOOD}))
    assert replacement(path, ash) == ash
    write_baseline(path, both)
    with pytest.raises(InputError, match="holds boxes · ddc, cones · ash, cones · ddc, which this run lacks"):
        replacement(path, ash)
    write_baseline(path, ash)
    assert replacement(path, both) == both


def test_another_capture_cannot_be_compared() -> None:
    other = [replace(r, config=replace(r.config, truth="d")) for r in run([25.0, 25.1])]
    assert verdicts(other)["capture"] == "fail"


def test_one_seed_is_believed_only_when_it_is_far_off() -> None:
    assert verdicts(run([24.6]))["novel_view/foreground/psnr"] == "pass"
    assert verdicts(run([24.0]))["novel_view/foreground/psnr"] == "fail"


def test_false_alarms_of_the_rule() -> None:
    """Unchanged code with other seeds raises few alarms; a loss of 0.6 dB at a spread of 0.1 is found."""
    rng = np.random.default_rng(0)
    alarms = found = 0
    rounds = 200
    for _ in range(rounds):
        base = summarise("ci", run(list(rng.normal(25, 0.1, 6))))
        same = summarise("ci", run(list(rng.normal(25, 0.1, 3))))
        worse = summarise("ci", run(list(rng.normal(24.4, 0.1, 3))))
        alarms += any(check.verdict != "pass" for check in judge(base, same))
        found += any(check.verdict == "fail" for check in judge(base, worse))
    assert alarms / rounds < 0.05
    assert found / rounds > 0.9


def test_a_baseline_survives_the_disk_and_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    write_baseline(path, BASE)
    assert read_baseline(path) == BASE
    whole = path.read_text()
    path.write_text(whole.replace(f'"protocol": "{PROTOCOL}"', '"protocol": "0"'))
    with pytest.raises(InputError, match=f"expected protocol {PROTOCOL}, got '0'"):
        read_baseline(path)
    for damaged in (whole[:200], "[]", whole.replace("qualities", "quality")):
        path.write_text(damaged)
        with pytest.raises(InputError, match=r"baseline\.json"):
            read_baseline(path)
    with pytest.raises(InputError, match="suite ci"):
        judge(BASE, replace(BASE, suite="quick"))


def test_the_committed_baseline_can_be_read() -> None:
    baseline = read_baseline(Path(__file__).parents[3] / "reports" / "baseline.json")
    assert baseline.suite == "ci"
    assert all(len(entry.seeds) == 3 and not entry.failed and entry.times for entry in baseline.entries)


def two(psnrs: dict[tuple[str, str], list[float]], **costs: float) -> list[CellResult]:
    """Results of several methods on several scenes."""
    return [
        replace(r, config=replace(r.config, scene=scene, method=method))
        for (scene, method), values in psnrs.items()
        for r in run(values, **costs)
    ]


GOOD, WORSE = [25.0, 25.1, 24.9, 25.05, 24.95], [24.0, 24.1, 23.9, 24.05, 23.95]
PLACES = [("boxes", "ash"), ("boxes", "ddc"), ("cones", "ash"), ("cones", "ddc")]


@pytest.mark.parametrize(
    ("moved", "said", "suspect"),
    [
        ([PLACES[1], PLACES[3]], "one method of 2 (ddc), on all 2 scenes, in quality", "baselines/ddc.py"),
        ([("cones", "ash"), ("cones", "ddc")], "all 2 methods, on one scene of 2 (cones), in quality", "synth/"),
        (PLACES, "all 2 methods, on all 2 scenes, in quality", "benchmarks/cell/"),
    ],
)  # fmt: skip
def test_the_terminal_says_what_moved_and_where_to_look(moved: list[tuple[str, str]], said: str, suspect: str) -> None:
    base = summarise("ci", two(dict.fromkeys(PLACES, GOOD)))
    head = summarise("ci", two({place: WORSE if place in moved else GOOD for place in PLACES}))
    checks = judge(base, head)
    changed = ("README.md", "baselines/ddc.py", "synth/posing.py", "benchmarks/cell/metrics.py")
    lines = terminal(base, head, checks, changed).splitlines()
    assert lines[0] == lines[-1] and lines[0].startswith("gate: FAILED")
    assert any(line.startswith(f"What changed: {said}") for line in lines)
    near = [line.removeprefix("  * ") for line in lines if line.startswith("  * ")]
    assert any(name.startswith(suspect) for name in near)
    assert len(near) == (2 if moved == PLACES else 1), "what all methods share is suspect where all scenes moved"
    assert not any("README" in line for line in lines)
    bad = next(line for line in lines if line.startswith("  fail"))
    assert "25 -> 24 dB" in bad and "detectable from" in bad


def test_the_terminal_knows_time_from_quality_and_good_from_bad() -> None:
    slow = summarise("ci", run([25.0, 25.1, 24.9, 25.05, 24.95], ms=20.0))
    text = terminal(BASE, slow, judge(BASE, slow), None)
    assert "in time" in text and "ash/gaussians/" in text and "+100%" in text and "not known here" in text
    better = summarise("ci", run([26.4, 26.5, 26.45]))
    assert "a leak looks like progress" in terminal(BASE, better, judge(BASE, better), ())
    text = terminal(BASE, BASE, judge(BASE, BASE), ())
    assert text.splitlines()[0] == text.splitlines()[-1] == "gate: passed, 6 checks"
    assert "identical predictions" in text and "What changed" not in text


def test_the_smallest_visible_change_is_seen() -> None:
    """A loss twice what the gate says that it would see is found nearly always."""
    rng = np.random.default_rng(1)
    base = summarise("ci", run(list(rng.normal(25, 0.1, 5))))
    trial = judge(base, summarise("ci", run(list(rng.normal(25, 0.1, 5)))))
    detail = next(check.detail for check in trial if check.name == "novel_view/foreground/psnr")
    smallest = float(detail.split("detectable from ")[1].split()[0])
    found = 0
    for _ in range(50):
        head = summarise("ci", run(list(rng.normal(25 - 2 * smallest, 0.1, 5))))
        found += any(check.verdict == "fail" for check in judge(base, head))
    assert smallest < 1 and found >= 45


def test_every_source_that_is_named_exists() -> None:
    root = Path(__file__).parents[3]
    named = {name for places in summary.STAGES.values() for name in places}
    named |= {*summary.TEMPLATE, *summary.MAKING_SCENES, *summary.SHARED, *summary.SOURCES}
    for method in methods():
        places = summary.sources_of(method)
        assert len(places) == (1 if places[0] == "ash/" else 2), method
        named |= set(places)
    assert {"ash/", "baselines/ddc.py", "ash/training/"} <= named
    assert [name for name in sorted(named) if not (root / name).exists()] == []
    assert summary.sources_of("a row of the user's") == ("the method's own sources",)


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


def test_summary_and_junit() -> None:
    head = summarise("ci", run([24.4, 24.5, 24.45], mb=800.0))
    checks = [*judge(BASE, head), Check(what="a: <b> & c", verdict="pass", detail="")]
    text = markdown(BASE, head, checks)
    assert "3 of" in text and "peak memory" in text
    suite = ElementTree.fromstring(junit(checks).split("\n", 1)[1])
    assert int(suite.attrib["tests"]) == len(checks) == len(suite)
    assert int(suite.attrib["failures"]) == 3 == len(suite.findall("testcase/failure"))


@pytest.mark.parametrize("text", HOSTILE)
def test_names_and_details_are_texts_in_every_form(text: str) -> None:
    words = " ".join(escaping.one_line(text).split())
    machine = replace(BASE, suite=text, commit=text, machine=text)
    checks = [Check(what=f"{text}: {text}", verdict=verdict, detail=text) for verdict in ("pass", "fail", "not judged")]
    reader = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    page = Text(reader.render(markdown(machine, machine, checks)))
    ours = {"h2", "p", "strong", "details", "summary", "table", "thead", "tbody", "tr", "th", "td"}
    assert set(page.tags) <= ours and page.tags.count("td") == 3 * (1 + len(checks))
    assert " ".join(page.text.split()).count(words) >= 2 * len(checks)
    suite = ElementTree.fromstring(junit(checks).split("\n", 1)[1])
    assert len(suite) == 3 and all(f"{e.get('classname')}: {e.get('name')}" == words_of(text) for e in suite)
    assert suite[1][0].text == suite[2][0].get("message") == escaping.one_line(text)
    shown = terminal(machine, machine, checks, None)
    assert all(line.isprintable() or not escaping.CONTROLS.search(line) for line in shown.split("\n"))


def words_of(text: str) -> str:
    """How the title of a check is split and put together again."""
    group, _, name = f"{text}: {text}".partition(": ")
    return f"{escaping.one_line(group)}: {escaping.one_line(name)}"
