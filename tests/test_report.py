import html
import io
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from pathlib import Path

import fakes
import pytest
from cells import config

from ash.files import InputError
from benchmarks import charts, cli, findings, tables
from benchmarks.cells import CellResult, Summary, failed_result
from benchmarks.charts import Bar, Line, Panel, Point
from benchmarks.engine import Limits, make_executor, plan_cells, run_cells
from benchmarks.experiments import CaptureSpec, CellSpec
from benchmarks.progress import Progress
from benchmarks.report import publish, write_report
from benchmarks.runs import Run, cell_for, read_run, write_run
from benchmarks.scores import Scores

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def scored(method: str, *, view: float, pose: float, frame_ms: float = 10.0, seed: int = 0) -> CellResult:
    rows = (
        Summary(split="novel_view", region="foreground", metric="psnr", value=view),
        Summary(split="novel_pose", region="foreground", metric="psnr", value=pose),
        Summary(split="novel_view", region="foreground", metric="flip", value=1 / view),
        Summary(split="speed", region="", metric="frame_ms", value=frame_ms),
    )
    return CellResult(config=config(method, seed), status="done", summary=rows)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A finished run of fake methods, one of which fails."""
    folder = tmp_path_factory.mktemp("report")
    capture = fakes.write_capture(folder / "capture")
    out, spec = folder / "run", CaptureSpec(scene="boxes", size="ci")
    with pytest.MonkeyPatch.context() as patch:
        fakes.use(folder / "plugins", patch)
        names = ("fake_good", "fake_bad", "fake_nan")
        specs = [CellSpec(capture=spec, method=name, preset="ci", seed=0) for name in names]
        cells = tuple(cell_for(cell, capture, out) for cell in specs)
        found = Run(folder=out, suite="fakes", about="boxes", command="ash-bench run fakes", cells=cells)
        write_run(found)
        plan = plan_cells(cells)
        progress = Progress("cells", 3, expected_s=1.0, workers=2, stream=io.StringIO())
        with make_executor("local", workers=2) as executor:
            run_cells(plan, executor, Limits(seconds=60.0, memory_mb=4096), progress)
        write_report(found)
    return found


class Page(HTMLParser):
    """Collects what a page refers to, and whether its tags are balanced."""

    VOID = frozenset({"meta", "img", "input", "br", "link", "circle", "rect", "line", "path", "polyline"})

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
    assert page.references and all(reference.startswith("data:image/png") for reference in page.references)
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", text)
    assert "default-src 'none'" in text
    assert page.tags.count("svg") == 3, "the chart, the training curves and the stages"
    for words in (
        "fake_good is best on held-out views",
        "1 of 1 failed",
        "diverged",
        "Protocol 1",
        "noise ceiling 39.9",
    ):
        assert words in text


def test_the_charts_are_valid_svg_and_adapt_to_dark_pages(run: Run) -> None:
    text = (run.folder / "chart_boxes.svg").read_text()
    assert ElementTree.fromstring(text).tag == "{http://www.w3.org/2000/svg}svg"
    assert "prefers-color-scheme:dark" in text
    assert "nan" not in text.replace("fake_nan", "")


def test_markdown_and_latex_say_the_same_as_the_page(run: Run) -> None:
    page, plain = (run.folder / "report.html").read_text(), (run.folder / "report.md").read_text()
    tex = (run.folder / "tables.tex").read_text()
    bold = re.findall(r"\*\*([\d.]+)\*\*", plain)
    assert bold and all(f">{number}<" in page for number in bold)
    assert all(rf"\cellcolor{{yellow}}{number}" in tex for number in bold)
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == tex.count(r"\toprule") > 2
    assert "fake\\_good" in tex


def test_the_report_does_without_the_capture(run: Run, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run.folder, tmp_path / "copy"))
    for path in copy.rglob("config.json"):
        path.write_text(re.sub(r'"capture_folder": "[^"]*"', '"capture_folder": "/gone"', path.read_text()))
    write_report(read_run(copy))
    assert "No pictures: /gone/manifest.json" in (copy / "report.html").read_text()
    assert (copy / "results.csv").read_bytes() == (run.folder / "results.csv").read_bytes()


def test_headline_of_the_duel() -> None:
    ahead = Scores([scored("ash", view=27.9, pose=22.3), scored("ddc", view=24.8, pose=22.25)])
    assert findings.headline(ahead, "loose") == (
        "On loose, ASH is 3.1 dB ahead of DDC on held-out views (27.9 against 24.8 dB) "
        "and level with DDC on held-out motion (22.3 against 22.2 dB)."
    )
    behind = Scores([scored("ash", view=24.0, pose=20.0), scored("ddc", view=25.0, pose=19.0)])
    assert "1.0 dB behind DDC on held-out views" in findings.headline(behind, "loose")
    exact = Scores(
        [*ahead.results, scored("ash_truth", view=30.0, pose=29.0), scored("ddc_truth", view=32.0, pose=31.0)]
    )
    assert any("the mesh leads by 2.0 dB" in remark for remark in findings.remarks(exact, "loose"))


def test_best_and_second_are_marked_as_printed_and_oracles_are_not_ranked() -> None:
    results = [
        scored("ash", view=27.904, pose=20.0, frame_ms=40.0),
        scored("wo_disp", view=27.901, pose=19.0, frame_ms=30.0),
        scored("ddc", view=24.0, pose=21.0, frame_ms=6.0),
        scored("ash_truth", view=33.0, pose=33.0, frame_ms=1.0),
        failed_result(config("mlp", 0), "crashed", "boom"),
    ]
    columns = [*tables.quality_columns(("psnr", "flip")), *tables.cost_columns(("frame_ms",))]
    table = tables.build(Scores(results), "loose", columns, title="t")
    marks = {row.name: [entry.mark for entry in row.entries] for row in table.rows}
    assert [c.metric for c in table.columns] == ["psnr", "flip", "psnr", "flip", "frame_ms"]
    assert marks["ASH"][:1] == marks["w/o disp."][:1] == ["best"], "equal as printed"
    assert marks["DDC"] == ["second", "second", "best", "", "best"]
    assert set(marks["ASH, exact surface"]) == {""} and table.rows[-1].oracle
    crashed = next(row for row in table.rows if row.name == "w/ MLP")
    assert {entry.text for entry in crashed.entries} == {"failed"} and crashed.note == "1 of 1 failed"


def test_several_seeds_give_intervals() -> None:
    results = [scored("ash", view=27.0 + seed, pose=20.0, seed=seed) for seed in range(3)]
    table = tables.build(Scores(results), "loose", tables.quality_columns(("psnr",)), title="t")
    assert table.rows[0].entries[0].whole == "28.00 ± 2.48"
    assert not any("One seed" in remark for remark in findings.remarks(Scores(results), "loose"))


def test_labels_overlap_neither_each_other_nor_points() -> None:
    anchors = [(100.0, 100.0), (108.0, 103.0), (104.0, 96.0), (190.0, 100.0), (112.0, 100.0)]
    widths = [70.0, 60.0, 80.0, 90.0, 50.0]
    places = charts.place_labels(anchors, widths, (0.0, 0.0, 300.0, 200.0))
    boxes = [(x, y - 10, x + w, y + 2) for (x, y), w in zip(places, widths, strict=True)]
    points = [(x - 5, y - 5, x + 5, y + 5) for x, y in anchors]
    for i, a in enumerate(boxes):
        assert a[0] >= 0 and a[2] <= 300
        for b in boxes[i + 1 :] + points:
            assert min(a[2], b[2]) <= max(a[0], b[0]) or min(a[3], b[3]) <= max(a[1], b[1])


def test_chart_positions_follow_the_values() -> None:
    points = tuple(
        Point(x=x, y=y, label=f"m{x}", colour="#123456") for x, y in ((1.0, 18.0), (10.0, 22.0), (100.0, 24.0))
    )
    root = ElementTree.fromstring(charts.scatter([Panel(title="p", points=points)], x_title="x", y_title="y"))
    circles = root.findall("{http://www.w3.org/2000/svg}circle")
    x, y = ([float(circle.attrib[name]) for circle in circles] for name in ("cx", "cy"))
    assert x[1] - x[0] == pytest.approx(x[2] - x[1], abs=0.2), "equal ratios are equal distances"
    assert (y[0] - y[1]) / (y[1] - y[2]) == pytest.approx(2, abs=0.02)


def test_charts_of_nothing_and_of_one_value() -> None:
    assert "no results" in charts.scatter([], x_title="x", y_title="y")
    point = Point(x=5.0, y=0.0, label="a<b&c", colour="#123456")
    ElementTree.fromstring(charts.scatter([Panel(title="p", points=(point,))], x_title="x", y_title="y"))
    assert charts.curves([Line(label="a", colour="#123456", points=())], x_title="x", y_title="y") == ""
    assert charts.bars([], ["a"], ["#123456"], unit="ms") == ""
    ElementTree.fromstring(charts.bars([Bar(label="a", parts=(1.0, 2.0))], ["s", "t"], ["#111", "#222"], unit="ms"))


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_the_page_works_in_a_browser(run: Run, tmp_path: Path) -> None:
    """Tables sort, the slider shows pictures, nothing is logged and nothing leaves the page."""
    probe = """<script>
    const errors = [];
    window.addEventListener("error", (event) => errors.push(event.message));
    window.addEventListener("securitypolicyviolation", (event) => errors.push(event.blockedURI));
    window.addEventListener("load", () => {
      const table = document.querySelector("table");
      const names = () => [...table.tBodies[0].rows].map((row) => row.cells[0].textContent);
      const before = names(), button = table.querySelectorAll("thead button")[1];
      button.click();
      const up = [...table.tBodies[0].rows].map((row) => row.cells[1].dataset.value);
      button.click();
      const slider = document.querySelector(".slider img");
      document.title = JSON.stringify({ errors, before, up, after: names(), shown: slider.naturalWidth > 0,
        charts: [...document.querySelectorAll("svg")].map((svg) => svg.getBoundingClientRect().height > 50),
        wide: document.documentElement.scrollWidth > document.documentElement.clientWidth,
        requests: performance.getEntriesByType("resource").filter((entry) => !entry.name.startsWith("data:")).length });
    });
    </script>"""
    page = tmp_path / "page.html"
    page.write_text((run.folder / "report.html").read_text().replace("<title>", probe + "<title>", 1))
    flags = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
    flags += " --disable-component-update --disable-sync --virtual-time-budget=4000 --dump-dom"
    command = [str(CHROMIUM), *flags.split(), f"--user-data-dir={tmp_path / 'profile'}", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    told = json.loads(html.unescape(re.search(r"<title>(.*?)</title>", done.stdout, re.S).group(1)))
    assert told["errors"] == [] and told["requests"] == 0
    assert told["shown"] and all(told["charts"]) and not told["wide"]
    values = [float(value) for value in told["up"] if value]
    assert values == sorted(values) and len(values) == 3
    assert sorted(told["after"]) == sorted(told["before"]) and told["after"][0] == "fake_good"


def test_conventions_move_the_ranking_and_say_how_far() -> None:
    from scipy.stats import kendalltau

    from benchmarks.conventions import CONVENTIONS, compare, kendall

    def scored_so(method: str, values: tuple[float, ...]) -> CellResult:
        regions = [convention.region for convention in CONVENTIONS]
        rows = [
            Summary(split="novel_view", region=region, metric="psnr", value=value)
            for region, value in zip(regions, values, strict=True)
        ]
        return CellResult(config=config(method, 0), status="done", summary=tuple(rows))

    results = [
        scored_so("ash", (27.0, 30.0, 25.0, 36.0)),
        scored_so("ddc", (25.0, 31.0, 24.0, 37.0)),
        scored_so("mlp", (24.0, 28.0, 26.0, 35.0)),
        scored_so("ash_truth", (40.0, 40.0, 40.0, 40.0)),
    ]
    found = compare(Scores(results), "loose", "novel_view", "psnr", title="t")
    assert found is not None and [s.name for s in found.standings] == ["ASH", "DDC", "w/ MLP"]
    assert [s.ranks for s in found.standings] == [(1, 2, 2, 2), (2, 1, 3, 1), (3, 3, 1, 3)]
    assert found.agreement == pytest.approx((1, 1 / 3, -1 / 3, 1 / 3))
    a, b = [1.0, 4.0, 2.0, 3.0], [2.0, 3.0, 1.0, 4.0]
    assert kendall(a, b) == pytest.approx(kendalltau(a, b).statistic)
    assert compare(Scores(results[:1]), "loose", "novel_view", "psnr", title="t") is None


def test_the_necessity_matrix_says_what_its_intervals_allow() -> None:
    from dataclasses import replace

    from benchmarks.necessity import matrix

    def scene(name: str, method: str, values: list[float]) -> list[CellResult]:
        found = [scored(method, view=value, pose=20.0, seed=seed) for seed, value in enumerate(values)]
        return [replace(result, config=replace(result.config, scene=name)) for result in found]

    results = scene("still", "ash", [27.0, 27.02, 26.98]) + scene("still", "wo_mot", [27.01, 27.0, 27.02])
    results += scene("swing", "ash", [27.0, 27.1, 26.9]) + scene("swing", "wo_mot", [24.0, 24.1, 23.9])
    results += scene("lit", "ash", [27.0, 27.1, 26.9]) + scene("lit", "wo_mot", [25.0, 28.0, 26.0])
    found = matrix(Scores(results), "novel_view", title="t")
    assert found is not None and found.parts == ("w/o mot.",)
    assert {row.scene: row.losses[0].verdict for row in found.rows} == {
        "still": "not needed",
        "swing": "needed",
        "lit": "unclear",
    }
    assert matrix(Scores(scene("still", "ash", [1.0])), "novel_view", title="t") is None


def test_a_failed_method_is_compared_with_nobody() -> None:
    from benchmarks.contrasts import contrasts

    whole = [scored("ash", view=27.0 + seed, pose=20.0, seed=seed) for seed in range(2)]
    whole += [scored("ash_truth", view=30.0, pose=29.0), failed_result(config("ddc_truth", 0), "timeout", "slow")]
    fallen = Scores([*whole, *(failed_result(config("ddc", seed), "crashed", "boom") for seed in range(2))])
    assert findings.headline(fallen, "loose") == "On loose, DDC failed, so ASH and DDC cannot be compared."
    assert not any("exact surface, " in remark and "leads" in remark for remark in findings.remarks(fallen, "loose"))
    assert contrasts(fallen, "loose") == ()


def test_a_published_report_replaces_the_one_before_and_leaves_the_rest_alone(run: Run, tmp_path: Path) -> None:
    place = tmp_path / "reports" / "fakes"
    place.mkdir(parents=True)
    for name in ("chart_gone.svg", "findings.md"):
        (place / name).write_text("before")
    command = ["report", str(run.folder), "--publish", str(place)]
    assert cli.main(command) == cli.FAILED, "one method failed, and the report says so"
    there = {path.name for path in place.iterdir()}
    assert {"report.md", "results.csv", "tables.tex", "chart_boxes.svg", "findings.md"} <= there
    assert "chart_gone.svg" not in there and "report.html" not in there
    assert (place / "report.md").read_bytes() == (run.folder / "report.md").read_bytes()
    with pytest.raises(InputError, match=r"expected report\.md"):
        publish(tmp_path, place)
    assert (place / "report.md").exists()


def test_a_point_far_below_the_others_stands_at_the_floor_with_its_value() -> None:
    near = [Point(x=10.0 + i, y=28.0 + i, label=f"near {i}", colour="#123456") for i in range(3)]
    far = Point(x=20.0, y=11.0, label="far", colour="#654321")
    alone, beside = (
        charts.scatter([Panel(title="", points=tuple(p))], x_title="", y_title="") for p in (near, [*near, far])
    )
    assert "far: 11.0 ↓" in beside
    heights = [[float(cy) for cy in re.findall(r'cy="([\d.]+)"', chart)] for chart in (alone, beside)]
    assert heights[1][3] > max(heights[1][:3]), "below all others"
    spread = [max(h[:3]) - min(h[:3]) for h in heights]
    assert spread[1] > 0.15 * spread[0], "the others stay apart"


def test_a_label_that_had_to_stand_apart_has_a_line_to_its_point() -> None:
    crowd = [Point(x=10.0, y=28.0 + 0.02 * i, label=f"one of many {i}", colour="#123456") for i in range(12)]
    lonely = [Point(x=10.0, y=34.0, label="alone", colour="#123456")]
    crowd += lonely
    lines = [
        charts.scatter([Panel(title="", points=tuple(p))], x_title="", y_title="").count('stroke-width="0.8"')
        for p in (crowd, lonely)
    ]
    assert lines[0] > 2 and lines[1] == 0
