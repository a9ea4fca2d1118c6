"""The manifest of a capture: what it is, which files belong to it, and whether they are intact."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from ash.capture.typed import from_json
from ash.files import InputError, read_json, require_plain, sha256_of, write_json

NAME = "manifest.json"
SCHEMA = 1
SPLITS = ("train", "novel_view", "near_pose", "novel_pose", "far_pose")


@dataclass(frozen=True, kw_only=True, slots=True)
class Split:
    """Which cameras and frames belong together: where no parts are given, every camera saw every frame."""

    cameras: tuple[str, ...]
    frames: tuple[int, ...]
    parts: tuple[tuple[str, ...], ...] = ()  # the cameras that saw each frame, in the order of `frames`; none: all did

    @property
    def cameras_per_frame(self) -> tuple[tuple[str, ...], ...]:
        """The cameras that saw each frame, in the order of `frames`."""
        return self.parts or (self.cameras,) * len(self.frames)

    @property
    def views(self) -> list[tuple[str, int]]:
        """All (camera, frame) pairs that have an image, frame by frame."""
        return [
            (camera, frame) for frame, part in zip(self.frames, self.cameras_per_frame, strict=True) for camera in part
        ]

    @property
    def count(self) -> int:
        """How many images there are."""
        return sum(map(len, self.cameras_per_frame))

    def seeing(self, frame: int) -> tuple[str, ...]:
        """The cameras that saw a frame of the split."""
        return self.cameras_per_frame[self.frames.index(frame)]

    def only(self, *, cameras: Sequence[str] | None = None, frames: Sequence[int] | None = None) -> "Split":
        """The split's images by some of its cameras, in some of its frames. What is left without images is left out.

        Raises:
            InputError: none of its images is.
        """
        few_cameras, few_frames = set(self.cameras if cameras is None else cameras), set(frames or ())
        cameras_by_frame = {
            frame: tuple(name for name in part if name in few_cameras)
            for frame, part in zip(self.frames, self.cameras_per_frame, strict=True)
            if frames is None or frame in few_frames
        }
        cameras_by_frame = {frame: part for frame, part in cameras_by_frame.items() if part}
        if not cameras_by_frame:
            raise InputError("expected images of the split, got cameras and frames that have none together")
        used = {name for part in cameras_by_frame.values() for name in part}
        names = tuple(name for name in self.cameras if name in used)
        return Split(
            cameras=names, frames=tuple(cameras_by_frame), parts=tuple(cameras_by_frame.values()) if self.parts else ()
        )


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
    pose_novelty_deg: float | None = None  # mean over the split novel_pose, see `ash.capture.novelty`
    perturbed: dict[str, Any] = field(default_factory=dict)  # how it was perturbed, and of which capture
    undistorted: dict[str, str] = field(default_factory=dict)  # of which capture

    def write(self, folder: Path) -> None:
        """Write it into a capture's folder, atomically."""
        content = {f.name: getattr(self, f.name) for f in fields(self)}
        content["splits"] = {name: _as_json(split) for name, split in self.splits.items()}
        given = {name: value for name, value in content.items() if name == "files" or value not in ("", {}, None)}
        write_json(folder / NAME, {"schema": SCHEMA} | given)


def _as_json(split: Split) -> dict[str, Any]:
    """A split as JSON, which says nothing of parts where every camera saw every frame."""
    content: dict[str, Any] = {"cameras": list(split.cameras), "frames": list(split.frames)}
    return content | ({"parts": [list(part) for part in split.parts]} if split.parts else {})


def is_capture(folder: Path) -> bool:
    """Whether a folder has a manifest, be the capture finished or not."""
    return (folder / NAME).is_file()


def read_manifest(folder: Path) -> Manifest:
    """Read a manifest and check that this version of the package understands it."""
    path = folder / NAME
    content = read_json(path)
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        found = content.get("schema") if isinstance(content, dict) else None
        raise InputError(f"{path}: expected capture schema {SCHEMA}, got {found}")
    try:
        if "complete" not in content:
            raise ValueError("the key 'complete' is missing")
        manifest: Manifest = from_json(Manifest, {name: value for name, value in content.items() if name != "schema"})
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
        if split.parts:
            _require_parts(name, split)


def _require_parts(name: str, split: Split) -> None:
    if len(split.parts) != len(split.frames):
        raise ValueError(f"splits.{name}: parts of {len(split.parts)} frames, expected {len(split.frames)}")
    for part in split.parts:
        if not part or len(set(part)) < len(part) or not set(part) <= set(split.cameras):
            raise ValueError(f"splits.{name}: expected in every part some cameras of the split, each once")
    if set(split.cameras) != {camera for part in split.parts for camera in part}:
        raise ValueError(f"splits.{name}: a camera stands in no part")


def files_below(folder: Path) -> list[str]:
    """Every file of a capture but its manifest, by its path below the capture."""
    return sorted({str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} - {NAME})


def hash_files(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a capture but its manifest."""
    return {name: sha256_of(folder / name) for name in files_below(folder)}


def verify_capture(folder: Path) -> list[str]:
    """Hash every file of a capture again. Returns one line per file that is missing, altered or not in the manifest."""
    manifest, root = read_manifest(folder), folder.resolve()
    problems = []
    for name, expected in sorted(manifest.files.items()):
        path = folder / name
        if ".." in name.split("/"):
            problems.append(f"{name}: outside the capture")
        elif not path.is_file():
            problems.append(f"{name}: missing")
        elif not path.resolve().is_relative_to(root):
            problems.append(f"{name}: outside the capture")
        elif sha256_of(path) != expected:
            problems.append(f"{name}: altered (SHA-256 differs from the manifest)")
    return problems + [f"{name}: not in the manifest" for name in files_below(folder) if name not in manifest.files]
