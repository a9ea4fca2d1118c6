"""What a report says of one scene: findings, tables, charts and pictures, computed from the tables of results."""

from dataclasses import dataclass

import pandas as pd

from ash.capture.dataset import Capture
from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks.analysis import contrasts, conventions
from benchmarks.analysis.error_attribution import REGIONS
from benchmarks.analysis.scores import (
    HELD_OUT_SPLITS,
    MOTION_SPLITS,
    RANKED_SPLITS,
    Quantity,
    Scores,
    curves_of,
    foreground,
)
from benchmarks.analysis.style import EXACT, SPLIT_NAMES, is_ours, style_of
from benchmarks.cell.cells import CellResult
from benchmarks.cell.metrics import METRICS
from benchmarks.report import charts, differences, figures, people, pictures, sentences, tables, vega
from benchmarks.report.content import (
    Block,
    Bullets,
    Chart,
    Entry,
    Flipbook,
    Head,
    KeptSheet,
    Row,
    Section,
    Strips,
    Table,
    Text,
    texts,
)
from benchmarks.report.pictures import Album, Shown
from benchmarks.report.vega import Figure
from benchmarks.suites.runs import Run

IMAGE_SPLITS = (*RANKED_SPLITS, "train_view")  # In the order of the columns.
COSTS = (
    "frame_ms",
    *figures.STAGE_METRICS,
    "train_s",
    "train_cpu_s",
    "settled_s",
    "steps",
    "train_cameras",
    "train_frames",
    "peak_rss_mb",
    "params",
    "gaussians",
)
ON_SHEETS = ("ash", "ddc", "ash_truth", "ddc_truth")
AT_MOST_ON_SHEETS = 5
WORST, FEW_WORST, MANY = 3, 1, 24  # worst frames of each method; of more than so many methods on all scenes, one
COLOURS = ("blue", "orange", "red", "ochre", "grey")  # of the regions
SHEETS = {"pictures": "Truth, methods and errors", "pictures_people": "Everybody", "worst": "The worst frames"}
KEPT = "Sheets of an earlier report of this run: the capture or the pictures of its cells are not here any more."
SMALL = ("ci",)  # sizes and presets of smoke tests


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneData:
    """One scene of a run, with what its pictures may take."""

    run: Run
    scores: Scores
    results: tuple[CellResult, ...]  # of the unspoilt captures of the scene
    scene: str
    album: Album
    room: int  # bytes
    worst_frames: int


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneReport:
    """A scene's sections, its main tables (for LaTeX and terminals), and its sheets of pictures by file name."""

    sections: tuple[Section, ...]
    tables: tuple[Table, ...]
    sheets: dict[str, bytes]


def scene_report(data: SceneData) -> SceneReport:
    """Compute the part of one scene."""
    scores, scene = data.scores, data.scene
    capture, shown, trouble = _pictured(data)
    exposed = sentences.exposed(data.results)
    notes = [Text(text=doubt, note=True) for doubt in sentences.doubts(data.results)]
    seen = [Text(text=sentence, note=True) for sentence in sentences.views_seen(scores, scene)]
    quality = tables.build(scores, scene, _quality_quantities(), title=f"Accuracy on {scene}", exposed=exposed)
    cost = tables.build(scores, scene, tables.cost_columns(COSTS), title=f"Cost on {scene}", exposed=exposed)
    more = _more_tables(scores, scene)
    compared = contrasts.contrasts(scores, scene)
    beside = contrasts.contrasts(scores, scene, splits=tuple(s for s in MOTION_SPLITS if s not in RANKED_SPLITS))
    apart = (APART_NOTE,) if any(row.apart for row in quality.rows) else ()
    quality_note = " ".join((QUALITY_NOTE, *apart, VALUES_NOTE, differences.note(scores, scene, compared)))
    picture_sections, sheets = _picture_sections(data, capture, shown, trouble)
    sections = [
        Section(title=scene, headline=sentences.headline(scores, scene), blocks=tuple(_opening(data, capture))),
        Section(title=quality.title, blocks=(_untitled(quality), *seen, Text(text=quality_note, note=True), *notes)),
        Section(title=cost.title, blocks=(_untitled(cost), Text(text=COST_NOTE, note=True), *notes)),
        *differences.sections(scores, scene, compared, beside),
        *people.sections(scores, scene),
        *_exact(scores, scene),
        *picture_sections,
        *_time(data),
        Section(title=f"All other numbers of {scene}", blocks=more, folded=True),
        *_conventions(scores, scene),
    ]
    return SceneReport(sections=tuple(s for s in sections if s.blocks), tables=(quality, cost, *more), sheets=sheets)


QUALITY_NOTE = (
    "Quality on the foreground, LPIPS on the whole frame, IoU on the silhouette. Best and second best are marked "
    "among the methods that see only training views."
)
APART_NOTE = "Those below the line were given the exact surface, and are not ranked."
VALUES_NOTE = (
    "n/a: not measured (LPIPS needs the user's AlexNet weights). Where an interval would reach below zero, the range "
    "of the values stands instead."
)
COST_NOTE = (
    "A frame and its stages: median over frames of near held-out motion (of new motion, where a capture has no near "
    "one) after warm-up, one core, while other cells may run beside it. "
    "Training on one core: seconds by the clock, and the CPU time that was counted from outside. Memory: the peak of "
    "the cell's process, Python and libraries included."
)


def what_was_compared(data: SceneData, capture: Capture | None) -> str:
    """One paragraph for a stranger: methods, scene, subject, images, cameras, frames, preset and budget."""
    scores, scene, config = data.scores, data.scene, data.results[0].config
    rows = scores.clean.query("scene == @scene")
    names = [style_of(method).title for method in scores.methods(scene)]
    presets = ", ".join(dict.fromkeys(result.config.preset for result in data.results))
    folders, subjects = (list(map(str, rows[name].unique())) for name in ("capture", "subject"))
    shown = f"capture {folders[0]}" if len(folders) == 1 else f"{len(folders)} captures, {folders[0]} to {folders[-1]}"
    who = f"subject {subjects[0]}" if len(subjects) == 1 else f"subjects {', '.join(subjects)}"
    text = f"{_count(len(names), 'method')} ({'; '.join(names)}) were trained with preset {presets} on scene {scene}"
    text += f" ({shown}; {who})"
    if capture is not None:
        camera, train = next(iter(capture.cameras.values())), capture.splits["train"]
        text += f": {_count(len(train.cameras), 'camera')}, {_count(len(train.frames), 'frame')}"
        text += f", each seen by {len(train.parts[0])} of the cameras by turns," if train.parts else ""
        text += f" of {camera.width}x{camera.height} pixels"
    text += "."
    judged = []
    seen = scores.images.query("scene == @scene")[["split", "camera", "frame"]].drop_duplicates()
    for split, images in seen[seen["split"].isin(HELD_OUT_SPLITS)].groupby("split", sort=False):
        cameras, frames = (_count(images[name].nunique(), name) for name in ("camera", "frame"))
        judged.append(f"{len(images)} images of {SPLIT_NAMES[str(split)].words} ({cameras}, {frames})")
    if judged:
        text += f" They are judged on {', '.join(judged[:-1])}{' and ' if judged[1:] else ''}{judged[-1]}."
    seconds = rows.query("metric == 'train_s' and status == 'done'")["value"]
    if len(seconds):
        text += f" A training took {seconds.min():.0f} to {seconds.max():.0f} s on one core,"
        text += f" {_count(scores.seeds, 'seed')} each."
    if config.size in SMALL or set(presets.split(", ")) & set(SMALL):
        text += " This is a smoke test: it shows that every part works, and says nothing about which method is better."
    return text


def _opening(data: SceneData, capture: Capture | None) -> list[Block]:
    scores, scene = data.scores, data.scene
    figure = figures.speed_figure(scores, scene)
    blocks: list[Block] = [Text(text=what_was_compared(data, capture))]
    blocks.append(Bullets(items=tuple(sentences.remarks(scores, scene))))
    blocks += [Chart(figure=figure)] if figure else []
    front = sentences.frontier(scores, scene)
    return [*blocks, Bullets(items=front)] if front else blocks


def _untitled(table: Table) -> Table:
    return Table(title="", columns=table.columns, rows=table.rows, corner=table.corner, note=table.note)


def _quality_quantities() -> list[Quantity]:
    return [foreground("train_view"), *tables.quality_columns(("psnr", "gap", "ssim", "flip", "lpips", "iou"))]


def _more_tables(scores: Scores, scene: str) -> tuple[Table, ...]:
    geometry = [Quantity(split, "", metric) for split in HELD_OUT_SPLITS for metric in ("template_mm", "surface_mm")]
    geometry.append(foreground("novel_pose", "flicker"))
    regions = (("full", "psnr"), ("release_crop", "psnr"), ("full", "ssim"), ("full", "flip"))
    whole = [Quantity(split, region, metric) for split in IMAGE_SPLITS for region, metric in regions]
    training = [foreground("train_view", metric) for metric in ("psnr", "ssim", "flip")]
    ceiling = [foreground(split, "noise_ceiling") for split in (*HELD_OUT_SPLITS, "train_view")]
    novelty = [Quantity(split, "", "novelty_deg") for split in MOTION_SPLITS]
    asked = {
        "Geometry against the truth, and flicker beyond the truth's own": geometry,
        "Whole frame, and the crop of the released ASH code": whole,
        "Training views, the noise ceiling of the renders, and how far poses are from training's": [
            *training,
            *ceiling,
            *novelty,
        ],
    }
    found = [tables.build(scores, scene, quantities, title=title) for title, quantities in asked.items()]
    return tuple(table for table in found if table.columns)


def _exact(scores: Scores, scene: str) -> list[Section]:
    """The pair of methods with the honest template and with the exact surface, on each split."""
    blocks: list[Block] = []
    if not scores.whole(scene, *EXACT, *EXACT.values()):
        return []
    for split in RANKED_SPLITS:
        means = {m: s.mean for m in (*EXACT, *EXACT.values()) if (s := scores.get(scene, m, foreground(split)))}
        if len(means) < 2 * len(EXACT):
            continue
        pairs = {style_of(method).title: (means[method], means[exact]) for method, exact in EXACT.items()}
        rows = [
            Row(name=name, entries=texts(f"{honest:.2f}", f"{exact:.2f}", f"{exact - honest:+.2f}"))
            for name, (honest, exact) in pairs.items()
        ]
        (ash, ash_exact), (ddc, ddc_exact) = pairs.values()
        margins = [Entry(text=f"{margin:+.2f}", mark="strong") for margin in (ash - ddc, ash_exact - ddc_exact)]
        rows.append(Row(name="ASH minus DDC", entries=(*margins, Entry(text="")), apart=True))
        heads = tuple(Head(title=title, unit="dB") for title in ("honest template", "exact surface", "gain"))
        blocks.append(Table(title=SPLIT_NAMES[split].title, columns=heads, rows=tuple(rows)))
    note = (
        "Foreground PSNR. Splats can leave a wrong template, a textured mesh cannot: the margin between the two "
        "is a function "
        "of the template's error, and can change its sign."
    )
    blocks += [Text(text=note, note=True)] if blocks else []
    return [Section(title=f"What the template's error decides on {scene}", blocks=tuple(blocks))]


def _pictured(data: SceneData) -> tuple[Capture | None, list[Shown], str]:
    """The capture and the first finished cell of each method on it, the user's own first; or why there are none."""
    done = {result.config.key: result for result in data.results if result.status == "done"}
    first: dict[str, Shown] = {}
    for cell in data.run.cells:
        if cell.config.key in done:
            first.setdefault(cell.config.method, Shown(cell=cell, result=done[cell.config.key]))
    shown = [first[method] for method in data.scores.methods(data.scene) if method in first]
    shown = [each for each in shown if each.cell.config.capture == shown[0].cell.config.capture]
    if not shown:
        return None, [], "No pictures: every cell failed."
    try:
        return load_capture(shown[0].cell.capture_folder), shown, ""
    except InputError as error:
        return None, [], f"No pictures: {error}. The numbers come from {data.run.folder} and do not need it."


def _picture_sections(
    data: SceneData, capture: Capture | None, shown: list[Shown], trouble: str
) -> tuple[list[Section], dict[str, bytes]]:
    title = f"Side by side on {data.scene}"
    try:
        if capture is None:
            raise InputError(trouble)
        flipbook, sheets = _flipbook(data, capture, shown)
        everybody, cast_sheet = people.pictured(data.run, data.results, data.scores, data.scene, data.album)
        strips, worst_sheet = _worst(data, capture, shown)
    except InputError as error:
        reason = trouble or f"No pictures: {error}. The numbers come from {data.run.folder} and do not need it."
        kept = _kept_sheets(data)
        told = Text(text=KEPT if kept else reason, note=True)
        return [Section(title=title, blocks=(*kept, told))], {sheet.file: sheet.data for sheet in kept}
    note = (
        "Cropped to the subject, on grey; compressed for this page, while scores come from the stored pictures. "
        "First seed. "
        "Difference: that to the truth, four times enlarged."
    )
    sections = [Section(title=title, blocks=(flipbook, Text(text=note, note=True)))]
    if everybody is not None:
        typical = "Of held-out cameras and of new motion the view whose score by ASH is the person's median."
        sections.append(Section(title=everybody.title, blocks=(everybody, Text(text=typical, note=True))))
    if strips is not None:
        regions = (
            "Held-out motion, worst foreground PSNR first, each from another frame. FLIP error from black (0) to "
            "light yellow "
            f"(0.7). Regions: {', '.join(f'{region} ({name})' for region, name in zip(REGIONS, COLOURS, strict=True))}."
        )
        sections.append(
            Section(title=f"The worst frames on {data.scene}, and why", blocks=(strips, Text(text=regions, note=True)))
        )
    return sections, sheets | cast_sheet | worst_sheet


def _kept_sheets(data: SceneData) -> tuple[KeptSheet, ...]:
    """What an earlier report left in the run's folder, for cells whose pictures are not here."""
    places = {title: data.run.folder / f"{kind}_{data.scene}.png" for kind, title in SHEETS.items()}
    return tuple(
        KeptSheet(file=path.name, title=title, data=path.read_bytes())
        for title, path in places.items()
        if path.is_file()
    )


def _flipbook(data: SceneData, capture: Capture, shown: list[Shown]) -> tuple[Flipbook, dict[str, bytes]]:
    tracks = pictures.tracks(capture, shown, data.album, room=data.room)
    looks = vega.series_of([each.cell.config.method for each in shown])
    points = [
        {"track": index, "series": look.title, "frame": frame, "psnr": psnr}
        for index, track in enumerate(tracks)
        for look, scores in zip(looks, track["psnr"], strict=True)
        for frame, psnr in zip(track["frames"], scores, strict=True)
    ]
    chart = Figure(
        name=f"frames_{data.scene}",
        title="PSNR per frame",
        caption="PSNR of every frame shown; a click goes there.",
        panels=charts.frames(pd.DataFrame(points), looks),
        series=looks,
    )
    file = f"pictures_{data.scene}.png"
    wanted = [each for each in shown if not is_ours(each.cell.config.method)]
    wanted += [each for each in shown if each.cell.config.method in ON_SHEETS]
    sheet = pictures.sheet(pictures.comparisons(capture, (wanted or shown)[:AT_MOST_ON_SHEETS]))
    names = tuple(look.title for look in looks)
    return Flipbook(file=file, tracks=tuple(tracks), names=names, chart=chart), {file: sheet}


def _worst(data: SceneData, capture: Capture, shown: list[Shown]) -> tuple[Strips | None, dict[str, bytes]]:
    found = {each.title: pictures.worst(capture, each, count=data.worst_frames) for each in shown}
    found = {title: rows for title, rows in found.items() if rows}
    if not found:
        return None, {}
    file = f"worst_{data.scene}.png"
    groups = tuple((title, tuple(row.strip(data.album) for row in rows)) for title, rows in found.items())
    return Strips(file=file, title="The worst frames", groups=groups), {
        file: pictures.sheet(next(iter(found.values())))
    }


def _time(data: SceneData) -> list[Section]:
    training = figures.training_figure(data.scores, curves_of(data.results), data.scene)
    found = [figure for figure in (training, figures.stage_figure(data.scores, data.scene)) if figure]
    return [Section(title=f"Time on {data.scene}", blocks=tuple(Chart(figure=figure) for figure in found))]


def _conventions(scores: Scores, scene: str) -> list[Section]:
    asked = [(split, metric) for split in RANKED_SPLITS for metric in ("psnr", "ssim")]
    found = [comparison for pair in asked if (comparison := conventions.compare(scores, scene, *pair)) is not None]
    note = (
        "One set of predictions, four ways to score it. The release looks only inside the eroded mask; whole "
        "frames are "
        "diluted by background that everybody gets right. A rank in bold differs from ours."
    )
    title = f"The same renders of {scene} by the conventions of others"
    blocks: tuple[Block, ...] = (*map(_convention_table, found), Text(text=note, note=True)) if found else ()
    return [Section(title=title, blocks=blocks, folded=True)]


def _convention_table(found: conventions.Comparison) -> Table:
    measure = METRICS[found.metric]
    rows = []
    for method, values in found.values.iterrows():
        ranks = found.ranks.loc[method]
        entries = [
            Entry(
                text=f"{value:.{measure.decimals}f} #{ranks[region]}",
                sort=float(value),
                mark="strong" if ranks[region] != ranks["foreground"] else "",
            )
            for region, value in values.items()
        ]
        rows.append(Row(name=style_of(str(method)).title, entries=tuple(entries)))
    taus = tuple(Entry(text=f"{tau:.2f}", sort=tau) for tau in found.agreement)
    rows.append(Row(name="agreement with ours (Kendall's tau)", entries=taus, apart=True))
    heads = tuple(Head(title=title) for title in conventions.CONVENTIONS.values())
    return Table(title=f"{SPLIT_NAMES[found.split].title}, {measure.title}", columns=heads, rows=tuple(rows))


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"
