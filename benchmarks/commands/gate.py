"""Commands of the gate."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ash.files import InputError
from benchmarks.commands.arguments import DONE, FAILED, File, Folder, whole

if TYPE_CHECKING:
    from benchmarks.gate.baseline import Baseline
    from benchmarks.suites.runs import RunOptions


@dataclass(frozen=True, kw_only=True)
class GateCommand:
    """Compare today's code with a committed baseline; exit code 1 where it is worse.

    What is deterministic is compared exactly, in seconds; seeds are trained and compared statistically only where
    something changed. docs/gate.md shows it for a method in a repository of its own.
    """

    baseline: Folder = Path("reports/baseline")  # what today's code is compared with
    suite: str | None = None  # of a new baseline: a name or FILE.toml, default ci; else the baseline has its own
    seeds: Annotated[int, whole(2)] = 6  # of a new baseline: as many are the most that a comparison can use
    minutes: float = 10.0  # that trainings beyond two seeds of each row may take
    strict: bool = False  # exit with 1 where anything changed
    data: Folder = Path("data")  # where captures are kept
    out: Folder = Path("runs/gate")  # where trainings and pictures go
    markdown: File | None = None  # write the summary there, for a pull request
    junit: File | None = None  # write the checks there as JUnit
    update_baseline: bool = False  # make today's code the new baseline
    history: Folder | None = None  # append the run to this folder's history, and write its page of charts
    # a revision of the repository that --method-path lies in, else of this checkout: draws in turn with today's code
    against: str | None = None
    init: str | None = None  # package.module:factory: write gate/NAME.toml, its baseline and a GitHub workflow here
    accept: str | None = None  # a row of the last comparison, as it is printed: make what it is now its baseline
    because: str = ""  # with --accept: why; shown from then on

    def __call__(self) -> int:
        """Judge today's code, make it the baseline, or accept a change."""
        from ash.files import run_lock

        if self.because and self.accept is None:
            raise InputError("--because goes with --accept ROW")
        self.out.mkdir(parents=True, exist_ok=True)
        with run_lock(self.out):
            if self.accept is not None:
                return self._accept(self.accept)
            if self.init is not None:
                return self._start(self.init)
            return self._update() if self.update_baseline else self._judge()

    def _start(self, method: str) -> int:
        from benchmarks.gate.starting import WORKFLOW, start

        folder = Path("gate")
        suite = start(method, folder)
        print(f"{suite} and {WORKFLOW}: commit them with the baseline, which is made now")
        return replace(self, init=None, suite=str(suite), baseline=folder / "baseline")._update()

    def _judge(self) -> int:
        from ash.files import write_atomic
        from benchmarks.gate.against import revision_of
        from benchmarks.gate.baseline import keeps_avatar, read_baseline
        from benchmarks.gate.checks import FAILING, outcome
        from benchmarks.gate.gate import judge
        from benchmarks.gate.history import append
        from benchmarks.gate.summary import junit, markdown, terminal, write_pictures
        from benchmarks.suites.files import read_suite

        baseline = read_baseline(self.baseline)
        suite = read_suite(baseline.suite)
        if self.suite is not None:
            self._require_own(baseline)
        revision = None
        if self.against is not None:
            cells = [entries[0].cell for entries in baseline.rows.values()]
            drawn = dict.fromkeys(cell.config.source for cell in cells if keeps_avatar(cell))
            revision = revision_of(self.against, drawn, self.out / "against")
        judged = judge(baseline, suite, self._options(), minutes=self.minutes, against=revision)
        pictures = write_pictures(judged, self.out)
        print(terminal(baseline, judged))
        for path in pictures:
            print(f"before, after, difference: {path}")
        if self.markdown:
            write_atomic(self.markdown, markdown(baseline, judged).encode())
        if self.junit:
            write_atomic(self.junit, junit(judged.checks).encode())
        if self.history:
            print(f"history: {append(judged, self.history)}")
        verdict = outcome(judged.checks)
        return FAILED if verdict in FAILING or (self.strict and verdict != "unchanged") else DONE

    def _require_own(self, baseline: "Baseline") -> None:
        from benchmarks.suites.files import suite_file

        if suite_file(str(self.suite)).read_bytes() != baseline.suite.read_bytes():
            raise InputError(
                f"--suite {self.suite}: expected the content of {baseline.suite}, which the baseline was made of;"
                " --update-baseline takes another"
            )

    def _update(self) -> int:
        from benchmarks.gate.baseline import GateFile, read_baseline, require_replaceable, write_baseline
        from benchmarks.gate.gate import cells_of, times_of, trained
        from benchmarks.provenance import processor_name
        from benchmarks.suites.files import read_suite, suite_file

        there = (self.baseline / "gate.json").exists()
        path = suite_file(self.suite or "ci") if self.suite or not there else read_baseline(self.baseline).suite
        suite = read_suite(path).narrowed(seeds=self.seeds)
        options = self._options()
        run, by_row = cells_of(suite, options)
        rows = trained(by_row, suite, options)
        require_replaceable(self.baseline, rows)
        file = GateFile(machine=processor_name(), times=times_of(rows, self.out))
        write_baseline(self.baseline, path, run, file)
        print(f"{self.baseline}: now holds {len(rows)} rows of {self.seeds} seeds")
        return DONE

    def _accept(self, row: str) -> int:
        from benchmarks.gate.against import commit_of
        from benchmarks.gate.baseline import GateFile, read_baseline, with_row, write_baseline
        from benchmarks.gate.gate import cells_of, times_of, trained
        from benchmarks.provenance import processor_name
        from benchmarks.suites.files import read_suite

        if not self.because:
            raise InputError("--accept ROW: expected a reason with --because")
        baseline = read_baseline(self.baseline)
        suite = read_suite(baseline.suite)
        options = self._options()
        count = max(len(entries) for entries in baseline.rows.values())
        _, by_row = cells_of(suite.narrowed(seeds=count), options)
        if row not in by_row:
            raise InputError(f"--accept: expected one of {'; '.join(by_row)}, got {row!r}")
        rows = trained({row: by_row[row]}, suite, options)
        same = processor_name() == baseline.file.machine  # Others' times would be compared as if they were its own.
        times = {**baseline.file.times, **(times_of(rows, self.out) if same else {row: {}})}
        run, accepted = with_row(
            baseline, row, rows[row], because=self.because, commit=commit_of({rows[row][0].cell.config.source})
        )
        file: GateFile = replace(baseline.file, times=times, accepted=accepted)
        write_baseline(self.baseline, baseline.suite, run, file)
        print(f"{self.baseline}: {row} is now as it is today")
        return DONE

    def _options(self) -> "RunOptions":
        from benchmarks.provenance import cores
        from benchmarks.suites.runs import RunOptions

        return RunOptions(out=self.out, data=self.data, workers=cores(), retry_failed=True)
