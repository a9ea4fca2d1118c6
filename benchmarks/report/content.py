"""What a report holds, whatever it is written in: sections of texts, tables, charts and pictures.

A table is a DataFrame of texts. The page and the Markdown are two templates over these classes.
"""

from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, ClassVar, Literal

import pandas as pd

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
class Links:
    """A list of texts that link to files, by paths relative to the page."""

    kind: ClassVar[str] = "links"
    items: tuple[tuple[str, Path], ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Facts:
    """Texts with a label each."""

    kind: ClassVar[str] = "facts"
    items: tuple[tuple[str, str], ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Commands:
    """Lines for a shell, in order."""

    kind: ClassVar[str] = "commands"
    items: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of texts: the index names the rows; columns are titles, or pairs of a group and a title.

    `marks`: by row and column number. The last `below` rows (oracles, sums) stand below a line and are not ranked.
    """

    kind: ClassVar[str] = "table"
    frame: pd.DataFrame
    title: str = ""
    corner: str = "method"
    marks: dict[tuple[int, int], Mark] = field(default_factory=dict)
    below: int = 0

    @property
    def heads(self) -> list[tuple[str, str]]:
        """Group and title of every column."""
        return [head if isinstance(head, tuple) else ("", str(head)) for head in self.frame.columns]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Column groups and how many columns each spans."""
        return [(group, len([*columns])) for group, columns in groupby(group for group, _ in self.heads)]

    @property
    def rows(self) -> list[tuple[str, list[tuple[str, Mark]]]]:
        """The name of every row, and its texts with their marks."""
        return [
            (str(name), [(str(text), self.marks.get((i, k), "")) for k, text in enumerate(texts)])
            for i, (name, texts) in enumerate(zip(self.frame.index, self.frame.to_numpy(), strict=True))
        ]


@dataclass(frozen=True, kw_only=True, slots=True)
class Strip:
    """A row of pictures of one size, truth first: captions, scores and places in the album."""

    title: str
    tiles: tuple[tuple[str, str, int], ...]
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


Block = Text | Bullets | Links | Facts | Commands | Table | Figure | Strips | Flipbook


@dataclass(frozen=True, kw_only=True, slots=True)
class Section:
    """A part of the report; a folded one is closed at first. A scene begins with a headline."""

    title: str
    blocks: tuple[Block, ...]
    folded: bool = False
    headline: str = ""
