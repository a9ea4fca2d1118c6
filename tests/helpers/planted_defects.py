"""Planted defects: what may go wrong in a change, each with the layer of the gate that must tell it first.

A defect changes what a name of ours stands for, or the configuration. Harmless changes are planted in the same way.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from ash import model as ash_model
from ash import plus
from ash.avatar import AshAvatar
from ash.capture.dataset import Pose
from ash.config import AshConfig
from ash.decoders import GlobalFeatures
from ash.model import AshModel
from ash.native import texels
from ash.rotations import RigidTransforms
from ash.template import template
from ash.template.template import Template
from ash.textures import TextureDrawer
from ash.training import batches, loop
from benchmarks.cell import evaluation, metrics
from benchmarks.gate.checks import Layer

Plant = Callable[[pytest.MonkeyPatch], None]


@dataclass(frozen=True)
class Defect:
    """A change of code (`plant`) or configuration, and the layer that must tell it first."""

    layer: Layer
    plant: Plant = lambda _: None
    reason: str = ""  # in what the gate says
    config: Callable[[AshConfig], AshConfig] = lambda config: config
    sound: Callable[[AshConfig], AshConfig] = lambda config: config  # what it is compared with


def model(**changes: Any) -> Callable[[AshConfig], AshConfig]:
    return lambda config: replace(config, model=replace(config.model, **changes))


def training(**changes: Any) -> Callable[[AshConfig], AshConfig]:
    return lambda config: replace(config, training=replace(config.training, **changes))


def replaced(owner: Any, name: str, make: Callable[[Any], Any]) -> Plant:
    """A name of `owner` stands for what `make` makes of what it stood for."""
    return lambda patch: patch.setattr(owner, name, make(getattr(owner, name)))


def result(owner: Any, name: str, change: Callable[[Any], Any]) -> Plant:
    """The result of a function or method is changed."""
    return replaced(owner, name, lambda sound: lambda *values, **more: change(sound(*values, **more)))


def gaussians(change: Callable[[Any], Any]) -> Plant:
    """What is posed is changed on its way to the splatter."""
    return together(result(ash_model, "pose", change), result(plus, "pose", change))


def together(*plants: Plant) -> Plant:
    def plant(patch: pytest.MonkeyPatch) -> None:
        for each in plants:
            each(patch)

    return plant


def linear_skinning(joints: RigidTransforms, skin: Any) -> RigidTransforms:
    quats = (joints.quats[skin.joints] * skin.weights[..., None]).sum(1)
    translations = (joints.translations[skin.joints] * skin.weights[..., None]).sum(1)
    return RigidTransforms(quats=quats / quats.norm(dim=-1, keepdim=True), translations=translations)


def first_pose_kept(sound: Any) -> Any:
    kept: list[Any] = []

    def pose(self: Template, pose: Pose) -> Any:
        if not kept:
            kept.append(sound(self, pose))
        return kept[0]

    return pose


def with_holes(posed: Any) -> Any:
    shown = torch.ones_like(posed.opacities)
    shown[::4] = 0
    return replace(posed, opacities=posed.opacities * shown)


def in_linear_light(sound: Any) -> Any:
    def splat(posed: Any, **more: Any) -> Any:
        drawn = sound(replace(posed, sh=posed.sh * posed.sh.abs()), **more)
        return replace(drawn, rgb=drawn.rgb.clamp(min=1e-8).sqrt())

    return splat


def camera_moved(pixels: float) -> Plant:
    shift = np.array([[0, 0, pixels], [0, 0, 0], [0, 0, 0]])

    def moved(sound: Any) -> Any:
        return lambda self, pose, camera, *, clock: sound(self, pose, replace(camera, K=camera.K + shift), clock=clock)

    return replaced(AshAvatar, "render", moved)


def one_camera_off(sound: Any) -> Any:
    return lambda camera, left, *more: sound(camera, left + 2 * (camera.name == "cam1"), *more)


def alpha_changed(change: Callable[[torch.Tensor], torch.Tensor]) -> Plant:
    """Training images have other masks, uint8 `[h, w]`."""

    def changed(sound: Any) -> Any:
        return lambda rgba, *more: sound(torch.cat([rgba[..., :3], change(rgba[..., 3])[..., None]], -1), *more)

    return replaced(batches, "composite", changed)


def eroded(alpha: torch.Tensor) -> torch.Tensor:
    return -torch.nn.functional.max_pool2d(-alpha[None, None].float(), 3, 1, 1)[0, 0].to(torch.uint8)


def adam_with(eps: float) -> Plant:
    """Another constant below the root of the second moment."""
    return replaced(loop, "Adam", lambda sound: lambda groups, **_: sound(groups, eps=eps))


def means_by(mean: Callable[[Any], float]) -> Plant:
    """Means over images are taken by something else."""

    class Numbers:
        def __getattr__(self, name: str) -> Any:
            return mean if name == "mean" else getattr(np, name)

    return replaced(evaluation, "np", lambda _: Numbers())


def made(change: Callable[[AshConfig], AshConfig]) -> Plant:
    """Avatars are made of another configuration."""
    return replaced(
        AshAvatar, "from_capture", lambda sound: staticmethod(lambda config, capture: sound(change(config), capture))
    )


def in_another_order(posed: Any) -> Any:
    order = torch.randperm(len(posed.means), generator=torch.Generator().manual_seed(0))
    return replace(posed, **{field.name: getattr(posed, field.name)[order] for field in fields(posed)})


def other_signs(sound: Any) -> Any:
    return lambda joints, skin: sound(replace(joints, quats=-joints.quats), skin)


def global_generators_used(config: AshConfig) -> AshConfig:
    torch.rand(7)
    np.random.default_rng().random()
    return config


LARGE_OFFSETS = model(offset_unit_m=0.05, sh_degree=1)
DEFECTS: dict[str, Defect] = {
    "quaternions are blended linearly": Defect(
        "rendering", replaced(template, "dual_quaternion_skinning", lambda _: linear_skinning)
    ),
    "normals point inwards": Defect("rendering", result(Template, "pose", lambda p: replace(p, normals=-p.normals))),
    "a cache keeps the first pose": Defect("rendering", replaced(Template, "pose", first_pose_kept)),
    "offsets are halved": Defect("rendering", sound=LARGE_OFFSETS, config=model(offset_unit_m=0.025)),
    "harmonics do not turn with their Gaussian": Defect(
        "rendering", replaced(texels, "turn_sh", lambda _: lambda quats, sh, **_: sh), sound=LARGE_OFFSETS
    ),
    "every fourth Gaussian is missing": Defect("rendering", gaussians(with_holes)),
    "opacities times 0.9": Defect("rendering", gaussians(lambda g: replace(g, opacities=0.9 * g.opacities))),
    "Gaussians are 10 % larger": Defect("rendering", gaussians(lambda g: replace(g, scales=1.1 * g.scales))),
    "colours are blended in linear light": Defect("rendering", replaced(ash_model, "splat", in_linear_light)),
    "pictures move by half a pixel": Defect("rendering", camera_moved(0.5)),
    "another low-pass filter": Defect("rendering", config=model(dilation=0.3)),
    "decoders see the frame before": Defect(
        "rendering",
        replaced(
            TextureDrawer,
            "forward",
            lambda sound: lambda self, mesh, pose: sound(self, mesh, Pose(pose.motion, max(0, pose.frame - 1))),
        ),
    ),
    "residual times 0.9": Defect("rendering", result(AshModel, "residual", lambda residual: 0.9 * residual)),
    "Phi is zero": Defect("rendering", result(GlobalFeatures, "forward", lambda phi: 0 * phi)),
    "the loss is L1 alone": Defect("training", reason="loss of step 1 ", config=training(ssim_weight=0.0)),
    "half of the gradient is lost": Defect(
        "training", result(AshAvatar, "loss", lambda loss: 0.5 * loss + 0.5 * loss.detach()), "gradient of step 1 "
    ),
    "learning rates times three": Defect(
        "training",
        reason="in the update before it",
        config=lambda c: training(
            learning_rate=3 * c.training.learning_rate, base_learning_rate=3 * c.training.base_learning_rate
        )(c),
    ),
    "another constant in Adam": Defect("training", adam_with(0.1), "in the update before it"),
    "a training camera is off by 2 px": Defect(
        "training", replaced(batches, "crop_camera", one_camera_off), "from the loss"
    ),
    "masks lose a pixel": Defect("training", alpha_changed(eroded), "loss of step 1 "),
    "frames come in another order": Defect(
        "training",
        replaced(batches, "_order", lambda sound: lambda seed, epoch, frames: sound(seed, epoch + 1, frames)),
        "from the loss",
    ),
    "no warm-up": Defect("training", config=training(warmup="none", warmup_steps=0)),
    "all seeds are 0": Defect("training", made(lambda config: replace(config, seed=0)), "seed is ignored"),
    "training ends after three quarters": Defect(
        "training", reason="from step 16 on (step 16 -> 12)", config=training(steps=12)
    ),
    "weights are not averaged": Defect("training", reason="step 16 on (train_psnr", config=training(ema=0.0)),
    "PSNR is of the whole frame": Defect(
        "protocol", replaced(metrics, "psnr", lambda sound: lambda a, b, region=None: sound(a, b)), "foreground psnr"
    ),
    "means are medians": Defect("protocol", means_by(np.median), "mean "),
}
HARMLESS: dict[str, Plant] = {  # several at once, for together they move numbers further
    "the same bits": together(
        replaced(Template, "pose", lambda sound: lambda self, pose: self.clear_cache() or sound(self, pose)),
        alpha_changed(lambda alpha: (255 * (alpha.double() / 255)).round().to(torch.uint8)),
        made(global_generators_used),
    ),
    "Gaussians by rounding": together(
        gaussians(lambda g: replace(g, means=g.means * (1 + 2e-7))),
        gaussians(in_another_order),
        camera_moved(math.ulp(1.0)),
        replaced(template, "dual_quaternion_skinning", other_signs),
        result(Template, "pose", lambda p: replace(p, normals=p.normals / p.normals.norm(dim=-1, keepdim=True))),
        result(TextureDrawer, "forward", lambda textures: textures * (1 + 1e-7)),
    ),
    "training and scores by rounding": together(
        result(AshModel, "residual", lambda residual: 0.3 * residual + 0.7 * residual),
        result(AshAvatar, "loss", lambda loss: 0.3 * loss + 0.7 * loss),
        adam_with(1e-16),
        result(metrics, "psnr", lambda db: 20 * math.log10(1 / math.sqrt(10 ** (-db / 10)))),
        means_by(lambda values: math.fsum(values) / len(values)),
    ),
}
