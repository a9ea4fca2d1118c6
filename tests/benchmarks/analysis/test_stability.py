"""Stress axes, breakdown points and the margin against the template's error."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import cache
from pathlib import Path

import pandas as pd
import pytest
from helpers.cells import cell, people
from helpers.fakes import write_capture

from ash.capture.dataset import Split
from ash.capture.formats import load_capture
from ash.capture.manifest import verify_capture
from ash.files import InputError
from benchmarks.analysis import stability, template_error
from benchmarks.analysis.results import RunTables, load
from benchmarks.cell.registry import configured, offered
from benchmarks.cell.schema import CellResult, failed_result
from benchmarks.report import sections, vega
from benchmarks.report.charts import _number_axis
from benchmarks.report.content import Table
from benchmarks.report.vega import Figure
from benchmarks.suites import captures
from benchmarks.suites.dry_run import estimate
from benchmarks.suites.files import find_suite
from benchmarks.suites.runs import RunOptions
from benchmarks.suites.stress import AXES, FOOTAGE_FRAMES, Stress
from benchmarks.suites.suites import CaptureSpec

MASKS = Path(__file__).parents[2] / "data" / "masks.toml"


our_suite = cache(find_suite)  # Reading one takes seconds.


def severities_of(axis: str) -> list[float]:
    """The steps that our suites take along an axis."""
    stresses = (*our_suite("stability").stresses, *our_suite("motions").stresses)
    return [stress.severity for stress in stresses if stress.axis == axis]


def course(levels: tuple[float, ...]) -> list[CellResult]:
    """Three seeds of a method along the camera axis, a tenth of a decibel apart, and the trivial baseline at 10 dB."""
    severities = (0.0, *severities_of("cameras"))
    found = [cell("nearest", 10.0)]
    for severity, level in zip(severities, levels, strict=True):
        axis = "cameras" if severity else ""
        found += [cell("ash", level + 0.1 * seed, seed=seed, axis=axis, severity=severity) for seed in range(3)]
    return found


def on_views(table: pd.DataFrame) -> pd.DataFrame:
    """What a table has of ASH on novel views."""
    return table.query("method == 'ash' and split == 'novel_view'")


def breakdown(results: list[CellResult]) -> float:
    """That of ASH on novel views."""
    return on_views(stability.breakdowns(stability.losses(load(results))))["breakdown"].item()


def test_a_method_breaks_where_its_interval_is_below_half_way_to_the_trivial_baseline() -> None:
    """At 50 % the mean, 20.0, lies below the midpoint of 30.1 and 10, but not its interval."""
    results = course((30.0, 26.0, 19.9, 12.0))
    assert on_views(stability.losses(load(results)))["mean"].tolist() == pytest.approx([4.0, 10.1, 18.0])
    assert breakdown(results) == 75.0
    assert pd.isna(breakdown(course((30.0, 26.0, 25.0, 24.0))))
    without = course((30.0, 26.0, 19.0, 12.0))[1:]
    assert on_views(stability.losses(load(without)))["distance"].isna().all(), "no trivial baseline was run"
    assert pd.isna(breakdown(without))


def test_people_who_differ_more_than_a_defect_costs_are_compared_with_themselves() -> None:
    """People are 10 dB apart; each loses about 6 of the 10 dB to the baseline, and is broken."""
    clean = people({"ash": (20.0, 30.0, 40.0), "nearest": (10.0, 20.0, 30.0)})
    worse = people({"ash": (14.0, 24.1, 33.9)})
    results = [*clean, *(replace(r, config=replace(r.config, axis="lens", severity=12.0)) for r in worse)]
    names = {r.config.key: f"{r.config.subject}-{r.config.axis}" for r in results}  # as the folders of captures differ
    rows = load(results, names)
    (loss,) = on_views(stability.losses(rows)).itertuples()
    assert (loss.mean, loss.low, loss.high) == pytest.approx((6.0, 6 - 0.248, 6 + 0.248), abs=1e-3)  # t(2) is 4.30
    assert loss.distance == pytest.approx(-1 + 0.248, abs=1e-3)
    on_axis = on_views(stability.steps(rows))
    assert on_axis["psnr"].tolist() == [30.0, 24.0]
    assert (on_axis["high"] - on_axis["low"]).max() < 0.5
    assert breakdown(results) == 12.0


def test_a_failed_cell_is_the_worst_score_and_counts_in_the_rate() -> None:
    results = course((30.0, 26.0, 25.0, 24.0))
    last = next(i for i, r in enumerate(results) if r.config.severity == 75.0)
    results[last] = failed_result(results[last].config, "diverged", "NaN")
    steps = stability.steps(load(results)).query("method == 'ash' and split == 'novel_view'")
    assert steps["psnr"].iloc[-1] == pytest.approx((24.1 + 24.2) / 3)
    row = stability.reliability(load(results), "loose").set_index("method").loc["ash"]
    assert (row.failures, row.cells, row.diverged) == (1, 12, 1)
    assert row.low < 1 / 12 < row.high and row.spread_db == pytest.approx(0.1)


def test_perturbed_captures_do_not_reach_the_tables() -> None:
    assert set(RunTables(course((30.0, 26.0, 19.9, 12.0))).rows["axis"]) == {""}


def test_the_margin_is_read_off_templates_of_known_error() -> None:
    pairs = {"ash_truth": 30.0, "ddc_truth": 31.0, "ash_4mm": 27.0, "ddc_4mm": 26.0, "ash_16mm": 24.0, "ddc_16mm": 16.0}
    results = [cell(method, psnr, seed=seed) for method, psnr in pairs.items() for seed in range(3)]
    own = {"ash": 26.0, "ddc": 24.5, "by_scans": 26.5, "ddc_by_scans": 25.5}
    results += [cell(method, psnr, seed=seed) for method, psnr in own.items() for seed in range(3)]
    tables = RunTables(results)
    found = template_error.margins(tables).query("split == 'novel_view'")
    planted = found[found["template"] == template_error.PLANTED]
    assert list(zip(planted["error_mm"], planted["mean"], strict=True)) == [(0.0, -1.0), (4.0, 1.0), (16.0, 8.0)]
    learned = found[found["template"] != template_error.PLANTED]
    assert learned[["template", "error_mm", "mean"]].to_numpy().tolist() == [["images", 5.0, 1.5], ["scans", 5.0, 1.0]]
    assert template_error.error_at(planted, 0.0) == pytest.approx(2.0)
    assert template_error.error_at(planted, 7.4) == pytest.approx(4 + 12 * 6.4 / 7)
    assert template_error.interpolated(planted["error_mm"], planted["mean"], 5.0) == pytest.approx(1 + 7 / 12)
    assert template_error.interpolated(planted["error_mm"], planted["mean"], 17.0) is None
    said = template_error.sentences(tables, template_error.margins(tables))
    assert "the two are equal at 2.0 mm" in said[0] and "the paper's +7.4 dB is reached at" in said[0]
    assert "learned from images (5.0 mm) it is +1.5 dB, on a planted error of that size +1.6 dB" in said[0]
    assert "ASH 26.0 dB at 5.0 mm (26.8)" in said[2]
    assert not len(template_error.margins(RunTables(results[:6]))), "two planted errors are needed"


def test_quality_on_templates_of_known_error_has_a_curve_per_method_and_shows_no_failed_one() -> None:
    known = {"ash_truth": 30.0, "ddc_truth": 31.0, "oracle_texture": 29.0, "ash_4mm": 27.0, "ddc_4mm": 26.0}
    results = [cell(method, psnr, seed=seed) for method, psnr in known.items() for seed in range(3)]
    results += [failed_result(cell("texture_4mm", 20.0).config, "diverged", "NaN")]
    tables = RunTables(results)
    views = template_error.levels(tables).query("split == 'novel_view'")
    found = {m: list(zip(own["error_mm"], own["psnr"], strict=True)) for m, own in views.groupby("method")}
    expected = {"ash_truth": [(0.0, 30.0), (4.0, 27.0)], "ddc_truth": [(0.0, 31.0), (4.0, 26.0)]}
    assert found == {**expected, "oracle_texture": [(0.0, 29.0)]}
    (section,) = sections.template_errors(tables)
    levels = next(block for block in section.blocks if isinstance(block, Figure))
    assert levels.file == "chart_levels.svg"
    assert "best texture, exact mesh" in "".join(ElementTree.fromstring(levels.svg()).itertext())


def test_curves_on_known_errors_leave_out_how_people_differ() -> None:
    """People are 6 dB apart, and the error costs each of them 3 dB: nothing but that is left."""
    tables = RunTables(people({"ash_truth": (24.0, 30.0, 36.0), "ash_4mm": (21.0, 27.0, 33.0)}))
    views = template_error.levels(tables).query("split == 'novel_view'")
    assert views[["psnr", "low", "high"]].to_numpy().tolist() == [pytest.approx([30.0] * 3), pytest.approx([27.0] * 3)]


def test_ticks_that_would_lie_on_each_other_give_way_to_the_rounder_one() -> None:
    """A learned template of 7.81 mm beside a planted error of 8 mm: two labels, one place."""
    axis = _number_axis(pd.Series([0.0, 7.812, 4.0, 5.371, 8.0]), "template error", log=False).to_dict()["axis"]
    assert axis == {"values": [0.0, 4.0, 5.371, 8.0], "format": ".3~g"}


def test_charts_are_svg_with_a_mark_where_a_method_breaks() -> None:
    (section,) = sections.stabilities(RunTables(course((30.0, 26.0, 12.0, 11.0))))
    figures = [block for block in section.blocks if isinstance(block, Figure)]
    assert [figure.file for figure in figures] == ["chart_stability_loose_0.svg", "chart_stability_loose_1.svg"]
    for figure in figures:
        drawn = ElementTree.fromstring(figure.svg())
        crosses = [path for path in drawn.iter("{http://www.w3.org/2000/svg}path") if path.get("stroke") == vega.INK]
        assert drawn.tag.endswith("svg") and len(crosses) == 1
    losses = next(block for block in section.blocks if isinstance(block, Table))
    title = "training cameras missing: 50 %"
    assert losses.frame.loc[title].tolist() == ["18.0 [17.8, 18.2], broken"]


def test_a_row_of_another_suite_stands_beside_ash() -> None:
    """Named and placed as one of ours, and broken by itself."""
    results = [cell("nearest", 10.0)]
    for method, worst in {"ash": 12.0, "ash_plus": 29.0}.items():
        results += [cell(method, 30.0), cell(method, worst, axis="mask_grown", severity=8.0)]
    (section,) = sections.stabilities(RunTables(results))
    views, poses, reliability = (block for block in section.blocks if isinstance(block, Table))
    assert list(views.frame.columns) == ["ASH", "ASH+"]
    assert views.frame.loc["masks too large: 8 px"].tolist() == ["18.0, broken", "1.0"]
    assert poses.frame.to_dict() == views.frame.to_dict()
    assert "ASH+" in reliability.frame.index
    mine = RunTables([*results, cell("mine", 20.0)])
    assert mine.methods("loose") == ("mine", "nearest", "ash", "ash_plus"), "a user's own first"


def test_what_is_drawn_beside_the_person_costs_on_a_white_frame_only() -> None:
    def scored(found: CellResult, on_white: float) -> CellResult:
        rows = [replace(row, region="white_frame", value=on_white) for row in found.summary if row.metric == "psnr"]
        return replace(found, summary=(*found.summary, *rows))

    haloed = scored(cell("ash", 29.0, axis="mask_grown", severity=8.0), 15.0)
    results = [scored(cell("nearest", 10.0), 12.0), scored(cell("ash", 30.0), 28.0), haloed]
    on_white = on_views(stability.losses(load(results), "white_frame"))
    assert on_white[["mean", "distance"]].to_numpy().tolist() == [[13.0, -5.0]]
    (section,) = sections.stabilities(RunTables(results))
    views, views_on_white, *_ = (block for block in section.blocks if isinstance(block, Table))
    assert views.title == "Loss to the clean capture, foreground, novel views [dB]"
    assert views.frame.loc["masks too large: 8 px"].tolist() == ["1.0"]
    assert views_on_white.title == "Loss to the clean capture, on a white frame, novel views [dB]"
    assert views_on_white.frame.loc["masks too large: 8 px"].tolist() == ["13.0, broken"]


def test_the_studio_is_all_that_the_row_knows_more_and_a_dry_run_counts_it(tmp_path: Path) -> None:
    suite = find_suite(str(MASKS))
    (row,) = [row for row in suite.methods if row.name == "ash_studio"]
    plain = offered("ash", suite.preset)
    studio = replace(plain, training=replace(plain.training, background="studio"))
    assert configured(row.of, suite.preset, row.changes) == studio != plain
    output = estimate(suite, RunOptions(out=tmp_path, data=tmp_path, workers=1))
    (rows,) = {line.partition(": ")[2] for line in output.splitlines() if ", cpu, seed " in line}
    assert rows.split(", ") == [row.name for row in suite.methods], "on every capture, for every seed"


@pytest.mark.parametrize("stress", [("cameras", 0.0), ("weather", 1.0), ("frames", float("inf"))])
def test_a_stress_without_meaning_is_refused(stress: tuple[str, float]) -> None:
    with pytest.raises(InputError):
        Stress(axis=stress[0], severity=stress[1])


def test_every_axis_changes_what_a_method_learns_from_more_and_more(capture: Path) -> None:
    whole = load_capture(capture)
    train = Split(cameras=tuple(f"cam{i}" for i in range(4)), frames=tuple(range(FOOTAGE_FRAMES)))
    longer = replace(whole, splits={**whole.splits, "train": train})
    for name, axis in AXES.items():
        found = [axis.perturbation(longer, severity) for severity in severities_of(name)]
        assert len({repr(p) for p in found}) == len(found) >= 3, name
        assert severities_of(name) == sorted(severities_of(name))


def test_a_stressed_suite_has_its_clean_captures_first_and_one_per_stress() -> None:
    suite = our_suite("stability")
    steps = 3 * (len(AXES) - 1)  # All but `footage`, which the suite `motions` goes along.
    assert [spec.stress for spec in suite.captures] == [None, *suite.stresses] and len(suite.stresses) == steps
    cells = [(cell.method, cell.capture.stress) for cell in suite.cells]
    assert len(cells) == suite.seeds * (len(suite.methods) + (len(suite.methods) - 1) * steps)
    assert [stress for method, stress in cells if method == "nearest"] == [None] * suite.seeds, "the floor of all axes"
    assert len({spec.name for spec in suite.captures}) == 1 + steps


def test_a_perturbed_capture_is_made_once_whole_and_again_after_an_accident(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clean = write_capture(tmp_path / "clean")
    original = captures.make_capture

    def make(spec: CaptureSpec, data: Path, *, workers: int) -> Path:
        return clean if spec.stress is None else original(spec, data, workers=workers)

    monkeypatch.setattr(captures, "make_capture", make)
    spec = CaptureSpec(scene="boxes", size="ci", stress=Stress(axis="frames", severity=50.0))
    folder = make(spec, tmp_path, workers=1)
    whole, perturbed = load_capture(clean), load_capture(folder)
    assert len(perturbed.splits["train"].frames) == round(len(whole.splits["train"].frames) / 2)
    assert perturbed.identity != whole.identity and not verify_capture(folder)
    stamp = (folder / "manifest.json").stat().st_mtime_ns
    assert make(spec, tmp_path, workers=1) == folder
    assert (folder / "manifest.json").stat().st_mtime_ns == stamp
    (folder / "manifest.json").unlink()
    assert load_capture(make(spec, tmp_path, workers=1)).identity == perturbed.identity
