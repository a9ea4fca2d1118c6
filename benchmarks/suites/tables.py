"""What a table of results shows, as `[[table]]` in a TOML file says it; that file may be a suite's as well.

    [[table]]
    caption = "What motion input is worth."
    rows = [["ash"], ["wo_mot", { method = "narrow", title = "Half the width" }]]  # a rule between two lists
    columns = [{ metric = "psnr", split = "novel_view" }, { metric = "frame_ms", decimals = 0, title = "Time" }]
    reference = "ash"              # the row that others are compared with
    form = "difference"            # mean and difference to the reference; or "half-width", "interval", "mean"
    marks = ["bold", "underline"]  # also "colour"

Without `rows` the table has every method of the run, without `columns` those of the table above it. `scene` names the
scene, of a table or of a column; without it there is a table for each scene of the run. A column
`{ given = "paper", title = "PSNR" }` prints what rows bring along: `{ title = "NA", given.paper = 30.33 }`. The orders
of rows by a metric and by such numbers are compared where its column says `beside = "paper"`.
"""

import re
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from ash.capture.typed import from_json
from ash.fields import suggest
from ash.files import InputError
from benchmarks.cell.metrics import IMAGE_SPLITS, METRICS

FORMS = ("half-width", "mean", "interval", "difference")
MARKS = ("bold", "underline", "colour")
SPLITS = (*IMAGE_SPLITS, "speed", "memory")
REGIONS = ("foreground", "full", "release_crop", "white_frame")
UNITS = {  # what a number is multiplied by: unit measured, unit shown
    ("s", "min"): 1 / 60,
    ("s", "h"): 1 / 3600,
    ("ms", "s"): 1e-3,
    ("mm", "cm"): 0.1,
    ("MB", "GB"): 1e-3,
    ("x1000", "1"): 1e-3,
    ("", "k"): 1e-3,
    ("", "M"): 1e-6,
}
MOST_DECIMALS = 9
LONGEST = 500  # characters of a text
LABEL = re.compile(r"[\w:.-]*", re.ASCII)


@dataclass(frozen=True, kw_only=True, slots=True)
class TableRow:
    """A row: a method of the run, or numbers from elsewhere, or both."""

    method: str = ""
    title: str = ""  # none: the method's
    instead: str = ""  # the method shown where the first was not run
    note: str = ""  # said below the table where it is
    given: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, slots=True)
class TableColumn:
    """A column: a quantity of the run, or numbers that the rows bring along (`given`)."""

    metric: str = ""
    given: str = ""
    beside: str = ""  # of a metric: the numbers of this table whose order of rows its own is compared with
    split: str = ""  # none: novel views, or the first that has the metric
    region: str = ""  # none: the foreground, or the first that has the metric
    scene: str = ""  # none: the table's
    unit: str = ""  # none: the metric's
    decimals: int | None = None  # none: the metric's
    title: str = ""
    group: str = ""  # printed once above columns that share it


@dataclass(frozen=True, kw_only=True, slots=True)
class TableSpec:
    """A table; `rows` in groups with a rule between them, none: every method of the run."""

    columns: tuple[TableColumn, ...]
    rows: tuple[tuple[TableRow, ...], ...] = ()
    caption: str = ""
    label: str = ""  # for LaTeX's \ref
    scene: str = ""  # none: a table for each scene of the run
    reference: str = ""
    form: str = "half-width"  # one of FORMS
    marks: tuple[str, ...] = ("bold", "underline")  # some of MARKS
    wide: bool = False  # over both columns of a page

    def __post_init__(self) -> None:
        """Refuse what no run can have.

        Raises:
            ValueError: an unknown name; lists those that there are.
        """
        rows = [row for group in self.rows for row in group]
        if not self.columns:
            raise ValueError("columns: expected at least one")
        given = tuple(column.given for column in self.columns)
        for column in self.columns:
            _require_column(column)
            _require_known("beside", column.beside, ("", *given) if column.metric else ("",))
        _require_known("form", self.form, FORMS)
        for mark in self.marks:
            _require_known("mark", mark, MARKS)
        for row in rows:
            if not (row.method or row.title):
                raise ValueError("rows: expected a method or a title in each")
        named = tuple(row.method for row in rows if row.method)
        if self.reference and named and self.reference not in named:
            raise ValueError(f"reference: no row {self.reference!r}, {suggest(self.reference, named)}")
        if self.form == "difference" and not self.reference:
            raise ValueError("form: a difference needs `reference`, the row that others are compared with")
        if not LABEL.fullmatch(self.label):
            raise ValueError(f"label: expected letters, digits and : . _ -, got {self.label!r:.60}")
        texts = [self.caption, *(text for c in self.columns for text in (c.title, c.group))]
        texts += [text for row in rows for text in (row.title, row.note)]
        if not all(text.isprintable() and len(text) <= LONGEST for text in texts):
            raise ValueError(f"caption and titles: expected at most {LONGEST} printable characters")


def _require_column(column: TableColumn) -> None:
    if bool(column.metric) == bool(column.given):
        raise ValueError("columns: expected `metric` or `given` in each")
    if column.given and not column.title:
        raise ValueError(f"columns: expected a title beside given = {column.given!r}")
    if column.decimals is not None and not 0 <= column.decimals <= MOST_DECIMALS:
        raise ValueError(f"decimals: expected 0 to {MOST_DECIMALS}, got {column.decimals}")
    for name, known in (("metric", tuple(METRICS)), ("split", SPLITS), ("region", REGIONS)):
        _require_known(name, getattr(column, name), ("", *known))
    if column.metric:
        own = METRICS[column.metric].unit
        _require_known("unit", column.unit, ("", own, *(shown for measured, shown in UNITS if measured == own)))


def _require_known(what: str, name: str, allowed: tuple[str, ...]) -> None:
    if name not in allowed:
        raise ValueError(f"unknown {what} {name!r}, expected one of {', '.join(filter(None, allowed)) or 'none'}")


def tables_of(content: Any, *, place: str) -> tuple[TableSpec, ...]:
    """Tables as TOML has them. A row is a name, which stands for its method, or a table; a column likewise.

    Raises:
        InputError: names `place` and the key.
    """
    tables = content if isinstance(content, list) else [content]
    plain = [_spelt_out(table) if isinstance(table, dict) else table for table in tables]
    for above, table in pairwise(plain):
        if isinstance(table, dict) and isinstance(above, dict) and "columns" in above:
            table.setdefault("columns", above["columns"])
    try:
        return tuple(from_json(tuple[TableSpec, ...], plain, place="table"))
    except ValueError as error:
        raise InputError(f"{place}: {error}") from error


def _spelt_out(table: dict[str, Any]) -> dict[str, Any]:
    """A copy in which rows lie in groups, and a name is a table with the key that it stands for."""
    columns, rows = table.get("columns"), table.get("rows")
    plain = dict(table)
    if isinstance(columns, list):
        plain["columns"] = _named("metric", columns)
    if isinstance(rows, list):
        groups = rows if any(isinstance(each, list) for each in rows) else [rows]
        plain["rows"] = [_named("method", group) if isinstance(group, list) else group for group in groups]
    return plain


def _named(key: str, entries: list[Any]) -> list[Any]:
    return [{key: entry} if isinstance(entry, str) else entry for entry in entries]
