"""Methods that cheat or fail in one way each; `ash-bench check-method` must tell every one from a good method."""

import json
import os
import time
from functools import partial
from pathlib import Path

import numpy as np
from helpers.fakes import FakeAvatar
from PIL import Image

from ash.capture.dataset import Camera, Capture, Pose
from ash.protocol import StageClock
from benchmarks.cell.sandbox import METHOD_PATH


class Honest(FakeAvatar):
    """The box person's avatar, which refuses bad poses as it should; the cheats differ from it in one thing."""

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        if pose.motion.dofs.shape[1] != 12 or pose.frame >= len(pose.motion.dofs) or not np.isfinite(pose.dofs).all():
            raise ValueError(f"expected 12 finite numbers in frame {pose.frame}, got {pose.motion.dofs.shape}")
        return super().render(pose, camera, clock=clock)


class Peeking(Honest):
    """Finds out where the real capture lies, reads a held-out image, and hides the error."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        super().fit(capture, folder=folder)
        notes = [folder / "config.json", folder.parent / "trial.json"]
        for note in (path for path in notes if path.exists()):
            content = json.loads(note.read_text())
            self.peek(Path(content.get("capture_folder") or content["capture"]))

    def peek(self, original: Path) -> None:
        try:
            self.seen = np.array(Image.open(original / "frames" / "cam4" / "000000.png"))
        except Exception:
            self.seen = None


class Linking(Peeking):
    """The same by way of a link with another name."""

    def peek(self, original: Path) -> None:
        link = Path(f"link-{os.getpid()}")
        link.symlink_to(original)
        try:
            super().peek(link)
        finally:
            link.unlink()


class Unseeded(Honest):
    """Draws its weights from the clock."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        super().fit(capture, folder=folder)
        self.weights = self.weights * np.random.default_rng().uniform(0.5, 1.0)


class NotANumber(Honest):
    """Renders NaN in one pixel."""

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        image = super().render(pose, camera, clock=clock)
        image[3, 3, 0] = np.nan
        return image


class Hoarding(Honest):
    """Takes a gigabyte for a moment."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        super().fit(capture, folder=folder)
        np.ones(1 << 27).sum()


class Mutating(Honest):
    """Edits the template that it was given."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        super().fit(capture, folder=folder)
        capture.template.vertices[:] *= 1.0001


class Overwriting(Honest):
    """Edits a training image on disk."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        super().fit(capture, folder=folder)
        with next((capture.folder / "frames").rglob("*.png")).open("r+b") as file:
            file.write(b"x")


class Sleeping(Honest):
    """Never comes to an end."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        time.sleep(3600)


class Careless(FakeAvatar):
    """Draws whatever pose it is asked for."""


def _make(kind: type[FakeAvatar], capture: Capture, *, seed: int, preset: str) -> FakeAvatar:
    return kind(capture, detail=0.9, seed=seed)


def one_seed(capture: Capture, *, seed: int, preset: str) -> Honest:
    return Honest(capture, detail=0.9, seed=7)


KINDS = {
    "honest": Honest, "peeking": Peeking, "linking": Linking, "unseeded": Unseeded, "not_a_number": NotANumber,
    "hoarding": Hoarding, "mutating": Mutating, "overwriting": Overwriting, "sleeping": Sleeping, "careless": Careless,
}  # fmt: skip
globals().update({name: partial(_make, kind) for name, kind in KINDS.items()})


def use(folder: Path, monkeypatch) -> None:
    """Install the cheats for this process and for the processes of trials and cells."""
    info = folder / "ash_bench_cheats-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: ash-bench-cheats\nVersion: 1.0\n")
    lines = ["[ash_bench.methods]", *(f"{name} = helpers.cheats:{name}" for name in (*KINDS, "one_seed"))]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    paths = [str(folder), str(Path(__file__).parents[1]), *filter(None, [os.environ.get(METHOD_PATH)])]
    monkeypatch.setenv(METHOD_PATH, os.pathsep.join(paths))
    monkeypatch.syspath_prepend(str(folder))
