"""The speed table: the order of calls, what a ratio refers to, the pairs of a pixel and a splat."""

from pathlib import Path

import pytest

import benchmarks.speed.kernels
from ash.files import read_json
from benchmarks.speed.kernels import SplatDetail, count_pairs, main, splat_scene
from benchmarks.speed.timing import WHOLE, Candidate, SpeedRow, as_json, rows_of, time_interleaved


def test_candidates_are_interleaved_and_the_fast_ones_are_called_more_often() -> None:
    calls: list[str] = []

    def candidate(name: str, repeats: int) -> Candidate:
        return Candidate(
            name=name,
            threads=repeats,
            before=lambda number: calls.append(f"before {number}"),
            call=lambda number: calls.append(name) or {"stage": 7.0},
            repeats=repeats,
        )

    samples = time_interleaved([candidate("slow", 1), candidate("fast", 2)], rounds=2)
    assert [call for call in calls if "before" not in call] == ["fast", *["slow", "fast", "fast"] * 2], "one warms up"
    assert calls[:4] == ["before 0", "fast", "before 0", "slow"]
    assert {key: len(stages[WHOLE]) for key, stages in samples.items()} == {("slow", 1): 2, ("fast", 2): 4}
    assert samples["fast", 2]["stage"] == [7.0] * 4


def test_a_ratio_is_the_first_candidates_minimum_over_the_rows_own() -> None:
    samples = {("naive", 1): {WHOLE: [40.0, 60.0, 90.0]}, ("native", 2): {WHOLE: [5.0, 4.0, 10.0], "part": [1.0]}}
    naive, native, part = rows_of("splat", "S", "forward", samples)
    assert (naive.ratio, native.ratio) == (1.0, 10.0)
    assert (native.min_ms, native.median_ms, part.what) == (4.0, 5.0, "part")
    columns = ["what", "size", "pass", "device", "threads", "candidate", "min_ms", "median_ms", "ratio"]
    assert list(as_json(native)) == columns
    assert as_json(part)["ratio"] is None


def test_pairs_are_counted_as_the_definition_blends_them() -> None:
    scene = splat_scene("S")
    covered, pairs = count_pairs(scene)
    alpha = benchmarks.speed.kernels.splat(
        scene.gaussians, viewmats=scene.viewmats, Ks=scene.Ks, width=scene.width, height=scene.height
    ).alpha
    assert covered == pytest.approx(float((alpha > 0).float().mean()), abs=1e-4)
    assert pairs > covered * scene.width * scene.height


def test_the_table_and_its_json_say_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    results = list(benchmarks.speed.kernels.time_splat(splat_scene("S"), rounds=1, threads=(1,)))
    monkeypatch.setattr(benchmarks.speed.kernels, "speed_kernels", lambda device: iter(results))
    assert main(tmp_path / "speed.json") == 0
    written = read_json(tmp_path / "speed.json")
    rows = [row for result in results if isinstance(result, list) for row in result]
    assert written["rows"] == [as_json(row) for row in rows]
    assert [(row.pass_, row.candidate) for row in rows] == [
        (pass_, candidate) for pass_ in ("forward", "forward+backward") for candidate in ("naive", "native")
    ]
    printed = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("splat ") for line in printed) == len(rows)
    detail = next(result for result in results if isinstance(result, SplatDetail))
    total = sum(detail.stages_ms.values())
    both = next(row for row in rows if (row.pass_, row.candidate) == ("forward+backward", "native"))
    assert 0 < total <= both.median_ms * 1.5
    assert all(isinstance(row, SpeedRow) and row.min_ms <= row.median_ms for row in rows)
