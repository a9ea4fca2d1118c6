"""Comparing a fast path with its definition: one number per tensor, and scenes of Gaussians to compare on."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted, splat, splat_by_warp, splat_naive
from ash.native.splatting import Viewport

Drawer = Callable[..., Splatted]
IMAGES = ("rgb", "alpha", "depth")
# Errors are a few units in the last place of float32 (6e-8), summed: 1e-6 is typical. A halved gradient is off by 0.5.
TOLERANCE = 2e-5


def relative_error(value: Tensor, truth: Tensor) -> float:
    """Largest difference over the truth's largest number; infinite if either is not, or if only the truth is 0."""
    assert value.shape == truth.shape, f"{tuple(value.shape)} against {tuple(truth.shape)}"
    if truth.numel() == 0:
        return 0.0
    difference, size = (value.double() - truth.double()).abs().max().item(), truth.double().abs().max().item()
    if difference == 0:
        return 0.0
    return difference / size if size > 0 and difference == difference else float("inf")


@dataclass(frozen=True)
class Scene:
    """The arguments of `splat`."""

    gaussians: Gaussians
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    background: Tensor | None = None
    dilation: float = 0.3
    compensate: bool = False
    near: float = 0.01


def tensors_of(gaussians: Gaussians) -> dict[str, Tensor]:
    return {field.name: getattr(gaussians, field.name) for field in fields(gaussians)}


def cast(scene: Scene, dtype: torch.dtype) -> Scene:
    """A copy of the scene in another precision whose Gaussians and cameras are leaves that ask for gradients."""

    def leaf(tensor: Tensor) -> Tensor:
        return tensor.detach().to(dtype, copy=True).requires_grad_()

    return replace(
        scene,
        gaussians=Gaussians(**{name: leaf(tensor) for name, tensor in tensors_of(scene.gaussians).items()}),
        viewmats=leaf(scene.viewmats),
        Ks=scene.Ks.to(dtype),
        background=None if scene.background is None else scene.background.to(dtype),
    )


def values_and_gradients(drawer: Drawer, scene: Scene, dtype: torch.dtype, **more: int) -> dict[str, Tensor]:
    """All that is drawn, and the gradient of a random linear function of its images in all that it takes."""
    scene = cast(scene, dtype)
    drawn = draw(drawer, scene, **more)
    drawn.means2d.retain_grad()
    generator = torch.Generator().manual_seed(7)
    loss = torch.zeros((), dtype=dtype)
    for name in IMAGES:
        image = getattr(drawn, name)
        loss = loss + (image * torch.randn(image.shape, generator=generator, dtype=torch.float64).to(dtype)).sum()
    if loss.requires_grad:  # the definition of an empty image is a constant
        loss.backward()
    results = {name: getattr(drawn, name).detach() for name in (*IMAGES, "means2d")}
    leaves = tensors_of(scene.gaussians) | {"viewmats": scene.viewmats, "means2d": drawn.means2d}
    return results | gradients_of(leaves)


def gradients_of(leaves: dict[str, Tensor]) -> dict[str, Tensor]:
    """Zero where nothing depends on a leaf."""
    return {f"grad_{name}": torch.zeros_like(t) if t.grad is None else t.grad for name, t in leaves.items()}


def assert_same(
    results: dict[str, Tensor], truth: dict[str, Tensor], tolerance: float, wider: dict[str, float] | None = None
) -> None:
    """Every tensor within `tolerance`, or its own in `wider`, of the truth in `relative_error`."""
    assert results.keys() == truth.keys()
    errors = {name: relative_error(results[name], truth[name]) for name in truth}
    bad = {name: error for name, error in errors.items() if not error <= (wider or {}).get(name, tolerance)}
    assert not bad, f"beyond {tolerance}: {bad}"


def draw(drawer: Drawer, scene: Scene, **more: Any) -> Splatted:
    """A scene, drawn by `splat` or its definition."""
    return drawer(**{field.name: getattr(scene, field.name) for field in fields(scene)}, **more)


def change(scene: Scene, **tensors: Tensor) -> Scene:
    """The scene with other Gaussians' tensors."""
    return replace(scene, gaussians=Gaussians(**(tensors_of(scene.gaussians) | tensors)))


def compare(scene: Scene, tolerance: float = TOLERANCE, *, drawer: Drawer = splat) -> dict[str, Tensor]:
    """`splat` against its definition in double precision, in value and gradient."""
    results = values_and_gradients(drawer, scene, torch.float32)
    truth = values_and_gradients(splat_naive, scene, torch.float64)
    if drawer is not splat:
        del results["grad_viewmats"], truth["grad_viewmats"]  # Only the native kernels have it.
    assert_same(results, truth, tolerance)
    return results


def splat_warp(
    gaussians: Gaussians, *, viewmats: Tensor, Ks: Tensor, width: int, height: int, background: Tensor | None,
    dilation: float, compensate: bool, near: float,
) -> Splatted:  # fmt: skip
    """What `splat` does on CUDA, on the device of the Gaussians; cameras have no gradient."""
    view = Viewport(width, height, int(compensate), dilation, near, 1)
    return splat_by_warp(gaussians, viewmats.detach(), Ks, view, background)


def turned_cameras(count: int) -> Tensor:
    """World to camera `[c, 4, 4]`: cameras that look at the origin from 3 m, from several sides."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    turns = [Rotation.from_euler("XY", [0.2 - 0.3 * i, 0.4 + 1.3 * i]).as_matrix() for i in range(count)]
    viewmats[:, :3, :3] = torch.from_numpy(np.array(turns))
    viewmats[:, 2, 3] = 3.0
    return viewmats.float()


def random_scene(
    *, count: int = 150, coefficients: int = 4, cameras: int = 1, seed: int = 0, width: int = 70, height: int = 50
) -> Scene:
    """Gaussians of all shapes around the origin, in an image of several tiles, its principal point off the centre."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    gaussians = Gaussians(
        means=0.4 * normal(count, 3),
        quats=normal(count, 4),
        scales=torch.exp(0.7 * normal(count, 3) - 3),
        opacities=torch.sigmoid(2 * normal(count)),
        sh=0.3 * normal(count, coefficients, 3),
    )
    K = torch.tensor([[80.0, 0, 0.47 * width], [0, 90, 0.55 * height], [0, 0, 1]])
    return Scene(
        gaussians=gaussians,
        viewmats=turned_cameras(cameras),
        Ks=K.repeat(cameras, 1, 1),
        width=width,
        height=height,
        background=torch.tensor([0.1, 0.5, 0.9]),
    )
