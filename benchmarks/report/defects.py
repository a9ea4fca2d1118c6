"""How a method draws a person whom it learned from captures with defects: one view, severity by severity."""

from collections.abc import Sequence
from dataclasses import replace

from ash.capture.dataset import Capture
from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks.analysis.curves import FOOTAGE_AXIS
from benchmarks.analysis.error_attribution import psnr_of
from benchmarks.analysis.style import prominence
from benchmarks.cell import metrics
from benchmarks.cell.schema import CellResult, ViewScore, stored_prediction
from benchmarks.report import pictures
from benchmarks.report.content import Section, Strips, Text
from benchmarks.report.pictures import Album, Frame, Frames, Shown
from benchmarks.suites.runs import Run
from benchmarks.suites.stress import AXES, TRIVIAL

SPLIT = "novel_view"
CLEAN = ("", 0.0)  # axis and severity
NOTE = (
    "A typical novel view of subject {subject} by {method}, trained on the clean capture and on captures with a "
    "defect, with its foreground PSNR."
)


def pictured(
    run: Run, results: Sequence[CellResult], scene: str, album: Album
) -> tuple[list[Section], dict[str, bytes]]:
    """A row for each defect, with the truth and the clean capture first: of one method and a person with most steps.

    Where no method has pictures of the clean capture and of one with a defect: the sheet of an earlier report, if any.
    """
    done = [each for each in results if each.config.scene == scene and each.status == "done" and each.has_alpha]
    trained: dict[tuple[str, int], dict[tuple[str, float], Shown]] = {}
    for by_method in pictures.first_cells(run, [each for each in done if each.config.axis != FOOTAGE_AXIS]):
        for method, shown in by_method.items():
            config = shown.cell.config
            trained.setdefault((method, config.subject), {})[config.axis, config.severity] = shown
    title, file = f"Defects on {scene}", f"pictures_defects_{scene}.webp"
    sheet = Section(title=title, blocks=(Strips(file=file, title=title, groups=()),))
    earlier = [sheet] if (run.folder / file).exists() else []
    whole = [key for key, own in trained.items() if key[0] != TRIVIAL and CLEAN in own and len(own) > 1]
    if not whole:
        return earlier, {}
    method, subject = min(whole, key=lambda key: (prominence(key[0]), -len(trained[key])))
    own = trained[method, subject]
    views = [{(v.camera, v.frame) for v in each.result.views if v.split == SPLIT} for each in own.values()]
    scored = tuple(v for v in own[CLEAN].result.views if (v.camera, v.frame) in set.intersection(*views))
    chosen = pictures.choose_views(replace(own[CLEAN].result, views=scored), SPLIT, 1)
    axes = [axis for axis in AXES if any(axis == name for name, _ in own)]
    try:
        capture = load_capture(own[CLEAN].cell.capture_folder)
        rows = [_row(axis, own, capture, view) for view in chosen for axis in axes]
    except InputError:  # The cells of a published report have no pictures.
        return earlier, {}
    if not rows:
        return [], {}
    name = own[CLEAN].title
    strips = Strips(file=file, title=title, groups=((name, tuple(row.strip(album) for row in rows)),))
    note = Text(text=NOTE.format(subject=subject, method=name), note=True)
    return [Section(title=title, blocks=(strips, note))], {file: pictures.sheet(rows)}


def _row(axis: str, own: dict[tuple[str, float], Shown], capture: Capture, view: ViewScore) -> Frames:
    """The view as it is, as learned from the clean capture, and at each severity, the least first."""
    truth = metrics.on_black(capture.image(view.camera, view.frame))
    crop = pictures.crop_of([truth])
    images = [Frame(caption=AXES[axis].title, score="truth", pixels=pictures.on_paper(truth[crop]))]
    for name, severity in sorted(own):
        if name in (axis, CLEAN[0]):
            each = own[name, severity]
            drawn = stored_prediction(each.cell, capture, view)
            caption = f"{severity:g} {AXES[axis].unit}" if name else "clean"
            score = f"{psnr_of(pictures.score_of(each, view)):.1f} dB"
            images.append(Frame(caption=caption, score=score, pixels=pictures.on_paper(drawn[crop])))
    return Frames(title=f"{own[CLEAN].title}, {pictures.title_of(view)}", images=tuple(images))
