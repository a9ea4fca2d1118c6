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

import ash.avatar
import ash.decoders
import ash.model
import ash.native.texels
import ash.plus
import ash.template.template
import ash.textures
import ash.training.batches
import ash.training.loop
from ash.capture.dataset import Camera, Pose
from ash.config import AshConfig
from ash.rotations import RigidTransforms
from ash.template.skinning import SkinWeights
from benchmarks.cell import evaluation, metrics
from benchmarks.gate.checks import Layer

Patch = pytest.MonkeyPatch


@dataclass(frozen=True, kw_only=True)
class Defect:
    """A change of code or configuration, and the layer that must tell it first; None: it is harmless."""

    about: str
    layer: Layer | None
    reason: str = ""  # in what the gate says
    plant: Callable[[Patch], None] = lambda _: None
    config: Callable[[AshConfig], AshConfig] = lambda config: config
    sound: Callable[[AshConfig], AshConfig] = lambda config: config  # what it is compared with


def model(**changes: Any) -> Callable[[AshConfig], AshConfig]:
    return lambda config: replace(config, model=replace(config.model, **changes))


def training(**changes: Any) -> Callable[[AshConfig], AshConfig]:
    return lambda config: replace(config, training=replace(config.training, **changes))


def linear_skinning(patch: Patch) -> None:
    def blend(joints: RigidTransforms, skin: SkinWeights) -> RigidTransforms:
        quats = (joints.quats[skin.joints] * skin.weights[..., None]).sum(1)
        translations = (joints.translations[skin.joints] * skin.weights[..., None]).sum(1)
        return RigidTransforms(quats=quats / quats.norm(dim=-1, keepdim=True), translations=translations)

    patch.setattr(ash.template.template, "dual_quaternion_skinning", blend)


def normals_flipped(patch: Patch) -> None:
    sound = ash.template.template.Template.pose

    def pose(*arguments: Any, **more: Any) -> ash.template.template.PosedTemplate:
        posed = sound(*arguments, **more)
        return replace(posed, normals=-posed.normals)

    patch.setattr(ash.template.template.Template, "pose", pose)


def first_pose_kept(patch: Patch) -> None:
    sound, kept = ash.template.template.Template.pose, []

    def pose(self: Any, pose: Pose) -> ash.template.template.PosedTemplate:
        if not kept:
            kept.append(sound(self, pose))
        return kept[0]

    patch.setattr(ash.template.template.Template, "pose", pose)


def sh_not_turned(patch: Patch) -> None:
    patch.setattr(ash.native.texels, "turn_sh", lambda quats, sh, *, threads: sh)


def gaussians_changed(change: Callable[[Any], Any]) -> Callable[[Patch], None]:
    """What is posed is changed on its way to the splatter."""

    def plant(patch: Patch) -> None:
        for module in (ash.model, ash.plus):
            sound = module.pose
            patch.setattr(module, "pose", lambda *a, sound=sound, **more: change(sound(*a, **more)))

    return plant


def with_holes(gaussians: Any) -> Any:
    shown = torch.ones_like(gaussians.opacities)
    shown[::4] = 0
    return replace(gaussians, opacities=gaussians.opacities * shown)


def in_linear_light(patch: Patch) -> None:
    sound = ash.model.splat

    def splat(gaussians: Any, **more: Any) -> Any:
        drawn = sound(replace(gaussians, sh=gaussians.sh * gaussians.sh.abs()), **more)
        return replace(drawn, rgb=drawn.rgb.clamp(min=1e-8).sqrt())

    patch.setattr(ash.model, "splat", splat)


def camera_moved(pixels: float) -> Callable[[Patch], None]:
    def plant(patch: Patch) -> None:
        sound = ash.avatar.AshAvatar.render

        def render(self: Any, pose: Pose, camera: Camera, *, clock: Any) -> np.ndarray:
            K = camera.K + np.array([[0, 0, pixels], [0, 0, 0], [0, 0, 0]])
            return sound(self, pose, replace(camera, K=K), clock=clock)

        patch.setattr(ash.avatar.AshAvatar, "render", render)

    return plant


def textures_of_the_frame_before(patch: Patch) -> None:
    sound = ash.textures.TextureDrawer.forward

    def forward(self: Any, template: Any, pose: Pose) -> torch.Tensor:
        return sound(self, template, Pose(pose.motion, max(0, pose.frame - 1)))

    patch.setattr(ash.textures.TextureDrawer, "forward", forward)


def residual_weakened(patch: Patch) -> None:
    sound = ash.model.AshModel.residual
    patch.setattr(ash.model.AshModel, "residual", lambda self, inputs: 0.9 * sound(self, inputs))


def phi_dropped(patch: Patch) -> None:
    sound = ash.decoders.GlobalFeatures.forward
    patch.setattr(ash.decoders.GlobalFeatures, "forward", lambda self, where: 0 * sound(self, where))


def one_camera_off(patch: Patch) -> None:
    sound = ash.training.batches.crop_camera

    def crop(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
        return sound(camera, left + 2 * (camera.name == "cam1"), top, width, height)

    patch.setattr(ash.training.batches, "crop_camera", crop)


def masks_eroded(patch: Patch) -> None:
    sound = ash.training.batches.composite

    def composite(rgba: torch.Tensor, background: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        alpha = -torch.nn.functional.max_pool2d(-rgba[None, None, ..., 3].float(), 3, 1, 1)[0, 0]
        return sound(torch.cat([rgba[..., :3], alpha.to(torch.uint8)[..., None]], -1), background)

    patch.setattr(ash.training.batches, "composite", composite)


def frames_in_another_order(patch: Patch) -> None:
    sound = ash.training.batches._order
    patch.setattr(ash.training.batches, "_order", lambda seed, epoch, frames: sound(seed, epoch + 1, frames))


def adam_with(other: float) -> Callable[[Patch], None]:
    """Another constant below the root of the second moment."""

    def plant(patch: Patch) -> None:
        sound = ash.training.loop.Adam
        patch.setattr(ash.training.loop, "Adam", lambda groups, *, eps: sound(groups, eps=other))

    return plant


def gradient_halved(patch: Patch) -> None:
    sound = ash.avatar.AshAvatar.loss

    def loss(self: Any, batches: Any, step: int) -> torch.Tensor:
        whole = sound(self, batches, step)
        return 0.5 * whole + 0.5 * whole.detach()

    patch.setattr(ash.avatar.AshAvatar, "loss", loss)


def psnr_of_the_whole_frame(patch: Patch) -> None:
    sound = metrics.psnr
    patch.setattr(metrics, "psnr", lambda a, b, region=None: sound(a, b, None))


def means_by(mean: Callable[[Any], float]) -> Callable[[Patch], None]:
    """Means over images are taken by something else."""

    class Numbers:
        def __getattr__(self, name: str) -> Any:
            return mean if name == "mean" else getattr(np, name)

    return lambda patch: patch.setattr(evaluation, "np", Numbers())


def seed_ignored(patch: Patch) -> None:
    sound = ash.avatar.AshAvatar.from_capture.__func__

    def made(cls: Any, config: AshConfig, capture: Any) -> Any:
        return sound(cls, replace(config, seed=0), capture)

    patch.setattr(ash.avatar.AshAvatar, "from_capture", classmethod(made))


def moved_by_rounding(gaussians: Any) -> Any:
    return replace(gaussians, means=gaussians.means * (1 + 2e-7))


def in_another_order(gaussians: Any) -> Any:
    order = torch.randperm(len(gaussians.means), generator=torch.Generator().manual_seed(0))
    return replace(gaussians, **{field.name: getattr(gaussians, field.name)[order] for field in fields(gaussians)})


def other_signs_of_quaternions(patch: Patch) -> None:
    sound = ash.template.template.dual_quaternion_skinning
    patch.setattr(
        ash.template.template,
        "dual_quaternion_skinning",
        lambda joints, skin: sound(RigidTransforms(quats=-joints.quats, translations=joints.translations), skin),
    )


def normals_normalised_again(patch: Patch) -> None:
    sound = ash.template.template.Template.pose

    def pose(*arguments: Any, **more: Any) -> ash.template.template.PosedTemplate:
        posed = sound(*arguments, **more)
        return replace(posed, normals=posed.normals / posed.normals.norm(dim=-1, keepdim=True))

    patch.setattr(ash.template.template.Template, "pose", pose)


def no_pose_kept(patch: Patch) -> None:
    sound = ash.template.template.Template.pose

    def pose(self: Any, pose: Pose) -> ash.template.template.PosedTemplate:
        self.clear_cache()
        return sound(self, pose)

    patch.setattr(ash.template.template.Template, "pose", pose)


def textures_rounded(patch: Patch) -> None:
    sound = ash.textures.TextureDrawer.forward
    patch.setattr(ash.textures.TextureDrawer, "forward", lambda *a, **more: sound(*a, **more) * (1 + 1e-7))


def residual_in_halves(patch: Patch) -> None:
    sound = ash.model.AshModel.residual

    def residual(self: Any, inputs: Any) -> torch.Tensor:
        whole = sound(self, inputs)
        return 0.3 * whole + 0.7 * whole

    patch.setattr(ash.model.AshModel, "residual", residual)


def loss_in_halves(patch: Patch) -> None:
    sound = ash.avatar.AshAvatar.loss

    def loss(self: Any, batches: Any, step: int) -> torch.Tensor:
        whole = sound(self, batches, step)
        return 0.3 * whole + 0.7 * whole

    patch.setattr(ash.avatar.AshAvatar, "loss", loss)


def masks_by_another_way(patch: Patch) -> None:
    sound = ash.training.batches.composite

    def composite(rgba: torch.Tensor, background: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        alpha = (255 * (rgba[..., 3:].double() / 255)).round().to(torch.uint8)
        return sound(torch.cat([rgba[..., :3], alpha], -1), background)

    patch.setattr(ash.training.batches, "composite", composite)


def psnr_by_root(patch: Patch) -> None:
    sound = metrics.psnr

    def psnr(a: Any, b: Any, region: Any = None) -> Any:
        value = sound(a, b, region)
        return 20 * math.log10(1 / math.sqrt(10 ** (-value / 10)))

    patch.setattr(metrics, "psnr", psnr)


def global_generators_used(patch: Patch) -> None:
    sound = ash.avatar.AshAvatar.from_capture.__func__

    def made(cls: Any, config: AshConfig, capture: Any) -> Any:
        torch.rand(7)
        np.random.default_rng().random()
        return sound(cls, config, capture)

    patch.setattr(ash.avatar.AshAvatar, "from_capture", classmethod(made))


DEFECTS: dict[str, Defect] = {
    "linear skinning": Defect(about="quaternions are blended linearly", layer="rendering", plant=linear_skinning),
    "normals flipped": Defect(about="normals point inwards", layer="rendering", plant=normals_flipped),
    "stale pose": Defect(about="a cache keeps the first pose", layer="rendering", plant=first_pose_kept),
    "half offset": Defect(
        about="offsets are halved",
        layer="rendering",
        sound=model(offset_unit_m=0.05),
        config=model(offset_unit_m=0.025),
    ),
    "sh frame": Defect(
        about="harmonics do not turn with their Gaussian",
        layer="rendering",
        plant=sh_not_turned,
        sound=model(sh_degree=1),
        config=model(sh_degree=1),
    ),
    "holes": Defect(about="every fourth Gaussian is missing", layer="rendering", plant=gaussians_changed(with_holes)),
    "opacity": Defect(
        about="opacities times 0.9",
        layer="rendering",
        plant=gaussians_changed(lambda g: replace(g, opacities=0.9 * g.opacities)),
    ),
    "scales": Defect(
        about="Gaussians are 10 % larger",
        layer="rendering",
        plant=gaussians_changed(lambda g: replace(g, scales=1.1 * g.scales)),
    ),
    "linear light": Defect(about="colours are blended in linear light", layer="rendering", plant=in_linear_light),
    "half a pixel": Defect(about="pictures move by half a pixel", layer="rendering", plant=camera_moved(0.5)),
    "dilation": Defect(about="another low-pass filter", layer="rendering", config=model(dilation=0.3)),
    "late textures": Defect(
        about="decoders see the frame before", layer="rendering", plant=textures_of_the_frame_before
    ),
    "weak decoders": Defect(about="residual times 0.9", layer="rendering", plant=residual_weakened),
    "no phi": Defect(about="Phi is zero", layer="rendering", plant=phi_dropped),
    "no ssim": Defect(
        about="the loss is L1 alone", layer="training", reason="loss of step 1 ", config=training(ssim_weight=0.0)
    ),
    "halved gradient": Defect(
        about="half of the gradient is lost", layer="training", reason="gradient of step 1 ", plant=gradient_halved
    ),
    "triple rate": Defect(
        about="learning rates times three",
        layer="training",
        reason="in the update before it",
        config=lambda c: training(
            learning_rate=3 * c.training.learning_rate, base_learning_rate=3 * c.training.base_learning_rate
        )(c),
    ),
    "adam's eps": Defect(
        about="another constant in Adam",
        layer="training",
        reason="in the update before it",
        plant=adam_with(0.1),
    ),
    "one camera off": Defect(
        about="a training camera is off by 2 px", layer="training", reason="from the loss", plant=one_camera_off
    ),
    "eroded masks": Defect(about="masks lose a pixel", layer="training", reason="loss of step 1 ", plant=masks_eroded),
    "another order": Defect(
        about="frames come in another order", layer="training", reason="from the loss", plant=frames_in_another_order
    ),
    "no warm-up": Defect(
        about="everything is learned from the first step on",
        layer="training",
        config=training(warmup="none", warmup_steps=0),
    ),
    "seed ignored": Defect(about="all seeds are 0", layer="training", reason="seed is ignored", plant=seed_ignored),
    "fewer steps": Defect(
        about="training ends after three quarters",
        layer="training",
        reason="from step 16 on (step 16 -> 12)",
        config=training(steps=12),
    ),
    "no averaging": Defect(
        about="weights are not averaged", layer="training", reason="step 16 on (train_psnr", config=training(ema=0.0)
    ),
    "whole frame": Defect(
        about="PSNR is of the whole frame", layer="protocol", reason="foreground psnr", plant=psnr_of_the_whole_frame
    ),
    "median": Defect(about="means are medians", layer="protocol", reason="mean ", plant=means_by(np.median)),
}
HARMLESS: dict[str, Defect] = {
    "nothing": Defect(about="the same code", layer=None),
    "rounding": Defect(
        about="another order of summation moves Gaussians by rounding",
        layer=None,
        plant=gaussians_changed(moved_by_rounding),
    ),
    "same picture another way": Defect(
        about="a pixel is moved there and back", layer=None, plant=lambda patch: camera_moved(math.ulp(1.0))(patch)
    ),
    "same score another way": Defect(
        about="means are summed in another order",
        layer=None,
        plant=means_by(lambda values: math.fsum(values) / len(values)),
    ),
    "signs": Defect(about="quaternions have the other sign", layer=None, plant=other_signs_of_quaternions),
    "normals": Defect(about="normals are normalised twice", layer=None, plant=normals_normalised_again),
    "no cache": Defect(about="no posed template is kept", layer=None, plant=no_pose_kept),
    "textures": Defect(about="textures differ by rounding", layer=None, plant=textures_rounded),
    "residual": Defect(about="the residual is a sum", layer=None, plant=residual_in_halves),
    "order": Defect(about="Gaussians in another order", layer=None, plant=gaussians_changed(in_another_order)),
    "loss": Defect(about="the loss is a sum", layer=None, plant=loss_in_halves),
    "eps": Defect(about="a constant in Adam that is never seen", layer=None, plant=adam_with(1e-16)),
    "masks": Defect(about="masks are rounded anew", layer=None, plant=masks_by_another_way),
    "psnr": Defect(about="PSNR by the root of the error", layer=None, plant=psnr_by_root),
    "generators": Defect(about="global generators were used before", layer=None, plant=global_generators_used),
}
