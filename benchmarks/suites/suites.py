"""What a suite is: a matrix of scenes x methods x seeds. `benchmarks.suites.files` reads it; ours are `*.toml` here."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ash.fields import Changes, suggest
from ash.files import InputError, hash_of
from benchmarks.cell.registry import ORACLES, brought_folder, find_method, is_oracle, methods, named_method
from benchmarks.suites.stress import TRIVIAL, Stress
from benchmarks.suites.tables import TableSpec
from synth.person.cast import VALIDATION

MOST_SEEDS = 1000
AS_GIVEN = "as given"  # size of a capture, or preset of brought pictures, that nobody says
LONGEST_VALUE = 24  # Characters of a changed value in a name; its hash stands for a longer one.
LONGEST_NAME = 120  # Characters of a name; the hash of all changes stands for a longer list of them.


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneSpec:
    """A row of scenes: one of the generator's with fields replaced, or a capture that is there already."""

    name: str  # in tables
    of: str = ""  # the generator's scene, where it has another name
    size: str = ""  # none: the suite's
    changes: Changes = ()  # in `synth.scene.Scene`
    folder: Path | None = None  # of a finished capture
    subject: int = 0  # whom the finished capture shows
    recipe: str = ""  # hash of what decides the finished capture but its subject
    methods: tuple[str, ...] = ()  # rows of the suite that run on it; none: all


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodSpec:
    """A row of methods: an entry point or `package.module:factory`, perhaps with its configuration changed.

    Or `predictions:DIR`, pictures that were rendered elsewhere.
    """

    name: str  # in tables
    of: str = ""  # the entry point or factory, where it has another name
    preset: str = ""  # none: the suite's
    changes: Changes = ()  # in the configuration that the preset means
    title: str = ""  # in reports; none: the name

    def __post_init__(self) -> None:
        """Refuse an oracle under a competitor's name, a competitor under an oracle's, and pictures under a method's."""
        oracle, method = self.of in ORACLES, named_method(self.of)
        if oracle and named_method(self.name) != method:
            raise InputError(f"method {self.name!r}: expected a name that begins with {method!r}, an oracle")
        if self.of and not oracle and is_oracle(self.name):
            raise InputError(f"method {self.name!r}: expected a name that is no oracle's")
        if brought_folder(self.of) is not None and named_method(self.name) in methods():
            raise InputError(
                f"method {self.name!r}: pictures are brought, expected a name that no installed method has"
            )


@dataclass(frozen=True, kw_only=True, slots=True)
class CaptureSpec:
    """Which capture a cell needs: a scene, its root seed, its subject, and its perturbation, if any."""

    scene: str
    size: str
    seed: int = 0
    subject: int = 0
    stress: Stress | None = None
    of: str = ""  # the generator's scene, where `scene` is a name of the suite's
    changes: Changes = ()
    folder: Path | None = None  # where it lies, if it is a finished one

    @property
    def name(self) -> str:
        """The capture's folder."""
        name = capture_name(self.scene, self.size, self.seed, self.subject)
        return name if self.stress is None else f"{name}-{self.stress.axis}-{self.stress.severity:g}"


@dataclass(frozen=True, kw_only=True, slots=True)
class CellSpec:
    """A cell before its capture exists."""

    capture: CaptureSpec
    method: str
    preset: str
    seed: int
    factory: str = ""  # the entry point or factory, where `method` is a name of the suite's
    changes: Changes = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Suite:
    """A matrix of cells. `cell_minutes`: what one cell takes on one core of an ordinary machine, for estimates only."""

    name: str
    about: str
    scenes: tuple[SceneSpec, ...]
    size: str
    methods: tuple[MethodSpec, ...]
    preset: str
    seeds: int = 1
    subjects: int = 1
    cell_minutes: float = 1.0
    stresses: tuple[Stress, ...] = ()
    table: tuple[TableSpec, ...] = ()  # that the report shows
    limit_minutes: float = 60.0
    limit_mb: int = 8192
    validation: bool = False  # on the people that are there to choose by, whom no table of results has

    def __post_init__(self) -> None:
        """Refuse what makes no table."""
        scenes, known = tuple(row.name for row in self.scenes), tuple(row.name for row in self.methods)
        several = [name for name in scenes if not people_of_one([row for row in self.scenes if row.name == name])]
        twice = [name for name in known if known.count(name) > 1]
        for what, names, alike in (("scene", scenes, several), ("method", known, twice)):
            if not names:
                raise InputError(f"expected at least one {what}")
            if alike:
                raise InputError(f"two {what}s are called {alike[0]!r}, expected a name of its own for each")
        for scene in self.scenes:
            for name in scene.methods:
                if name not in known:
                    raise InputError(f"scenes: {scene.name} asks for the method {name!r}, {suggest(name, known)}")
        if not 1 <= self.seeds <= MOST_SEEDS:
            raise InputError(f"seeds: expected 1 to {MOST_SEEDS}, got {self.seeds}")
        if not 1 <= self.subjects <= VALIDATION:
            raise InputError(
                f"subjects: expected 1 to {VALIDATION}, got {self.subjects}:"
                f" those from {VALIDATION} on are for validation"
            )
        for name in ("cell_minutes", "limit_minutes", "limit_mb"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name}: expected more than 0, got {getattr(self, name)}")

    @property
    def captures(self) -> tuple[CaptureSpec, ...]:
        """One capture per subject and scene, and one per stress of it, shared by all methods and seeds.

        Subjects outermost; a finished capture has the one that it has.
        """
        first = VALIDATION if self.validation else 0
        return tuple(
            CaptureSpec(
                scene=scene.name,
                size=scene.size or self.size,
                subject=scene.subject if scene.folder else subject,
                stress=stress,
                of="" if scene.of == scene.name else scene.of,
                changes=scene.changes,
                folder=scene.folder,
            )
            for subject in range(first, first + self.subjects)
            for stress in (None, *self.stresses)
            for scene in self.scenes
            if not scene.folder or subject == first
        )

    @property
    def cells(self) -> Iterator[CellSpec]:
        """Seeds outermost: whoever interrupts early has one whole table, not three thirds of one.

        The trivial method runs on clean captures only: no report asks for more of it.
        """
        chosen = {(scene.name, scene.folder): scene.methods for scene in self.scenes}
        for seed in range(self.seeds):
            for capture in self.captures:
                wanted = chosen[capture.scene, capture.folder]
                for method in self.methods:
                    if wanted and method.name not in wanted:
                        continue
                    if capture.stress is not None and method.of == TRIVIAL:
                        continue
                    if seed and brought_folder(method.of) is not None:
                        continue  # The same pictures again would pass for a second training.
                    yield CellSpec(
                        capture=capture,
                        method=method.name,
                        factory="" if method.of == method.name else method.of,
                        preset=method.preset or self.preset,
                        seed=seed,
                        changes=method.changes,
                    )

    def narrowed(
        self,
        *,
        scenes: tuple[SceneSpec, ...] = (),
        methods: tuple[str, ...] = (),
        stresses: tuple[str, ...] = (),
        **others: object,
    ) -> "Suite":
        """The suite with other rows and values where they are given; a method that is no row of it becomes one.

        Methods that are given run on every scene, also on one that has a choice of its own. Of the suite's stresses
        those of the given axes stay, at all their severities.

        Raises:
            InputError: a method that is neither a row nor installed, or an axis that the suite has not.
        """
        rows = {row.name: row for row in self.methods}
        chosen = tuple(rows[name] if name in rows else MethodSpec(name=find_method(name).name) for name in methods)
        given: dict[str, object] = {name: value for name, value in others.items() if value is not None}
        given |= {"scenes": scenes} if scenes else {}
        axes = tuple(dict.fromkeys(stress.axis for stress in self.stresses))
        for axis in stresses:
            if axis not in axes:
                known = suggest(axis, axes) if axes else "expected none"
                raise InputError(f"suite {self.name}: no stress {axis!r}, {known}")
        given |= {"stresses": tuple(each for each in self.stresses if each.axis in stresses)} if stresses else {}
        if chosen:
            given |= {"methods": chosen, "scenes": tuple(replace(scene, methods=()) for scene in scenes or self.scenes)}
        return replace(self, **given)  # type: ignore[arg-type]


def people_of_one(rows: Sequence[SceneSpec]) -> bool:
    """Whether captures are of one scene, each of another person; a scene that is to be made has all its people."""
    return len({row.subject for row in rows}) == len(rows) and len({row.recipe for row in rows}) == 1


def varied_name(of: str, changes: Changes) -> str:
    """A name for what differs from `of` in some fields, such as `ash+texels=128`; fit for files and links."""
    parts = [of]
    for key, value in changes:
        text = re.sub(r"[^\w.-]", "", "_".join(map(str, value)) if isinstance(value, tuple) else str(value))
        parts.append(f"{key.rpartition('.')[2]}={text if len(text) <= LONGEST_VALUE else hash_of(value)[:8]}")
    name = "+".join(parts)
    return name if len(name) <= LONGEST_NAME else f"{of}+{hash_of([(key, str(value)) for key, value in changes])[:8]}"


def capture_name(scene: str, size: str, seed: int, subject: int = 0) -> str:
    """What the folder of a capture is called."""
    return f"{scene}-{size}-{seed}-subject{subject}" if subject else f"{scene}-{size}-{seed}"
