"""Commands that give results to others: pack, leaderboard."""

from dataclasses import dataclass
from pathlib import Path

from ash.files import InputError
from benchmarks.commands.arguments import DONE, File, Folder, Positional, Repeated


@dataclass(frozen=True, kw_only=True)
class PackCommand:
    """Pack a run for others: pictures, configurations, results and hashes in one file, which `verify` checks.

    Avatars stay where they are; the pack has their SHA-256.
    """

    run: Positional[Path]  # a run's folder or a cell's
    out: File | None = None  # the file; default: RUN.zip

    def __call__(self) -> int:
        """Write it."""
        from benchmarks.suites.archive import write_pack
        from benchmarks.suites.runs import read_run

        if not self.run.is_dir():
            raise InputError(f"{self.run}: expected the folder of a run or of a cell")
        run, folder = read_run(self.run), self.run.resolve()
        out = self.out or folder.with_name(f"{folder.name}.zip")
        pack = write_pack(run, out)
        pictures = sum(name.endswith(".png") for name in pack.files)
        missing = len(run.cells) + len(run.absent) - sum(name.endswith("result.json") for name in pack.files)
        unfinished = f", without {missing} cells that have no result" if missing else ""
        print(f"{out}: {pictures} pictures, {len(pack.checkpoints)} hashes of avatars{unfinished}")
        return DONE


@dataclass(frozen=True, kw_only=True)
class LeaderboardCommand:
    """Write one static page of runs and packs: a table to sort and filter, and every picture beside the truth.

    Packs are verified first; one whose scores differ from its pictures is refused. The page needs no network:
    open index.html, or publish the folder.
    """

    sources: Positional[tuple[Path, ...]]  # folders of runs, packs, or cells.zip of a published report
    out: Folder  # where index.html, images.csv and the pictures go
    capture: Repeated[tuple[Path, ...]] = ()  # where the truth lies; may be repeated; default: as runs name it

    def __call__(self) -> int:
        """Write it."""
        from ash.capture.manifest import read_manifest
        from benchmarks.report.leaderboard import write_leaderboard

        for folder in self.capture:
            read_manifest(folder)
        for line in write_leaderboard(self.sources, self.out, captures=self.capture):
            print(line)
        return DONE
