"""The suites: matrices of scenes x methods x seeds, declared here and nowhere else."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ash.files import InputError
from benchmarks.stress import ALL_STRESSES, Stress

METHOD_GROUP = "ash_bench.methods"

# Who may look at truth/ is decided here, not by the method: these get the whole capture, all others its training part.
TEMPLATE_ERRORS_MM = (0, 2, 4, 8, 16)
ON_EXACT = ("ash_truth", "ddc_truth", "oracle_texture")
WRONG_BY_MM = {
    mm: ON_EXACT if mm == 0 else (f"ash_{mm}mm", f"ddc_{mm}mm", f"texture_{mm}mm") for mm in TEMPLATE_ERRORS_MM
}
ORACLES = frozenset({"baselines.switches:by_vertices"}).union(*WRONG_BY_MM.values())

# Sources of ours that decide a cell's outcome; a change in any other file (a report, say) leaves results valid.
DECIDING_PACKAGES = ("ash", "baselines")
DECIDING_MODULES = ("cells.py", "lpips.py", "metrics.py", "run.py", "sealing.py", "timing.py", "views.py")
SOURCE_SUFFIXES = {".py", ".cpp", ".hpp", ".h", ".inc"}


@dataclass(frozen=True, kw_only=True, slots=True)
class CaptureSpec:
    """Which capture a cell needs: the generator's scene and size, its root seed, and how it is spoilt, if it is."""

    scene: str
    size: str
    seed: int = 0
    stress: Stress | None = None

    @property
    def name(self) -> str:
        """The capture's folder."""
        name = f"{self.scene}-{self.size}-{self.seed}"
        return name if self.stress is None else f"{name}-{self.stress.axis}-{self.stress.severity:g}"


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
    stresses: tuple[Stress, ...] = ()
    limit_minutes: float = 60.0
    limit_mb: int = 8192

    @property
    def captures(self) -> tuple[CaptureSpec, ...]:
        """One capture per scene, and one per scene and stress, shared by all methods and seeds."""
        return tuple(
            CaptureSpec(scene=scene, size=self.size, stress=stress)
            for stress in (None, *self.stresses)
            for scene in self.scenes
        )

    @property
    def cells(self) -> Iterator[CellSpec]:
        """Seeds outermost: whoever interrupts early has one whole table, not three thirds of one."""
        for seed in range(self.seeds):
            for capture in self.captures:
                for method in self.methods:
                    yield CellSpec(capture=capture, method=method, preset=self.preset, seed=seed)


MAIN_METHODS = ("ash", "ddc", "wo_disp", "wo_mot", "ash_truth", "ddc_truth")

# Rows of the suite `switches`; named here, for to import them is to import torch.
SWITCHES = (
    "warm_up_paper",
    "warm_up_released",
    "warm_up_none",
    "loss_paper",
    "loss_released",
    "norm_released",
    "norm_instance",
    "world_rotations",
    "released_phi",
    "wo_phi",
    "sh_3",
    "wide_dilation",
    "wo_base",
    "wo_light",
    "wo_light_and_motion",
    "wo_standardise",
    "wo_heading",
    "two_trunks",
    "noisy_textures",
    "averaged",
    "blendshapes",
    "learned_template",
)
LEARNED = ("by_vertices", "by_images", "by_graph", "unlearned", "refined")  # Rows of the suite `template`, as above.

ABLATIONS = ("mlp", "res_128", "res_512", "cams_12", "cams_30", "cams_60")
REFERENCES = ("mlp_time", "smpl", "static", "nearest", "oracle_texture")

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
            about="the paper's two comparisons and two ablations on both outfits, and references, three seeds",
            scenes=("tight", "loose"),
            size="quick",
            methods=(*MAIN_METHODS[:4], *ABLATIONS, *REFERENCES, *MAIN_METHODS[4:]),
            preset="brief",
            seeds=3,
            cell_minutes=1.2,
        ),
        Suite(
            name="ladder",
            about="one phenomenon per scene against one missing part per method: what needs what",
            scenes=("splats", "still", "skinned", "wrinkles", "swing", "lit", "glossy", "turning"),
            size="ci",
            methods=("ash", "wo_mot", "wo_disp", "mlp", "ddc", "ash_truth", "ddc_truth"),
            preset="ci",
            seeds=3,
            cell_minutes=0.2,
        ),
        Suite(
            name="stability",
            about="where methods fail: nine ways to spoil a capture, three severities each, and the trivial baseline",
            scenes=("loose",),
            size="ci",
            methods=("ash", "ddc", "nearest"),
            preset="ci",
            seeds=3,
            cell_minutes=0.2,
            stresses=ALL_STRESSES,
        ),
        Suite(
            name="template",
            about="splats and meshes against the template's error, planted (0 to 16 mm) and learned, on loose clothes",
            scenes=("loose",),
            size="quick",
            methods=(
                *("ash", "ddc", *(f"baselines.switches:{name}" for name in LEARNED)),
                *(method for row in WRONG_BY_MM.values() for method in row),
            ),
            preset="brief",
            seeds=3,
            cell_minutes=1.2,
        ),
        Suite(
            name="switches",
            about="every switch between paper, release and the fast presets, one at a time, on both outfits",
            scenes=("tight", "loose"),
            size="ci",
            methods=("ash", *(f"baselines.switches:{name}" for name in SWITCHES)),
            preset="ci",
            seeds=3,
            cell_minutes=0.2,
        ),
        Suite(
            name="speed",
            about="accuracy against milliseconds per frame: lighter and heavier avatars on loose clothes, three seeds",
            scenes=("loose",),
            size="quick",
            methods=("ash", "ash_frugal", "res_128", "res_512", "wo_mot", "mlp", "static", "ddc"),
            preset="brief",
            seeds=3,
            cell_minutes=1.2,
        ),
        Suite(
            name="paper",
            about="both outfits at the paper's size and length: work for a cluster with GPUs",
            scenes=("tight", "loose"),
            size="paper",
            methods=(*MAIN_METHODS[:4], *ABLATIONS, "smpl", *MAIN_METHODS[4:]),
            preset="paper",
            seeds=3,
            cell_minutes=7 * 24 * 60.0,  # The paper: GPU-weeks.
            limit_minutes=21 * 24 * 60.0,
            limit_mb=128 * 1024,
        ),
        Suite(
            name="ci",
            about="the same machinery on a small mannequin at 128x128, in about a minute: what the tests run",
            scenes=("mannequin",),
            size="ci",
            methods=("ash", "ddc", "ash_truth", "ddc_truth"),
            preset="ci",
            seeds=1,
            cell_minutes=0.2,
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
    """An installed method by name, or any importable factory as `package.module:function`."""
    if ":" in name and find_spec_of(name) is not None:
        return Method(name=name, target=name, distribution="")
    known = methods()
    if name not in known:
        raise InputError(f"unknown method {name!r}, expected one of {', '.join(known) or '(none installed)'}")
    return known[name]


def find_spec_of(target: str) -> ModuleSpec | None:
    """The module of `package.module:function`, None where there is none."""
    try:
        return find_spec(target.partition(":")[0])
    except (ImportError, ValueError):
        return None


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
    spec = find_spec_of(found.target)
    if not found.distribution and spec is not None and spec.origin is not None:
        digest.update(Path(spec.origin).read_bytes())  # No version tells when a factory by its path changes.
    return digest.hexdigest()[:16]


def _package_folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise InputError(f"the package {package} is not importable: install ash-bench again")
    return Path(spec.origin).parent  # Not its search locations: an editable install lists an empty folder among them.


def _add_files(digest: "hashlib._Hash", root: Path, paths: list[Path]) -> None:
    for path in paths:
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
