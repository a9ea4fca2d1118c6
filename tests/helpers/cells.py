"""Results of cells that nobody ran."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from benchmarks.cell.schema import CellConfig, CellResult, Summary

SPLITS = ("novel_view", "novel_pose")


def config(
    method: str = "ash", seed: int = 0, *, scene: str = "loose", axis: str = "", severity: float = 0.0
) -> CellConfig:
    """A config at size `ci`."""
    fixed = {"size": "ci", "capture_seed": 0, "capture": "c" * 64, "preset": "ci", "code": "0"}
    return CellConfig(scene=scene, method=method, seed=seed, axis=axis, severity=severity, **fixed)


def cell(method: str, psnr: float, *, seed: int = 0, axis: str = "", severity: float = 0.0) -> CellResult:
    """A result with the same foreground PSNR on both held-out splits, and a template that is off by 5 mm."""
    rows = [Summary(split=split, region="foreground", metric="psnr", value=psnr) for split in SPLITS]
    rows += [Summary(split=split, region="", metric="template_mm", value=5.0) for split in SPLITS]
    known = config(method, seed, axis=axis, severity=severity)
    return CellResult(config=known, status="done", summary=tuple(rows))


def people(
    levels: Mapping[str, Sequence[float]], seeds: Sequence[float] = (0.0,), *, scene: str = "loose"
) -> list[CellResult]:
    """A cell per method, subject and seed, of 12 ms per frame; `seeds` are what each adds to the subject's level."""
    costs = (("speed", "frame_ms", 12.0), ("memory", "params", 2e6))
    rows = tuple(Summary(split=split, region="", metric=metric, value=value) for split, metric, value in costs)
    found = []
    for method, own in levels.items():
        for subject, level in enumerate(own):
            for seed, luck in enumerate(seeds):
                result = cell(method, level + luck, seed=seed)
                place = replace(result.config, scene=scene, subject=subject)
                found.append(replace(result, config=place, summary=(*result.summary, *rows)))
    return found
