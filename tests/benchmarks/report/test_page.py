import io
import re
import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Literal

import pandas as pd
import pytest
from helpers import fakes
from helpers.browser import DESKTOP, PHONE, Visit, Visitor
from helpers.cells import config, people
from helpers.waiting import wait_for
from PIL import Image

from ash.files import InputError
from ash.protocol import TrainingOutcome
from benchmarks import cli
from benchmarks.analysis import headings
from benchmarks.analysis.differences import differences
from benchmarks.analysis.results import Quantity, RunTables
from benchmarks.analysis.style import titles_of
from benchmarks.cell.metrics import PROTOCOL
from benchmarks.cell.schema import Cell, CellResult, Summary, failed_result, result_of, write_config, write_result
from benchmarks.commands import arguments
from benchmarks.report import charts, defects, pictures, sentences, tables, vega
from benchmarks.report import page as page_module
from benchmarks.report import scene as scene_module
from benchmarks.report.content import Strips, Table, Text
from benchmarks.report.figures import speed_figure
from benchmarks.report.headings import new_headings
from benchmarks.report.page import publish, write_report
from benchmarks.report.pictures import Album, Shown
from benchmarks.report.scene import SceneData, scene_report
from benchmarks.suites import runs
from benchmarks.suites.runs import Run, read_run, results_of, write_run
from benchmarks.suites.tables import tables_of


@pytest.fixture(scope="module")
def run(made_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A copy of the finished run with its report, to which a method was added that failed."""
    folder = tmp_path_factory.mktemp("report")
    done = read_run(Path(shutil.copytree(made_once, folder / "run")))
    own = Path(shutil.copytree(done.cells[0].capture_folder, folder / "own"))  # Found by no other run.
    cells = [replace(cell, capture_folder=own) for cell in done.cells]
    place = replace(cells[0].config, method="fake_nan")
    cells.append(replace(cells[0], config=place, folder=folder / "run" / "cells" / place.key))
    for cell in cells:
        write_config(cell)
    write_result(cells[-1].folder, failed_result(place, "diverged", "NaN"))
    found = replace(done, suite="fakes", about="boxes", command="ash-bench run fakes", cells=tuple(cells))
    write_run(found)
    write_report(found)
    return found


def scored(method: str, *, view: float, pose: float, frame_ms: float = 10.0, seed: int = 0) -> CellResult:
    rows = (
        Summary(split="novel_view", region="foreground", metric="psnr", value=view),
        Summary(split="novel_pose", region="foreground", metric="psnr", value=pose),
        Summary(split="novel_view", region="foreground", metric="flip", value=1 / view),
        Summary(split="speed", region="", metric="frame_ms", value=frame_ms),
    )
    return CellResult(config=config(method, seed), status="done", summary=rows)


class Page(HTMLParser):
    """Collects what a page refers to, and whether its tags are balanced."""

    VOID = frozenset({"meta", "img", "input", "br", "link"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.references: list[str] = []
        self.open: list[str] = []
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "action")]
        if tag not in self.VOID and tag not in ("option",):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID and tag != "option":
            assert self.open.pop() == tag


def test_the_page_is_whole_and_needs_nothing_else(run: Run) -> None:
    text = (run.folder / "report.html").read_text()
    page = Page(text)
    assert page.open == []
    assert page.references and all(reference.startswith("#term-") for reference in page.references)
    assert all(f'id="{reference[1:]}"' in text for reference in page.references), "every term is in the glossary"
    assert "default-src 'none'" in text
    assert text.count("data-chart>") == 3, "accuracy against speed, PSNR per frame, training curves"
    for words in (
        "fake_good 33.",
        "<code>ash-bench run fakes</code>",
        "1 of 1 failed",
        "diverged",
        f"Protocol {PROTOCOL}",
        ">code<",
        "noise ceiling 39.9",
        "Smoke test on boxes: it shows that every part runs",
        "2 cameras, 4 frames",
    ):
        assert words in text


def test_headings_far_from_those_of_training_are_told_apart(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "New headings" not in (run.folder / "report.md").read_text()
    monkeypatch.setattr(headings, "EDGES_DEG", (-2.0, -1.0))  # All lie beyond.
    run_tables = RunTables(results_of(run), {cell.config.key: cell.capture_folder.name for cell in run.cells})
    (turned,), sheets = new_headings(run, results_of(run), run_tables, Album())
    _, table, _, strips = turned.blocks
    assert isinstance(table, Table) and isinstance(strips, Strips)
    assert list(table.frame.columns) == ["beyond 60 deg, 3 frames [dB]"]
    assert {"fake_good", "fake_bad"} <= set(table.frame.index)
    assert len(strips.groups[0][1][0].tiles) == 1 + len(table.frame) and list(sheets) == [strips.file]


def test_the_charts_are_valid_svg_and_adapt_to_dark_pages(run: Run) -> None:
    text = (run.folder / "chart_boxes.svg").read_text()
    assert ElementTree.fromstring(text).tag == "{http://www.w3.org/2000/svg}svg"
    assert "prefers-color-scheme:dark" in text
    assert "fake_good" in text and "nan" not in text.replace("fake_nan", "").lower()


def test_no_caption_tells_of_marks_that_are_not_there(run: Run) -> None:
    output = "given the exact surface"
    assert output not in (run.folder / "report.md").read_text()
    captions = []
    for methods in (("ash", "ddc"), ("ash", "ash_truth")):
        figure = speed_figure(RunTables([scored(m, view=27.0, pose=20.0) for m in methods]), "loose")
        assert figure is not None
        captions.append(figure.caption)
    assert [output in caption for caption in captions] == [False, True]


def test_methods_of_different_people_stand_in_no_chart() -> None:
    results = [scored(method, view=27.0, pose=20.0) for method in ("ash", "ddc")]
    of_another = replace(results[1], config=replace(results[1].config, subject=1, capture="another", truth="another"))
    assert speed_figure(RunTables(results), "loose") is not None
    assert speed_figure(RunTables([results[0], of_another]), "loose") is None


def speed_layers(*, ms: tuple[float, float], low: tuple[float, float], high: tuple[float, float]) -> list[dict]:
    points = pd.DataFrame({"panel": "views", "series": ["a", "b"], "ms": ms, "psnr": [30.0, 31.0]})
    points = points.assign(low=low, high=high, ringed=False)
    front = pd.DataFrame({"panel": ["views"], "ms": ms[:1], "psnr": [30.0]})
    links = pd.DataFrame(columns=["panel", "link", "ms", "psnr"])
    series = [vega.Series(title=name, colour=vega.BLUE) for name in "ab"]
    (panel,) = charts.speed(points, front, links, series, notes={}, timed_on="one core")
    return panel.to_dict()["layer"]


def test_one_failure_does_not_press_the_points_of_a_chart_together() -> None:
    layers = speed_layers(ms=(5.0, 9.0), low=(29.5, 0.0), high=(30.5, 60.0))
    low, high = layers[0]["encoding"]["y"]["scale"]["domain"]
    assert 27 < low < 28.1 and 32.9 < high < 34


@pytest.mark.parametrize(("slowest_ms", "align"), [(90.0, "left"), (32.0, "right")])
def test_the_label_of_30_frames_a_second_stands_where_it_has_room(slowest_ms: float, align: str) -> None:
    layers = speed_layers(ms=(9.0, slowest_ms), low=(29.5, 30.5), high=(30.5, 31.5))
    (label,) = (layer["mark"] for layer in layers if layer["mark"]["type"] == "text")
    assert label["align"] == align


def test_a_title_of_the_suite_is_shown_in_every_form_of_the_report_and_every_result_is_read_once(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_chart_files: None
) -> None:
    read = []
    monkeypatch.setattr(runs, "result_of", lambda cell: read.append(cell.folder) or result_of(cell))
    spec = tables_of({"columns": ["psnr"]}, place="x")
    shown = "\n".join(write_report(replace(run, folder=tmp_path, titles={"fake_good": "Good row"}, table=spec)))
    assert read == [cell.folder for cell in run.cells]
    texts = [(tmp_path / name).read_text() for name in ("report.html", "report.md", "tables.tex")]
    assert all("Good row" in text for text in (shown, *texts))
    assert "Good row" not in (tmp_path / "results.csv").read_text(), "a table for programs keeps names"
    for text in (shown, texts[1]):
        assert "Smoke test on boxes" in text and "How sure" in text and "Protocol" in text, "beside the suite's tables"


def test_the_findings_of_several_scenes_stand_first(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_chart_files: None
) -> None:
    results = [
        replace(result, config=replace(result.config, scene=scene, preset="cpu", size="quick"))
        for scene in ("boxes", "other")
        for result in results_of(run)
    ]

    def no_capture(folder: Path) -> None:
        raise InputError(f"{folder}: gone")

    monkeypatch.setattr(page_module, "results_of", lambda _: results)
    monkeypatch.setattr(scene_module, "load_capture", no_capture)
    write_report(replace(run, folder=tmp_path))
    text = (tmp_path / "report.md").read_text()
    assert (
        text.index("## Results by scene") < text.index("**other.**") < text.index("## boxes") < text.index("## Again")
    )
    assert text.count("On other, ") == 1, "what was found stands once"


def test_markdown_and_latex_say_the_same_as_the_page(run: Run) -> None:
    page, plain = (run.folder / "report.html").read_text(), (run.folder / "report.md").read_text()
    tex = (run.folder / "tables.tex").read_text()
    numbers = re.findall(r"\| ([\d.]+) ", plain.partition("by other conventions")[0])
    assert numbers and all(f">{number}<" in page for number in numbers)
    assert not re.search(r"\*\*[\d.]+\*\*", plain.partition("by other conventions")[0]), (
        "one value per row: none is best"
    )
    assert r"\cellcolor" not in tex
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == tex.count(r"\toprule") == 1
    assert "fake\\_good" in tex


CHANCE = "one training of each: chance is not ruled out."
SHORT = TrainingOutcome(steps=9, seconds=1.0, ended_by="steps", correction_spread=0.0)
DUEL = [scored("ash", view=27.9, pose=22.3), scored("ddc", view=24.8, pose=22.25)]
SEEDS = [
    scored(method, view=view + 0.1 * seed, pose=pose + seed, seed=seed)
    for seed in range(3)
    for method, view, pose in (("ash", 24.0, 20.0), ("ddc", 25.0, 19.5))
]
FALLEN = [scored("ash", view=27.0 + seed, pose=20.0, seed=seed) for seed in range(2)]
FALLEN += [failed_result(config("ddc", seed), "crashed", "boom") for seed in range(2)]
CUT = [replace(scored("wo_mot", view=27.0, pose=20.0), training=SHORT)]


@pytest.mark.parametrize(
    ("results", "expected"),
    [
        (DUEL, f"ASH and DDC have 27.9 and 24.8 dB on novel views and 22.3 and 22.2 dB on novel poses, {CHANCE}"),
        (
            SEEDS,
            "DDC is better than ASH on novel views by 1.0 dB (95 % interval 0.8 to 1.2); no difference between "
            "ASH and DDC is shown on novel poses (+0.5 dB, 95 % interval -1.8 to +2.8).",
        ),
        (
            [scored("wide", view=23.04, pose=20.0), scored("narrow", view=23.01, pose=20.0)],
            f"wide and narrow have 23.0 and 23.0 dB on novel views, {CHANCE}",
        ),
        (FALLEN, "DDC failed: ASH and DDC cannot be compared."),
        ([replace(DUEL[0], training=SHORT), DUEL[1]], "Not at their plateau when training ended: ASH. On loose, ASH"),
        (CUT, "Not at their plateau when training ended: w/o mot. On loose, w/o mot. has 27.0 dB on novel views."),
    ],
    ids=["one value", "seeds", "no win of equals", "a failed one", "cut short", "cut short, alone"],
)
def test_the_headline(results: list[CellResult], expected: str) -> None:
    assert sentences.headline(RunTables(results), "loose").removeprefix("On loose, ").startswith(expected)


def test_scores_on_the_exact_surface_and_dead_decoders_are_told() -> None:
    exact = [scored("ash_truth", view=30.0, pose=29.0), scored("ddc_truth", view=32.0, pose=31.0)]
    facts = dict(sentences.facts(RunTables([replace(DUEL[0], training=SHORT), DUEL[1], *exact]), "loose"))
    assert "Given the exact surface, on novel views: ASH 30.0, DDC 32.0 dB." in facts["Scores"]
    assert "same output in every frame: ASH." in facts["Weakest"]
    fallen = RunTables([*FALLEN, exact[0], failed_result(config("ddc_truth", 0), "timeout", "slow")])
    assert "Given the exact surface" not in dict(sentences.facts(fallen, "loose"))["Scores"]


def test_the_headline_has_the_verdict_of_the_table_below_it() -> None:
    levels = {"ash": (24.0, 24.5), "ddc": (25.0, 25.4), "wo_mot": (24.1, 24.6), "mlp": (20.0, 20.6)}
    scores = RunTables(
        [scored(m, view=view, pose=view, seed=seed) for m, views in levels.items() for seed, view in enumerate(views)]
    )
    table = differences(scores.rows).query("method == 'ddc' and split == 'novel_view'").iloc[0]
    assert table["verdict"] == "unclear" and table["p"] > 0.05
    assert sentences.headline(scores, "loose").startswith("On loose, no difference between ASH and DDC is shown on ")


def test_the_headline_of_an_ablation_has_the_verdicts_on_its_rows() -> None:
    levels = {"ash_plus": (24.0, 25.0, 30.0), "wo_mot_plus": (22.0, 23.1, 28.1), "double_width": (24.1, 24.8, 30.4)}
    scores = RunTables(people(levels | {"half_width": (24.01, 25.0, 30.01)}))
    verdicts = "ASH+ is better than ASH+ w/o mot., equal within 0.1 dB to ASH+, half width, not known to differ from"
    assert sentences.headline(scores, "loose") == (
        f"On loose, on novel views {verdicts} ASH+, double width; on novel poses {verdicts} ASH+, double width."
    )
    two = RunTables(people({name: levels[name] for name in ("ash_plus", "wo_mot_plus")}))
    assert sentences.headline(two, "loose").endswith("on novel poses ASH+ is better than ASH+ w/o mot.")


def test_best_and_second_are_marked_as_printed_and_oracles_are_not_ranked() -> None:
    results = [
        result
        for seed in range(2)
        for result in (
            scored("ash", view=27.904, pose=20.0, frame_ms=40.0, seed=seed),
            scored("wo_disp", view=27.901, pose=19.0, frame_ms=30.0, seed=seed),
            scored("ddc", view=24.0, pose=21.0, frame_ms=6.0, seed=seed),
            scored("ash_truth", view=33.0, pose=33.0, frame_ms=1.0, seed=seed),
            failed_result(config("mlp", seed), "crashed", "boom"),
        )
    ]
    columns = [*tables.quality_columns(("psnr", "flip")), *tables.cost_columns(("frame_ms",))]
    table = tables.build(RunTables(results), "loose", columns, title="t")
    marks = {name: [mark for _, mark in texts] for name, texts in table.rows}
    assert [title.split()[0] for _, title in table.heads] == ["PSNR", "FLIP", "PSNR", "FLIP", "frame"]
    assert marks["ASH"][:1] == marks["w/o disp."][:1] == ["best"], "equal as printed"
    assert marks["DDC"] == ["second", "second", "best", "", "best"]
    assert set(marks["ASH, exact surface"]) == {""} and table.below == 1
    assert set(table.frame.loc["w/ MLP (2 of 2 failed)"]) == {"failed"}


@pytest.mark.parametrize(("times", "expected"), [((10.0, 11.0, 12.0), "11.0 ± 2.5"), ((6.1, 14.3), "6.1 to 14.3")])
def test_an_interval_that_reaches_below_zero_gives_way_to_the_range(times: tuple[float, ...], expected: str) -> None:
    results = [scored("ash", view=27.0, pose=20.0, frame_ms=ms, seed=i) for i, ms in enumerate(times)]
    table = tables.build(RunTables(results), "loose", tables.cost_columns(("frame_ms",)), title="t")
    assert table.frame.iloc[0, 0] == expected
    sure = dict(sentences.facts(RunTables(results), "loose"))["How sure"]
    assert sure.startswith(f"{len(times)} trainings (seeds) of each method, on one person")


def test_what_is_published_replaces_what_was_before_and_is_a_run_again_which_does_without_the_capture(
    run: Run, tmp_path: Path
) -> None:
    place, again = tmp_path / "reports" / "fakes", tmp_path / "again"
    place.mkdir(parents=True)
    for path in (place / "chart_gone.svg", place / "findings.md", run.folder / "chart_of_an_earlier_report.svg"):
        path.write_text("before")
    report = (run.folder / "report.md").read_text()
    private = f"./ash-bench run --capture {run.folder.parent.resolve()}/loose --out runs/mine"
    public = f"./ash-bench run --capture {run.folder.parent.name}/loose --out runs/mine"
    (run.folder / "report.md").write_text(f"{report}\n    {private}\n")
    publish(replace(run, command=private), place)
    (run.folder / "report.md").write_text(report)
    there = {path.name for path in place.iterdir()}
    assert {"report.md", "results.csv", "tables.tex", "chart_boxes.svg", "findings.md"} <= there
    assert not there & {"chart_gone.svg", "chart_of_an_earlier_report.svg"} and "report.html" not in there
    assert (place / "report.md").read_text() == f"{report}\n    {public}\n"
    with pytest.raises(InputError, match=r"expected report\.md"):
        publish(replace(run, folder=tmp_path), place)
    assert (place / "report.md").exists()
    shutil.unpack_archive(place / "cells.zip", again)
    assert not any(str(run.folder.parent) in path.read_text() for path in again.rglob("*.json"))
    assert read_run(again).command == public
    assert results_of(read_run(again)) == results_of(run)
    sheets = ("pictures_boxes.webp", "worst_boxes.webp")
    for name in sheets:  # As an earlier report left them.
        shutil.copy(run.folder / name, again / name)
    command = ["report", str(again), "--publish", str(tmp_path / "second")]
    assert cli.main(command) == arguments.FAILED, "one method failed, and the report says so"
    for name in ("cells.zip", "results.csv"):
        assert (tmp_path / "second" / name).read_bytes() == (place / name).read_bytes()
    plain = (again / "report.md").read_text()
    assert all(f"]({name})" in plain and (again / name).exists() for name in sheets)
    assert "No pictures: own/manifest.json" in (again / "report.html").read_text()


def test_defects_are_pictured_severity_by_severity_beside_the_clean_capture(run: Run, tmp_path: Path) -> None:
    clean = next(cell for cell in run.cells if cell.config.method == "fake_good")
    steps = (("", 0.0), ("lens", 12.0), ("lens", 2.0), ("noise", 6.0))
    configs = [replace(clean.config, axis=axis, severity=severity) for axis, severity in steps]
    done = next(result for result in results_of(run) if result.config.key == clean.config.key)
    results = [replace(done, config=each) for each in configs]
    perturbed = replace(run, cells=tuple(replace(clean, config=each) for each in configs))
    (section,), sheets = defects.pictured(perturbed, results, clean.config.scene, album := Album())
    strips = section.blocks[0]
    ((_, rows),) = strips.groups
    assert [[caption for caption, _, _ in row.tiles] for row in rows] == [
        ["lens distortion that the calibration lacks", "clean", "2 px", "12 px"],
        ["more noise in the training images", "clean", "6 dB"],
    ]
    assert all(row.title.startswith(f"{strips.groups[0][0]}, novel views, camera ") for row in rows)
    scores = {score for row in rows for _, score, _ in row.tiles[1:]}
    assert len(scores) == 1 and re.fullmatch(r"[0-9.]+ dB", scores.pop())
    assert len(album.pictures) == 4 + 3
    (sheet,) = sheets.values()
    assert Image.open(io.BytesIO(sheet)).height > 2 * rows[0].width
    without = replace(perturbed, cells=tuple(replace(each, folder=run.folder / "none") for each in perturbed.cells))
    assert defects.pictured(without, results, clean.config.scene, Album()) == ([], {})
    (tmp_path / next(iter(sheets))).touch()
    earlier = defects.pictured(replace(without, folder=tmp_path), results, clean.config.scene, Album())
    assert earlier == ([replace(section, blocks=(replace(strips, groups=()),))], {})
    unclean = replace(perturbed, folder=tmp_path, cells=perturbed.cells[1:])
    assert defects.pictured(unclean, results, clean.config.scene, Album()) == earlier, "the clean capture is another's"
    assert defects.pictured(run, results_of(run), clean.config.scene, Album()) == ([], {}), "nothing is perturbed"


def test_no_count_of_gaussians_is_the_best_and_columns_have_names_of_their_own() -> None:
    regions = ("foreground", "full", "release_crop", "white_frame")
    results = []
    for method, count in (("ash", 3000.0), ("ddc", 0.0)):
        rows = [Summary(split="novel_view", region=region, metric="psnr", value=20.0) for region in regions]
        rows += [Summary(split="memory", region="", metric=metric, value=count) for metric in ("gaussians", "params")]
        results += [CellResult(config=config(method, seed), status="done", summary=tuple(rows)) for seed in range(2)]
    quantities = [Quantity("novel_view", region, "psnr") for region in regions]
    quantities += tables.cost_columns(("gaussians", "params"))
    table = tables.build(RunTables(results), "loose", quantities, title="")
    assert len(set(table.heads)) == len(table.heads) == 6
    assert [mark for _, mark in table.rows[1][1]] == ["", "", "", "", "", "best"]
    assert (table.heads[4][1], table.heads[5][1]) == ("Gaussians", "parameters ↓")


def test_a_report_says_what_each_rows_template_was_learned_from() -> None:
    def on(method: str, template: str, seed: int = 0) -> CellResult:
        end = TrainingOutcome(steps=9, seconds=1.0, ended_by="steps", template=template)
        return replace(scored(method, view=27.0, pose=20.0, seed=seed), training=end)

    images, scans = "learned from images: a linear map per node", "learned from scans: a linear map per node"
    results = [on("ash", images), on("ash", images, 1), on("ddc", images), on("by_scans", scans), on("static", "")]
    text = sentences.templates(RunTables(results), "loose")
    assert f": {images} (ASH, DDC); {scans} (template from scans)." in text


def test_the_main_table_is_followed_by_what_training_saw_of_the_views() -> None:
    def on(method: str, cameras: int, frames: int, subject: int = 0) -> CellResult:
        found = scored(method, view=27.0, pose=20.0)
        seen = {"train_cameras": cameras, "train_frames": frames}
        rows = tuple(Summary(split="speed", region="", metric=name, value=float(count)) for name, count in seen.items())
        own = replace(found.config, subject=subject)
        return replace(found, config=own, summary=(*found.summary, *rows))

    results = [on("ash", 20, 104), on("ash", 20, 104, 1), on("ddc", 20, 104), on("cams_12", 2, 37)]
    results += [on("cams_60", 10, 97), on("cams_60", 10, 98, 1), on("wo_mot_truncated", 20, 4)]
    results += [scored("cams_30", view=27.0, pose=20.0)]
    data = SceneData(
        run=Run(folder=Path("gone"), suite="t", about="", command="", cells=()),
        tables=RunTables(results),
        results=tuple(results),
        scene="loose",
        album=Album(),
        max_bytes=0,
        worst_frames=1,
    )
    main = next(section for section in scene_report(data)[0] if section.title == "Accuracy on loose")
    output = [block.text for block in main.blocks[1:] if isinstance(block, Text) and "training saw" in block.text]
    assert output == [
        "1/10 of cameras: training saw 2 of 20 cameras, 37 of 104 frames (paper: 12 of 120 cameras).",
        "1/2 of cameras: training saw 10 of 20 cameras, 97 to 98 of 104 frames (paper: 60 of 120 cameras).",
        "w/o mot., 40 s of footage: training saw 20 of 20 cameras, 4 of 104 frames (paper: 40 s of footage).",
    ]  # Of 1/4 of the cameras nothing is known.
    unknown = RunTables([scored("ash", view=27.0, pose=20.0), on("cams_12", 2, 37)])
    assert sentences.training_views(unknown, "loose") == []


def test_the_browser_sees_errors_overflow_faint_text_and_requests(visit: Visitor, tmp_path: Path) -> None:
    """Without which the checks below would say nothing."""
    (
        tmp_path / "page.html"
    ).write_text("""<!doctype html><meta name=viewport content='width=device-width'><title>t</title>
    <p>text</p><p style="color:#aaa">faint</p><div class="long" style="width:600px">wide</div><img src="gone.png">
    <meta http-equiv="Content-Security-Policy" content="script-src 'unsafe-inline'">
    <script>setTimeout(() => { try { eval("1") } catch {} throw new Error("thrown") })</script>""")
    seen = visit(tmp_path / "page.html", size=PHONE)
    seen.page.wait_for_timeout(100)
    assert any("thrown" in error for error in seen.errors) and any("gone.png" in error for error in seen.errors)
    assert any("unsafe-eval" in error or "Security" in error for error in seen.errors)
    assert len(seen.requests) == 1 and seen.requests[0].endswith("gone.png")
    assert any("long" in found for found in seen.too_wide())
    assert ['"faint"' in found for found in seen.poor_contrast()] == [True]


def walked(run: Run, visit: Visitor, size: tuple[int, int], scheme: Literal["light", "dark"]) -> Visit:
    """The page in a window, everything unfolded and walked through, so that whatever is lazy has come."""
    found = visit(run.folder / "report.html", size=size, scheme=scheme)
    found.page.evaluate("document.querySelectorAll('details').forEach((fold) => (fold.open = true))")
    for _ in range(40):
        found.page.evaluate("scrollBy(0, 500)")
        found.page.wait_for_timeout(20)
    drawn = "[...document.querySelectorAll('.panels > .vega')].every((box) => box.dataset.drawn)"
    for fact in (drawn, "[...document.images].every((image) => image.naturalWidth > 0)"):
        wait_for(partial(found.page.evaluate, fact))  # Playwright's own waiting is against the page's policy.
    return found


def check_nothing_is_wrong(seen: Visit) -> None:
    assert (seen.errors, seen.requests) == ([], [])
    assert seen.too_wide() == [] and seen.poor_contrast() == []
    found, broken = seen.page.evaluate("""async () => {
      const album = JSON.parse(document.getElementById("album").textContent);
      const loads = (text) => new Promise((done) => {
        const image = new Image();
        image.onload = () => done(0); image.onerror = () => done(1); image.src = "data:image/webp;base64," + text;
      });
      return [album.length, (await Promise.all(album.map(loads))).reduce((sum, each) => sum + each, 0)];
    }""")
    assert found > 20 and broken == 0
    heights = "(strip) => [...strip.querySelectorAll('img:not(.reference)')].map((image) => image.height)"
    for strip in seen.page.locator(".strip").all():
        found = strip.evaluate(heights)
        assert len(found) > 2 and len(set(found)) == 1, "truth and predictions stand at one height"


def test_nothing_is_wrong_on_a_phone_and_every_cell_of_a_table_is_in_sight_with_its_head(
    run: Run, visit: Visitor
) -> None:
    seen = walked(run, visit, PHONE, "dark")
    check_nothing_is_wrong(seen)
    page = seen.page
    page.set_viewport_size({"width": 360, "height": 740})
    cells = """[...document.querySelectorAll("td")].filter((cell) => cell.checkVisibility()).map((cell) => {
      const box = cell.getBoundingClientRect(), head = getComputedStyle(cell, "::before").content;
      return [box.left >= 0 && box.right <= innerWidth, !cell.dataset.head || head.includes(cell.dataset.head)];
    })"""
    found = page.evaluate(cells)
    assert len(found) > 50 and all(inside and named for inside, named in found)


def test_a_print_has_every_chart_and_picture_and_folds_again(run: Run, visit: Visitor) -> None:
    page = visit(run.folder / "report.html").page
    folded = "document.querySelectorAll('details:not([open])').length"
    page.evaluate(
        "addEventListener('beforeprint', () => { document.body.dataset.folded = FOLDED; })".replace("FOLDED", folded)
    )
    before = page.evaluate(folded)
    assert len(page.pdf(format="A4", print_background=True)) > 100_000
    assert page.evaluate("document.body.dataset.folded") == "0", "folded parts are printed"
    assert page.evaluate("[...document.querySelectorAll('.panels > .vega')].every((box) => box.querySelector('svg'))")
    assert page.evaluate("[...document.images].filter((image) => image.dataset.picture && !image.src).length") == 0
    assert before == page.evaluate(folded) > 0


def test_nothing_is_wrong_on_a_desktop_and_the_controls_work(run: Run, visit: Visitor) -> None:
    seen = walked(run, visit, DESKTOP, "light")
    check_nothing_is_wrong(seen)
    page = seen.page
    picture = page.locator("img[data-picture]").first
    picture.scroll_into_view_if_needed()
    picture.click()
    full = page.locator("#full img")
    size = "(image) => [image.width, image.naturalWidth]"
    wide, natural = full.evaluate(size)
    assert page.locator("#full").evaluate("(box) => box.open") and wide >= natural and wide % natural == 0
    full.click()
    assert full.evaluate(size)[0] == min(2 * wide, 8 * natural)
    page.keyboard.press("Escape")
    assert not page.locator("#full").evaluate("(box) => box.open")
    table = page.locator("table", has_text="PSNR").first
    values = """(table) => [...table.tBodies[0].rows]
      .map((row) => parseFloat(row.cells[1].textContent)).filter((value) => !isNaN(value))"""
    table.locator("thead button").nth(1).click()
    assert table.evaluate(values) == sorted(table.evaluate(values)) and len(table.evaluate(values)) == 2
    player = page.locator("[data-player]")
    frame, number, under = (player.locator(f"[data-{name}]") for name in ("frame", "number", "under"))
    player.locator("[data-edge]").focus()
    page.keyboard.press("End")
    assert player.locator(".slider").evaluate("(box) => box.style.getPropertyValue('--cut')") == "100%"
    before, shown = number.text_content(), under.get_attribute("src")
    frame.focus()
    page.keyboard.press("ArrowRight")
    assert number.text_content() != before and under.get_attribute("src") != shown, "a key steps through time"
    player.locator("[data-step='-1']").click()
    assert number.text_content() == before
    player.locator("[data-zoom]").select_option("4")
    wide, natural = player.locator("[data-over]").evaluate("(image) => [image.width, image.naturalWidth]")
    assert wide == 4 * natural, "pixels stay whole"
    tile = player.locator(".strip figure").nth(2)
    tile.locator("button").click()
    chosen = player.locator("[data-right]").evaluate("(list) => list.selectedOptions[0].textContent")
    assert tile.locator("figcaption").text_content().startswith(chosen) and chosen == "fake_bad"
    lines = player.locator("[data-frames] .vega svg")
    lines.click(position={"x": lines.bounding_box()["width"] - 12, "y": 40})
    page.wait_for_timeout(100)
    domain = lines.evaluate("(svg) => [...svg.querySelectorAll('.role-axis-label text')].map((t) => t.textContent)")
    last = fakes.TRAIN_FRAMES + fakes.TEST_FRAMES - 1
    assert int(number.text_content()) == last, f"a click on the chart goes there, {domain}"
    chart = page.locator("[data-chart]").first
    marks = "(chart) => chart.querySelectorAll('.panels .mark-symbol path').length"
    count, entry = chart.evaluate(marks), chart.locator(".legend button").first
    entry.click()
    page.wait_for_timeout(200)
    assert entry.get_attribute("aria-pressed") == "false"
    assert chart.evaluate(marks) < count, "an entry of the legend hides its series"
    assert seen.errors == []


def test_a_sheet_shows_every_row_once_those_of_a_user_first_and_our_main_ones_next() -> None:
    """A user's row may have the name of one of ours."""
    changed = replace(config("ddc"), changes={"training.seconds": 9.0})
    rows = [config("wo_disp"), config("ash"), changed]
    cells = [Cell(config=each, folder=Path()) for each in rows]
    shown = [Shown(cell=each, result=CellResult(config=each.config, status="done")) for each in cells]
    with titles_of([each.config for each in cells]):
        assert [each.cell.config.method for each in pictures.on_sheet(shown)] == ["ddc", "ash", "wo_disp"]
