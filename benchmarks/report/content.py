"""What a report says, whatever it is written in: sections of texts, tables, charts and pictures.

The page and the Markdown are two templates over these; a new section is a few of them, and appears in both.
"""

import base64
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from benchmarks.report.vega import Figure

Mark = Literal["", "best", "second", "strong"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Text:
    """A paragraph; a note explains what stands above it."""

    kind: ClassVar[str] = "text"
    text: str
    note: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Bullets:
    """A list."""

    kind: ClassVar[str] = "bullets"
    items: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Head:
    """A column's head: name, unit, direction that is better, and the group that heads it; `term` is in the glossary."""

    title: str
    unit: str = ""
    arrow: str = ""
    group: str = ""
    term: str = ""

    @property
    def whole(self) -> str:
        """Name, unit and direction on one line."""
        return f"{self.title}{f' [{self.unit}]' if self.unit else ''} {self.arrow}".strip()

    @property
    def in_group(self) -> str:
        """The same where groups have no line of their own."""
        return f"{self.group}: {self.whole}" if self.group else self.whole


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """One number as it is printed; `sort` is the number itself (None: not measured)."""

    text: str
    spread: str = ""  # half of the 95 % interval
    sort: float | None = None
    mark: Mark = ""

    @property
    def whole(self) -> str:
        """The number with its spread."""
        return f"{self.text} ± {self.spread}" if self.spread else self.text


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """A row. Those set apart (oracles, sums) stand below a line and are not ranked."""

    name: str
    entries: tuple[Entry, ...]
    apart: bool = False
    note: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Table:
    """A table; `corner` heads the rows' names."""

    kind: ClassVar[str] = "table"
    title: str
    columns: tuple[Head, ...]
    rows: tuple[Row, ...]
    corner: str = "method"
    note: str = ""

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Column groups and how many columns each spans."""
        found: list[tuple[str, int]] = []
        for column in self.columns:
            if found and found[-1][0] == column.group:
                found[-1] = (column.group, found[-1][1] + 1)
            else:
                found.append((column.group, 1))
        return found


@dataclass(frozen=True, kw_only=True, slots=True)
class Chart:
    """A chart."""

    kind: ClassVar[str] = "chart"
    figure: Figure


@dataclass(frozen=True, kw_only=True, slots=True)
class Tile:
    """A picture in a row; `key` is its place in the report's album."""

    caption: str
    score: str
    key: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Strip:
    """A row of pictures of one size, the truth first, and what it shows."""

    title: str
    tiles: tuple[Tile, ...]
    width: int  # pixels


@dataclass(frozen=True, kw_only=True, slots=True)
class Strips:
    """Rows of pictures, by method; `file` holds those that go into Markdown."""

    kind: ClassVar[str] = "strips"
    file: str
    title: str
    groups: tuple[tuple[str, tuple[Strip, ...]], ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Flipbook:
    """The pictures of all methods, to be put side by side and stepped through; `file` is the sheet for Markdown.

    `tracks` is what the page's script reads: see `pictures.py`. `chart` shows PSNR per frame.
    """

    kind: ClassVar[str] = "flipbook"
    file: str
    tracks: tuple[dict[str, Any], ...]
    names: tuple[str, ...]
    chart: Figure


@dataclass(frozen=True, kw_only=True, slots=True)
class KeptSheet:
    """A PNG of pictures that an earlier report left; `data` is the file's content."""

    kind: ClassVar[str] = "sheet"
    file: str
    title: str
    data: bytes

    @property
    def uri(self) -> str:
        """The picture as an address that needs no other file."""
        return f"data:image/png;base64,{base64.b64encode(self.data).decode()}"


Block = Text | Bullets | Table | Chart | Strips | Flipbook | KeptSheet


@dataclass(frozen=True, kw_only=True, slots=True)
class Section:
    """A part of the report. A folded one is opened by who wants it; a scene begins with a headline."""

    title: str
    blocks: tuple[Block, ...]
    folded: bool = False
    headline: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Report:
    """A whole report."""

    title: str
    sections: tuple[Section, ...]


def texts(*values: str) -> tuple[Entry, ...]:
    """Entries of plain words."""
    return tuple(Entry(text=value) for value in values)
