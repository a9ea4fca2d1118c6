"""Quality against training seconds, training frames and novelty, on known numbers."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from helpers.cells import cell, config

from ash.protocol import TrainingOutcome
from benchmarks.analysis import curves, stability
from benchmarks.analysis.results import RunTables, load, load_images, load_snapshots
from benchmarks.cell.evaluation import seconds_to_settle
from benchmarks.cell.schema import CellResult, CurvePoint, Snapshot, Summary, ViewScore, failed_result
from benchmarks.report import sections, tables
from benchmarks.report.content import Bullets
from benchmarks.report.vega import Figure

STATIC = {30: 23.0, 60: 24.0, 120: 24.0}
LEARNED = {30: 22.0, 60: 23.5, 120: 25.0, 240: 26.0}

OF_CAPTURES = (("loose", "ash", "abc"), ("loose", "ddc", "abc"), ("loose", "slow", "b"), ("tight", "ash", "d"))


def trained(method: str, course: dict[int, float], *, seed: int = 0) -> CellResult:
    """A cell with snapshots of these scores; the last is its end."""
    *early, end = course.items()
    snapshots = tuple(
        Snapshot(seconds=float(s), split=split, psnr=p) for s, p in early for split in ("novel_view", "novel_pose")
    )
    outcome = TrainingOutcome(steps=100, seconds=float(end[0]), ended_by="plateau")
    return replace(cell(method, end[1], seed=seed), snapshots=snapshots, training=outcome)


def test_a_training_curve_is_the_mean_over_people_while_all_of_them_train() -> None:
    """One person is scored from 10 s to 90 s, the other from 5 s to 40 s; alone a curve is what was scored."""
    first = pd.DataFrame({"capture": "a", "seconds": [10.0, 20.0, 90.0], "psnr": [20.0, 22.0, 29.0]})
    second = pd.DataFrame({"capture": "b", "seconds": [5.0, 10.0, 40.0], "psnr": [25.0, 26.0, 29.0]})
    both = curves.during_training(pd.concat([first, second]).assign(scene="loose", method="ash", seed=0))
    assert both["seconds"].tolist() == pytest.approx([10, 20, 40]) and set(both["method"]) == {"ash"}
    assert both["psnr"].tolist() == pytest.approx([23.0, 24.5, 26.5])
    alone = curves.during_training(first.assign(scene="loose", method="ddc", seed=1))
    assert alone["psnr"].tolist() == first["psnr"].tolist()


def test_methods_that_lack_captures_stand_with_the_others_on_the_captures_that_they_have() -> None:
    rows = pd.DataFrame(
        [(scene, method, capture) for scene, method, captures in OF_CAPTURES for capture in captures],
        columns=["scene", "method", "capture"],
    )
    found = curves.on_equal_captures(rows)
    by_method = {key: "".join(part["capture"]) for key, part in found.groupby(["scene", "method"])}
    assert by_method == {
        ("loose", "ash"): "abc",
        ("loose", "ddc"): "abc",
        ("loose, 1 of 3 captures", "ash"): "b",
        ("loose, 1 of 3 captures", "ddc"): "b",
        ("loose, 1 of 3 captures", "slow"): "b",
        ("tight", "ash"): "d",
    }
    assert curves.on_equal_captures(rows.head(0)).empty
    apart = pd.DataFrame({"scene": "loose", "method": ["ash", "ddc"], "capture": ["a", "b"]})
    assert list(curves.on_equal_captures(apart)["scene"]) == ["loose, 1 of 2 captures", "loose, 1 of 2 captures (2)"]


def test_intervals_over_captures_leave_out_what_a_capture_does_to_all_methods() -> None:
    runs = [
        replace(run, config=replace(run.config, subject=subject))
        for subject, level in enumerate((0.0, 4.0, 9.0))
        for method, gain in (("ash", 0.1 * level), ("wo_mot", 0.0))
        for run in [trained(method, {s: p + level + gain for s, p in STATIC.items()})]
    ]
    table = curves.time_to_quality(load_snapshots(runs)).set_index(["method", "split", "seconds"])
    halves = (table.high - table.psnr).loc[:, "novel_view", 60]
    paired = 4.3026528 * np.std([0.0, 0.4, 0.9], ddof=1) / 3**0.5  # of the differences, t of 2 degrees
    np.testing.assert_allclose(halves, paired / 2**0.5, rtol=1e-5)


def test_an_early_end_of_a_training_makes_no_mark_for_the_others() -> None:
    cells = [trained("ash", LEARNED), trained("ddc", {30: 22.0, 60: 23.0, 65: 23.5})]
    views = curves.time_to_quality(load_snapshots(cells)).query("split == 'novel_view'")
    assert views[views.method == "ash"].seconds.tolist() == [30, 60, 120, 240]
    assert views[views.method == "ddc"].psnr.tolist() == [22.0, 23.0, 23.5, 23.5]


def test_methods_cross_where_their_scores_are_equal() -> None:
    """ASH is 0.5 dB behind after a minute and 1 dB ahead after two: a third of the way, in the logarithm."""
    table = curves.time_to_quality(load_snapshots([trained("wo_mot", STATIC), trained("ash", LEARNED)]))
    views = table[table.split == "novel_view"]
    assert views[views.method == "ash"].psnr.tolist() == [22.0, 23.5, 25.0, 26.0]
    assert views[views.method == "wo_mot"].psnr.tolist() == [23.0, 24.0, 24.0, 24.0], "it had ended"
    assert curves.crossings(views) == [
        f"On loose, novel views, ASH is ahead of w/o mot. from {60 * 2 ** (1 / 3):.0f} s of training on."
    ]
    above = {s: p + 1 for s, p in STATIC.items()}
    table = curves.time_to_quality(load_snapshots([trained("wo_mot", STATIC), trained("ash", above)]))
    assert curves.crossings(table)[0].endswith("ASH is ahead of w/o mot. at every time, by 1.0 to 1.0 dB.")
    back = {30: 24.0, 60: 23.0, 120: 25.0}
    (view, _) = curves.crossings(
        curves.time_to_quality(load_snapshots([trained("wo_mot", STATIC), trained("ash", back)]))
    )
    assert "ASH is ahead of w/o mot. from 85 s" in view and view.endswith("The lead had changed before.")
    four = [trained(name, STATIC) for name in ("ash", "ddc", "ash_plus", "ddc_plus")]
    ranked = [
        replace(run, snapshots=tuple(replace(s, psnr=s.psnr + k) for s in run.snapshots)) for k, run in enumerate(four)
    ]
    said = curves.crossings(
        curves.time_to_quality(load_snapshots(ranked)).query("split == 'novel_view' and seconds < 120")
    )
    assert [each.split(", ")[2].removesuffix(" at every time") for each in said] == [
        "DDC is ahead of ASH",
        "ASH+ is ahead of ASH",
        "DDC+ is ahead of ASH+",
    ], "each pair, not all of them"


def test_seeds_give_intervals_and_are_averaged_within_captures() -> None:
    cells = [
        trained("ash", {s: p + shift for s, p in LEARNED.items()}, seed=i) for i, shift in enumerate((-0.2, 0, 0.2))
    ]
    table = curves.time_to_quality(load_snapshots(cells))
    assert (table.high > table.psnr).all() and (table.low < table.psnr).all()
    assert np.isnan(curves.time_to_quality(load_snapshots(cells[:1])).low).all()
    runs = [
        replace(run, config=replace(run.config, subject=subject))
        for subject, shift in enumerate((0.0, 4.0))
        for seed in (0, 1)
        for run in [trained("ash", {s: p + shift + seed for s, p in LEARNED.items()}, seed=seed)]
    ]
    first = curves.time_to_quality(load_snapshots(runs)).query("split == 'novel_view'").iloc[0]
    assert (first.psnr, first.high - first.psnr) == (24.5, pytest.approx(12.706 * 2.0, rel=1e-4))  # t of 1 degree


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ((22.0, 23.1, 22.9, 23.5, 24.0), "from 160 training frames on."),
        ((23.1, 23.1, 23.1, 23.5, 24.0), "at every number of training frames, 20 to 320."),
        ((20.0, 20.0, 20.0, 20.0, 20.0), "at no number of training frames."),
        ((23.1, 22.0, 23.1, 22.0, 22.0), "at 20, 80 training frames, but not at 320."),
    ],
)
def test_from_how_many_training_frames_on_motion_helps(scores: tuple[float, ...], expected: str) -> None:
    frames = dict(zip((20, 40, 80, 160, 320), scores, strict=True))

    def made(method: str, score: float, count: int) -> CellResult:
        missing = 320 - count
        return cell(method, score, axis="footage" if missing else "", severity=float(missing))

    results = [made("ash", score, count) for count, score in frames.items()]
    results += [made("wo_mot", 23.0, count) for count in frames]
    table = curves.data_scaling(load(results))
    assert table[(table.method == "ash") & (table.split == "novel_pose")].frames.tolist() == [20, 40, 80, 160, 320]
    assert curves.frames_needed(table) == [f"On loose, ASH is above w/o mot. on novel poses {expected}"]
    assert list(dict.fromkeys(table.split)) == ["novel_view", "novel_pose"]
    assert not len(stability.steps(load(results)).query("axis == 'footage'")), "less footage is no perturbation"


def test_the_report_draws_what_was_run_on_a_scale_for_each_scene() -> None:
    results = [trained("wo_mot", STATIC), trained("ash", LEARNED)]
    results += [replace(r, config=replace(r.config, scene="elsewhere")) for r in [trained("ash", {30: 31.0, 60: 33.0})]]
    (section,) = sections.training_cost(RunTables(results))
    figure, said = section.blocks
    assert isinstance(figure, Figure) and figure.file == "chart_budget.svg" and "ASH" in figure.svg()
    spans = [panel.to_dict()["layer"][1]["encoding"]["y"]["scale"]["domain"] for panel in figure.panels]
    assert len(spans) == 4 and spans[0] == spans[1] != spans[2] == spans[3]
    assert isinstance(said, Bullets) and any("ahead" in sentence for sentence in said.items)
    assert sections.training_cost(RunTables([cell("ash", 20.0)])) == []


def test_a_curve_settles_where_it_never_leaves_the_last_three_tenths_again() -> None:
    scores = {10: 20.0, 20: 24.8, 30: 24.5, 40: 24.75, 80: 25.0}
    curve = tuple(CurvePoint(seconds=float(s), loss=None, psnr=p) for s, p in scores.items())
    assert seconds_to_settle(curve) == 40
    assert seconds_to_settle(curve[-1:]) == 80
    assert seconds_to_settle((CurvePoint(seconds=1.0, loss=0.1, psnr=None),)) is None


MOTION = {"near_pose": (3.0, 4.0, 5.0), "novel_pose": (10.0, 11.0, 12.0), "far_pose": (18.0, 20.0, 22.0)}


def moving(method: str, seed: int, slope: float, *, subject: int = 0, level: float = 30.0) -> CellResult:
    """PSNR falls by `slope` dB per degree, and one seed is half a decibel better than the next."""
    views = [
        ViewScore(
            split=split,
            camera=camera,
            frame=100 * index + number,
            prediction="",
            scores={("foreground", "psnr"): level - slope * degrees - 0.5 * seed, ("", "novelty_deg"): degrees},
        )
        for index, (split, all_degrees) in enumerate([("novel_view", (0.0, 0.0)), *MOTION.items()])
        for number, degrees in enumerate(all_degrees)
        for camera in ("a", "b")
    ]
    summary = [
        Summary(split=split, region="foreground", metric="psnr", value=level - slope * float(np.mean(degrees)))
        for split, degrees in [("novel_view", (0.0,)), *MOTION.items()]
    ]
    place = replace(config(method, seed), subject=subject)
    return CellResult(config=place, status="done", summary=tuple(summary), views=tuple(views))


def test_bins_of_novelty_hold_equal_numbers_of_frames_and_their_means() -> None:
    table = curves.novelty(load_images([moving("ash", 0, 0.5), moving("wo_mot", 0, 0.1)]))
    ash = table[table["method"] == "ash"]
    np.testing.assert_allclose(ash["novelty_deg"], [0, 4, 11, 20])
    np.testing.assert_allclose(ash["psnr"], [30, 28, 24.5, 20])
    assert ash[["low", "high"]].isna().all(axis=None), "one training has no interval"
    assert curves.losses_by_novelty(table) == [
        "On loose, from 0 to 20 degrees from the training poses, PSNR falls: w/o mot. 2.0 dB, ASH 10.0 dB."
    ]


def test_intervals_of_novelty_are_over_seeds_of_one_capture_and_over_several_captures() -> None:
    seeds = curves.novelty(load_images([moving("ash", seed, 0.5) for seed in range(3)]))
    np.testing.assert_allclose(seeds["psnr"], [29.5, 27.5, 24, 19.5])
    np.testing.assert_allclose(seeds["high"] - seeds["psnr"], 4.3026528 * 0.5 / np.sqrt(3), rtol=1e-5)
    several = [moving("ash", seed, 0.5, subject=gain, level=30 + gain) for gain in (0, 1) for seed in (0, 1)]
    captures = curves.novelty(load_images(several))
    half = 12.7062047 * np.std([0, 1], ddof=1) / np.sqrt(2)
    np.testing.assert_allclose(captures["high"] - captures["psnr"], half, rtol=1e-5)


def test_one_pose_and_results_without_novelty_have_no_curve() -> None:
    images = load_images([moving("ash", 0, 0.5)])
    assert curves.novelty(images.assign(novelty_deg=images["novelty_deg"] / 25)).empty
    assert not curves.novelty(images.assign(novelty_deg=images["novelty_deg"] / 20)).empty
    old = moving("ash", 0, 0.5)
    views = [replace(v, scores={("foreground", "psnr"): 20.0}) for v in old.views if v.split == "novel_view"]
    assert sections.novelty(RunTables([replace(old, views=tuple(views))])) == []


def test_the_chart_of_novelty_has_a_line_per_method() -> None:
    (section,) = sections.novelty(RunTables([moving("ash", s, 0.5) for s in (0, 1)] + [moving("ddc", 0, 0.2)]))
    figure = section.blocks[0]
    assert isinstance(figure, Figure) and figure.file == "chart_novelty.svg"
    assert [series.title for series in figure.series] == ["ASH", "DDC"]
    assert "novelty of the pose [degrees]" in figure.svg()


def test_of_many_rows_the_chart_of_novelty_shows_the_main_ones_and_its_sentence_all() -> None:
    rows = ["wo_disp", "wo_mot", "window_1", "unlearned", "wo_phi", "sh_0", "sh_1", "sh_2", "ash"]
    (section,) = sections.novelty(RunTables([moving(row, 0, 0.5) for row in rows]))
    figure, sentences = section.blocks
    assert isinstance(figure, Figure) and [series.title for series in figure.series] == ["w/o mot.", "ASH"]
    assert isinstance(sentences, Bullets) and sentences.items[0].count(" dB") == len(rows)
    (fewer,) = sections.novelty(RunTables([moving(row, 0, 0.5) for row in rows[1:]]))
    assert isinstance(fewer.blocks[0], Figure) and len(fewer.blocks[0].series) == len(rows) - 1


@pytest.mark.parametrize("splits", [("novel_view", "novel_pose"), ("novel_view", *MOTION)])
def test_tables_show_near_and_far_where_a_scene_has_them(splits: tuple[str, ...]) -> None:
    whole = moving("ash", 0, 0.5)
    own = replace(whole, summary=tuple(row for row in whole.summary if row.split in splits))
    fallen = failed_result(config("ddc"), "crashed", "", splits=splits)
    made = tables.build(RunTables([own, fallen]), "loose", tables.quality_columns(("psnr",)), title="")
    groups = [group for group, _ in made.groups]
    assert ("Novel pose: near" in groups) == ("Novel pose: far" in groups) == ("near_pose" in splits)
    assert "Novel pose: new" in groups
