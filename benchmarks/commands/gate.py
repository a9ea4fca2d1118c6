"""Commands of the gate."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ash.files import InputError
from benchmarks.commands.arguments import DONE, FAILED, Count, File, Folder
from benchmarks.commands.runs import run_and_report

if TYPE_CHECKING:
    from benchmarks.gate.gate import Baseline
    from benchmarks.suites.suites import Suite


@dataclass(frozen=True, kw_only=True)
class GateCommand:
    """Compare a run with a committed baseline; exit code 1 where it is worse."""

    baseline: File = Path("reports/baseline.json")  # what the run is compared with
    head: Folder | None = None  # the run to judge; default: run the suite now
    suite: str | None = None  # a name or FILE.toml; default: the baseline's, of a new baseline ci
    seeds: Count = 3  # of the run
    data: Folder = Path("data")  # where captures are kept
    markdown: File | None = None  # write the summary there, for a pull request
    junit: File | None = None  # write the checks there as JUnit
    update_baseline: bool = False  # make the run the new baseline

    def __call__(self) -> int:
        """Judge the run, or make it the baseline."""
        from ash.files import write_atomic
        from benchmarks.gate import gate as rules
        from benchmarks.gate.remeasure import remeasure
        from benchmarks.gate.summary import terminal
        from benchmarks.provenance import changed_since, cores
        from benchmarks.suites.runs import RunOptions, read_run, require_complete, results_of

        baseline = None if self.update_baseline else rules.read_baseline(self.baseline)
        if self.head is not None:
            run = require_complete(read_run(self.head))
            head = rules.summarise(run.suite, results_of(run))
            checks = rules.judge(baseline, head) if baseline else []
        else:
            suite = self._suite(baseline).narrowed(seeds=self.seeds)
            # One cell at a time: a neighbour slows the stages of a frame by more than it slows the reference workload.
            options = RunOptions(out=Path("runs/gate"), data=self.data, workers=cores(), cells=1)
            code = run_and_report(suite, options)
            if code not in (DONE, FAILED):
                return code
            results = results_of(read_run(options.out))
            if baseline is None:
                more = range(suite.seeds, suite.seeds + rules.TIMED_AGAIN)
                head = rules.summarise(suite.name, results, remeasure(suite, options, more))
            else:
                head, checks = rules.judge_with_retries(
                    baseline, suite.name, results, lambda slow, k: remeasure(suite, options, [suite.seeds + k], slow)
                )
        if baseline is None:
            rules.write_baseline(self.baseline, rules.replacement(self.baseline, head))
            print(f"{self.baseline}: now holds {len(head.entries)} methods at commit {head.commit}")
            return DONE
        print(terminal(baseline, head, checks, changed_since(baseline.commit)))
        if self.markdown:
            write_atomic(self.markdown, rules.markdown(baseline, head, checks).encode())
        if self.junit:
            write_atomic(self.junit, rules.junit(checks).encode())
        return DONE if all(check.verdict in rules.FINE for check in checks) else FAILED

    def _suite(self, baseline: "Baseline | None") -> "Suite":
        """The suite to run."""
        from benchmarks.suites.files import find_suite, suite_files

        if self.suite is None and baseline is not None and baseline.suite not in suite_files():
            raise InputError(f"{self.baseline} is of the suite {baseline.suite!r}: expected its file in --suite")
        suite = find_suite(self.suite or (baseline.suite if baseline else "ci"))
        if baseline is not None and suite.name != baseline.suite:
            raise InputError(
                f"--suite {self.suite}: expected the suite {baseline.suite!r}, which {self.baseline} is of"
            )
        return suite
