"""The speed table: who is called how often and in which order, what a ratio refers to, what is counted."""

from pathlib import Path

import pytest

import benchmarks.speed.kernels
from ash.files import read_json
from benchmarks.speed.kernels import SplatDetail, count_pairs, main
from benchmarks.speed.rows import SpeedRow, TimedCandidate, as_json, rows_of, time_interleaved
from benchmarks.speed.scenes import splat_scene


def test_candidates_take_turns_and_the_fast_ones_are_called_more_often() -> None:
    calls: list[str] = []
    slow = TimedCandidate(name="slow", threads=1, call=lambda: calls.append("slow"))
    fast = TimedCandidate(name="fast", threads=2, call=lambda: calls.append("fast"), repeats=3)
    times = time_interleaved([slow, fast], rounds=2)
    assert calls == ["fast", *["slow", "fast", "fast", "fast"] * 2]  # the first call warms up and is not timed
    assert {key: len(samples) for key, samples in times.items()} == {("slow", 1): 2, ("fast", 2): 6}


def test_a_ratio_is_the_first_candidates_minimum_over_the_rows_own() -> None:
    naive, native = rows_of(
        "splat", "S", "forward", {("naive", 1): [40.0, 60.0, 90.0], ("native", 2): [5.0, 4.0, 10.0]}
    )
    assert (naive.ratio, native.ratio) == (1.0, 10.0)
    assert (native.min_ms, native.median_ms) == (4.0, 5.0)
    assert list(as_json(native)) == [
        "what",
        "size",
        "pass",
        "device",
        "threads",
        "candidate",
        "min_ms",
        "median_ms",
        "ratio",
    ]


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
