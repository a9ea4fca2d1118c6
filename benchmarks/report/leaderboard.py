"""One static page of runs and packs: a table to sort and filter, and every scored picture beside the truth.

index.html    table and viewer; needs no network and no server
images.csv    a row per scored image, numbers in full
pictures/CELL/images/SPLIT/CAM/FRAME.png    what was scored, RGB on black
truth/CAPTURE/CAM/FRAME.png                 the same of the truth, where the capture is at hand
"""

import contextlib
import csv
import io
import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ash.capture.dataset import Capture
from ash.capture.formats import load_capture
from ash.files import InputError, hash_of, open_regular, read_image, write_atomic
from benchmarks.analysis.results import load, summarise
from benchmarks.analysis.style import SPLIT_NAMES, style_of, titles_of
from benchmarks.cell import metrics
from benchmarks.cell.metrics import IMAGE_SPLITS, LPIPS_SCORES, METRICS, NOVELTY, VIEW_SCORES
from benchmarks.cell.registry import is_oracle
from benchmarks.cell.schema import BROUGHT_NOTE, Cell, CellResult, prediction_path, printable, result_of
from benchmarks.report.escaping import csv_text
from benchmarks.report.page import environment
from benchmarks.suites.archive import LARGEST_PICTURE, PACK_FILE, unpacked
from benchmarks.suites.runs import mixed_places, read_run
from benchmarks.suites.verification import Kind, find_capture, verify_pack
from synth.person.cast import VALIDATION

REGIONS = {
    "foreground": "foreground",
    "full": "whole frame",
    "release_crop": "crop of the ASH release",
    "white_frame": "white frame (AnimatableGaussians)",
}
SCORES = sorted(
    (*VIEW_SCORES, *LPIPS_SCORES, ("foreground", "noise_ceiling"), NOVELTY),
    key=lambda name: [*REGIONS, ""].index(name[0]),
)  # of an image, region by region
QUALITIES = ("psnr", "ssim", "lpips", "flip", "iou")
COSTS = (("speed", "frame_ms"), ("speed", "train_s"), ("memory", "params"), ("memory", "gaussians"))
ORIGINS: dict[Kind, str] = {
    "equal": "pack, scored again: equal",
    "near": "pack, scored again on the scene rendered elsewhere: equal within tolerance",
    "failed": "pack",
    "unchecked": "pack, NOT CHECKED: no capture at hand",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """A finished cell of one of the sources; `name` is its own among all of them, `place` its scene."""

    name: str
    place: str
    source: str
    origin: str  # how far its scores can be trusted
    cell: Cell
    result: CellResult
    capture: Path | None  # where its truth lies


def write_leaderboard(sources: Sequence[Path], out: Path, *, captures: Sequence[Path] = ()) -> list[str]:
    """Write the page, the CSV and the pictures into `out`; returns lines for the terminal.

    `captures`: folders with the truth, besides those that runs and packs name.

    Raises:
        InputError: a source is neither run nor pack, is damaged, of another protocol, or has scores that its pictures
            do not have; or people for validation stand beside others.
    """
    with contextlib.ExitStack() as stack:
        entries: list[Entry] = []
        titles: dict[str, str] = {}
        for number, source in enumerate(sources):
            folder = source if source.is_dir() else stack.enter_context(unpacked(source))
            near = (each.capture for each in entries if each.capture is not None)  # A run knows where its truth lies.
            entries += _entries(number, source, folder, tuple(dict.fromkeys((*captures, *near))))
            if source.is_dir():  # Titles that a pack gives would stand above rows of others too.
                titles = read_run(folder).titles | titles
        if not entries:
            raise InputError(f"{sources[0]}: no cell is finished, so there is nothing to show")
        if len({entry.cell.config.subject >= VALIDATION for entry in entries}) > 1:
            raise InputError(f"{out}: people from {VALIDATION} on are there to choose by, expected none or no others")
        with titles_of((entry.cell.config for entry in entries), titles):
            entries = _told_apart(entries)
            data = _data(entries, _write_pictures(entries, out))
            page = environment("html").get_template("leaderboard.html").render(data=data)
            write_atomic(out / "images.csv", _csv(entries).encode())
            write_atomic(out / "index.html", page.encode())
    count = sum(len(entry.result.views) for entry in entries)
    unseen = sorted({entry.cell.capture_folder.name for entry in entries if entry.capture is None})
    lines = [f"truth of {', '.join(unseen)}: not at hand, so not shown; --capture DIR names it"] if unseen else []
    return [*lines, f"{len(entries)} cells, {count} images", f"leaderboard: {out / 'index.html'}"]


def _entries(number: int, source: Path, folder: Path, captures: Sequence[Path]) -> Iterator[Entry]:
    origins: dict[Path, str] = {}
    if (folder / PACK_FILE).is_file() and not source.is_dir():
        for check in verify_pack(folder, captures)[0]:
            if check.kind == "differs":
                raise InputError(f"{source}: {check.cell.config.title}: {check.text}")
            origins[check.cell.folder] = ORIGINS[check.kind]
    default = "scores of its folder" if source.is_dir() else "no pack, NOT CHECKED"
    for cell in read_run(folder).cells:
        if (result := result_of(cell)) is not None:
            yield Entry(
                name=f"{number}-{cell.config.key}",
                place=cell.config.place,
                source=printable(source.resolve().name),
                origin=origins.get(cell.folder, default),
                cell=cell,
                result=result,
                capture=find_capture(cell, captures),
            )


def _told_apart(entries: Sequence[Entry]) -> list[Entry]:
    """The entries; scenes of one name that show different truths have names of their own."""
    mixed = mixed_places(entry.cell.config for entry in entries)
    return [
        replace(e, place=f"{e.place} ({e.cell.config.size}, {e.cell.config.truth[:6]})") if e.place in mixed else e
        for e in entries
    ]


def _write_pictures(entries: Sequence[Entry], out: Path) -> set[str]:
    """Pictures and truth as they were compared; the names of the entries that have pictures.

    A run that was unpacked from its numbers has none.
    """
    drawn: set[str] = set()
    truths: dict[Path, Capture] = {}
    for entry in entries:
        if entry.capture is not None and entry.capture not in truths:
            truths[entry.capture] = load_capture(entry.capture)
        for view in entry.result.views:
            if (stored := prediction_path(entry.cell.folder, view)).is_file():
                drawn.add(entry.name)
                _write(prediction_path(out / "pictures" / entry.name, view), _pixels(stored)[..., :3])
            if entry.capture is not None and view.camera in truths[entry.capture].cameras:
                truth = metrics.on_black(truths[entry.capture].image(view.camera, view.frame))[..., :3]
                _write(out / _truth(entry) / view.camera / f"{view.frame:06d}.png", truth)
    return drawn


def _truth(entry: Entry) -> str:
    """The folder of its truth."""
    return f"truth/{hash_of(entry.cell.config.capture)[:16]}"


def _pixels(path: Path) -> np.ndarray:
    """A stored picture, uint8 RGBA on black, of whatever size."""
    with open_regular(path, most=LARGEST_PICTURE) as file:
        width, height = struct.unpack(">II", file.read(24)[16:].rjust(8, b"\0"))  # where a PNG has them
    return read_image(path, shape=(height, width, 4))


def _write(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(rgb).save(path, compress_level=4)


def _data(entries: Sequence[Entry], pictures: set[str]) -> dict[str, Any]:
    """What the page shows, as JSON; `pictures`: names of entries that have any."""
    rows: dict[tuple[str, ...], list[Entry]] = {}
    for entry in entries:
        config, source = entry.cell.config, entry.name.partition("-")[0]
        rows.setdefault((entry.place, config.method, config.preset, source), []).append(entry)
    return {
        "splits": [(split, SPLIT_NAMES[split].title) for split in IMAGE_SPLITS],
        "regions": list(REGIONS.items()),
        "metrics": {name: _metric(name) for name in (*QUALITIES, "noise_ceiling", "novelty_deg")},
        "costs": [(name, _metric(name)) for _, name in COSTS],
        "qualities": QUALITIES,
        "scores": ["/".join(name) for name in SCORES],
        "rows": [_row(group) for group in rows.values()],
        "cells": [_cell(entry, has_pictures=entry.name in pictures) for entry in entries],
    }


def _metric(name: str) -> dict[str, Any]:
    metric = METRICS[name]
    unit = f", {metric.unit}" if metric.unit else ""
    arrow = f"\N{NO-BREAK SPACE}{metric.arrow}" if metric.arrow else ""
    return {
        "title": f"{metric.title}{unit}{arrow}",
        "up": metric.direction == "up",
        "decimals": metric.decimals,
    }


def _row(group: Sequence[Entry]) -> dict[str, Any]:
    """A method on a scene, of one source: means over people, or over seeds of one."""
    results, config = [entry.result for entry in group], group[0].cell.config
    scores: dict[str, dict[str, list[float | None]]] = {}
    for (_, _, split, region, metric), each in summarise(load(results)).iterrows():
        half = None if math.isnan(each.half_width) else each.half_width
        scores.setdefault(split, {})[f"{region}/{metric}"] = [float(f"{each.value:.6g}"), half]
    machines = {_machine(result) for result in results} - {""}
    counts = {"people": len({r.config.subject for r in results}), "seeds": len({r.config.seed for r in results})}
    return {
        "scene": group[0].place,
        "method": style_of(config.method).title,
        "origin": "; ".join([*dict.fromkeys(f"{each.source}: {each.origin}" for each in group), *_notes(results)]),
        "protocol": config.protocol,
        "over": ", ".join(f"{count} {what}" for what, count in counts.items() if count > 1) or "1",
        "scores": {split: scores[split] for split in IMAGE_SPLITS if split in scores},
        "costs": {name: scores.get(split, {}).get(f"/{name}") for split, name in COSTS},
        "machine": machines.pop() if len(machines) == 1 else "several machines" if machines else "",
        "cell": group[0].name,
    }


def _notes(results: Sequence[CellResult]) -> list[str]:
    failed = sum(result.status != "done" for result in results)
    notes = [f"{failed} of {len(results)} failed"] if failed else []
    if is_oracle(results[0].config.method):
        notes.append("is given part of the truth")
    for brought in dict.fromkeys(result.brought for result in results):
        if brought is not None:
            reported = {
                "s of training": brought.training_s,
                "ms per frame": brought.frame_ms,
                "parameters": brought.parameters,
            }
            figures = ", ".join(f"{value:.10g} {unit}" for unit, value in reported.items() if value is not None)
            notes += [BROUGHT_NOTE, *([f"reported by its authors, not measured: {figures}"] if figures else [])]
    if any(result.isolated is False for result in results):
        notes.append("not isolated")
    return notes


def _machine(result: CellResult) -> str:
    """On what frames were drawn and timed; empty where nothing was timed."""
    if result.value("speed", "", "frame_ms") is None or result.status != "done":
        return ""
    facts = {} if result.provenance is None else result.provenance.machine
    if not (result.drawn_on or result.config.device).startswith("cpu"):
        return facts.get("gpu", "unknown GPU")
    return f"{facts.get('processor', 'unknown processor')}, {facts.get('cores', '?')} cores"


def _cell(entry: Entry, *, has_pictures: bool) -> dict[str, Any]:
    config = entry.cell.config
    views = []
    for view in entry.result.views:
        values = [view.scores.get(name) for name in SCORES]
        shown = [None if value is None else float(f"{value:.5g}") for value in values]
        views.append([view.split, view.camera, view.frame, *shown])
    who = f", seed {config.seed}" + (f", {config.preset}" if config.preset else "")
    return {
        "name": entry.name,
        "title": f"{style_of(config.method).title}{who}",
        "source": entry.source,
        "capture": f"{entry.place}, subject {config.subject}",
        "pictures": f"pictures/{entry.name}/images" if has_pictures else "",
        "truth": _truth(entry) if entry.capture is not None else "",
        "views": views,
    }


def _csv(entries: Sequence[Entry]) -> str:
    """Every score of every image."""
    buffer = io.StringIO()
    table = csv.writer(buffer, lineterminator="\n")
    named = ("scene", "subject", "capture", "method", "preset", "seed", "protocol", "source", "origin")
    table.writerow(
        [*named, "split", "camera", "frame", "prediction", *("_".join(filter(None, name)) for name in SCORES)]
    )
    for entry in entries:
        config = entry.cell.config
        texts = entry.place, config.subject, config.capture, config.method, config.preset, config.seed
        about = [csv_text(str(text)) for text in (*texts, config.protocol, entry.source, entry.origin)]
        for view in entry.result.views:
            place = [view.split, csv_text(view.camera), view.frame, csv_text(view.prediction)]
            table.writerow([*about, *place, *(view.scores.get(name, "") for name in SCORES)])
    return buffer.getvalue()
