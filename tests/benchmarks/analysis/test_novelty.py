from dataclasses import replace

import numpy as np
import pytest
from helpers.cells import config

from benchmarks.analysis import novelty
from benchmarks.analysis.scores import images_of, scores_of
from benchmarks.cell.cells import CellResult, Summary, ViewScore, failed_result
from benchmarks.report import sections, tables
from benchmarks.report.scene import _quality_quantities

MOTION = {"near_pose": (3.0, 4.0, 5.0), "novel_pose": (10.0, 11.0, 12.0), "far_pose": (18.0, 20.0, 22.0)}


def result(method: str, seed: int, slope: float, *, capture: str = "c", level: float = 30.0) -> CellResult:
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
    known = replace(config(method, seed), capture=capture * 64)
    return CellResult(config=known, status="done", summary=tuple(summary), views=tuple(views))


def test_bins_hold_equal_numbers_of_frames_and_the_curve_their_means():
    table = novelty.curves(images_of([result("ash", 0, 0.5), result("wo_mot", 0, 0.1)]))
    ash = table[table["method"] == "ash"]
    np.testing.assert_allclose(ash["novelty_deg"], [0, 4, 11, 20])
    np.testing.assert_allclose(ash["psnr"], [30, 28, 24.5, 20])
    assert ash[["low", "high"]].isna().all(axis=None), "one training has no interval"
    assert set(table["method"]) == {"ash", "wo_mot"}
    assert novelty.sentences(table) == [
        "On loose, from poses 0 to poses 20 degrees from training's, PSNR falls by: w/o mot. 2.0 dB, ASH 10.0 dB."
    ]


def test_intervals_are_over_seeds_of_one_capture_and_over_captures_of_several():
    seeds = novelty.curves(images_of([result("ash", seed, 0.5) for seed in range(3)]))
    np.testing.assert_allclose(seeds["psnr"], [29.5, 27.5, 24, 19.5])
    half = 4.3026528 * 0.5 / np.sqrt(3)  # Student's t for three seeds
    np.testing.assert_allclose(seeds["high"] - seeds["psnr"], half, rtol=1e-5)
    people = [
        result("ash", seed, 0.5, capture=name, level=30 + gain) for gain, name in enumerate("cd") for seed in (0, 1)
    ]
    captures = novelty.curves(images_of(people))
    half = 12.7062047 * np.std([0, 1], ddof=1) / np.sqrt(2)
    np.testing.assert_allclose(captures["high"] - captures["psnr"], half, rtol=1e-5)


def test_one_pose_has_no_curve():
    images = images_of([result("ash", 0, 0.5)])
    assert novelty.curves(images.assign(novelty_deg=images["novelty_deg"] / 25)).empty
    assert not novelty.curves(images.assign(novelty_deg=images["novelty_deg"] / 20)).empty


def test_results_from_before_novelty_have_no_curve():
    old = result("ash", 0, 0.5)
    views = [replace(v, scores={("foreground", "psnr"): 20.0}) for v in old.views if v.split == "novel_view"]
    scores = scores_of([replace(old, views=tuple(views))])
    assert novelty.curves(scores.images).empty and sections.novelties(scores) == []


def test_the_chart_has_a_line_per_method(tmp_path):
    (section,) = sections.novelties(scores_of([result("ash", s, 0.5) for s in (0, 1)] + [result("ddc", 0, 0.2)]))
    figure = section.blocks[0].figure
    assert figure.file == "chart_novelty.svg" and [look.title for look in figure.series] == ["ASH", "DDC"]
    assert "novelty of the pose [degrees]" in figure.svg()


@pytest.mark.parametrize("splits", [("novel_view", "novel_pose"), ("novel_view", *MOTION)])
def test_tables_show_near_and_far_where_a_scene_has_them(splits):
    whole = result("ash", 0, 0.5)
    own = replace(whole, summary=tuple(row for row in whole.summary if row.split in splits))
    fallen = failed_result(config("ddc"), "crashed", "", splits=splits)
    made = tables.build(scores_of([own, fallen]), "loose", _quality_quantities(), title="")
    groups = [group for group, _ in made.groups]
    assert ("Held-out motion: near" in groups) == ("Held-out motion: far" in groups) == ("near_pose" in splits)
    assert "Held-out motion: new" in groups
