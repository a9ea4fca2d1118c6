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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks.cell.run import evaluate_cell, time_cell
from benchmarks.cell.schema import Cell, CellResult, Timing, result_of
from benchmarks.gate.against import Revision, interleaved
from benchmarks.gate.baseline import Baseline, Entry, copied, keeps_avatar, row_of
from benchmarks.gate.checks import Check
from benchmarks.gate.exact import Worst, first_steps_check, protocol_check, rendering_checks, seeds_check
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
Times = dict[str, dict[str, float]]  # least times of frozen avatars and trainings by row; see `GateFile`


@dataclass(frozen=True, kw_only=True, slots=True)
class Judgement:
    """The checks, the run that was judged, least times of frozen avatars, and the worst pictures of changed rows."""

    checks: tuple[Check, ...]
    run: Run
    times: Times = field(default_factory=dict)
    worst: dict[str, Worst] = field(default_factory=dict)


def judge(
    baseline: Baseline, suite: Suite, options: RunOptions, *, minutes: float, against: Revision | None = None
) -> Judgement:
    """Run what is needed of a suite, and compare it with the baseline.

    `minutes`: clock time that trainings beyond the first two seeds of a row may take. `against`: an earlier
    revision that draws in turn with today's code; its times take the place of those of the baseline.

    Raises:
        InputError: the suite has no row in common with the baseline, or the baseline has a row of a single seed.
    """
    seeds = max(len(entries) for entries in baseline.rows.values())
    if few := [row for row, entries in baseline.rows.items() if len(entries) < TRAINED]:
        raise InputError(f"{few[0]}: expected a baseline of {TRAINED} seeds or more; --update-baseline makes one")
    run, by_row = cells_of(suite.narrowed(seeds=seeds), options)
    if not baseline.rows.keys() & by_row.keys():
        raise InputError(
            f"nothing was compared: the baseline has {', '.join(baseline.rows)}; the suite has {', '.join(by_row)}"
        )
    checks, by_row = _row_checks(baseline, by_row)
    drawn: dict[str, CellResult] = {}
    worst: dict[str, Worst] = {}
    frozen = [row for row in by_row if keeps_avatar(baseline.rows[row][0].cell)]
    progress = Progress("frozen avatars", len(frozen), expected_s=15.0, workers=1)
    for row in frozen:
        row_checks, result, changed = _draw_frozen(row, baseline.rows[row][0], by_row[row][0], options.out / FROZEN)
        checks += row_checks
        drawn |= {} if result is None else {row: result}
        worst |= {} if changed is None else {row: changed}
        progress.finish(row)
    progress.close()
    after = trained(by_row, suite, options, seeds=TRAINED)
    until = time.monotonic() + 60 * minutes
    pairs: Pairs = {row: (baseline.rows[row], entries) for row, entries in after.items()}
    checks += _training_checks(pairs)
    checks += _quality_checks(pairs, by_row, suite, options, until=until, seeds=seeds)
    costs, times = _cost_checks(baseline, pairs, by_row, drawn, options.out / FROZEN, against)
    return Judgement(checks=(*checks, *costs), run=run, times=times, worst=worst)


def cells_of(suite: Suite, options: RunOptions) -> tuple[Run, dict[str, list[Cell]]]:
    """The suite's captures, its run on disk, and its cells by row; nothing is trained."""
    require_runnable(suite, options)
    run = prepared(suite, options)
    by_row: dict[str, list[Cell]] = {}
    for cell in run.cells:
        by_row.setdefault(row_of(cell.config), []).append(cell)
    return run, by_row


def trained(
    by_row: Mapping[str, Sequence[Cell]], suite: Suite, options: RunOptions, *, seeds: int | None = None
) -> dict[str, list[Entry]]:
    """Run the first seeds of all rows, by default every seed; what is there is not run again."""
    run_missing([cell for cells in by_row.values() for cell in cells[:seeds]], suite, options)
    entries: dict[str, list[Entry]] = {}
    for row, cells in by_row.items():
        for cell in cells[:seeds]:
            if (result := result_of(cell)) is None:
                raise KeyboardInterrupt("some trainings were interrupted")
            entries.setdefault(row, []).append(Entry(cell, result))
    return entries


def times_of(entries: Mapping[str, Sequence[Entry]], out: Path) -> Times:
    """Least times of each row's first avatar, drawn `TIMED` times, and of its trainings, for a baseline."""
    progress = Progress("avatars timed", len(entries), expected_s=10.0 * TIMED, workers=1)
    times = {}
    for row, seeds in entries.items():
        first = seeds[0]
        times[row] = training_time(seeds)
        if keeps_avatar(first.cell):
            copies = (copied(first, first.cell, out / FROZEN) for _ in range(TIMED))
            times[row] |= least_times(time_cell(copy) for copy in copies)
        progress.finish(row)
    progress.close()
    return times


def _row_checks(baseline: Baseline, by_row: Mapping[str, list[Cell]]) -> tuple[list[Check], dict[str, list[Cell]]]:
    """What the run lacks or adds, and the cells of the rows that can be compared."""
    checks: list[Check] = []
    comparable: dict[str, list[Cell]] = {}
    for row in dict.fromkeys((*baseline.rows, *by_row)):
        if row not in by_row:
            checks.append(Check(row, "rows", "worse", "the baseline has this row and the suite lacks it"))
        elif row not in baseline.rows:
            detail = "the baseline has no results of this row; --update-baseline adds it"
            checks.append(Check(row, "rows", "not judged", detail))
        elif by_row[row][0].config.truth != baseline.rows[row][0].result.config.truth:
            detail = "the ground truth changed, so qualities cannot be compared; update the baseline"
            checks.append(Check(row, "rows", "worse", detail, "capture"))
        else:
            comparable[row] = by_row[row]
    return checks, comparable


def _draw_frozen(row: str, entry: Entry, here: Cell, out: Path) -> tuple[list[Check], CellResult | None, Worst | None]:
    """Draw a baseline's avatar by today's code, and judge protocol and rendering.

    Returns the checks, its result (None: it cannot be drawn), and its worst picture where rendering changed.
    """
    capture = load_capture(here.capture_folder)
    if capture.identity == entry.cell.config.capture:
        protocol = protocol_check(row, entry, capture)
    else:
        detail = "the truth has other bytes here, rounded by another processor"
        protocol = Check(row, "protocol", "not judged", detail)
    cell = copied(entry, here, out)
    try:
        result = evaluate_cell(cell)
    except InputError as error:
        detail = f"the frozen avatar cannot be drawn any more: {error}"
        return [protocol, Check(row, "rendering", "worse", detail)], None, None
    checks, worst = rendering_checks(row, entry, Entry(cell, result), capture)
    return [protocol, *checks], result, worst


def _drop_failed(pairs: Pairs) -> list[Check]:
    """Take away rows of which a training failed, which are not compared any further."""
    checks = []
    for row, (_, entries) in list(pairs.items()):
        if failed := [entry.result for entry in entries if entry.result.status != "done"]:
            detail = f"{len(failed)} of {len(entries)} trainings failed: {failed[0].status}: {failed[0].reason}"
            checks.append(Check(row, "rows", "worse", detail))
            del pairs[row]
    return checks


def _training_checks(pairs: Pairs) -> list[Check]:
    """Failed cells, first steps and seeds."""
    checks = _drop_failed(pairs)
    for row, (before, after) in pairs.items():
        logs = (entries[0].cell.folder / "log.jsonl" for entries in (before, after))
        checks += filter(None, (first_steps_check(row, *logs), seeds_check(row, before, after)))
    return checks


def _quality_checks(
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
        checks, undecided = judge_quality(pairs, looks=seeds - 1)
        more = {row: by_row[row] for row in undecided if count < min(len(by_row[row]), len(pairs[row][0]))}
        if not more or time.monotonic() >= until:
            return [*failed, *checks]
        count += 1
        for row, entries in trained(more, suite, options, seeds=count).items():
            pairs[row] = pairs[row][0], entries
        failed += _drop_failed(pairs)


def _cost_checks(
    baseline: Baseline,
    pairs: Pairs,
    by_row: Mapping[str, Sequence[Cell]],
    drawn: Mapping[str, CellResult],
    out: Path,
    against: Revision | None,
) -> tuple[list[Check], Times]:
    """Counts; times in turn with a revision; on a processor like the baseline's, memory and stored times as well.

    `drawn`: results of the frozen avatars. Also returns the least times of each row that was timed.
    """
    checks: list[Check] = []
    times: Times = {}
    machine = processor_name()
    for row, (before, after) in pairs.items():
        first, here = before[0], by_row[row][0]
        checks += count_checks(row, first.result, after[0].result)
        in_turn = against if row in drawn and against and first.cell.config.source in against.methods else None
        if in_turn is not None:
            timed, times[row] = interleaved(row, first, here, out, in_turn)
            checks += timed
        if machine == baseline.file.machine:
            checks.append(memory_check(row, before, after))
            old, training = baseline.file.times.get(row, {}), training_time(after)
            if row in drawn and in_turn is None:
                timed, times[row] = _times_again(row, old, training, _timings(drawn[row], first, here, out))
                checks += timed
            else:
                checks += time_checks(row, old, training, stored=True)
    if machine != baseline.file.machine:
        detail = f"memory and stored times: the baseline was made on {baseline.file.machine}, this run on {machine}"
        checks.append(Check("", "cost", "not judged", detail))
    return checks, times


def _timings(drawn: CellResult, entry: Entry, here: Cell, out: Path) -> Iterator[Timing]:
    """Times of the frozen avatar: of the pictures that were judged, then ever new ones."""
    assert drawn.timing is not None
    yield drawn.timing
    while True:
        yield time_cell(copied(entry, here, out))


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
