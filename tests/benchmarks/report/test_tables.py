import math
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from helpers.cells import config

from ash.files import InputError
from benchmarks.analysis.results import COLUMNS, RunTables, csv_of, foreground, load, read_csv, samples_of
from benchmarks.analysis.statistics import independent
from benchmarks.cell.evaluation import read_curve
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.schema import (
    Cell,
    CellResult,
    CurvePoint,
    Provenance,
    Summary,
    Timing,
    ViewScore,
    failed_result,
    read_cell,
    read_result,
    write_config,
    write_result,
)
from benchmarks.report.sentences import doubts
from benchmarks.report.tables import build, quality_columns


def result(method: str = "ash", seed: int = 0, psnr: float = 25.0) -> CellResult:
    rows = (
        Summary(split="novel_view", region="foreground", metric="psnr", value=psnr),
        Summary(split="speed", region="", metric="frame_ms", value=12.5),
    )
    view = ViewScore(
        split="novel_view", camera="a", frame=3, prediction="d" * 64, scores={("foreground", "psnr"): psnr}
    )
    return CellResult(
        config=config(method, seed),
        status="done",
        summary=rows,
        views=(view,),
        timing=Timing(frame_ms=(12.5,), stage_ms={"stg1": (2.0,)}, reference_ms=(5.0,)),
        curve=(CurvePoint(seconds=1.0, loss=0.5, psnr=None),),
        provenance=Provenance(commit="abc", machine={"cores": "2"}, versions={"numpy": "2"}, wall_s=3.0),
    )


def test_a_result_survives_the_disk(tmp_path: Path) -> None:
    write_result(tmp_path, result())
    assert read_result(tmp_path) == result()
    failed = failed_result(config(), "timeout", "too slow")
    write_result(tmp_path, failed)
    assert read_result(tmp_path) == failed
    assert read_result(tmp_path / "elsewhere") is None


def test_not_a_number_is_never_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        write_result(tmp_path, result(psnr=math.nan))
    assert not (tmp_path / "result.json").exists()


def test_a_cell_survives_the_disk_and_its_key_is_checked(tmp_path: Path) -> None:
    cell = Cell(config=config(), folder=tmp_path / "cell", capture_folder=tmp_path)
    write_config(cell)
    assert read_cell(cell.folder) == cell
    path = cell.folder / "config.json"
    path.write_text(path.read_text().replace('"seed": 0', '"seed": 1'))
    with pytest.raises(InputError, match="key does not fit"):
        read_cell(cell.folder)


def test_every_input_changes_the_key() -> None:
    base = config()
    changed = [config("ddc"), config(seed=1)]
    assert len({c.key for c in (base, *changed)}) == 3
    assert config().key == base.key


def test_results_csv_has_the_stable_columns_and_all_digits(tmp_path: Path) -> None:
    made = load([result(psnr=1 / 3), failed_result(config("ddc"), "crashed", "")])
    (tmp_path / "results.csv").write_text(csv_of(made))
    table = pd.read_csv(tmp_path / "results.csv", keep_default_na=False)
    header = "scene,method,seed,split,region,metric,value,unit,direction,protocol,subject,capture"
    assert ",".join(table.columns) == header == ",".join(COLUMNS)
    row = table[(table.method == "ash") & (table.metric == "psnr")].iloc[0]
    assert (row["value"], row["unit"], row["direction"], str(row["protocol"])) == (1 / 3, "dB", "up", "3")
    assert set(table.metric) <= set(METRICS)
    failed = table[table.method == "ddc"]
    assert failed[failed.metric == "failed"]["value"].item() == 1
    assert failed[failed.metric == "psnr"]["value"].max() == 0
    pd.testing.assert_frame_equal(read_csv(tmp_path / "results.csv"), made, check_dtype=False)


def test_several_captures_of_a_scene_are_the_unit_and_their_seeds_are_averaged() -> None:
    values = {0: (24.0, 26.0), 1: (27.0, 29.0)}
    results = [
        replace(result(seed=seed, psnr=psnr), config=replace(config(seed=seed), subject=subject))
        for subject, scores in values.items()
        for seed, psnr in enumerate(scores)
    ]
    tables = RunTables(results)
    assert list(tables.rows["subject"].unique()) == [0, 1]
    assert list(tables.rows["capture"].unique()) == ["loose-ci-0", "loose-ci-0-subject1"]
    samples = samples_of(tables.of("loose"), foreground())["ash"]
    assert independent(samples) == [25.0, 28.0] and tables.captures("loose") == 2
    assert tables.get("loose", "ash", foreground()).n == 2


def test_a_mean_over_fewer_people_says_so_and_is_not_ranked() -> None:
    results = [
        replace(result(psnr=psnr), config=replace(config(method), subject=subject))
        for method, scores in {"ash": (24.0, 26.0, 27.0), "ddc": (23.0, 24.0, 25.0), "wo_mot": (29.0, 30.0)}.items()
        for subject, psnr in enumerate(scores)
    ]
    table = build(RunTables(results), "loose", quality_columns(("psnr",)), title="")
    assert [(name, mark) for name, ((_, mark),) in table.rows] == [
        ("ASH", "best"),
        ("DDC", "second"),
        ("w/o mot. (2 of 3 people)", ""),
    ]


def test_scores_are_means_with_students_interval() -> None:
    tables = RunTables([result(seed=seed, psnr=psnr) for seed, psnr in enumerate((24.0, 25.0, 27.0))])
    score = tables.get("loose", "ash", foreground())
    assert score is not None and score.n == 3
    assert score.value == pytest.approx(76 / 3)
    assert score.half_width == pytest.approx(4.302653 * math.sqrt(7 / 3 / 3), rel=1e-5)  # t of 2 degrees of freedom
    assert math.isnan(RunTables([result()]).get("loose", "ash", foreground()).half_width)
    assert tables.get("loose", "ddc", foreground()) is None


def test_a_curve_passes_over_what_is_no_point(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    rows = ['{"seconds": 2, "train_psnr": 20.5, "loss": 0.1}', "not json", "[1]", '{"event": "warm-up"}']
    rows += ['{"seconds": 1, "loss": 0.2}', '{"seconds": NaN, "loss": 1}', '{"seconds": 3, "lo']
    log.write_text("\n".join(rows))
    first, second = CurvePoint(seconds=1.0, loss=0.2, psnr=None), CurvePoint(seconds=2.0, loss=0.1, psnr=20.5)
    assert read_curve(log) == (first, second)
    log.write_text("\n".join(f'{{"seconds": {i}, "loss": 1}}' for i in range(5000)))
    curve = read_curve(log)
    assert len(curve) <= 201 and curve[-1].seconds == 4999
    assert read_curve(tmp_path / "none") == ()


def test_what_was_not_enforced_and_clocks_that_contradict_are_told() -> None:
    def trained(wall: float, cpu: float, *, isolated: bool | None) -> CellResult:
        rows = [
            Summary(split="speed", region="", metric=name, value=value)
            for name, value in (("train_wall_s", wall), ("train_cpu_s", cpu))
        ]
        return replace(result(), summary=(*result().summary, *rows), isolated=isolated)

    assert doubts([trained(100.0, 98.0, isolated=True), trained(4.0, 0.5, isolated=True), result()]) == ()
    (stopped,) = doubts([trained(160.0, 100.0, isolated=True)])
    assert "160 s by the clock and 100 s of CPU time" in stopped and "stopped" in stopped
    (several,) = doubts([trained(100.0, 190.0, isolated=None)])
    assert "more than one core" in several
    exposed, *others = doubts([trained(100.0, 98.0, isolated=False)])
    assert exposed.startswith("Not isolated: ASH.") and not others
    oracle = replace(result(), config=replace(result().config, method="ash_truth"), isolated=False)
    assert doubts([oracle]) == (), "an oracle is given the truth"
    columns = quality_columns(("psnr",))
    plain, marked = (
        build(RunTables([result()]), "loose", columns, title="", exposed=exposed) for exposed in ((), ("ash",))
    )
    assert (plain.frame.index[0], marked.frame.index[0]) == ("ASH", "ASH (not isolated)")


def test_texts_of_a_result_cannot_steer_the_terminal(tmp_path: Path) -> None:
    ends = replace(
        result(),
        reason="no\n\x1b[2Jimage",
        provenance=Provenance(commit="a\x07", machine={"c\r": "\x9b"}, versions={}, wall_s=1.0),
    )
    write_result(tmp_path, ends)
    read = read_result(tmp_path)
    assert read.reason == "no  [2Jimage"
    assert (read.provenance.commit, read.provenance.machine) == ("a ", {"c ": " "})


def test_an_unknown_metric_is_one_line(tmp_path: Path) -> None:
    write_result(tmp_path, result())
    path = tmp_path / "result.json"
    path.write_text(path.read_text().replace('"metric": "psnr"', '"metric": "psrn"'))
    with pytest.raises(InputError, match=r"result\.json: .*unknown metric 'psrn', did you mean psnr\?"):
        read_result(tmp_path)
