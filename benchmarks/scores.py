"""What a report asks of the results: one number with its spread for a scene, a method and a quantity."""

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.cells import CellResult
from benchmarks.statistics import mean_interval


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """Mean over seeds, and the half width of its 95 % interval (None for a single seed)."""

    mean: float
    half_width: float | None
    seeds: int


class Scores:
    """The results of a run, looked up by scene, method and quantity."""

    def __init__(self, results: Sequence[CellResult]) -> None:
        self.results = tuple(result for result in results if not result.config.axis)  # Spoilt captures: stability.py.
        self.scenes = tuple(dict.fromkeys(result.config.scene for result in self.results))
        self.seeds = len({result.config.seed for result in self.results})

    def methods(self, scene: str) -> tuple[str, ...]:
        """Methods on a scene, in the suite's order."""
        return tuple(dict.fromkeys(r.config.method for r in self.results if r.config.scene == scene))

    def cells(self, scene: str, method: str) -> tuple[CellResult, ...]:
        """The seeds of a method on a scene."""
        return tuple(r for r in self.results if (r.config.scene, r.config.method) == (scene, method))

    def failed(self, scene: str, method: str) -> int:
        """How many seeds of a method failed."""
        return sum(cell.status != "done" for cell in self.cells(scene, method))

    def values(self, scene: str, method: str, split: str, region: str, metric: str) -> list[float]:
        """The quantity for each seed."""
        values = [cell.value(split, region, metric) for cell in self.cells(scene, method)]
        return [value for value in values if value is not None]

    def get(self, scene: str, method: str, split: str, region: str, metric: str) -> Score | None:
        """The quantity over all seeds, or None where no cell has it."""
        values = self.values(scene, method, split, region, metric)
        if not values:
            return None
        interval = mean_interval(values)
        half_width = None if interval.high is None else interval.high - interval.mean
        return Score(mean=interval.mean, half_width=half_width, seeds=len(values))

    def fg(self, scene: str, method: str, split: str = "novel_view", metric: str = "psnr") -> Score | None:
        """A foreground quality."""
        return self.get(scene, method, split, "foreground", metric)
