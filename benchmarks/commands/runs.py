"""Commands that make, score and report cells and runs: run, train, eval, report, compare, claims."""

import os
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ash.fields import Changes
from ash.files import InputError, require_plain, run_lock
from benchmarks.commands.arguments import (
    DONE,
    FAILED,
    INTERRUPTED,
    Argument,
    Count,
    File,
    Folder,
    Names,
    Positional,
    Repeated,
    Seed,
    refuse_all,
    typed,
)
from benchmarks.commands.devices import CPU, DeviceName, chosen_device, gpus_for, on_device
from benchmarks.problems import Problems

if TYPE_CHECKING:
    from benchmarks.cell.schema import Cell
    from benchmarks.suites.runs import Run as RunOnDisk
    from benchmarks.suites.runs import RunOptions
    from benchmarks.suites.suites import MethodSpec, SceneSpec, Suite

LOCAL = "local"
LpipsWeights = Annotated[Path | None, Argument(metavar="FILE")]


@dataclass(frozen=True, kw_only=True)
class RunCommand:
    """Run a suite: capture, train, evaluate, report.

    SUITE is one of ours (`run --list` prints them) or a file of yours. Flags narrow or widen it.

    On a cluster whose machines share a disk, as a Slurm array of 20 jobs, each one core, all into one folder; each job
    resumes if started again: `ash-bench synth tight`, `ash-bench synth loose` once, then `sbatch --array=1-20 --wrap
    'ash-bench run table --out runs/table --workers 1 --shard $SLURM_ARRAY_TASK_ID/20'`, then `ash-bench report
    runs/table`. Without a shared disk give each shard its own --out, then `ash-bench report A B --out RUN` merges them.
    On a Dask cluster, `ash-bench run table --executor dask://HOST:8786`; with --device cuda, on the workers that were
    started with `--resources GPU=1`.
    """

    suite: Positional[str] = ""  # quick (the default), ci, table, ... or FILE.toml
    methods: Names = ()  # only these rows, or installed methods besides
    scenes: Names = ()  # only these rows, or other scenes
    stresses: Names = ()  # of its perturbations of captures only these, at all severities
    capture: Repeated[tuple[Path, ...]] = ()  # in place of the scenes: a finished capture; may be repeated
    size: str | None = None  # of scenes: ci, factor, quick, long, table or paper
    preset: str | None = None  # budget of the methods
    device: DeviceName = CPU  # where methods learn and draw that can choose: cpu, cuda, cuda:1, or auto
    seeds: Count | None = None  # train every method with so many seeds
    subjects: Count | None = None  # on captures of so many people, from subject 0 on
    validation: bool = False  # on the people from 100 on: to choose by, not to report
    out: Folder | None = None  # where results go; default: runs/SUITE
    data: Folder = Path("data")  # where captures are kept
    workers: Count | None = None  # cells side by side; default: all cores, on CUDA all GPUs
    executor: str = LOCAL  # or dask://HOST:PORT, for a cluster
    shard: Annotated[str | None, Argument(metavar="i/n")] = None  # every n-th cell only, from the i-th; for job arrays
    # AlexNet's, of torchvision; default: torch's cache, or those that set-up installed
    lpips_weights: LpipsWeights = None
    retry_failed: bool = False  # run cells again that failed before
    # another run, whose cells are taken; of other code where today's makes the same pictures for one of each row
    reuse: Repeated[tuple[Path, ...]] = ()
    dry_run: bool = False  # print cells, hours and gigabytes, and do nothing
    list: bool = False  # print the suites as TOML, or only SUITE: a copy is a start for your own

    def __call__(self) -> int:
        """Captures, cells, report."""
        if self.list:
            return self._print_suites()
        from benchmarks.provenance import cores
        from benchmarks.suites.captures import require_kept_apart
        from benchmarks.suites.runs import RunOptions

        local = self.executor == LOCAL
        device = chosen_device(self.device, here=local)
        gpus = gpus_for(device) if local else ()
        suite = on_device(self._chosen(), device)
        require_kept_apart(suite)
        _use_lpips(self.lpips_weights)
        options = RunOptions(
            out=self.out or Path("runs") / suite.name,
            data=self.data,
            workers=self.workers or cores(),
            cells=self.workers or len(gpus) or None,
            gpus=gpus,
            executor=self.executor,
            shard=self.shard,
            retry_failed=self.retry_failed,
            reuse=self.reuse,
            command=re.sub(r" --shard[ =]\d+/\d+", "", typed()),  # All shards together are the run.
        )
        if self.dry_run:
            from benchmarks.suites.dry_run import estimate

            print(estimate(suite, options))
            return DONE
        return run_and_report(suite, options)

    def _print_suites(self) -> int:
        from benchmarks.suites.files import suite_file, suite_files

        for path in [suite_file(self.suite)] if self.suite else suite_files().values():
            print(f"# {path.name}\n{path.read_text()}")
        return DONE

    def _chosen(self) -> "Suite":
        """The suite, as the flags have it."""
        from benchmarks.suites.files import find_suite

        suite = find_suite(self.suite or "quick")
        return suite.narrowed(
            scenes=self._scenes(suite),
            methods=self.methods,
            stresses=self.stresses,
            size=self.size,
            preset=self.preset,
            seeds=self.seeds,
            subjects=self.subjects,
            validation=self.validation,
        )

    def _scenes(self, suite: "Suite") -> "tuple[SceneSpec, ...]":
        from benchmarks.suites.files import given_captures
        from benchmarks.suites.scenes import scene_of
        from benchmarks.suites.suites import SceneSpec

        if self.capture and self.scenes:
            raise InputError("--capture takes the place of the scenes: expected it or --scenes")
        rows = {row.name: row for row in suite.scenes}
        for name in self.scenes:
            if name in rows:
                continue
            scene_of(name, size=self.size or suite.size)
            if variants := [row.name for row in suite.scenes if row.of == name]:
                raise InputError(f"{suite.name} has {name!r} as {', '.join(variants)}: expected that name in --scenes")
        return given_captures(self.capture) or tuple(rows.get(name, SceneSpec(name=name)) for name in self.scenes)


def run_and_report(suite: "Suite", options: "RunOptions") -> int:
    """Run a suite to its end, or to the end of this shard, and write its report."""
    from benchmarks.suites.runs import failures, finished_results, run_suite

    finished = run_suite(suite, options)
    results = finished_results(finished)
    if len(results) < len(finished.cells):
        there = f"{len(results)} of {len(finished.cells)} cells are there"
        if options.shard is None:
            print(f"{there}, the others were interrupted; the same command goes on", file=sys.stderr)
            return INTERRUPTED
        print(f"{there}; the report waits for the other shards")
        return FAILED if failures(results) else DONE
    return _report(finished)


@dataclass(frozen=True, kw_only=True)
class ReportCommand:
    """Write a report: of a run again, or of any cells and runs together.

    Shards of one run are merged: their cells are copied to --out, which is then the whole run.

    What --publish leaves holds cells.zip, every number of every cell. That is a run too, without pictures.
    """

    runs: Positional[tuple[Path, ...]]  # folders of runs or of single cells, packs, or cells.zip of a published report
    out: Folder | None = None  # where the report goes; default: the run's own folder, otherwise runs/report
    publish: Folder | None = None  # copy it there, to be committed: all but the page, and every cell's numbers
    chosen_on: Folder | None = None  # a run of the same rows with --validation: how what suffices there does here
    # write its tables alone: a suite of ours or FILE.toml with [[table]]; default: the table of the run's suite
    table: Annotated[str, Argument(metavar="FILE")] = ""
    latex: File | None = None  # where these tables go as LaTeX, which compiles alone and in a paper
    markdown: File | None = None  # and as Markdown
    csv: File | None = None  # and as numbers

    def __call__(self) -> int:
        """Write it, and copy it where that is asked for."""
        from benchmarks.suites.archive import opened
        from benchmarks.suites.merge import are_shards, merge_runs
        from benchmarks.suites.runs import TRAINED_BY_HAND, gathered, read_run

        if not self.runs:
            raise InputError("expected the folder of a run or of a cell")
        out = self.out or Path("runs/report")
        if are_shards(self.runs):
            merge_runs(self.runs, out)
            return self._write(read_run(out))
        with opened(self.runs) as runs:
            if len(runs) > 1 or self.out is not None or self.runs[0].is_file():
                return self._write(gathered(runs, out, command=typed()))
            if runs[0].suite == TRAINED_BY_HAND:  # Nothing keeps such a folder from holding two versions of a row.
                runs = [gathered(runs, self.runs[0], command=runs[0].command)]
            return self._write(runs[0])

    def _write(self, run: "RunOnDisk") -> int:
        from benchmarks.suites.runs import joined, read_run, require_for_choosing

        if self.table or self.latex or self.markdown or self.csv:
            return self._tables(run)
        if self.chosen_on is None:
            code = _report(run)
        else:  # The report says so; the run that --publish leaves is as it was.
            both = replace(run, command=joined(run.command, typed()))
            code = _report(both, require_for_choosing(read_run(self.chosen_on)))
        if self.publish is not None:
            from benchmarks.report.page import publish

            publish(run, self.publish)
        return code

    def _tables(self, run: "RunOnDisk") -> int:
        from benchmarks.report.page import write_tables
        from benchmarks.suites.files import suite_file

        if self.publish or self.chosen_on:
            raise InputError(
                "--table, --latex, --markdown, --csv: expected no --publish and no --chosen-on beside them"
            )
        file = suite_file(self.table) if self.table else None
        lines = write_tables(run, file, latex=self.latex, markdown=self.markdown, csv=self.csv)
        print("\n".join(lines))
        return DONE


@dataclass(frozen=True, kw_only=True)
class CompareCommand:
    """Put two runs side by side: before and after, row by row, with the worst frames of each."""

    before: Positional[Path]  # a run's folder or a cell's, a pack, or cells.zip of a published report
    after: Positional[Path]  # another
    out: Folder | None = None  # write compare.html and compare.csv there; default: AFTER/compare, of a file beside it

    def __call__(self) -> int:
        """Print the table, and write the page."""
        from benchmarks.report.compare import write_comparison
        from benchmarks.suites.archive import folder_of, opened

        out = self.out or folder_of(self.after) / "compare"
        with opened((self.before, self.after)) as (before, after):
            print(write_comparison(before, after, out))
        print(out / "compare.html")
        return DONE


@dataclass(frozen=True, kw_only=True)
class ClaimsCommand:
    """Judge claims by the rows of runs: what the ASH paper says, and what our README says.

    A claim is a contrast of two rows on a scene, judged in pairs over people; all runs are judged as one. Of a row that
    several have, trained differently or on other captures, the first run's cells count.
    Exit code 1 where a claim that held in an earlier judgement (--before) does not hold any more.
    """

    runs: Positional[tuple[Path, ...]]  # folders of runs, packs, or cells.zip of a published report
    claims: File | None = None  # other claims, as benchmarks/analysis/claims.toml has ours
    before: File | None = None  # the claims.csv of an earlier judgement
    out: Folder = Path("runs/claims")  # where claims.html, claims.md and claims.csv go

    def __call__(self) -> int:
        """Print the verdicts, and write the page."""
        from benchmarks.analysis.claims import FILE, read_claims
        from benchmarks.report.claims import write_claims
        from benchmarks.suites.archive import folder_of, opened
        from benchmarks.suites.runs import gathered

        if not self.runs:
            raise InputError("expected the folder of a run")
        places = [folder_of(run) for run in self.runs]
        written = [[place / name for name in ("report.html", "report.md")] for place in places]
        pages = [next((page for page in pair if page.exists()), None) for pair in written]
        with opened(self.runs) as runs:
            reports: dict[tuple[str, str], Path] = {}
            for part, page in zip(runs, pages, strict=True):
                if page is not None:
                    for config in (cell.config for cell in part.cells):
                        reports.setdefault((config.place, config.method), page)
            run = gathered(runs, self.out, command="", leave_out=partial(print, file=sys.stderr))
            lines, lost = write_claims(
                run,
                read_claims(self.claims or FILE),
                self.out,
                before=self.before,
                reports=reports,
                command=typed(),
            )
        print("\n".join([*lines, str(self.out / "claims.html")]))
        for claim in lost:
            print(f"no longer holds: {claim}", file=sys.stderr)
        return FAILED if lost else DONE


@dataclass(frozen=True, kw_only=True)
class TrainCommand:
    """Train and evaluate one method on one capture.

    Every field of the method's configuration is a flag (--model.texels 128 --training.steps 5000), if the method offers
    one; `train METHOD --help` lists them.
    """

    method: Positional[str]  # an entry point, or package.module:factory
    capture: Positional[Path]  # the capture's folder
    preset: str = "cpu"  # budget of the method: ci, cpu, ...
    seed: Seed = 0  # of the training
    device: DeviceName = CPU  # where it learns and draws: cpu, cuda, cuda:1, or auto
    out: Folder = Path("runs/train")  # where cells go
    row: str = ""  # what it is called in tables; default: the method's name and what is changed

    changes: Changes = ()  # of the method's configuration

    def settings(self) -> Any:
        """The configuration that the preset means, if the method offers one."""
        from benchmarks.cell.registry import offered

        return offered(self.method, self.preset)

    def __call__(self) -> int:
        """One cell by hand."""
        from benchmarks.cell.registry import configured
        from benchmarks.cell.run import run_cell
        from benchmarks.cell.schema import read_result, write_config
        from benchmarks.suites.engine import plan_cells
        from benchmarks.suites.suites import varied_name

        changes, device = self.changes, chosen_device(self.device)
        if device != CPU:
            changes = tuple(sorted({**dict(changes), "device": device}.items()))
        if changes:
            configured(self.method, self.preset, changes)
        given: dict[str, Any] = {"of": self.method, "preset": self.preset, "changes": changes}
        row = _row_named(self.row or varied_name(self.method, changes), flag="--row", **given)
        cell = _cell_on(self.capture, row, self.out, seed=self.seed)
        plan_cells([cell], retry_failed=True)
        if read_result(cell.folder) is not None:
            message = "was trained before, from the same inputs: nothing is done again"
            print(f"{cell.config.title} {message}", file=sys.stderr)
        else:
            write_config(cell)
            print(f"training {cell.config.title} in {cell.folder}", file=sys.stderr)
        return _tell(cell.folder, run_cell(cell))


@dataclass(frozen=True, kw_only=True)
class ScoreCommand:
    """Score pictures that were rendered elsewhere: PNG files, named as `export --format test-views` says.

    They become a cell like any other, for `report` and `compare`. Missing, extra, wrongly sized and damaged files are
    named, a line each, and then nothing is scored. docs/predictions.md goes through it.
    """

    pictures: Positional[Path]  # the folder that holds images/SPLIT/CAMERA/FRAME.png
    capture: Positional[Path]  # the capture's folder
    name: str  # what the row is called in tables
    info: File | None = None  # alpha, cost and device as the authors report them; default: info.json in the folder
    out: Folder = Path("runs/train")  # where cells go

    def __call__(self) -> int:
        """One cell of brought pictures."""
        from benchmarks.cell.registry import BROUGHT
        from benchmarks.cell.run import run_cell
        from benchmarks.cell.schema import write_config
        from benchmarks.suites.suites import AS_GIVEN

        row = _row_named(self.name, flag="--name", of=f"{BROUGHT}:{self.pictures}", preset=AS_GIVEN)
        try:
            cell = _cell_on(self.capture, row, self.out, info=self.info)
        except Problems as problems:
            return refuse_all(problems)
        write_config(cell)
        return _tell(cell.folder, run_cell(cell))


@dataclass(frozen=True, kw_only=True)
class EvalCommand:
    """Render and score a run's cells again from their checkpoints, or score their stored predictions again.

    With --motion, the avatars are driven by a motion file instead, and scored against its truth, which is rendered: the
    results go to --out, those of the cells stay.
    """

    run: Positional[Path]  # a run's folder or a cell's
    scores_only: bool = False  # score the stored predictions: nothing is loaded or rendered
    device: DeviceName | None = None  # where avatars draw that have a choice: cpu, cuda, ...; default: as they learned
    motion: File | None = None  # BVH or AMASS .npz: drive the avatars by it
    frames: Count = 12  # of that motion
    out: Folder | None = None  # of the results on that motion; default: RUN/motion-FILE
    workers: Count | None = None  # processes that render that motion; default: all cores
    # AlexNet's, of torchvision; default: torch's cache, or those that set-up installed
    lpips_weights: LpipsWeights = None

    def __call__(self) -> int:
        """Render where that is asked for, and score."""
        from benchmarks.cell.run import evaluate_cell, rescore_cell

        if self.motion is not None:
            return self._on_motion(self.motion)
        if self.scores_only and self.device is not None:
            raise InputError("--scores-only renders nothing: expected no --device")
        for name in ("frames", "out", "workers"):
            if getattr(self, name) != getattr(type(self), name):
                raise InputError(f"--{name}: goes with --motion")
        _use_lpips(self.lpips_weights)
        if self.scores_only:
            return _again(self.run, rescore_cell)
        device = None if self.device is None else chosen_device(self.device)
        return _again(self.run, partial(evaluate_cell, device=device))

    def _on_motion(self, motion: Path) -> int:
        from benchmarks.provenance import cores
        from benchmarks.studies.retarget import retarget
        from benchmarks.suites.runs import read_run

        if self.scores_only or self.device is not None:
            raise InputError("--motion: expected no --scores-only and no --device")
        out = self.out or self.run / f"motion-{motion.stem}"
        cells, workers = list(read_run(self.run).cells), self.workers or cores()
        for row in retarget(cells, motion, out, frames=max(2, self.frames), workers=workers):
            own = "" if row.own_psnr is None else f" ({row.own_psnr:.2f} dB on its own test motion)"
            print(f"{row.title}: {row.psnr:.2f} dB{own}, IoU {row.iou:.3f}, foreground PSNR on {motion.name}")
        print(out)
        return DONE


def _row_named(name: str, *, flag: str, **row: Any) -> "MethodSpec":
    """The row that a flag names; refused as in a suite."""
    from benchmarks.suites.suites import MethodSpec

    try:
        return MethodSpec(name=require_plain(name, what="row"), **row)
    except ValueError as error:
        raise InputError(f"{flag}: {error}") from error


def _cell_on(folder: Path, row: "MethodSpec", out: Path, *, seed: int = 0, info: Path | None = None) -> "Cell":
    """The cell of a row on a finished capture, whose files are hashed again."""
    from ash.capture.formats import load_capture
    from benchmarks.suites.captures import require_intact
    from benchmarks.suites.runs import cell_for
    from benchmarks.suites.suites import AS_GIVEN, CaptureSpec, CellSpec

    capture = load_capture(folder)
    require_intact(folder)
    given = CaptureSpec(scene=capture.scene, size=AS_GIVEN, seed=capture.manifest.seed)
    factory = "" if row.of == row.name else row.of
    spec = CellSpec(capture=given, method=row.name, factory=factory, preset=row.preset, seed=seed, changes=row.changes)
    return cell_for(spec, folder, out, info=info)


def _use_lpips(weights: Path | None) -> None:
    """Hand the user's weights on to the cells' processes, once they are known to load."""
    if weights is None:
        return
    from benchmarks.cell.lpips import Lpips
    from benchmarks.cell.metrics import LPIPS_WEIGHTS

    os.environ[LPIPS_WEIGHTS] = str(weights.resolve())
    Lpips(weights)


def _report(run: "RunOnDisk", chosen_on: "RunOnDisk | None" = None) -> int:
    from benchmarks.report.page import write_report
    from benchmarks.suites.runs import failures, results_of

    lines = write_report(run, chosen_on)
    print("\n".join(lines))
    failed = failures(results_of(run))
    for result in failed:
        print(f"{result.config.title}: {result.status}: {result.reason}", file=sys.stderr)
    return FAILED if failed else DONE


def _again(folder: Path, function: Callable[[Any], Any]) -> int:
    from benchmarks.suites.runs import read_run, results_of

    run = read_run(folder)
    results_of(run)
    worst = DONE
    whole = folder.parent.parent if folder.parent.name == "cells" else folder
    with run_lock(whole):  # A run that is at work there must not see its results change.
        for cell in run.cells:
            if (cell.folder / "result.json").exists():
                worst = max(worst, _tell(cell.folder, function(cell)))
    return worst


def _tell(folder: Path, result: Any) -> int:
    """Print what came out of one cell in one line."""
    if result.status != "done":
        print(f"{result.config.title}: {result.status}: {result.reason}", file=sys.stderr)
        return FAILED
    from benchmarks.cell.schema import BROUGHT_NOTE

    parts, region = [], "foreground" if result.has_alpha else "full"
    for split in ("novel_view", "near_pose", "novel_pose", "far_pose"):
        if (value := result.value(split, region, "psnr")) is not None:
            parts.append(f"{split.replace('_', ' ')} {value:.2f} dB")
    if (value := result.value("speed", "", "frame_ms")) is not None:
        parts.append(f"{value:.1f} ms per frame")
    if result.brought is not None:
        parts.append(BROUGHT_NOTE)
    if result.evaluated_code:
        parts.append(f"scored by code {result.evaluated_code}, trained by {result.config.code}")
    where = "foreground PSNR" if result.has_alpha else "PSNR of the whole frame, for there is no alpha"
    print(f"{result.config.title}: {', '.join(parts)} ({where}) in {folder}")
    return DONE
