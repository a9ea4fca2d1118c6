"""Each row's scores and times over the commits that were judged: a file of one line per run, and a page of charts."""

import datetime
import json
import math
from pathlib import Path
from typing import Any

import altair as alt
import pandas as pd

from ash.files import InputError, open_regular, write_atomic
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.schema import printable, result_of
from benchmarks.gate.against import commit_of
from benchmarks.gate.baseline import row_of
from benchmarks.gate.checks import outcome
from benchmarks.gate.gate import Judgement
from benchmarks.report import escaping
from benchmarks.report.vega import BLUE, Figure

FILE, PAGE = "history.jsonl", "index.html"
LARGEST = 1 << 26  # bytes of the file
SHOWN = (("novel_view", "foreground", "psnr"), ("novel_pose", "foreground", "psnr"), ("novel_view", "full", "lpips"))
FRAME = "frame, times the reference workload"
STEP = 4.0  # A change of so many standard deviations of earlier changes is marked with its commit.


def append(judged: Judgement, folder: Path) -> Path:
    """Add a run to the history in `folder`, and write the page; returns the page.

    Raises:
        InputError: the history is damaged; nothing is written.
    """
    lines = read(folder / FILE)
    rows: dict[str, dict[str, float]] = {}
    for cell in judged.run.cells:
        result, row = result_of(cell), row_of(cell.config)
        if result is not None and result.status == "done" and row not in rows:
            values = {"/".join(name): result.value(*name) for name in SHOWN}
            values[FRAME] = judged.times.get(row, {}).get("frame")
            rows[row] = {what: value for what, value in values.items() if value is not None}
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    commit = commit_of({cell.config.source for cell in judged.run.cells})
    lines.append({"commit": commit, "when": now, "outcome": outcome(judged.checks), "rows": rows})
    write_atomic(folder / FILE, "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines).encode())
    write_atomic(folder / PAGE, page(lines).encode())
    return folder / PAGE


def read(path: Path) -> list[dict[str, Any]]:
    """The runs so far, the oldest first.

    Raises:
        InputError: a line is not one of ours.
    """
    if not path.exists():
        return []
    with open_regular(path, most=LARGEST) as file:
        texts = file.read().decode(errors="replace").splitlines()
    lines = []
    for number, text in enumerate(texts, 1):
        try:
            line = json.loads(text)
            rows = {printable(row): _numbers(values) for row, values in line["rows"].items()}
            labels = {name: printable(str(line[name])) for name in ("commit", "when", "outcome")}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(f"{path}:{number}: expected a line that the gate wrote ({error})") from error
        lines.append({**labels, "rows": rows})
    return lines


def _numbers(values: dict[str, Any]) -> dict[str, float]:
    numbers = {printable(name): float(value) for name, value in values.items()}
    if not all(map(math.isfinite, numbers.values())):
        raise ValueError("a number that is not finite")
    return numbers


def table(lines: list[dict[str, Any]]) -> pd.DataFrame:
    """One row per run, row of the suite and quantity: `run` (from 1), `commit`, `row`, `what`, `value`, `step`.

    `step`: whether the value changed by more than `STEP` standard deviations of the changes before it.
    """
    records = [
        (number, line["commit"], row, what, value)
        for number, line in enumerate(lines, 1)
        for row, values in line["rows"].items()
        for what, value in values.items()
    ]
    runs = pd.DataFrame(records, columns=["run", "commit", "row", "what", "value"])
    change = runs.groupby(["row", "what"])["value"].diff()
    usual = change.groupby([runs["row"], runs["what"]]).transform(lambda each: each.expanding(3).std().shift())
    return runs.assign(step=(change.abs() > STEP * usual) & (change.abs() > 0))


def page(lines: list[dict[str, Any]]) -> str:
    """The page: a chart per row and quantity."""
    charts = []
    for index, ((row, what), values) in enumerate(table(lines).groupby(["row", "what"], sort=False)):
        title = f"{row}: {_words(what)}"
        figure = Figure(name=f"history_{index}", title=title, caption="", panels=(_panel(values),))
        charts.append(f"<h2>{escaping.xml(title)}</h2>{figure.svg()}")
    last = lines[-1]
    head = f"{len(lines)} runs; the last: commit {last['commit']}, {last['when']}: {last['outcome']}"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>History of the gate</title>'
        '<meta name="viewport" content="width=device-width"><style>body{font-family:system-ui,sans-serif;margin:2em;'
        "max-width:60em}svg{max-width:100%;height:auto}</style></head><body><h1>History of the gate</h1>"
        f"<p>{escaping.xml(head)}. A named point is a step, a change far above the usual one, with its commit.</p>"
        f"{''.join(charts)}</body></html>\n"
    )


def _words(what: str) -> str:
    """The title of a quantity."""
    if (metric := METRICS.get(what.rpartition("/")[2])) is None:
        return what
    return f"{metric.title} of {what.partition('/')[0].replace('_', ' ')}s{metric.unit and ', ' + metric.unit}"


def _panel(values: pd.DataFrame) -> Any:
    where = alt.Chart(values).encode(
        x=alt.X("run:Q", title="run", axis=alt.Axis(tickMinStep=1)),
        y=alt.Y("value:Q", title=None, scale=alt.Scale(zero=False)),
    )
    steps = where.transform_filter("datum.step")
    layers = alt.layer(
        where.mark_line(color=BLUE),
        where.mark_point(color=BLUE, filled=True),
        steps.mark_point(color=BLUE, size=120),
        steps.mark_text(dy=-12).encode(text="commit:N"),
    )
    return layers.properties(width=620, height=160)
