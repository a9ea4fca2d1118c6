"""The verdict on a change: exact comparisons first, trainings and statistics only where they differ.

1. Protocol: stored pictures have their stored scores.
2. Rendering: the baseline's trained avatars, loaded by today's code, draw the pictures that they drew.
3. Training: with the same seeds, the log begins and the predictions end as the baseline's.
4. Quality, where 2 or 3 changed: scores in pairs of the same seed; seeds are added until the verdict is decided or the
   minutes are spent.
5. Cost: counts of work; on a processor like the baseline's, peak memory and times. Times are those of the frozen
   avatars, which take seconds to measure again, over a reference workload that is timed between the frames. Stored
   times show only what is much slower; an earlier revision that draws in turn with today's code shows the rest.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks.cell.schema import Cell, CellResult, Timing, result_of
from benchmarks.gate.against import Revision, interleaved
from benchmarks.gate.baseline import Baseline, Entry, drawn_again, keeps_avatar, row_of, timed_again
from benchmarks.gate.checks import Check
from benchmarks.gate.exact import (
    Worst,
    equal_seeds,
    first_steps_check,
    protocol_check,
    rendering_checks,
    worst_picture,
)
from benchmarks.gate.statistical import (
    Pairs,
    count_checks,
    judge_quality,
    least_times,
    memory_check,
    time_checks,
    training_time,
)
from benchmarks.provenance import processor_name
from benchmarks.suites.progress import Progress
from benchmarks.suites.runs import Run, RunOptions, prepared, require_runnable, run_missing
from benchmarks.suites.suites import Suite

TRAINED = 2  # seeds of every row, so that a seed that is ignored is seen
TIMED = 5  # drawings of a frozen avatar for a baseline's times; of a run one, and more while a time fails
FROZEN = "frozen"  # folder of avatars that were drawn again


@dataclass(frozen=True, kw_only=True, slots=True)
class Judgement:
    """The checks, the run that was judged, least times of frozen avatars, and the worst pictures of changed rows."""

    checks: tuple[Check, ...]
    run: Run
    times: dict[str, dict[str, float]] = field(default_factory=dict)
    worst: dict[str, Worst] = field(default_factory=dict)


def judge(
    baseline: Baseline, suite: Suite, options: RunOptions, *, minutes: float, against: Revision | None = None
) -> Judgement:
    """Run what is needed of a suite, and compare it with the baseline.

    `minutes`: clock time that trainings beyond the first two seeds of a row may take. `against`: an earlier
    revision that draws in turn with today's code; its times take the place of those of the baseline.

    Raises:
        InputError: the suite has no row in common with the baseline.
    """
    seeds = max(len(entries) for entries in baseline.rows.values())
    if few := [row for row, entries in baseline.rows.items() if len(entries) < TRAINED]:
        raise InputError(f"{few[0]}: expected a baseline of {TRAINED} seeds or more; --update-baseline makes one")
    run, by_row = cells_of(suite.narrowed(seeds=seeds), options)
    shared = [row for row in baseline.rows if row in by_row]
    if not shared:
        raise InputError(
            f"nothing was compared: the baseline has {', '.join(baseline.rows)}; the suite has {', '.join(by_row)}"
        )
    checks = _row_checks(baseline, by_row)
    same = [row for row in shared if by_row[row][0].config.truth == _first(baseline, row).result.config.truth]
    for row in set(shared) - set(same):
        detail = "the ground truth changed, so qualities cannot be compared; update the baseline"
        checks.append(Check(row=row, layer="rows", name="capture", verdict="worse", detail=detail))
    drawn, worst = _draw_frozen(baseline, by_row, same, options, checks)
    after = _train(by_row, same, TRAINED, suite, options)
    started = time.monotonic()
    pairs: Pairs = {row: (baseline.rows[row], entries) for row, entries in after.items() if entries}
    _judge_training(pairs, checks)
    checks += _judge_quality(pairs, by_row, suite, options, until=started + 60 * minutes, seeds=seeds)
    for row, (before, entries) in pairs.items():
        checks += count_checks(row, before[0].result, entries[0].result)
    times: dict[str, dict[str, float]] = {}
    turns = {
        row: partial(interleaved, row, _first(baseline, row), by_row[row][0], options.out / FROZEN, against)
        for row in drawn
        if against is not None and _first(baseline, row).cell.config.source in against.methods
    }
    checks += _cost_checks(baseline, pairs, drawn, turns, times)
    return Judgement(checks=tuple(checks), run=run, times=times, worst=worst)


def cells_of(suite: Suite, options: RunOptions) -> tuple[Run, dict[str, list[Cell]]]:
    """The suite's captures, its run on disk, and its cells by row; nothing is trained."""
    require_runnable(suite, options)
    run = prepared(suite, options)
    by_row: dict[str, list[Cell]] = {}
    for cell in run.cells:
        by_row.setdefault(row_of(cell.config), []).append(cell)
    return run, by_row


def trained(by_row: Mapping[str, Sequence[Cell]], suite: Suite, options: RunOptions) -> dict[str, list[Entry]]:
    """All seeds of all rows, for a baseline."""
    return _train(by_row, tuple(by_row), max(len(cells) for cells in by_row.values()), suite, options)


def times_of(entries: Mapping[str, Sequence[Entry]], out: Path) -> dict[str, dict[str, float]]:
    """Least times of each row's first avatar, drawn `TIMED` times, and of its trainings, for a baseline."""
    progress = Progress("avatars timed", len(entries), expected_s=10.0 * TIMED, workers=1)
    times = {}
    for row, seeds in entries.items():
        first = seeds[0]
        times[row] = training_time(seeds)
        if keeps_avatar(first.cell):
            times[row] |= least_times(timed_again(first, first.cell, out / FROZEN) for _ in range(TIMED))
        progress.finish(row)
    progress.close()
    return times


def _first(baseline: Baseline, row: str) -> Entry:
    return baseline.rows[row][0]


def _row_checks(baseline: Baseline, by_row: Mapping[str, Sequence[Cell]]) -> list[Check]:
    """What the run lacks or adds."""
    missing = "the baseline has this row and the suite lacks it"
    added = "the baseline has no results of this row; --update-baseline adds it"
    return [
        *(Check(row=row, layer="rows", verdict="worse", detail=missing) for row in baseline.rows if row not in by_row),
        *(
            Check(row=row, layer="rows", verdict="not judged", detail=added)
            for row in by_row
            if row not in baseline.rows
        ),
    ]


def _draw_frozen(
    baseline: Baseline,
    by_row: Mapping[str, Sequence[Cell]],
    rows: Sequence[str],
    options: RunOptions,
    checks: list[Check],
) -> tuple[dict[str, Iterator[Timing]], dict[str, Worst]]:
    """Draw the baseline's avatars by today's code, and judge protocol and rendering.

    Returns times of each: of the pictures that were judged, then ever new ones; and the worst pictures.
    """
    frozen, out = [row for row in rows if keeps_avatar(_first(baseline, row).cell)], options.out / FROZEN
    drawn: dict[str, Iterator[Timing]] = {}
    worst: dict[str, Worst] = {}
    progress = Progress("frozen avatars", len(frozen), expected_s=15.0, workers=1)
    for row in frozen:
        entry, here = _first(baseline, row), by_row[row][0]
        capture = load_capture(here.capture_folder)
        if capture.identity == entry.cell.config.capture:
            checks.append(protocol_check(row, entry, capture))
        else:
            told = "the truth has other bytes here, rounded by another processor"
            checks.append(Check(row=row, layer="protocol", verdict="not judged", detail=told))
        try:
            result = drawn_again(entry, here, out)
        except InputError as error:
            told = f"the frozen avatar cannot be drawn any more: {error}"
            checks.append(Check(row=row, layer="rendering", verdict="worse", detail=told))
            continue
        after = replace(entry.cell, folder=out / entry.cell.config.key)
        found = worst_picture(entry.cell, after, entry.result, capture)
        if found is not None:
            worst[row] = found
        checks += rendering_checks(row, entry.result, result, found)
        drawn[row] = _timings(result, entry, here, out)
        progress.finish(row)
    progress.close()
    return drawn, worst


def _timings(first: CellResult, entry: Entry, here: Cell, out: Path) -> Iterator[Timing]:
    if first.timing is not None:
        yield first.timing
    while True:
        yield timed_again(entry, here, out)


def _train(
    by_row: Mapping[str, Sequence[Cell]], rows: Sequence[str], seeds: int, suite: Suite, options: RunOptions
) -> dict[str, list[Entry]]:
    """Run the first seeds of some rows; what is there is not run again."""
    run_missing([cell for row in rows for cell in by_row[row][:seeds]], suite, options)
    found = {}
    for row in rows:
        results = [(cell, result_of(cell)) for cell in by_row[row][:seeds]]
        if any(result is None for _, result in results):
            raise KeyboardInterrupt("some trainings were interrupted")
        found[row] = [Entry(cell=cell, result=result) for cell, result in results if result is not None]
    return found


def _drop_failed(pairs: Pairs) -> list[Check]:
    """Take away rows of which a training failed, which are not compared any further."""
    checks = []
    for row, (_, entries) in list(pairs.items()):
        if failed := [entry.result for entry in entries if entry.result.status != "done"]:
            told = f"{len(failed)} of {len(entries)} trainings failed: {failed[0].status}: {failed[0].reason}"
            checks.append(Check(row=row, layer="rows", verdict="worse", detail=told))
            del pairs[row]
    return checks


def _judge_training(pairs: Pairs, checks: list[Check]) -> None:
    """Failed cells, first steps and seeds."""
    checks += _drop_failed(pairs)
    for row, (before, entries) in pairs.items():
        logs = (each.cell.folder / "log.jsonl" for each in (before[0], entries[0]))
        checks += [check for check in (first_steps_check(row, *logs),) if check is not None]
        if equal_seeds(row, before) is None:
            checks += [check for check in (equal_seeds(row, entries),) if check is not None]


def _judge_quality(
    pairs: Pairs,
    by_row: Mapping[str, Sequence[Cell]],
    suite: Suite,
    options: RunOptions,
    *,
    until: float,
    seeds: int,
) -> list[Check]:
    """Judge the scores, with a further seed of what is undecided as long as there are seeds and time."""
    count = TRAINED
    failed: list[Check] = []
    while True:
        quality = judge_quality(pairs, looks=max(1, seeds - 1))
        undecided = [row for row in quality.undecided if count < min(len(by_row[row]), len(pairs[row][0]))]
        if not undecided or time.monotonic() >= until:
            return [*failed, *quality.checks]
        count += 1
        for row, entries in _train(by_row, undecided, count, suite, options).items():
            pairs[row] = pairs[row][0], entries
        failed += _drop_failed(pairs)


def _cost_checks(
    baseline: Baseline,
    pairs: Pairs,
    drawn: Mapping[str, Iterator[Timing]],
    turns: Mapping[str, Callable[[], tuple[list[Check], dict[str, float]]]],
    times: dict[str, dict[str, float]],
) -> list[Check]:
    """Times in turn with a revision, by `turns`; on a processor like the baseline's, memory and stored times as well.

    A stored time that fails is measured again. `times`: receives the least times of each row.
    """
    checks = []
    for row, turn in turns.items():
        timed, times[row] = turn()
        checks += timed
    if (here := processor_name()) != baseline.file.machine:
        told = f"memory and stored times: the baseline was made on {baseline.file.machine}, this run on {here}"
        return [*checks, Check(row="", layer="cost", verdict="not judged", detail=told)]
    for row, (before, after) in pairs.items():
        checks.append(memory_check(row, before, after))
        old, training = baseline.file.times.get(row, {}), training_time(after)
        if row in drawn and row not in turns:
            timed, times[row] = _times_again(row, old, training, drawn[row])
            checks += timed
        else:
            checks += time_checks(row, old, training, stored=True)
    return checks


def _times_again(
    row: str, old: Mapping[str, float], training: Mapping[str, float], measured: Iterator[Timing]
) -> tuple[list[Check], dict[str, float]]:
    """The checks of stored times, after up to `2 * TIMED` more drawings while one fails, and the times."""
    timings = []
    for _ in range(1 + 2 * TIMED):
        timings.append(next(measured))
        times = {**least_times(timings), **training}
        checks = time_checks(row, old, times, stored=True)
        if all(check.verdict != "worse" for check in checks if check.name != "time of training"):
            break
    return checks, times
