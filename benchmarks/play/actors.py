"""The trained avatars of a run, opened when they are first asked for, and drawn as fast as this machine can."""

import math
import tempfile
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Capture, Pose
from ash.capture.formats import load_capture
from ash.files import InputError, link_or_copy
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted, splat
from ash.inference import Player
from ash.model import blend_renders, image_of, views_of
from ash.protocol import Avatar, PosedGeometry, PosesGaussians, StageClock
from benchmarks.analysis.style import style_of
from benchmarks.cell.cells import CHECKPOINT, Cell, is_trained, read_cell
from benchmarks.cell.methods import is_oracle
from benchmarks.cell.process import load_avatar
from benchmarks.play.cameras import first_camera
from benchmarks.suites.runs import RUN_FILE, read_run

Shared = list[tuple[float, Gaussians]]  # sets of Gaussians whose renders are blended, and their shares

KEPT_POSES = 48  # Playing a short motion again, or turning the camera, decodes nothing anew.
NOT_FINITE = "the rendered image holds NaN or infinity"
THIN = 0.4  # of its standard deviations: how large a Gaussian is shown as an ellipsoid


class Actor:
    """One trained avatar. Poses are kept: a camera moves around a standing avatar at the splatter's speed."""

    def __init__(self, cell: Cell, title: str, avatar: Avatar, capture: Capture) -> None:
        self.cell, self.title, self.avatar = cell, title, avatar
        self._kept: OrderedDict[tuple[bytes, int], Shared] = OrderedDict()
        self._decoders = None
        if isinstance(avatar, AshAvatar):
            engine = Player(avatar, capture.motion, first_camera(capture)).engine
            self._decoders = None if engine is None else engine.decode

    @torch.no_grad()
    def picture(self, pose: Pose, camera: Camera, clock: StageClock) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`."""
        if not isinstance(self.avatar, PosesGaussians):
            return self.avatar.render(pose, camera, clock=clock)
        shared = self.shared_gaussians(pose, clock)
        with clock.stage("stg4"):
            return image_of(self._splat(shared, camera, None))

    @torch.no_grad()
    def view(self, pose: Pose, camera: Camera, clock: StageClock, behind: tuple[int, int, int]) -> np.ndarray:
        """The picture over a colour, uint8 `[h, w, 3]`: what is shown, at less cost than what is scored."""
        if not isinstance(self.avatar, PosesGaussians):
            return on_colour(self.picture(pose, camera, clock), behind)
        shared = self.shared_gaussians(pose, clock)
        with clock.stage("stg4"):
            return self._over(shared, camera, behind)

    @torch.no_grad()
    def ellipsoids(self, pose: Pose, camera: Camera, clock: StageClock, behind: tuple[int, int, int]) -> np.ndarray:
        """The same, each Gaussian as a small opaque ellipsoid.

        Raises:
            InputError: the avatar has no Gaussians.
        """
        if not isinstance(self.avatar, PosesGaussians):
            raise InputError(f"{self.title} has no Gaussians to show as ellipsoids")
        shown = [
            (share, replace(full, scales=THIN * full.scales, opacities=(full.opacities > 0.1).float()))
            for share, full in self.shared_gaussians(pose, clock)
        ]
        with clock.stage("stg4"):
            return self._over(shown, camera, behind)

    def shared_gaussians(self, pose: Pose, clock: StageClock) -> Shared:
        """The posed Gaussians of an avatar that has any."""
        assert isinstance(self.avatar, PosesGaussians)
        key = (pose.motion.dofs[pose.window(8)].tobytes(), pose.frame)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        if isinstance(self.avatar, AshAvatar):
            posed = self.avatar.shared_gaussians(pose, clock=clock, decoders=self._decoders)
        else:
            posed = [(1.0, self.avatar.gaussians(pose))]
        self._kept[key] = posed
        if len(self._kept) > KEPT_POSES:
            self._kept.popitem(last=False)
        return posed

    def template(self, pose: Pose) -> np.ndarray | None:
        """The posed template `[v, 3]` metres, of an avatar that shows it."""
        if not isinstance(self.avatar, PosedGeometry):
            return None
        vertices = self.avatar.template_vertices(pose)
        return vertices if len(vertices) else None

    def _over(self, shared: Shared, camera: Camera, behind: tuple[int, int, int]) -> np.ndarray:
        rgb = self._splat(shared, camera, torch.tensor(behind) / 255).rgb[0]
        if not math.isfinite(float(rgb.sum())):
            raise FloatingPointError(NOT_FINITE)
        return rgb.mul_(255).add_(0.5).clamp_(0, 255).to(torch.uint8).cpu().numpy()

    def _splat(self, shared: Shared, camera: Camera, behind: torch.Tensor | None) -> Splatted:
        assert isinstance(self.avatar, PosesGaussians)
        how = {**views_of([camera]), "dilation": self.avatar.dilation, "threads": torch.get_num_threads()}
        return blend_renders([(share, splat(gaussians, background=behind, **how)) for share, gaussians in shared])


def on_colour(premultiplied: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """An avatar's picture, float premultiplied RGBA, over a colour: uint8 `[h, w, 3]`.

    Raises:
        FloatingPointError: a value is NaN or infinite.
    """
    if not np.isfinite(premultiplied).all():
        raise FloatingPointError(NOT_FINITE)
    behind = np.array(colour, dtype=np.float32)
    blended = 255 * premultiplied[..., :3] + (1 - premultiplied[..., 3:]) * behind
    return np.clip(blended + 0.5, 0, 255).astype(np.uint8)


class Cast:
    """The trained avatars of one capture; each is loaded when it is first wanted, and stays."""

    def __init__(
        self, capture: Capture, cells: Sequence[Cell], exit_stack: ExitStack, *, device: str, trust: bool
    ) -> None:
        self.capture, self.device, self.trust = capture, device, trust
        self.cells = dict(zip(_titles(cells), cells, strict=True))
        self._stack = exit_stack
        self._actors: dict[str, Actor] = {}

    @property
    def titles(self) -> tuple[str, ...]:
        """The avatars' names, as the user reads them."""
        return tuple(self.cells)

    def actor(self, title: str) -> Actor:
        """The avatar of that name, loaded now if it was not before."""
        if title not in self._actors:
            cell = self.cells[title]
            avatar = self._stack.enter_context(_loaded(cell, self.capture, device=self.device, trust=self.trust))
            self._actors[title] = Actor(cell, title, avatar, self.capture)
        return self._actors[title]

    def only(self) -> Actor:
        """The one avatar that there is.

        Raises:
            InputError: there are several.
        """
        if len(self.titles) != 1:
            raise InputError(f"expected one avatar, got {', '.join(self.titles)}; give the folder of a cell")
        return self.actor(self.titles[0])


@contextmanager
def open_cast(
    folder: Path, *, scene: str | None = None, methods: Sequence[str] = (), device: str = "cpu", trust: bool = False
) -> Iterator[Cast]:
    """The trained avatars of a run or of a single cell on a device, as long as the body runs.

    Oracles are left out: they know their capture's motion only. Of a run with several captures, the first is taken,
    or that of `scene`. Avatars are loaded in this process: methods of others only where they are trusted.

    Raises:
        InputError: nothing to show, or nothing of that scene or of those methods.
    """
    cells = [cell for cell in _cells_in(folder) if is_trained(cell) and not is_oracle(cell.config.method)]
    if not cells:
        raise InputError(f"{folder}: expected a run or a cell with a trained avatar (oracles cannot be played)")
    places = list(dict.fromkeys(cell.config.place for cell in cells))
    wanted = scene or places[0]
    if wanted not in places:
        raise InputError(f"scene: expected one of {', '.join(places)}, got {wanted!r}")
    here = [cell for cell in cells if cell.config.place == wanted]
    here = [cell for cell in here if cell.capture_folder == here[0].capture_folder]
    known = list(dict.fromkeys(cell.config.method for cell in here))
    if unknown := [name for name in methods if name not in known]:
        raise InputError(f"method: expected one of {', '.join(known)}, got {unknown[0]!r}")
    here = [cell for cell in here if not methods or cell.config.method in methods]
    with ExitStack() as stack:
        yield Cast(load_capture(here[0].capture_folder), here, stack, device=device, trust=trust)


@contextmanager
def _loaded(cell: Cell, capture: Capture, *, device: str, trust: bool) -> Iterator[Avatar]:
    """A cell's avatar, loaded in a folder of its own: others may look at the same cell at the same time."""
    with tempfile.TemporaryDirectory(dir=cell.folder, prefix=".shown-") as scratch:
        link_or_copy(cell.folder / CHECKPOINT, Path(scratch) / CHECKPOINT)
        shown = replace(cell, folder=Path(scratch))
        with load_avatar(shown, capture, device=device, trust=trust) as (avatar, _):
            yield avatar


def _cells_in(folder: Path) -> Sequence[Cell]:
    """Of a run, of a cell, or of what `train` left."""
    loose = sorted(folder.glob("cells/*/config.json"))
    if loose and not (folder / RUN_FILE).exists():
        return sorted(map(read_cell, (path.parent for path in loose)), key=lambda cell: cell.config.title)
    return read_run(folder).cells


def _titles(cells: Sequence[Cell]) -> list[str]:
    """Short and different names: the method, and its changes, preset and seed where several have the same."""
    plain = [style_of(cell.config.method.partition("+")[0]).title for cell in cells]
    short = [style_of(cell.config.method).title for cell in cells]
    middle = [f"{name} · {cell.config.preset}" for name, cell in zip(short, cells, strict=True)]
    full = [f"{name} · seed {cell.config.seed}" for name, cell in zip(middle, cells, strict=True)]
    for names in (plain, short, middle, full):
        if len(set(names)) == len(names):
            return names
    return [f"{name} · {cell.folder.name[:6]}" for name, cell in zip(full, cells, strict=True)]
