"""Stg.1: the animatable template. Motion in, deformed and posed template mesh out (ASH Sec. 3.2, appendix A)."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ash.dataset import Capture, Motion, Skeleton, TemplateMesh
from ash.files import InputError
from ash.skinning import (
    RigidTransforms,
    SkinWeights,
    dual_quaternion_skinning,
    forward_kinematics,
    sparse_skin_weights,
)


@dataclass(frozen=True, kw_only=True, slots=True)
class PosedTemplate:
    """The template in one frame. Vertices are related by posed = transforms.apply(canonical)."""

    canonical: Float[Tensor, "v 3"]  # metres, deformed but unposed
    transforms: RigidTransforms  # canonical -> world, one per vertex
    vertices: Float[Tensor, "v 3"]  # metres, world
    normals: Float[Tensor, "v 3"]  # unit, world


@runtime_checkable
class Deformation(Protocol):
    """Where the canonical vertices lie in a frame: the part of Stg.1 that is learned, fixed or known."""

    def canonical(self, motion: Motion, frame: int, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """Canonical vertices, metres, for this frame of this motion."""
        ...


class RestDeformation:
    """No deformation: the rest mesh, posed by skinning alone."""

    def __init__(self, mesh: TemplateMesh) -> None:
        self.rest = torch.from_numpy(mesh.vertices).float()

    def canonical(self, motion: Motion, frame: int, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """The rest vertices."""
        return self.rest


class KnownDeformation:
    """An oracle: posed vertices are known for every frame of one motion, and are brought back to canonical space."""

    def __init__(self, motion: Motion, posed: Float[np.ndarray, "t v 3"]) -> None:
        self.motion = motion
        self.posed = torch.from_numpy(posed).float()

    def canonical(self, motion: Motion, frame: int, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """Inverse skinning of the known posed vertices.

        Raises:
            InputError: asked for a frame of another motion than the one that is known.
        """
        if not (frame < len(self.posed) and np.array_equal(motion.dofs[frame], self.motion.dofs[frame])):
            raise InputError(f"frame {frame}: the exact surface is known only for the motion of the capture")
        return transforms.apply_inverse(self.posed[frame])


class Template:
    """Poses the template mesh. The last few frames are kept: in playback, they are the next frame's history."""

    KEPT_FRAMES = 4

    def __init__(self, mesh: TemplateMesh, skeleton: Skeleton, deformation: Deformation) -> None:
        self.mesh = mesh
        self.skeleton = skeleton
        self.faces = torch.from_numpy(mesh.faces)
        self.skin: SkinWeights = sparse_skin_weights(torch.from_numpy(mesh.skin_weights).float())
        self.deformation = deformation
        self._kept: OrderedDict[tuple[bytes, bytes], PosedTemplate] = OrderedDict()

    def pose(self, motion: Motion, frame: int) -> PosedTemplate:
        """The template in one frame of a motion."""
        window = motion.window(frame, 5)
        key = (motion.dofs[window].tobytes(), np.int64(frame).tobytes())
        if key not in self._kept:
            self._kept[key] = self._pose(motion, frame)
            if len(self._kept) > self.KEPT_FRAMES:
                self._kept.popitem(last=False)
        return self._kept[key]

    @torch.no_grad()
    def _pose(self, motion: Motion, frame: int) -> PosedTemplate:
        dofs = torch.from_numpy(motion.dofs[frame])
        joints = forward_kinematics(self.skeleton, dofs)
        joints = RigidTransforms(quats=joints.quats.float(), translations=joints.translations.float())
        transforms = dual_quaternion_skinning(joints, self.skin)
        canonical = self.deformation.canonical(motion, frame, transforms)
        vertices = transforms.apply(canonical)
        return PosedTemplate(
            canonical=canonical,
            transforms=transforms,
            vertices=vertices,
            normals=vertex_normals(vertices, self.faces),
        )


def vertex_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """Area-weighted mean of the adjacent face normals, unit length. A vertex without area gets the zero vector."""
    a, b, c = vertices[faces].unbind(1)
    doubled_area = torch.linalg.cross(b - a, c - a)
    summed = torch.zeros_like(vertices).index_add_(0, faces.reshape(-1), doubled_area.repeat_interleave(3, 0))
    return torch.nn.functional.normalize(summed, dim=-1)


def skinned_template(capture: Capture) -> Template:
    """The template a method gets without learning: skinned, not deformed."""
    return Template(capture.template, capture.skeleton, RestDeformation(capture.template))


def exact_template(capture: Capture, posed: Float[np.ndarray, "t v 3"]) -> Template:
    """The oracle's template: `posed` vertices are exact in every frame of the capture's motion."""
    return Template(capture.template, capture.skeleton, KnownDeformation(capture.motion, posed))
