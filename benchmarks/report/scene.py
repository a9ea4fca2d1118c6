"""What a report says of one scene: findings, tables, charts and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from ash.capture.dataset import Capture
from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks.analysis import differences, paper
from benchmarks.analysis.error_attribution import REGIONS
from benchmarks.analysis.results import HELD_OUT_SPLITS, MOTION_SPLITS, RANKED_SPLITS, Quantity, RunTables
from benchmarks.analysis.style import SPLIT_NAMES, is_ours, style_of
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.schema import CellResult
from benchmarks.report import charts, figures, people, pictures, sentences, tables, vega
from benchmarks.report.content import Block, Facts, Flipbook, Mark, Section, Strips, Table, Text
from benchmarks.report.glossary import ROWS
from benchmarks.report.pictures import Album, Shown
from benchmarks.report.vega import Figure
from benchmarks.suites.runs import Run

COSTS = ("frame_ms", "train_s", "peak_rss_mb", "params", "gaussians")  # the others stand folded
WORST, FEW_WORST, MANY = 3, 1, 24  # worst frames of each method; of more than so many methods on all scenes, one
SHEETS = {"pictures": "Truth, methods and errors", "pictures_people": "All subjects", "worst": "The worst frames"}
HELD_OUT = {
    "novel_view": "cameras that no method was trained on",
    "near_pose": "a second take of a motion that was trained on",
    "novel_pose": "motion and cameras that no method was trained on",
    "far_pose": "motion unlike any that was trained on",
}
COLOURS = ("blue", "orange", "red", "ochre", "grey")  # of the regions
QUALITY_NOTE = (
    "Quality on the foreground, LPIPS on the whole frame. Where rows have several values, yellow is the best mean and "
    "orange the second, which may be chance: verdicts stand under the differences."
)
APART_NOTE = "Those below the line were given the exact surface, and are not ranked."
VALUES_NOTE = (
    "n/a: not measured (LPIPS: AlexNet's weights were absent). Where an interval would reach below zero, the range "
    "of the values stands instead."
)
COST_NOTE = (
    "A frame and its stages: median over frames of near novel poses (of new ones, where a capture has no near ones) "
    "after warm-up, one core, while other cells may run beside it. Training on one core: seconds by the clock, and CPU "
    "time measured from outside. Memory: the peak of the cell's process, Python and libraries included."
)
DIFFERENCES_NOTE = (
    "Foreground PSNR. Verdict on the method in the corner: better or worse if p is below 5 % and the difference above "
    f"{METRICS['psnr'].abs_tol:g} dB; equivalent if the interval lies within that margin; unclear otherwise. p is the "
    "chance of such a difference between equal methods, corrected for all rows of the table (Holm)."
)
CONVENTIONS_NOTE = (
    "One set of predictions, scored in four ways. The release scores only inside the eroded mask; whole frames are "
    "diluted by background that every method gets right. A rank in bold differs from ours."
)


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneData:
    """One scene of a run, and the bytes that its pictures may take."""

    run: Run
    tables: RunTables
    results: tuple[CellResult, ...]  # of the unperturbed captures of the scene
    scene: str
    album: Album
    max_bytes: int
    worst_frames: int


def scene_report(data: SceneData) -> tuple[list[Section], dict[str, bytes]]:
    """The sections of one scene, and its sheets of pictures by file name."""
    run_tables, scene = data.tables, data.scene
    capture: Capture | None = None
    shown, trouble = _first_cells(data), "No pictures: every cell failed, or has pictures without alpha."
    if shown:
        try:
            capture = load_capture(shown[0].cell.capture_folder)
        except InputError as error:
            trouble = _no_pictures(data, error)
    exposed = sentences.exposed(data.results)
    doubts = [Text(text=doubt, note=True) for doubt in sentences.doubts(data.results)]
    seen = [Text(text=each, note=True) for each in sentences.training_views(run_tables, scene)]
    asked = tables.main_columns(run_tables, scene)
    quality = tables.build(run_tables, scene, asked, title=f"Accuracy on {scene}", exposed=exposed)
    costs = tables.cost_columns(COSTS)
    cost = tables.build(run_tables, scene, costs, title=f"Cost on {scene}", exposed=exposed)
    more = _other_numbers(run_tables, scene, [*asked, *costs])
    ranked = differences.differences(run_tables.of(scene))
    note = " ".join((QUALITY_NOTE, *((APART_NOTE,) if quality.below else ()), VALUES_NOTE))
    picture_sections, sheets = _picture_sections(data, capture, shown, trouble)
    smoke = sentences.smoke(data.results)
    headline = sentences.headline(run_tables, scene, smoke=smoke)
    charts_first = [figures.speed_figure(run_tables, scene), figures.training_figure(run_tables, scene)]
    opening = Facts(items=tuple(_facts(data, capture, smoke=smoke)))
    compared_with = " and ".join(style_of(name).title for name in ranked["reference"].unique())
    sections = [
        Section(title=scene, headline=headline, blocks=(opening, *(chart for chart in charts_first if chart))),
        Section(title=quality.title, blocks=(_untitled(quality), *seen, Text(text=note, note=True))),
        Section(title=cost.title, blocks=(_untitled(cost), Text(text=COST_NOTE, note=True), *doubts)),
        Section(
            title=f"Differences to {compared_with} on {scene}",
            blocks=tuple(difference_tables(run_tables, scene, ranked, title="")),
        ),
        Section(title=f"Subject by subject on {scene}", blocks=people.blocks(run_tables, scene)),
        *picture_sections,
        Section(
            title=f"For specialists: statistics of {scene}",
            blocks=tuple(statistics_blocks(run_tables, scene)),
            folded=True,
        ),
        Section(title=f"All other numbers of {scene}", blocks=more, folded=True),
        Section(
            title=f"The same renders of {scene} by other conventions",
            blocks=_conventions(run_tables, scene),
            folded=True,
        ),
    ]
    return [section for section in sections if section.blocks], sheets


def _facts(data: SceneData, capture: Capture | None, *, smoke: bool) -> list[tuple[str, str]]:
    """What a reader asks first: what was compared on which data, what came out, how sure it is."""
    run_tables, scene = data.tables, data.scene
    rows, methods = run_tables.of(scene), run_tables.methods(scene)
    presets = ", ".join(dict.fromkeys(result.config.preset for result in data.results if result.brought is None))
    here, elsewhere = ([m for m in methods if (m in run_tables.brought) is brought] for brought in (False, True))
    meanings = {m: f" ({ROWS[m]})" if m in ROWS and is_ours(m) else "" for m in methods}
    names = ["; ".join(style_of(m).title + meanings[m] for m in some) for some in (here, elsewhere)]
    compared = (
        [f"{_count(len(here), 'method')}, sizes and training steps of preset {presets}: {names[0]}."] if here else []
    )
    compared += [f"Pictures of {_count(len(elsewhere), 'method')} from elsewhere: {names[1]}."] if elsewhere else []
    subjects = list(map(str, rows["subject"].unique()))
    truth = "synthetic, its true surface known; " if (rows["metric"] == "template_mm").any() else ""
    footage = f"Scene {scene}, {truth}subject{'s' if subjects[1:] else ''} {', '.join(subjects)}"
    if capture is not None:
        camera, train = next(iter(capture.cameras.values())), capture.splits["train"]
        footage += f". Training: {_count(len(train.cameras), 'camera')}, {_count(len(train.frames), 'frame')}"
        footage += f", each seen by {len(train.parts[0])} of the cameras in turn," if train.parts else ""
        footage += f" of {camera.width}x{camera.height} pixels"
    tests = []
    images = run_tables.images[run_tables.images["scene"] == scene][["split", "camera", "frame"]].drop_duplicates()
    for split, images_of_split in images[images["split"].isin(HELD_OUT_SPLITS)].groupby("split", sort=False):
        counts = (_count(images_of_split[name].nunique(), name) for name in ("camera", "frame"))
        what = f"{SPLIT_NAMES[str(split)].words}, {HELD_OUT[str(split)]}"
        tests.append(f"{_count(len(images_of_split), 'image')} of {what} ({', '.join(counts)})")
    of_scene = [c for c in data.run.cells if c.config.scene == scene and not c.config.axis]
    unfinished = len(of_scene) - len(data.results)
    known = dict(sentences.facts(run_tables, scene))
    if smoke:
        known.pop("Smallest sufficient", None)
    missing = [known.pop("Missing", "")]
    missing += [f"{unfinished} of {len(of_scene)} trainings are not finished."] if unfinished > 0 else []
    missing += [f"{_count(n, 'cell')} of the run: other shards have them."] if (n := len(data.run.absent)) else []
    facts = {
        "Compared": " ".join(compared),
        "Data": f"{footage}.",
        "Held out": f"{'; '.join(tests)}." if tests else "",
        **known,
        "Missing": " ".join(filter(None, missing)) or "Nothing: every method was trained and scored.",
    }
    return [(label, text) for label, text in facts.items() if text]


def difference_tables(run_tables: RunTables, scene: str, rows: pd.DataFrame, *, title: str) -> list[Block]:
    """The differences with intervals and verdicts."""
    rows = rows[rows["p"].notna()]  # Of single values there is no verdict.
    if rows.empty:
        return []
    test = "people, paired t" if run_tables.captures(scene) > 1 else "seeds, Welch"
    blocks: list[Block] = []
    for reference, table in rows.groupby("reference", sort=False):
        columns = {
            "split": table["split"].map(lambda split: SPLIT_NAMES[split].title),
            "verdict": table["verdict"],
            "difference [dB]": table["mean"].map("{:+.2f}".format),
            f"95 % interval [{test}]": [f"[{r.low:+.2f}, {r.high:+.2f}]" for r in table.itertuples()],
            "p [Holm]": table["p"].map("{:.2g}".format),
        }
        if table["needed"].notna().any():
            columns["people needed"] = table["needed"].map(tables.people_needed)
        frame = pd.DataFrame(columns).set_axis(table["method"].map(lambda method: style_of(method).title))
        marks: dict[tuple[int, int], Mark] = {(i, 2): "strong" for i, p in enumerate(table["p"]) if p < 0.05}
        corner = f"{style_of(str(reference)).title} minus"
        blocks.append(Table(title=title, corner=corner, frame=frame, marks=marks))
    return [*blocks, Text(text=DIFFERENCES_NOTE, note=True)]


def statistics_blocks(run_tables: RunTables, scene: str) -> list[Block]:
    """Templates, and differences on other splits."""
    learned = sentences.templates(run_tables, scene)
    blocks: list[Block] = [Text(text=learned)] if learned else []
    others = tuple(split for split in MOTION_SPLITS if split not in RANKED_SPLITS)
    beside = differences.differences(run_tables.of(scene), splits=others)
    blocks += difference_tables(run_tables, scene, beside, title="Near and far novel poses")
    return blocks


def _untitled(table: Table) -> Table:
    return Table(frame=table.frame, marks=table.marks, below=table.below)


def _other_numbers(run_tables: RunTables, scene: str, shown: Sequence[Quantity]) -> tuple[Table, ...]:
    """All quantities of the scene that no other table has, a table per split."""
    keys = run_tables.of(scene)[["split", "region", "metric"]].drop_duplicates().itertuples(index=False)
    quantities = [Quantity(*key) for key in keys if Quantity(*key) not in shown and key.metric != "failed"]
    by_title: dict[str, list[Quantity]] = {SPLIT_NAMES[split].title: [] for split in SPLIT_NAMES}
    for quantity in quantities:
        by_title[SPLIT_NAMES[quantity.split].title].append(quantity)
    return tuple(tables.build(run_tables, scene, own, title=title) for title, own in by_title.items() if own)


def _conventions(run_tables: RunTables, scene: str) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for split, metric in [(split, metric) for split in RANKED_SPLITS for metric in ("psnr", "ssim")]:
        if (values := paper.conventions(run_tables, scene, split, metric)) is not None:
            ranks, measure = values.rank(ascending=False, method="min").astype(int), METRICS[metric]
            texts = {
                paper.CONVENTIONS[region]: [
                    f"{v:.{measure.decimals}f} #{r}" for v, r in zip(values[region], ranks[region], strict=True)
                ]
                for region in values
            }
            moved = ranks.ne(ranks["foreground"], axis=0).to_numpy()
            index = [style_of(method).title for method in values.index]
            title = f"{SPLIT_NAMES[split].title}, {measure.title}"
            marks: dict[tuple[int, int], Mark] = {
                (int(i), int(k)): "strong" for i, k in zip(*moved.nonzero(), strict=True)
            }
            blocks.append(Table(title=title, frame=pd.DataFrame(texts, index=index), marks=marks))
    return (*blocks, Text(text=CONVENTIONS_NOTE, note=True)) if blocks else ()


def _first_cells(data: SceneData) -> list[Shown]:
    """The first finished cell of each method, the user's first; all on one capture."""
    finished = [result for result in data.results if result.status == "done" and result.has_alpha]
    methods, captures = data.tables.methods(data.scene), pictures.first_cells(data.run, finished)
    shown = ([cells[m] for m in methods if m in cells] for first in methods for cells in captures if first in cells)
    return next(shown, [])


def _no_pictures(data: SceneData, error: InputError) -> str:
    return f"No pictures: {error}. The numbers come from {data.run.folder} and do not need it."


def _picture_sections(
    data: SceneData, capture: Capture | None, shown: list[Shown], trouble: str
) -> tuple[list[Section], dict[str, bytes]]:
    title = f"Side by side on {data.scene}"
    try:
        if capture is None:
            raise InputError(trouble)
        flipbook, sheets = _flipbook(data, capture, shown)
        subjects, subject_sheet = people.pictured(data.run, data.results, data.tables, data.scene, data.album)
        strips, worst_sheet = _worst(data, capture, shown)
    except InputError as error:
        files = {f"{kind}_{data.scene}.webp": name for kind, name in SHEETS.items()}  # of an earlier report
        earlier = [Strips(file=f, title=name, groups=()) for f, name in files.items() if (data.run.folder / f).exists()]
        reason = Text(text=trouble if capture is None else _no_pictures(data, error), note=True)
        return [Section(title=title, blocks=(*earlier, reason))], {}
    note = (
        "Cropped to the subject, on grey; compressed for this page, while scores come from the stored pictures. First "
        "seed. Difference: that to the truth, four times enlarged."
    )
    if few := _people_pictured(data):
        note += f" Pictures are of {few}: the other cells are those of a published report, which holds no pictures."
    sections = [Section(title=title, blocks=(flipbook, Text(text=note, note=True)))]
    if subjects is not None:
        typical = "Of novel views and of novel poses the view whose score by ASH is the subject's median."
        sections.append(Section(title=subjects.title, blocks=(subjects, Text(text=typical, note=True))))
    if strips is not None:
        regions = ", ".join(f"{region} ({name})" for region, name in zip(REGIONS, COLOURS, strict=True))
        text = "Novel poses, worst foreground PSNR first, each from another frame. FLIP error from black (0) to light "
        text += f"yellow (0.7). Regions: {regions}."
        blocks = (strips, Text(text=text, note=True))
        sections.append(Section(title=f"The worst frames on {data.scene}, by image region", blocks=blocks))
    return sections, sheets | subject_sheet | worst_sheet


def _people_pictured(data: SceneData) -> str:
    """Of which people there are pictures, in words; empty where of all whose cells are done."""
    done = [result for result in data.results if result.status == "done"]
    people = {result.config.subject for result in done}
    shown = (each for cells in pictures.first_cells(data.run, done) for each in cells.values())
    pictured = sorted({each.cell.config.subject for each in shown})
    return f"subject {', '.join(map(str, pictured))} of {len(people)} people" if len(pictured) < len(people) else ""


def _flipbook(data: SceneData, capture: Capture, shown: list[Shown]) -> tuple[Flipbook, dict[str, bytes]]:
    tracks = pictures.tracks(capture, shown, data.album, max_bytes=data.max_bytes)
    series = tuple(vega.series_of(each.cell.config.method for each in shown).values())
    points = [
        {"track": index, "series": each.title, "frame": frame, "psnr": psnr}
        for index, track in enumerate(tracks)
        for each, scores in zip(series, track["psnr"], strict=True)
        for frame, psnr in zip(track["frames"], scores, strict=True)
    ]
    chart = Figure(
        name=f"frames_{data.scene}",
        title="PSNR per frame",
        caption="PSNR of every frame shown; a click goes there.",
        panels=charts.frames(pd.DataFrame(points), series),
        series=series,
    )
    file = f"pictures_{data.scene}.webp"
    sheet = pictures.sheet(pictures.comparisons(capture, pictures.on_sheet(shown)))
    names = tuple(each.title for each in series)
    return Flipbook(file=file, tracks=tuple(tracks), names=names, chart=chart), {file: sheet}


def _worst(data: SceneData, capture: Capture, shown: list[Shown]) -> tuple[Strips | None, dict[str, bytes]]:
    frames = {each.title: pictures.worst(capture, each, count=data.worst_frames) for each in shown}
    frames = {title: rows for title, rows in frames.items() if rows}
    if not frames:
        return None, {}
    file = f"worst_{data.scene}.webp"
    groups = tuple((title, tuple(row.strip(data.album) for row in rows)) for title, rows in frames.items())
    sheet = pictures.sheet(next(iter(frames.values())))
    return Strips(file=file, title="The worst frames", groups=groups), {file: sheet}


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"
