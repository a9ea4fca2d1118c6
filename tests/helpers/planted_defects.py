"""Planted defects: ASH with one thing wrong, to measure what the gate catches. Each is a factory of a method.

A defect changes the configuration, or what a module's name stands for in the process that trains: a cell has a process
of its own, so nothing else is touched.
"""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch

import ash.avatar
import ash.model
import ash.native.texels
import ash.plus
import ash.template.template
import ash.textures
from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Capture
from ash.config import AshConfig
from ash.presets import plus
from ash.rotations import RigidTransforms
from ash.template.skinning import SkinWeights

MISCALIBRATION_PX = 2.0
SLOWER = 0.2
MORE_MEMORY_MB = 400
_held: list[torch.Tensor] = []


def _ash(capture: Capture, seed: int, preset: str, *, model: Any = None, training: Any = None) -> AshAvatar:
    """ASH with some fields of its configuration replaced."""
    config = plus(preset)
    return AshAvatar.from_capture(
        AshConfig(
            model=replace(config.model, **(model or {})),
            training=replace(config.training, **(training or {})),
            template=config.template,
            seed=seed,
        ),
        capture,
    )


def sound_sh(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """No defect: ASH with colours that depend on the view, the reference of `sh_frame`."""
    return _ash(capture, seed, preset, model={"sh_degree": 1})


def sh_frame(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Spherical harmonics stay in the canonical frame while their Gaussians turn."""
    ash.native.texels.turn_sh = lambda quats, sh, *, threads: sh
    return sound_sh(capture, seed=seed, preset=preset)


def linear_skinning(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Quaternions and translations are blended linearly, each for itself."""

    def blend(joints: RigidTransforms, skin: SkinWeights) -> RigidTransforms:
        quats = (joints.quats[skin.joints] * skin.weights[..., None]).sum(1)
        translations = (joints.translations[skin.joints] * skin.weights[..., None]).sum(1)
        return RigidTransforms(quats=quats / quats.norm(dim=-1, keepdim=True), translations=translations)

    ash.template.template.dual_quaternion_skinning = blend
    return _ash(capture, seed, preset)


def ssim_dropped(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """The loss is L1 alone."""
    return _ash(capture, seed, preset, training={"ssim_weight": 0.0})


def half_offset(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Offsets are scaled by one half on the way to the posed Gaussian."""
    return _ash(capture, seed, preset, model={"offset_unit_m": 0.5 * plus(preset).model.offset_unit_m})


def triple_learning_rate(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Both learning rates are three times as large."""
    training = plus(preset).training
    rates = {name: 3 * getattr(training, name) for name in ("learning_rate", "base_learning_rate")}
    return _ash(capture, seed, preset, training=rates)


def warm_up_dropped(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Everything is learned at once from the first step on."""
    return _ash(capture, seed, preset, training={"warmup": "none", "warmup_steps": 0})


def half_the_steps(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Training ends after half its steps."""
    return _ash(capture, seed, preset, training={"steps": plus(preset).training.steps // 2})


def _turned(camera: Camera, pixels: float) -> Camera:
    """The camera turned about its own vertical axis, so that the middle of its image moves by so many pixels."""
    angle = pixels / camera.K[0, 0]
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    viewmat = camera.viewmat.copy()
    viewmat[:3] = turn @ viewmat[:3]
    return replace(camera, viewmat=viewmat)


class _Miscalibrated(AshAvatar):
    """Learns with one training camera turned."""

    def fit(self, capture: Capture, **more: Any) -> None:
        """Train on wrong extrinsics."""
        first = capture.splits["train"].cameras[0]
        wrong = _turned(capture.cameras[first], MISCALIBRATION_PX)
        super().fit(replace(capture, cameras={**capture.cameras, first: wrong}), **more)


def one_camera_off(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """The extrinsics of one training camera are off by about 2 pixels."""
    return _Miscalibrated.from_capture(replace(plus(preset), seed=seed), capture)


def normals_flipped(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Normals point inwards, in training and in rendering."""
    sound = ash.template.template.Template.pose

    def pose(*arguments: Any, **more: Any) -> ash.template.template.PosedTemplate:
        posed = sound(*arguments, **more)
        return replace(posed, normals=-posed.normals)

    ash.template.template.Template.pose = pose  # type: ignore[method-assign]
    return _ash(capture, seed, preset)


def holes(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Every fourth Gaussian is never drawn."""
    sound = ash.model.pose

    def pose(*arguments: Any, **more: Any) -> Any:
        gaussians = sound(*arguments, **more)
        shown = torch.ones_like(gaussians.opacities)
        shown[::4] = 0
        return replace(gaussians, opacities=gaussians.opacities * shown)

    ash.model.pose = ash.plus.pose = pose
    return _ash(capture, seed, preset)


def slow_splatter(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Splatting takes 20 % more time."""
    sound = ash.model.splat

    def splat(*arguments: Any, **more: Any) -> Any:
        start = time.perf_counter()
        drawn = sound(*arguments, **more)
        end = time.perf_counter() + SLOWER * (time.perf_counter() - start)
        while time.perf_counter() < end:
            pass
        return drawn

    ash.model.splat = splat
    return _ash(capture, seed, preset)


def more_memory(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """Holds 400 MB that nobody needs: twice what the cell's process takes without its libraries."""
    _held.append(torch.from_numpy(np.ones(MORE_MEMORY_MB << 17)))
    return _ash(capture, seed, preset)


DEFECTS = (
    linear_skinning,
    ssim_dropped,
    half_offset,
    triple_learning_rate,
    warm_up_dropped,
    one_camera_off,
    normals_flipped,
    sh_frame,
    slow_splatter,
    more_memory,
    half_the_steps,
    holes,
)
