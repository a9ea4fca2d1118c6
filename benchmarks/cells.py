"""A cell: one method trained once on one capture, and everything that was found out about it.

A cell lives in a folder of its own, named by the hash of what went in:

    config.json     what goes in: method, preset, seed, capture and its identity, code, protocol
    log.jsonl       the method's training log, one object per line
    output.log      what the process printed
    model.safetensors, checkpoints of the method
    input/          the training part of the capture, all that the method sees; only while it runs
    images/SPLIT/CAM/FRAME.png   predictions, RGBA uint8, colour on black: `rescore` reads them
    result.json     what came out; written last, atomically: where it exists, the cell is finished
"""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from ash.files import InputError, hash_of, read_json, write_json
from benchmarks.metrics import IMAGE_SPLITS, METRICS, PROTOCOL, VIEW_SCORES

Status = Literal["done", "crashed", "diverged", "timeout", "out of memory"]
STATUSES = ("done", "crashed", "diverged", "timeout", "out of memory")


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
    axis: str = ""  # the stress axis along which the capture is spoilt; none: the clean capture
    severity: float = 0.0
    protocol: str = PROTOCOL

    @property
    def key(self) -> str:
        """The cell's name."""
        return hash_of(asdict(self))[:16]

    @property
    def place(self) -> str:
        """The scene, and how its capture is spoilt."""
        return f"{self.scene} {self.axis}={self.severity:g}" if self.axis else self.scene

    @property
    def title(self) -> str:
        """For progress lines and errors."""
        return f"{self.place} · {self.method} · seed {self.seed}"


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewScore:
    """Scores of one image. `scores` maps (region, metric) to its value."""

    split: str
    camera: str
    frame: int
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
class Timing:
    """Milliseconds per timed frame, whole and by stage; `reference_ms` times a fixed workload between the frames."""

    frame_ms: tuple[float, ...]
    stage_ms: dict[str, tuple[float, ...]]
    reference_ms: tuple[float, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Provenance:
    """Where and with what a result was made."""

    commit: str
    machine: dict[str, str]
    versions: dict[str, str]
    wall_s: float


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
    provenance: Provenance | None = None

    def value(self, split: str, region: str, metric: str) -> float | None:
        """One number of the summary."""
        found = [row.value for row in self.summary if (row.split, row.region, row.metric) == (split, region, metric)]
        return found[0] if found else None


@dataclass(frozen=True, kw_only=True, slots=True)
class Cell:
    """A config and where it lives: the cell's own folder, and the folder of its capture on this machine."""

    config: CellConfig
    folder: Path
    capture_folder: Path = field(default=Path())


def failed_result(config: CellConfig, status: Status, reason: str, provenance: Provenance | None = None) -> CellResult:
    """The result of a cell that did not come through: the worst of every quality, never a missing row."""
    qualities = [(split, region, metric) for split in IMAGE_SPLITS for region, metric in VIEW_SCORES]
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
    write_json(cell.folder / "config.json", content)


def read_cell(folder: Path) -> Cell:
    """Read `config.json` of a cell's folder."""
    path = folder / "config.json"
    content = read_json(path)
    try:
        config = CellConfig(**content["config"])
        if config.key != content["key"]:
            raise ValueError("its key does not fit its content")
        return Cell(config=config, folder=folder, capture_folder=Path(content["capture_folder"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected the config of a cell ({error})") from error


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


def _result_from(content: Any) -> CellResult:
    if content["status"] not in STATUSES:
        raise ValueError(f"status {content['status']!r}")
    timing, provenance = content["timing"], content["provenance"]
    return CellResult(
        config=CellConfig(**content["config"]),
        status=content["status"],
        reason=content["reason"],
        summary=tuple(Summary(**row) for row in content["summary"]),
        views=tuple(_view_from(row) for row in content["views"]),
        timing=None
        if timing is None
        else Timing(
            frame_ms=tuple(timing["frame_ms"]),
            stage_ms={name: tuple(values) for name, values in timing["stage_ms"].items()},
            reference_ms=tuple(timing["reference_ms"]),
        ),
        curve=tuple(CurvePoint(**point) for point in content["curve"]),
        provenance=None if provenance is None else Provenance(**provenance),
    )


def _view_from(row: dict[str, Any]) -> ViewScore:
    scores = {}
    for name, value in row["scores"].items():
        region, metric = name.split("/")
        scores[region, metric] = float(value)
    return ViewScore(**{**row, "scores": scores})
