"""Stg.1: the animatable template. Motion in, deformed and posed template mesh out (ASH Sec. 3.2, appendix A)."""

import copy
from collections import OrderedDict
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

import ash.native.skinning
from ash.capture.dataset import Capture, Motion, Pose, Skeleton, TemplateMesh, require_pose
from ash.config import MAX_WINDOW
from ash.devices import moved
from ash.files import InputError
from ash.rotations import RigidTransforms
from ash.template.graph import EmbeddedGraph
from ash.template.skinning import SkinWeights, dual_quaternion_skinning, forward_kinematics, sparse_skin_weights


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

    def canonical(self, pose: Pose, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """Canonical vertices, metres, for this frame of this motion."""
        ...


class RestDeformation:
    """No deformation: the rest mesh, posed by skinning alone."""

    def __init__(self, mesh: TemplateMesh) -> None:
        self.rest = torch.from_numpy(mesh.vertices).float()

    def to(self, device: torch.device) -> "RestDeformation":
        """The same on a device."""
        other = copy.copy(self)
        other.rest = self.rest.to(device)
        return other

    def canonical(self, pose: Pose, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """The rest vertices."""
        return self.rest


class KnownDeformation:
    """An oracle: posed vertices are known for every frame of one motion, and are brought back to canonical space."""

    def __init__(self, motion: Motion, posed: Float[np.ndarray, "t v 3"]) -> None:
        self.motion = motion
        self.posed = torch.from_numpy(posed).float()

    def to(self, device: torch.device) -> "KnownDeformation":
        """The same on a device."""
        other = copy.copy(self)
        other.posed = self.posed.to(device)
        return other

    def canonical(self, pose: Pose, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """Inverse skinning of the known posed vertices.

        Raises:
            InputError: asked for a frame of another motion than the one that is known.
        """
        if not (pose.frame < len(self.posed) and np.array_equal(pose.dofs, self.motion.dofs[pose.frame])):
            raise InputError(f"frame {pose.frame}: the exact surface is known only for the motion of the capture")
        return transforms.apply_inverse(self.posed[pose.frame])


@dataclass(frozen=True, kw_only=True, slots=True)
class PlantedError:
    """A template error of known size and kind."""

    rms_mm: float  # in every frame, over the vertices
    static: float = 0.25  # share of its square that is the same in all frames; of learned templates 0.15 to 0.39
    lag: float = 0.5  # correlation of the rest from a frame to the next of its sequence; of learned ones 0.35 to 0.70


class PerturbedDeformation:
    """A deformation with a planted error whose size is exactly known, to chart quality against template error.

    The error is smooth over the surface. Part of its mean square is the same in all frames; the rest is a process in
    time whose correlation falls by the same factor with every frame (AR(1)), drawn anew for every sequence. In every
    frame its root mean square over the vertices is the stated one, before and after posing, for posing is rigid per
    vertex. It is a function of the seed, the sequence and the frame, in whatever order frames are asked for.
    """

    LENGTH_M = 0.05  # Points nearer than this move alike; of learned templates 0.07 on loose clothes, less on tight.
    WAVES = 192
    FORGOTTEN = 1e-3  # What a frame has of one so long ago does not count.

    def __init__(self, inner: Deformation, mesh: TemplateMesh, planted: PlantedError, *, seed: int) -> None:
        self.inner, self.planted, self.seed = inner, planted, seed
        rng = np.random.default_rng([seed, 0])
        # A Gaussian random field over space, by random Fourier features (Rahimi and Recht 2007).
        waves = rng.standard_normal((3, self.WAVES)) / self.LENGTH_M
        self.features = np.cos(mesh.vertices @ waves + rng.uniform(0, 2 * np.pi, self.WAVES))
        self.static = _of_unit_rms(self.features @ rng.standard_normal((self.WAVES, 3)))
        lag = abs(planted.lag)
        self.memory = 1 + (int(np.ceil(np.log(self.FORGOTTEN) / np.log(lag))) if lag > self.FORGOTTEN else 0)

    def to(self, device: torch.device) -> "PerturbedDeformation":
        """The same on a device."""
        other = copy.copy(self)
        other.inner = moved(self.inner, device)
        return other

    def canonical(self, pose: Pose, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """The inner deformation's vertices, off by the planted error."""
        error = self.error(pose.frame, int(pose.motion.sequence[pose.frame]))
        return self.inner.canonical(pose, transforms) + torch.from_numpy(error).float().to(transforms.quats.device)

    def error(self, frame: int, sequence: int = 0) -> Float[np.ndarray, "v 3"]:
        """The error of a frame, metres, canonical. The two parts are orthogonal, so that their squares add up."""
        own = self.features @ sum(
            self.planted.lag**ago * self._draw(sequence, frame + self.memory - ago) for ago in range(self.memory)
        )
        own -= self.static * (own * self.static).sum() / (self.static**2).sum()
        static, rest = np.sqrt([self.planted.static, 1 - self.planted.static])
        return 1e-3 * self.planted.rms_mm * (static * self.static + rest * _of_unit_rms(own))

    def _draw(self, sequence: int, number: int) -> Float[np.ndarray, "w 3"]:
        return np.random.default_rng([self.seed, 1, sequence, number]).standard_normal((self.WAVES, 3))


def _of_unit_rms(field: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    return field / np.sqrt((field**2).sum(1).mean())


@dataclass(frozen=True, kw_only=True, slots=True)
class Learned:
    """How a template was learned."""

    seconds: float  # what it took, whenever that was
    summary: str  # what it was learned from, and the choices made


class Template:
    """Poses the template mesh. The last few frames are kept: in playback, they are the next frame's history."""

    CACHED_FRAMES = 4

    def __init__(
        self,
        mesh: TemplateMesh,
        skeleton: Skeleton,
        deformation: Deformation,
        *,
        through: EmbeddedGraph | None = None,
    ) -> None:
        """`through`: skin the nodes of this graph only, and blend their transforms, as the release does."""
        self.mesh = mesh
        self.skeleton = skeleton
        self.faces = torch.from_numpy(mesh.faces)
        self.skin: SkinWeights = sparse_skin_weights(torch.from_numpy(mesh.skin_weights).float())
        self.links: SkinWeights | None = None
        if through is not None:
            self.skin = SkinWeights(joints=self.skin.joints[through.nodes], weights=self.skin.weights[through.nodes])
            self.links = SkinWeights(joints=through.links, weights=through.weights)
        self.deformation = deformation
        self.learned: Learned | None = None
        self._cache: OrderedDict[tuple[bytes, bytes], PosedTemplate] = OrderedDict()

    def pose(self, pose: Pose) -> PosedTemplate:
        """The template in one frame of a motion."""
        require_pose(pose, self.skeleton)
        window = pose.window(MAX_WINDOW)
        key = (pose.motion.dofs[window].tobytes(), np.int64(pose.frame).tobytes())
        if key not in self._cache:
            with torch.no_grad():
                self._cache[key] = self.pose_uncached(pose)
            if len(self._cache) > self.CACHED_FRAMES:
                self._cache.popitem(last=False)
        return self._cache[key]

    def clear_cache(self) -> None:
        """Keep nothing of what was posed: the deformation has changed."""
        self._cache.clear()

    @property
    def device(self) -> torch.device:
        """Where it is posed."""
        return self.faces.device

    def to(self, device: torch.device) -> "Template":
        """The same on a device."""
        other = self.deformed_by(moved(self.deformation, device))
        other.faces, other.skin = moved((self.faces, self.skin), device)
        other.links = moved(self.links, device)
        return other

    def deformed_by(self, deformation: Deformation) -> "Template":
        """The same mesh and skinning with another deformation."""
        other = copy.copy(self)
        other.deformation, other._cache = deformation, OrderedDict()
        return other

    def pose_uncached(self, pose: Pose) -> PosedTemplate:
        """The template in one frame, differentiable in what its deformation learns."""
        dofs = torch.from_numpy(pose.dofs)  # Joints are too few for a GPU.
        joints = forward_kinematics(self.skeleton, dofs)
        joints = RigidTransforms(quats=joints.quats.float(), translations=joints.translations.float())
        transforms = dual_quaternion_skinning(moved(joints, self.device), self.skin)
        if self.links is not None:
            transforms = dual_quaternion_skinning(transforms, self.links)
        canonical = self.deformation.canonical(pose, transforms)
        vertices = transforms.apply(canonical)
        return PosedTemplate(
            canonical=canonical,
            transforms=transforms,
            vertices=vertices,
            normals=vertex_normals(vertices, self.faces),
        )


def vertex_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """Area-weighted mean of the adjacent face normals, unit length. A vertex without area gets the zero vector.

    By a native kernel where no gradient is needed.
    """
    if ash.native.skinning.can_use_native(vertices):
        return ash.native.skinning.vertex_normals(vertices, faces)
    a, b, c = vertices[faces].unbind(1)
    doubled_area = torch.linalg.cross(b - a, c - a)
    summed = torch.zeros_like(vertices).index_add_(0, faces.reshape(-1), doubled_area.repeat_interleave(3, 0))
    return torch.nn.functional.normalize(summed, dim=-1)


def skinned_template(capture: Capture) -> Template:
    """The template a method gets without learning: skinned, not deformed."""
    return Template(capture.template, capture.skeleton, RestDeformation(capture.template))


def exact_template(
    capture: Capture, posed: Float[np.ndarray, "t v 3"], *, planted: PlantedError | None = None, seed: int = 0
) -> Template:
    """The oracle's template: `posed` vertices are exact in every frame of the capture's motion, or off by a `planted`
    error, which is a function of the seed and the frame."""
    known = KnownDeformation(capture.motion, posed)
    if planted is None or planted.rms_mm == 0:
        return Template(capture.template, capture.skeleton, known)
    off = PerturbedDeformation(known, capture.template, planted, seed=seed)
    return Template(capture.template, capture.skeleton, off)
