"""A cell: one method trained once on one capture, and everything that was found out about it.

A cell lives in a folder of its own, named by the hash of what went in:

    config.json     what goes in: method, preset, seed, capture and its identity, code, protocol
    log.jsonl       the method's training log, one object per line
    output.log      what the process printed, bounded
    model.safetensors   the trained method
    work/           the method's own folder, all that it can write to: its checkpoints
    input/          the training part of the capture, all that the method sees; only while it runs
    images/SPLIT/CAM/FRAME.png   predictions, RGBA uint8, colour on black: `rescore` reads them
    result.json     what came out; written last, atomically: where it exists, the cell is finished
"""

import contextlib
from collections.abc import Collection
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ash.capture.dataset import Capture
from ash.capture.manifest import NAME as MANIFEST
from ash.capture.typed import from_json
from ash.fields import suggest
from ash.files import InputError, hash_of, one_line, read_image, read_json, require_plain, sha256_of, write_json
from ash.protocol import TrainingOutcome
from benchmarks.cell.metrics import IMAGE_SPLITS, LPIPS_SCORES, METRICS, PROTOCOL, VIEW_SCORES, weights_file

DrawnBy = Literal["method", "display", "trainer"]  # a timed frame; "trainer": the display did not open there
Status = Literal["done", "crashed", "diverged", "timeout", "out of memory"]
VARIED = ("factory", "changes", "subject")
# Texts of a result, for people to read.
PRINTED = ("reason", "training", "provenance", "drawn_on", "evaluated_code", "brought")
CHECKPOINT = "model.safetensors"
BROUGHT_NOTE = "brought pictures; what it saw is not known"  # of rows whose pictures were rendered elsewhere
RETIRED = ("choice", "search_seconds")


class MethodFailed(Exception):
    """The method did not come through; `status` says how."""

    def __init__(self, status: Status, reason: str) -> None:
        super().__init__(one_line(reason))
        self.status: Status = status


class CaptureModifiedError(MethodFailed):
    """The capture is no longer what it was when a method that could reach it began."""

    def __init__(self, damage: str) -> None:
        super().__init__("crashed", f"while it ran without isolation the capture was changed: {damage}")


class HarnessFailed(Exception):
    """Something of ours failed before the method began, so that the method has no result from it."""


class Killed(Exception):
    """The method's process was killed by somebody else, such as the kernel for want of memory."""


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """One image to score."""

    split: str
    camera: str
    frame: int


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingTime:
    """Seconds of a training, seen from outside: by the clock, and of CPU time of all the method's processes.

    A process that was stopped, or shared its core, has less of the latter; one that used several cores has more.
    """

    wall_s: float
    cpu_s: float | None  # None: a result from before it was measured


@dataclass(frozen=True, kw_only=True, slots=True)
class CellConfig:
    """What goes into a cell. Equal configs give equal cells, so their hash is the cell's name."""

    scene: str
    size: str
    capture_seed: int
    capture: str  # identity of the capture: SHA-256 of its manifest
    method: str
    preset: str
    seed: int
    code: str  # SHA-256 over the sources that decide the outcome
    truth: str = ""  # what the capture shows, on any machine: hash of scene, generator and perturbation
    axis: str = ""  # the axis of the perturbation; empty: the clean capture
    severity: float = 0.0
    factory: str = ""  # an entry point or `package.module:factory`, where the row `method` has another name than that
    changes: dict[str, Any] = field(default_factory=dict)  # in the method's configuration: dotted key to new value
    subject: int = 0  # whom the capture shows
    protocol: str = PROTOCOL

    @property
    def key(self) -> str:
        """The cell's name. Cells from before methods and subjects could be varied keep theirs."""
        return hash_of({name: value for name, value in asdict(self).items() if name not in VARIED or value})[:16]

    @property
    def source(self) -> str:
        """The entry point or `package.module:factory` that makes the avatar."""
        return self.factory or self.method

    @property
    def device(self) -> str:
        """Where the method learns: the CPU, where it has no choice or none was made."""
        return str(self.changes.get("device", "cpu"))

    @property
    def place(self) -> str:
        """The scene, and the perturbation of its capture."""
        return f"{self.scene} {self.axis}={self.severity:g}" if self.axis else self.scene

    @property
    def title(self) -> str:
        """For progress lines and errors."""
        who = f" · subject {self.subject}" if self.subject else ""
        return f"{self.place}{who} · {self.method} · seed {self.seed}"


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewScore(View):
    """Scores of one image. `scores` maps (region, metric) to its value."""

    prediction: str  # SHA-256 of the pixels
    scores: dict[tuple[str, str], float]


@dataclass(frozen=True, kw_only=True, slots=True)
class Summary:
    """One row of results.csv, without the columns that say which cell it is."""

    split: str
    region: str
    metric: str
    value: float


@dataclass(frozen=True, kw_only=True, slots=True)
class CurvePoint:
    """One line of the training log: seconds of training, and the loss or PSNR (dB) at that time."""

    seconds: float
    loss: float | None
    psnr: float | None


@dataclass(frozen=True, kw_only=True, slots=True)
class Snapshot:
    """Foreground PSNR, dB, that the avatar would have had after so many seconds of training, on one split."""

    seconds: float
    split: str
    psnr: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Timing:
    """Milliseconds per timed frame, whole and by stage; `reference_ms` times a fixed workload between the frames.

    `agreement_db`: the least foreground PSNR between a timed picture and the scored one of the same view.
    """

    frame_ms: tuple[float, ...]
    stage_ms: dict[str, tuple[float, ...]]
    reference_ms: tuple[float, ...]
    drawn_by: DrawnBy = "method"
    agreement_db: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Provenance:
    """Where and with what a result was made."""

    commit: str
    machine: dict[str, str]
    versions: dict[str, str]
    wall_s: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Brought:
    """What the authors of brought pictures say of them; none of it was measured here, and none is compared."""

    alpha: Literal["straight", "premultiplied", "none"] = "straight"  # none: RGB, scored on the whole frame only
    training_s: float | None = None  # seconds
    frame_ms: float | None = None  # milliseconds per frame
    device: str | None = None
    parameters: int | None = None
    commit: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class CellResult:
    """What came out of a cell. A failed cell has the worst score in every row, never a missing row."""

    config: CellConfig
    status: Status
    reason: str = ""
    summary: tuple[Summary, ...] = ()
    views: tuple[ViewScore, ...] = ()
    timing: Timing | None = None
    curve: tuple[CurvePoint, ...] = ()
    training: TrainingOutcome | None = None  # as the method tells it
    snapshots: tuple[Snapshot, ...] = ()
    provenance: Provenance | None = None
    drawn_on: str = ""  # device of its pictures: `eval` may take another than the one that learned; empty: unknown
    evaluated_code: str = ""  # of `eval`, where it is not the code of the config, which trained; empty: the same code
    isolated: bool | None = None  # whether the method ran in a sandbox; None: an oracle, a failure, an old result
    brought: Brought | None = None  # of pictures that were rendered elsewhere: what the method saw is not known

    @property
    def has_alpha(self) -> bool:
        """Whether its pictures have alpha: those of methods do, brought ones may have none."""
        return self.brought is None or self.brought.alpha != "none"

    def value(self, split: str, region: str, metric: str) -> float | None:
        """One number of the summary."""
        values = [row.value for row in self.summary if (row.split, row.region, row.metric) == (split, region, metric)]
        return values[0] if values else None


@dataclass(frozen=True, kw_only=True, slots=True)
class Cell:
    """A config and where it lives: the cell's own folder, and the folder of its capture on this machine.

    Where pictures are brought that were rendered elsewhere: their folder, and the file that says what they are, if it
    does not lie there.
    """

    config: CellConfig
    folder: Path
    capture_folder: Path = field(default=Path())
    predictions: Path | None = None
    info: Path | None = None


def failed_result(
    config: CellConfig,
    status: Status,
    reason: str,
    provenance: Provenance | None = None,
    *,
    splits: Collection[str] = ("novel_view", "novel_pose"),
) -> CellResult:
    """The result of a cell that did not come through: the worst of every quality, never a missing row.

    `splits`: those that the capture has.
    """
    scored = [split for split in IMAGE_SPLITS if split == "train_view" or split in splits]
    measured = VIEW_SCORES + (LPIPS_SCORES if weights_file() is not None else ())
    qualities = [(split, region, metric) for split in scored for region, metric in measured]
    rows = [Summary(split=s, region=r, metric=m, value=METRICS[m].worst) for s, r, m in qualities]
    rows.append(Summary(split="speed", region="", metric="frame_ms", value=METRICS["frame_ms"].worst))
    rows.append(Summary(split="speed", region="", metric="failed", value=1.0))
    return CellResult(config=config, status=status, reason=reason, summary=tuple(rows), provenance=provenance)


def write_config(cell: Cell) -> None:
    """Write `config.json`; the capture's folder is noted beside the config, for it is no part of the identity."""
    content = {
        "config": asdict(cell.config),
        "key": cell.config.key,
        "capture_folder": str(cell.capture_folder.resolve()),
    }
    places = {"predictions": cell.predictions, "info": cell.info}
    content |= {name: str(place.resolve()) for name, place in places.items() if place is not None}
    write_json(cell.folder / "config.json", content)


def read_cell(folder: Path) -> Cell:
    """Read `config.json` of a cell's folder."""
    path = folder / "config.json"
    content = read_json(path)
    try:
        config: CellConfig = from_json(CellConfig, content["config"], place="config")
        _require_names(config)
        if config.key != content["key"]:
            raise ValueError("its key does not fit its content")
        capture_folder = _find_capture(Path(content["capture_folder"]), folder, identity=config.capture)
        places = {name: Path(content[name]) for name in ("predictions", "info") if name in content}
        return Cell(config=config, folder=folder, capture_folder=capture_folder, **places)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected the config of a cell ({error})") from error


def _find_capture(recorded: Path, cell_folder: Path, *, identity: str) -> Path:
    """The capture's folder: the recorded one, or where a run was copied or moved, one of the same name and content.

    That is searched in `data/` and beside it, of the current folder and of those around the cell.
    """
    parents = (Path(), *cell_folder.resolve().parents[:5])
    with contextlib.suppress(OSError, ValueError):  # A damaged path; whoever reads the capture says so.
        if not (recorded / MANIFEST).exists():
            for place in (parent / part for parent in parents for part in (f"data/{recorded.name}", recorded.name)):
                if (place / MANIFEST).is_file() and sha256_of(place / MANIFEST) == identity:
                    return place
    return recorded


def _require_names(config: CellConfig) -> None:
    """What becomes part of a path or a table is a plain name."""
    for name in ("scene", "size", "preset", "axis", "method", "factory"):
        require_plain(getattr(config, name), what=name, may_be_empty=name in ("axis", "factory"))


def write_result(folder: Path, result: CellResult) -> None:
    """Write `result.json`. NaN and infinity are refused by the writer."""
    content = asdict(result)
    for view in content["views"]:
        view["scores"] = {f"{region}/{metric}": value for (region, metric), value in view["scores"].items()}
    write_json(folder / "result.json", content)


def read_result(folder: Path) -> CellResult | None:
    """Read `result.json`, or None where the cell is unfinished.

    Raises:
        InputError: the file is damaged or of another protocol version; nothing is overwritten.
    """
    path = folder / "result.json"
    if not path.exists():
        return None
    try:
        content = read_json(path)
        result = _result_from(content)
    except InputError as error:
        raise InputError(f"{error}; remove {folder} to run that cell again") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = f"{path}: expected a complete result ({type(error).__name__}: {error})"
        raise InputError(f"{problem}; remove {folder} to run that cell again") from error
    if result.config.protocol != PROTOCOL:
        raise InputError(f"{path}: expected protocol {PROTOCOL}, got {result.config.protocol}; results do not mix")
    return result


def result_of(cell: Cell) -> CellResult | None:
    """The result of a cell, or None where it is unfinished.

    Raises:
        InputError: it is damaged, of another protocol version, or another cell's: copied or moved there.
    """
    result = read_result(cell.folder)
    # A report may call a scene by another name; the capture's identity tells it apart all the same.
    if result is not None and replace(result.config, scene=cell.config.scene).key != cell.config.key:
        raise InputError(
            f"{cell.folder}/result.json: expected the result of {cell.config.title}, got that of "
            f"{result.config.title} ({result.config.key}); remove {cell.folder} to run that cell again"
        )
    return result


def _result_from(content: Any) -> CellResult:
    if isinstance(content.get("training"), dict):  # Results of version 0.2 have two keys more.
        content["training"] = {key: value for key, value in content["training"].items() if key not in RETIRED}
    content = content | {name: _printable(content[name]) for name in PRINTED if name in content}
    views = [dict(view) for view in content["views"]]
    scores = [
        from_json(dict[str, float], view.pop("scores"), place=f"views[{k}].scores") for k, view in enumerate(views)
    ]
    result: CellResult = from_json(CellResult, content | {"views": [view | {"scores": {}} for view in views]})
    _require_names(result.config)
    for view in result.views:
        require_plain(view.split, what="split")
        require_plain(view.camera, what="camera")
    for row in result.summary:
        require_plain(row.split, what="split")
        require_plain(row.region, what="region", may_be_empty=True)
        if row.metric not in METRICS:
            raise ValueError(f"unknown metric {row.metric!r}, {suggest(row.metric, tuple(METRICS))}")
    whole = [replace(view, scores=_by_region(s)) for view, s in zip(result.views, scores, strict=True)]
    return replace(result, views=tuple(whole))


def printable(text: str) -> str:
    """A text from a file without line breaks, terminal codes and other control characters: blanks instead."""
    return "".join(c if c.isprintable() else " " for c in text)


def _printable(content: Any) -> Any:
    """JSON whose texts are printable."""
    if isinstance(content, str):
        return printable(content)
    if isinstance(content, dict):
        return {printable(name): _printable(value) for name, value in content.items()}
    return [_printable(value) for value in content] if isinstance(content, list) else content


def _by_region(scores: dict[str, float]) -> dict[tuple[str, str], float]:
    """Scores by region and metric, from names such as `foreground/psnr`."""
    pairs = [(name.split("/"), value) for name, value in scores.items()]
    return {(region, metric): value for (region, metric), value in pairs}


def is_trained(cell: Cell) -> bool:
    """Whether there is an avatar to load."""
    return (cell.folder / CHECKPOINT).exists()


def prediction_path(folder: Path, view: View) -> Path:
    """Where the prediction of a view lies."""
    return folder / "images" / view.split / view.camera / f"{view.frame:06d}.png"


def stored_prediction(cell: Cell, capture: Capture, view: View) -> np.ndarray:
    """The prediction of a view as it was scored, uint8 RGBA on black."""
    camera = capture.cameras[view.camera]
    return read_image(prediction_path(cell.folder, view), shape=(camera.height, camera.width, 4))
