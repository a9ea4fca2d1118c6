"""The ASH avatar, in the paper's order: template, textures, decoders, skinning, splatting. START READING HERE."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.capture.dataset import Camera, Pose
from ash.config import ModelConfig
from ash.devices import MovingModule, finish
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted, splat
from ash.gaussians.texels import pose, sample_surface
from ash.protocol import StageClock
from ash.template.motion import normalised_motion
from ash.template.template import Template
from ash.template_learning.refining import MotionRefinement, RefinedDeformation
from ash.textures import FrameInputs, TexelLattice, TextureDrawer, build_lattice


class AshModel(MovingModule):
    """The learned part of ASH, and how the stages are joined.

    A frame is `frame_inputs` (Stg. 1 and 2), `decode` (Stg. 3), `gaussians` and `rasterize` (Stg. 4). What the paper
    does not have is in `ash.plus.AshPlusModel`.
    """

    def __init__(
        self,
        config: ModelConfig,
        template: Template,
        lattice: TexelLattice,
        initial: Float[Tensor, "n o"],
        decoders: nn.Module | None,
    ) -> None:
        """`initial`: raw parameters per texel, to which the decoders add theirs; learned where there are no decoders.

        Decoders map a sequence of b `FrameInputs` to `[b, n, o]`; those of the paper are `ash.decoders.Decoders`.
        """
        super().__init__()
        self.config = config
        self.template = template
        self.lattice = lattice
        self.textures: TextureDrawer | None = None
        if decoders is not None:
            decoded = lattice if config.shuffle == 1 else build_lattice(template.mesh, config.decoded_texels)
            self.textures = TextureDrawer.of(config, decoded)
        self.decoders = decoders
        self._add_texels(initial)
        self.refinement: MotionRefinement | None = None
        if isinstance(template.deformation, RefinedDeformation):
            self.refinement = template.deformation.refinement

    def _add_texels(self, initial: Float[Tensor, "n o"]) -> None:
        """Make the parameters that no network has."""
        self.base_texels = nn.Parameter(initial.clone(), requires_grad=self.decoders is None)

    def frame_inputs(self, pose: Pose, clock: StageClock | None = None, threads: int = 1) -> FrameInputs:
        """Stg. 1 and 2: pose the template, and draw what the decoders take."""
        device = self.base_texels.device
        with stage(clock, "stg1", device):
            learns = self.refinement is not None and torch.is_grad_enabled()
            posed = self.template.pose_uncached(pose) if learns else self.template.pose(pose)
        with stage(clock, "stg2", device):
            canonical, normals, transforms = sample_surface(self.lattice, posed, threads=threads)
            config = self.config
            motion = normalised_motion(pose, window=config.window, yaw_normalise=config.yaw_normalise)
            return FrameInputs(
                textures=self._textures(pose),
                motion=motion.to(device),
                root_translation=torch.from_numpy(pose.dofs[:3]).float().to(device),
                canonical=canonical,
                normals=normals,
                transforms=transforms,
            )

    def _textures(self, pose: Pose) -> Float[Tensor, "c r r"]:
        return self.base_texels.new_zeros(0, 1, 1) if self.textures is None else self.textures(self.template, pose)

    def decode(self, inputs: Sequence[FrameInputs]) -> Float[Tensor, "b n o"]:
        """Stg. 3: raw Gaussian parameters per texel of several frames, decoded as one batch."""
        if self.decoders is None:
            return self.base_texels[None].expand(len(inputs), -1, -1)
        return self.base_texels[None] + self.residual(inputs)

    def residual(self, inputs: Sequence[FrameInputs]) -> Float[Tensor, "b n o"]:
        """What the decoders add."""
        assert self.decoders is not None
        decoded: Tensor = self.decoders(inputs)
        return decoded

    def gaussians(self, raw: Float[Tensor, "n o"], inputs: FrameInputs, threads: int = 1) -> Gaussians:
        """Activate the raw parameters and carry them from canonical to posed space (Eq. 5)."""
        return pose(raw, inputs, self.config, None, threads=threads)

    def rasterize(
        self, gaussians: Gaussians, cameras: list[Camera], background: Tensor | None, threads: int = 1
    ) -> Splatted:
        """Stg. 4: splat into cameras of one size; no background: over black."""
        return splat(
            gaussians, **views_of(cameras), background=background, dilation=self.config.dilation, threads=threads
        )

    def forward(self, pose: Pose, camera: Camera, clock: StageClock | None = None) -> Splatted:
        """Motion and camera to image: the whole of ASH, over black, on as many threads as torch is given."""
        gaussians = self.posed_gaussians(pose, clock)
        with stage(clock, "stg4", self.base_texels.device):
            return self.rasterize(gaussians, [camera], None, torch.get_num_threads())

    def posed_gaussians(self, pose: Pose, clock: StageClock | None = None) -> Gaussians:
        """Motion to posed Gaussians: all that does not depend on the camera."""
        threads = torch.get_num_threads()
        inputs = self.frame_inputs(pose, clock, threads)  # Stg. 1 and 2
        with stage(clock, "stg3", self.base_texels.device):
            (raw,) = self.decode([inputs])
        with stage(clock, "stg4", self.base_texels.device):
            return self.gaussians(raw, inputs, threads)

    def direct_parameters(self) -> list[nn.Parameter]:
        """What is learned directly, not through a network."""
        return [self.base_texels] if self.base_texels.requires_grad else []


def image_of(drawn: Splatted) -> np.ndarray:
    """The first view as a method returns it: premultiplied RGBA, float32 `[h, w, 4]`."""
    height, width = drawn.alpha.shape[1:]
    image = torch.empty(height, width, 4, device="cpu")
    image[..., :3], image[..., 3] = drawn.rgb[0], drawn.alpha[0]
    return image.clamp_(0, 1).numpy()


def views_of(cameras: list[Camera]) -> dict[str, Any]:
    """Cameras of one size as the splatter takes them."""
    return {
        "viewmats": torch.stack([torch.from_numpy(c.viewmat).float() for c in cameras]),
        "Ks": torch.stack([torch.from_numpy(c.K).float() for c in cameras]),
        "width": cameras[0].width,
        "height": cameras[0].height,
    }


@contextmanager
def stage(clock: StageClock | None, name: str, device: torch.device) -> Iterator[None]:
    """Time the body, to the end of what it queued on a GPU; without a clock nothing is timed or waited for."""
    with clock.stage(name) if clock is not None else nullcontext():
        yield
        if clock is not None:
            finish(device)
