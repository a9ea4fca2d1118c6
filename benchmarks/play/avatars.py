"""Trained avatars in Python: three lines load one and draw a frame of any motion from any camera.

    from benchmarks.play.avatars import load_avatar
    avatar = load_avatar("runs/ci/cells/0123456789abcdef")
    image = avatar.draw(avatar.motion, frame=12, camera=avatar.cameras["cam000"])

`docs/draw_a_frame.py` does this, with a motion from a file if one is given.
"""

import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ash.capture.dataset import Camera, Capture, Motion, Pose
from ash.capture.formats import load_capture
from ash.files import InputError, link_or_copy
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import splat
from ash.model import image_of, views_of
from ash.protocol import Avatar, PosesGaussians, StageClock
from benchmarks.analysis.style import style_of
from benchmarks.cell import metrics
from benchmarks.cell.registry import is_oracle
from benchmarks.cell.run import load_avatar as open_avatar
from benchmarks.cell.schema import CHECKPOINT, Cell, is_trained, read_cell
from benchmarks.play.motions import motion_clip
from benchmarks.suites.runs import RUN_FILE, read_run

CACHED_POSES = 48  # A short motion that is repeated, or a camera that turns, decodes nothing twice.


class LoadedAvatar:
    """An avatar as its cell trained it. Posed Gaussians are cached: a camera moves at the splatter's speed."""

    def __init__(self, cell: Cell, title: str, avatar: Avatar, capture: Capture) -> None:
        self.cell, self.title = cell, title
        self.avatar = avatar  # the method's object; `ash.protocol` says what it can do
        self.capture = capture  # what it was trained on, test splits included
        self._cache: OrderedDict[tuple[bytes, int], Gaussians] = OrderedDict()

    @property
    def motion(self) -> Motion:
        """The motion of its capture: the training sequences, then the test sequences."""
        return self.capture.motion

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras of its capture by name."""
        return self.capture.cameras

    def read_motion(self, path: Path | str) -> Motion:
        """A BVH or AMASS file on the avatar's skeleton, at the rate of its capture.

        Raises:
            InputError: the file cannot be read.
        """
        return motion_clip(self.capture, str(path)).motion

    def draw(self, motion: Motion, *, frame: int, camera: Camera) -> np.ndarray:
        """The avatar in a frame of a motion, seen by a camera: uint8 `[h, w, 4]`, sRGB, straight alpha.

        Raises:
            ValueError: the motion lacks the frame, is of another skeleton, or holds NaN
                (`ash.capture.dataset.require_pose`).
        """
        drawn = self.avatar.render(Pose(motion, frame), camera, clock=StageClock())
        colour = drawn[..., :3] / np.maximum(drawn[..., 3:], 1e-3)
        straight = np.concatenate([colour, drawn[..., 3:]], axis=-1)
        return np.rint(np.clip(straight, 0, 1) * 255).astype(np.uint8)

    @torch.no_grad()
    def on_black(self, pose: Pose, camera: Camera) -> np.ndarray:
        """The picture that is scored: on black, uint8 `[h, w, 4]`.

        Raises:
            FloatingPointError: a value is NaN or infinite.
        """
        avatar = self.avatar
        if not isinstance(avatar, PosesGaussians):
            return metrics.quantise(avatar.render(pose, camera, clock=StageClock()))
        threads = torch.get_num_threads()
        drawn = splat(self._gaussians(pose), **views_of([camera]), dilation=avatar.dilation, threads=threads)
        return metrics.quantise(image_of(drawn))

    def _gaussians(self, pose: Pose) -> Gaussians:
        assert isinstance(self.avatar, PosesGaussians)
        key = (pose.motion.dofs[pose.window(8)].tobytes(), pose.frame)
        if key not in self._cache:
            self._cache[key] = self.avatar.gaussians(pose)
            if len(self._cache) > CACHED_POSES:
                self._cache.popitem(last=False)
        self._cache.move_to_end(key)
        return self._cache[key]


def load_avatar(folder: Path | str, *, trust: bool = False) -> LoadedAvatar:
    """The trained avatar of a cell's folder. What it needs on disk is freed with it.

    The method's code runs in this process, and can do what you can: one that is not ours needs `trust`.

    Raises:
        InputError: the folder holds no trained cell, its capture is gone or another one, or its method is of others
            and not trusted.
    """
    folder = Path(folder)
    if not (folder / "config.json").is_file():
        trained = sorted(path.parent for path in folder.glob("cells/*/model.safetensors"))
        known = f"; trained ones are {', '.join(map(str, trained[:4]))}" if trained else ""
        raise InputError(f"{folder}: expected the folder of a cell{known}")
    cell = read_cell(folder)
    if not is_trained(cell):
        raise InputError(f"{folder}: {cell.config.title} left no avatar that could be loaded")
    capture = load_capture(cell.capture_folder)
    with ExitStack() as stack:
        avatar, _ = stack.enter_context(open_avatar(cell, capture, trust=trust))
        loaded = LoadedAvatar(cell, _titles([cell])[0], avatar, capture)
        weakref.finalize(loaded, stack.pop_all().close)
    return loaded


class AvatarSet:
    """The trained avatars of one capture by title; each is loaded when it is first used."""

    def __init__(self, capture: Capture, cells: Sequence[Cell], stack: ExitStack, *, device: str, trust: bool) -> None:
        self.capture, self._device, self._trust, self._stack = capture, device, trust, stack
        self._cells = dict(zip(_titles(cells), cells, strict=True))
        self._loaded: dict[str, LoadedAvatar] = {}
        self.titles = tuple(self._cells)

    def __getitem__(self, title: str) -> LoadedAvatar:
        if title not in self._loaded:
            cell = self._cells[title]
            # A folder of its own for the method's files: others may load the same cell at the same time.
            scratch = Path(self._stack.enter_context(tempfile.TemporaryDirectory(dir=cell.folder, prefix=".shown-")))
            link_or_copy(cell.folder / CHECKPOINT, scratch / CHECKPOINT)
            copy = replace(cell, folder=scratch)
            avatar, _ = self._stack.enter_context(
                open_avatar(copy, self.capture, device=self._device, trust=self._trust)
            )
            self._loaded[title] = LoadedAvatar(cell, title, avatar, self.capture)
        return self._loaded[title]

    def only(self) -> LoadedAvatar:
        """The one avatar of the set.

        Raises:
            InputError: there are several.
        """
        if len(self.titles) != 1:
            raise InputError(f"expected one avatar, got {', '.join(self.titles)}; give the folder of a cell")
        return self[self.titles[0]]


@contextmanager
def open_avatars(
    folder: Path, *, scene: str | None = None, methods: Sequence[str] = (), device: str = "cpu", trust: bool = False
) -> Iterator[AvatarSet]:
    """The trained avatars of a run or of a single cell on a device, as long as the body runs.

    Oracles are left out: they know their capture's motion only. Of a run with several captures, the first is taken,
    or that of `scene`. Avatars are loaded in this process: methods of others only where they are trusted.

    Raises:
        InputError: nothing to show, or nothing of that scene or of those methods.
    """
    cells = [c for c in read_run(folder).cells if is_trained(c) and not is_oracle(c.config.method)]
    if not (folder / RUN_FILE).exists():  # What `train` left has no order of its own.
        cells.sort(key=lambda cell: cell.config.title)
    if not cells:
        raise InputError(f"{folder}: expected a run or a cell with a trained avatar (oracles cannot be played)")
    scenes = list(dict.fromkeys(cell.config.place for cell in cells))
    if (scene or scenes[0]) not in scenes:
        raise InputError(f"scene: expected one of {', '.join(scenes)}, got {scene!r}")
    cells = [cell for cell in cells if cell.config.place == (scene or scenes[0])]
    cells = [cell for cell in cells if cell.capture_folder == cells[0].capture_folder]
    known = list(dict.fromkeys(cell.config.method for cell in cells))
    if unknown := [name for name in methods if name not in known]:
        raise InputError(f"method: expected one of {', '.join(known)}, got {unknown[0]!r}")
    cells = [cell for cell in cells if not methods or cell.config.method in methods]
    with ExitStack() as stack:
        yield AvatarSet(load_capture(cells[0].capture_folder), cells, stack, device=device, trust=trust)


def _titles(cells: Sequence[Cell]) -> list[str]:
    """Short and different names: the method, and its changes, preset, seed and key where several have the same."""
    title = [style_of(cell.config.method.partition("+")[0]).title for cell in cells]
    if len(set(title)) < len(title):
        title = [style_of(cell.config.method).title for cell in cells]
    for more in (lambda c: c.config.preset, lambda c: f"seed {c.config.seed}", lambda c: c.folder.name[:6]):
        if len(set(title)) < len(title):
            title = [f"{name} · {more(cell)}" for name, cell in zip(title, cells, strict=True)]
    return title
