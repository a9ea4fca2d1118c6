"""How methods do on headings that training did not see: a table, and the view that is turned farthest."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress

from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks.analysis.headings import BINS, by_heading, changes, heading_deg
from benchmarks.analysis.results import MOTION_SPLITS, RunTables
from benchmarks.analysis.style import style_of
from benchmarks.cell.schema import CellResult, ViewScore
from benchmarks.report import pictures
from benchmarks.report.content import Block, Bullets, Section, Strips, Table, Text
from benchmarks.report.pictures import Album, Frames, Shown
from benchmarks.suites.runs import Run, capture_name_of

SHEET = "pictures_headings.webp"
NOTE = (
    "Foreground PSNR, means over all images of new poses, by the angle between the root's heading and the nearest one "
    "of a training frame. Columns hold other poses: compare within a column. The paper's motion input is in the world, "
    "so its networks learn what they see together with where the person faces."
)
Degrees = Mapping[tuple[str, int], float]  # of a held-out frame, by the name of its capture


def new_headings(
    run: Run, results: Sequence[CellResult], tables: RunTables, album: Album
) -> tuple[list[Section], dict[str, bytes]]:
    """A section where new poses have headings beyond 60 degrees from training, and its sheet of pictures by file name.

    Captures that are not at hand take no part.
    """
    degrees = _degrees(run)
    table = by_heading(tables.images, degrees)
    if not len(table):
        return [], {}
    blocks: list[Block] = [Bullets(items=tuple(changes(table)))]
    groups, rows = [], []
    for scene, here in table.groupby("scene", sort=False):
        wide = here.pivot(index="method", columns="bin", values="psnr").reindex(here["method"].unique())
        counts = here.groupby("bin")["frames"].first()
        wide = wide[[name for name in BINS if name in wide]].map("{:.1f}".format, na_action="ignore").fillna("n/a")
        frame = wide.set_axis([f"{name}, {counts[name]} frames [dB]" for name in wide.columns], axis=1)
        blocks.append(Table(title=str(scene), frame=frame.rename(index=lambda method: style_of(method).title)))
        if (row := _farthest(run, results, str(scene), degrees)) is not None:
            groups.append((str(scene), (row.strip(album),)))
            rows.append(row)
    blocks.append(Text(text=NOTE, note=True))
    if rows:
        blocks.append(Strips(file=SHEET, title="The view that is turned farthest", groups=tuple(groups)))
    return [Section(title="New headings", blocks=tuple(blocks))], {SHEET: pictures.sheet(rows)} if rows else {}


def _degrees(run: Run) -> dict[tuple[str, int], float]:
    """From the heading of each frame of a new pose to the nearest of training."""
    degrees: dict[tuple[str, int], float] = {}
    folders = {capture_name_of(cell): cell.capture_folder for cell in run.cells if not cell.config.axis}
    for name, folder in folders.items():
        with suppress(InputError):
            splits = (capture := load_capture(folder)).splits
            frames = [frame for split in MOTION_SPLITS if split in splits for frame in splits[split].frames]
            turned_deg = heading_deg(capture.motion, train=splits["train"].frames, test=frames)
            degrees |= {(name, frame): float(each) for frame, each in zip(frames, turned_deg, strict=True)}
    return degrees


def _farthest(run: Run, results: Sequence[CellResult], scene: str, degrees: Degrees) -> Frames | None:
    """The view of all captures of a scene that is turned farthest; None where a picture is missing."""
    farthest = []
    for by_method in pictures.first_cells(run, results):
        here = [each for each in by_method.values() if each.cell.config.place == scene and any(_turned(each, degrees))]
        shown = pictures.on_sheet(here)
        if shown:
            farthest.append((*max(_turned(shown[0], degrees), key=lambda turned: turned[0]), shown))
    if not farthest:
        return None
    _, view, shown = max(farthest, key=lambda each: each[0])
    with suppress(InputError):
        return pictures.compare(load_capture(shown[0].cell.capture_folder), shown, view, with_errors=False)
    return None


def _turned(shown: Shown, degrees: Degrees) -> Iterator[tuple[float, ViewScore]]:
    """The views of new poses that have a score, with how far they are turned."""
    for view in shown.result.views:
        if view.split in MOTION_SPLITS and ("foreground", "psnr") in view.scores:
            yield degrees.get((capture_name_of(shown.cell), view.frame), 0.0), view
