"""The manifest of a capture: what it is, which files belong to it, and whether they are intact."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from ash.capture.typed import from_json
from ash.files import InputError, read_json, require_plain, sha256_of, write_json

NAME = "manifest.json"
SCHEMA = 1
SPLITS = ("train", "novel_view", "novel_pose")


@dataclass(frozen=True, kw_only=True, slots=True)
class Split:
    """Which cameras and frames belong together; every pair has an image."""

    cameras: tuple[str, ...]
    frames: tuple[int, ...]

    @property
    def views(self) -> list[tuple[str, int]]:
        """All (camera, frame) pairs, frame by frame."""
        return [(camera, frame) for frame in self.frames for camera in self.cameras]


@dataclass(frozen=True, kw_only=True, slots=True)
class Manifest:
    """What a capture is. On disk, `manifest.json` is written last; what is empty or None is not written."""

    scene: str
    seed: int
    splits: dict[str, Split]
    files: dict[str, str]  # SHA-256 of every file but this one, by its path below the capture
    complete: bool = True
    size: str = ""
    identity: str = ""  # hash of the scene's parameters; empty where no scene makes the capture again
    code: str = ""  # version of the code that made it, with the packages that decide bytes
    source: str = ""  # version of our sources alone
    parameters: dict[str, Any] = field(default_factory=dict)  # every parameter of the scene
    made_with: dict[str, str] = field(default_factory=dict)
    pose_novelty_deg: float | None = None  # of the test motion, see `synth.motion.clips.pose_novelty`
    perturbed: dict[str, Any] = field(default_factory=dict)  # how it was spoilt, and of which capture
    undistorted: dict[str, str] = field(default_factory=dict)  # of which capture

    def write(self, folder: Path) -> None:
        """Write it into a capture's folder, atomically."""
        told = {f.name: getattr(self, f.name) for f in fields(self)}
        told["splits"] = {n: {"cameras": list(s.cameras), "frames": list(s.frames)} for n, s in self.splits.items()}
        said = {name: value for name, value in told.items() if name == "files" or value not in ("", {}, None)}
        write_json(folder / NAME, {"schema": SCHEMA} | said)


def is_capture(folder: Path) -> bool:
    """Whether a folder has a manifest, be the capture finished or not."""
    return (folder / NAME).is_file()


def read_manifest(folder: Path) -> Manifest:
    """Read a manifest and check that this version of the package understands it."""
    path = folder / NAME
    told = read_json(path)
    if not isinstance(told, dict) or told.get("schema") != SCHEMA:
        found = told.get("schema") if isinstance(told, dict) else None
        raise InputError(f"{path}: expected capture schema {SCHEMA}, got {found}")
    try:
        if "complete" not in told:
            raise ValueError("the key 'complete' is missing")
        manifest: Manifest = from_json(Manifest, {name: value for name, value in told.items() if name != "schema"})
        require_plain(manifest.scene, what="scene")
        require_plain(manifest.size, what="size", may_be_empty=True)
        _require_splits(manifest.splits)
    except ValueError as error:
        raise InputError(f"{path}: expected the manifest of a capture ({error})") from error
    return manifest


def _require_splits(splits: dict[str, Split]) -> None:
    if set(splits) - set(SPLITS) or "train" not in splits:
        raise ValueError(f"splits: expected train, and perhaps others of {', '.join(SPLITS)}, got {sorted(splits)}")
    for name, split in splits.items():
        if not split.cameras or not split.frames:
            raise ValueError(f"splits.{name}: expected cameras and frames")
        if len(set(split.cameras)) < len(split.cameras) or len(set(split.frames)) < len(split.frames):
            raise ValueError(f"splits.{name}: a camera or a frame stands there twice")


def files_below(folder: Path) -> list[str]:
    """Every file of a capture but its manifest, by its path below the capture."""
    return sorted({str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} - {NAME})


def hash_files(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a capture but its manifest."""
    return {name: sha256_of(folder / name) for name in files_below(folder)}


def verify_capture(folder: Path) -> list[str]:
    """Hash every file of a capture again. Returns one line per file that is missing, altered or not in the manifest."""
    manifest = read_manifest(folder)
    problems = []
    for name, expected in sorted(manifest.files.items()):
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()):
            problems.append(f"{name}: outside the capture")
        elif not path.is_file():
            problems.append(f"{name}: missing")
        elif sha256_of(path) != expected:
            problems.append(f"{name}: altered (SHA-256 differs from the manifest)")
    return problems + [f"{name}: not in the manifest" for name in files_below(folder) if name not in manifest.files]
