"""Verbs of the gate."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import FlagCreatePairsOff

from benchmarks.verbs.arguments import DONE, FAILED, Count, File, Folder, Natural
from benchmarks.verbs.runs import run_and_report


@dataclass(frozen=True, kw_only=True)
class GateVerb:
    """Compare a run with a committed baseline; exit code 1 where it is worse."""

    baseline: File = Path("reports/baseline.json")  # what the run is compared with
    head: Folder | None = None  # the run to judge; default: run the suite now
    suite: str = "ci"  # of a new baseline
    seeds: Count = 3  # of the run
    data: Folder = Path("data")  # where captures are kept
    markdown: File | None = None  # write the summary there, for a pull request
    junit: File | None = None  # write the checks there as JUnit
    update_baseline: FlagCreatePairsOff[bool] = False  # make the run the new baseline

    def __call__(self) -> int:
        """Judge the run, or make it the baseline."""
        from ash.files import write_atomic
        from benchmarks.gate import gate as rules
        from benchmarks.gate.again import run_again
        from benchmarks.gate.words import terminal
        from benchmarks.provenance import changed_since, cores
        from benchmarks.suites.files import find_suite
        from benchmarks.suites.runs import RunOptions, read_run, results_of

        baseline = None if self.update_baseline else rules.read_baseline(self.baseline)
        if self.head is not None:
            found = read_run(self.head)
            head = rules.summarise(found.suite, results_of(found))
            checks = rules.judge(baseline, head) if baseline else []
        else:
            suite = find_suite(self.suite if baseline is None else baseline.suite).narrowed(seeds=self.seeds)
            # One cell at a time: a neighbour slows the stages of a frame by more than it slows the reference workload.
            options = RunOptions(out=Path("runs/gate"), data=self.data, workers=cores(), cells=1)
            code = run_and_report(suite, options)
            if code not in (DONE, FAILED):
                return code
            results = results_of(read_run(options.out))
            if baseline is None:
                more = range(suite.seeds, suite.seeds + rules.TIMED_AGAIN)
                head = rules.summarise(suite.name, results, run_again(suite, options, more))
            else:
                head, checks = rules.settle(
                    baseline, suite.name, results, lambda slow, k: run_again(suite, options, [suite.seeds + k], slow)
                )
        if baseline is None:
            rules.write_baseline(self.baseline, head)
            print(f"{self.baseline}: now holds {len(head.entries)} methods at commit {head.commit}")
            return DONE
        print(terminal(baseline, head, checks, changed_since(baseline.commit)))
        if self.markdown:
            write_atomic(self.markdown, rules.markdown(baseline, head, checks).encode())
        if self.junit:
            write_atomic(self.junit, rules.junit(checks).encode())
        return DONE if all(check.verdict in rules.FINE for check in checks) else FAILED


@dataclass(frozen=True, kw_only=True)
class GateRatesVerb:
    """Measure the gate's false alarms and the planted defects it catches."""

    reruns: Natural = 20  # unchanged runs
    out: Folder = Path("runs/gate-rates")  # where they go
    data: Folder = Path("data")  # where captures are kept

    def __call__(self) -> int:
        """Measure and print."""
        from benchmarks.gate.rates import markdown, measure
        from benchmarks.provenance import cores

        print(markdown(measure(self.out, self.data, reruns=self.reruns, workers=cores())))
        return DONE
