"""The suites: matrices of scenes x methods x seeds, declared here and nowhere else."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ash.files import InputError

METHOD_GROUP = "ash_bench.methods"

# Who may look at truth/ is decided here, not by the method: these get the whole capture, all others its training part.
ORACLES = frozenset({"ash_truth", "ddc_truth", "oracle_texture"})

# Sources of ours that decide a cell's outcome; a change in any other file (a report, say) leaves results valid.
DECIDING_PACKAGES = ("ash", "baselines")
DECIDING_MODULES = ("cells.py", "lpips.py", "metrics.py", "run.py", "timing.py", "views.py")
SOURCE_SUFFIXES = {".py", ".cpp", ".hpp", ".h", ".inc"}


@dataclass(frozen=True, kw_only=True, slots=True)
class CaptureSpec:
    """Which capture a cell needs: the generator's scene and size, and its root seed."""

    scene: str
    size: str
    seed: int = 0

    @property
    def name(self) -> str:
        """The capture's folder."""
        return f"{self.scene}-{self.size}-{self.seed}"


@dataclass(frozen=True, kw_only=True, slots=True)
class CellSpec:
    """A cell before its capture exists."""

    capture: CaptureSpec
    method: str
    preset: str
    seed: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Suite:
    """A matrix of cells. `cell_minutes`: what one cell takes on one core of an ordinary machine, for estimates only."""

    name: str
    about: str
    scenes: tuple[str, ...]
    size: str
    methods: tuple[str, ...]
    preset: str
    seeds: int
    cell_minutes: float
    limit_minutes: float = 60.0
    limit_mb: int = 8192

    @property
    def captures(self) -> tuple[CaptureSpec, ...]:
        """One capture per scene, shared by all methods and seeds."""
        return tuple(CaptureSpec(scene=scene, size=self.size) for scene in self.scenes)

    @property
    def cells(self) -> Iterator[CellSpec]:
        """Seeds outermost: whoever interrupts early has one whole table, not three thirds of one."""
        for seed in range(self.seeds):
            for capture in self.captures:
                for method in self.methods:
                    yield CellSpec(capture=capture, method=method, preset=self.preset, seed=seed)


MAIN_METHODS = ("ash", "ddc", "wo_disp", "wo_mot", "ash_truth", "ddc_truth")

ABLATIONS = ("mlp", "res_128", "res_512", "cams_12", "cams_30", "cams_60")

SUITES = {
    suite.name: suite
    for suite in (
        Suite(
            name="quick",
            about="the main comparison: a human in loose clothes, ASH against DDC and two ablations, one seed",
            scenes=("loose",),
            size="quick",
            methods=MAIN_METHODS,
            preset="cpu",
            seeds=1,
            cell_minutes=2.5,
        ),
        Suite(
            name="table",
            about="the paper's two comparisons and two ablations on both outfits, three seeds",
            scenes=("tight", "loose"),
            size="quick",
            methods=(*MAIN_METHODS[:4], *ABLATIONS, *MAIN_METHODS[4:]),
            preset="cpu",
            seeds=3,
            cell_minutes=3.0,
        ),
        Suite(
            name="ladder",
            about="one phenomenon per scene against one missing part per method: what needs what",
            scenes=("still", "skinned", "wrinkles", "swing", "lit", "glossy", "turning"),
            size="ci",
            methods=("ash", "wo_mot", "wo_disp", "mlp", "ddc", "ash_truth", "ddc_truth"),
            preset="ci",
            seeds=3,
            cell_minutes=0.4,
        ),
        Suite(
            name="ci",
            about="the same machinery on a small mannequin at 128x128, in about a minute: what the tests run",
            scenes=("mannequin",),
            size="ci",
            methods=("ash", "ddc", "ash_truth", "ddc_truth"),
            preset="ci",
            seeds=1,
            cell_minutes=0.3,
            limit_minutes=20.0,
        ),
    )
}


def find_suite(name: str, *, seeds: int | None = None) -> Suite:
    """A suite by name, with another number of seeds where one is given."""
    if name not in SUITES:
        raise InputError(f"unknown suite {name!r}, expected one of {', '.join(SUITES)}")
    if seeds is not None and seeds < 1:
        raise InputError(f"expected at least one seed, got {seeds}")
    return SUITES[name] if seeds is None else replace(SUITES[name], seeds=seeds)


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """An installed method: where its factory is (`package.module:function`) and which distribution brought it."""

    name: str
    target: str
    distribution: str

    @property
    def is_ours(self) -> bool:
        """Whether its sources are among those that are hashed."""
        return self.target.split(".")[0] in DECIDING_PACKAGES

    def load(self) -> Callable[..., Any]:
        """Import the factory."""
        module, _, function = self.target.partition(":")
        factory: Callable[..., Any] = getattr(import_module(module), function)
        return factory


def methods() -> dict[str, Method]:
    """All installed methods, ours and anyone's."""
    found = {}
    for entry in sorted(entry_points(group=METHOD_GROUP), key=lambda entry: entry.name):
        distribution = f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else ""
        found[entry.name] = Method(name=entry.name, target=entry.value, distribution=distribution)
    return found


def find_method(name: str) -> Method:
    """An installed method by name."""
    known = methods()
    if name not in known:
        raise InputError(f"unknown method {name!r}, expected one of {', '.join(known) or '(none installed)'}")
    return known[name]


@cache
def code_version(method: str) -> str:
    """SHA-256 over everything of ours that decides a cell's outcome, and the version of a third party's method."""
    digest = hashlib.sha256()
    benchmarks = Path(__file__).parent
    for package in DECIDING_PACKAGES:
        root = _package_folder(package)
        _add_files(digest, root, sorted(path for path in root.rglob("*") if path.suffix in SOURCE_SUFFIXES))
    _add_files(digest, benchmarks, [benchmarks / name for name in DECIDING_MODULES])
    found = find_method(method)
    if not found.is_ours:
        digest.update(f"{found.target} {found.distribution}".encode())
    return digest.hexdigest()[:16]


def _package_folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise InputError(f"the package {package} is not importable: install ash-bench again")
    return Path(spec.origin).parent  # Not its search locations: an editable install lists an empty folder among them.


def _add_files(digest: "hashlib._Hash", root: Path, paths: list[Path]) -> None:
    for path in paths:
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
