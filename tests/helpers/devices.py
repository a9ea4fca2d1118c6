"""A training step where tensors have a shape and no numbers: whatever was made on another device raises there.

What needs numbers is replaced on the device `meta`, and only that: the splatter and the rasteriser give shapes,
outlines are not followed, a frame's novelty is not measured, and nobody looks whether a gradient is finite. So is the
product with a sparse matrix, which `meta` has not.
"""

from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.captures import tiny_plus
from torch import Tensor

import ash.mesh.drawing
import ash.model
import ash.template.graph
import ash.template_learning.image_tracking
import ash.template_learning.learning
import ash.template_learning.regressing
import ash.textures
import ash.trained_avatar
import ash.training.adam
from ash.capture.dataset import Camera, Capture
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted
from ash.mesh.drawing import SUPERSAMPLING, MeshView, Topology
from ash.mesh.rasterizing import Rasterized, project_vertices
from ash.template.graph import NeighbourMean
from ash.training.adam import Adam
from ash.training.batches import draw_batch
from ash.training.images import load_training_images

META = torch.device("meta")


def tiny(config: Any, **template: Any) -> Any:
    """The configuration of a preset as it is, but for its size; on the skinned template, or another."""
    small = tiny_plus(steps=4, warmup_steps=0)
    size = {"texels": 16, "width": 4, "levels": 2, "window": 2, "shuffle": min(2, config.model.shuffle)}
    return replace(
        config,
        model=replace(config.model, **size),
        training=replace(config.training, steps=4, warmup_steps=0),
        template=replace(small.template, **({"kind": "skinned"} | template)),
        **({"texture": 32} if hasattr(config, "texture") else {}),
    )


def step_of(avatar: Any, capture: Capture, device: torch.device) -> list[Tensor]:
    """One training step, as the loop makes it; returns the parameters that moved."""
    training = avatar.config.training
    batch = draw_batch(load_training_images(capture, device), training, 0, 0)
    optimiser = Adam(avatar.parameter_groups(), eps=1e-15)
    avatar.loss([batch], 0).backward()
    assert optimiser.step()
    return [parameter for parameter in optimiser.parameters if parameter.grad is not None]


def without_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Avatars are made for `meta`, and what needs numbers is replaced."""
    monkeypatch.setattr(ash.trained_avatar, "device_named", lambda name: META)
    monkeypatch.setattr(ash.template.graph.NeighbourMean, "__call__", as_if_averaged)
    monkeypatch.setattr(ash.model, "splat", _shapes_of_images)
    monkeypatch.setattr(ash.mesh.drawing, "_view_of", _some_samples)
    monkeypatch.setattr(ash.mesh.drawing, "_outlines", _no_outlines)
    monkeypatch.setattr(ash.training.adam, "_all_finite", lambda gradients: True)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: torch.enable_grad())  # `meta` has none.
    equal = torch.equal
    monkeypatch.setattr(torch, "equal", lambda a, b: a.device == b.device == META or equal(a, b))


def _shapes_of_images(gaussians: Gaussians, *, viewmats: Tensor, width: int, height: int, **_: Any) -> Splatted:
    """What `splat` returns, and a graph that leads back to every parameter."""
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    total = torch.stack([tensor.sum() for tensor in tensors]).sum()
    size = (len(viewmats), height, width)
    centres = gaussians.means[:, :2].expand(len(viewmats), -1, -1)
    return Splatted(rgb=total.expand(*size, 3), alpha=total.expand(size), depth=total.expand(size), means2d=centres)


def _some_samples(vertices: Tensor, topology: Topology, camera: Camera) -> MeshView:
    """What `_view_of` returns where seven samples see the first triangle."""
    width, height = camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING
    viewmat, K = (torch.from_numpy(matrix).to(vertices) for matrix in (camera.viewmat, camera.K))
    corners = project_vertices(vertices, viewmat, K)
    covered = torch.arange(7, device=vertices.device)
    drawn = Rasterized(
        triangle=torch.zeros(height, width, dtype=torch.int32, device=vertices.device),
        barycentric=vertices.new_zeros(height, width, 3),
        depth=vertices.new_zeros(height, width),
    )
    return MeshView(camera=camera, corners=corners, drawn=drawn, covered=covered, triangles=torch.zeros_like(covered))


def as_if_averaged(mean: NeighbourMean, x: Tensor) -> Tensor:
    """What `NeighbourMean` returns, where the operator lies on the device of what it is applied to."""
    assert mean.operator.device == mean.transposed.device == x.device
    return x.clone()


def _no_outlines(samples: Tensor, view: MeshView, topology: Topology) -> Tensor:
    return samples.new_zeros(view.camera.height, view.camera.width, samples.shape[1])


def learning_without_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Templates are learned on `meta` and stay there.

    Where a choice depends on numbers, everything is chosen; where SciPy works in between, its result is replaced.
    """
    images, learning = ash.template_learning.image_tracking, ash.template_learning.learning
    regressing = ash.template_learning.regressing
    monkeypatch.setattr(learning, "CPU", META)
    monkeypatch.setattr(ash.template.graph.NeighbourMean, "__call__", as_if_averaged)
    monkeypatch.setattr(Tensor, "nonzero", _all_chosen)
    monkeypatch.setattr(images, "rasterize_mesh", _nothing_seen)
    monkeypatch.setattr(regressing, "_node_translations", _no_translations)
    monkeypatch.setattr(regressing, "_mean_square", lambda error: _on_meta(error) and 1.0)


def _on_meta(*tensors: Tensor) -> bool:
    assert {tensor.device for tensor in tensors} == {META}
    return True


def _all_chosen(
    mask: Tensor, *, as_tuple: bool = False, of_numbers: Any = Tensor.nonzero
) -> Tensor | tuple[Tensor, ...]:
    """What `Tensor.nonzero` returns on `meta` where everything is chosen."""
    if mask.device != META:
        return of_numbers(mask, as_tuple=as_tuple)  # type: ignore[no-any-return]
    rows = torch.empty(mask.numel(), mask.dim(), dtype=torch.int64, device=META)
    return rows.unbind(1) if as_tuple else rows


def _nothing_seen(vertices: Tensor, faces: Tensor, *, width: int, height: int) -> Rasterized:
    assert _on_meta(vertices, faces)
    image = vertices.new_zeros(height, width)
    return Rasterized(triangle=image.int(), barycentric=image[..., None].expand(-1, -1, 3), depth=image)


def _no_translations(graph: Any, shift: Tensor) -> Tensor:
    assert _on_meta(graph.weights, graph.links, shift)
    return shift.new_zeros(len(shift), len(graph.nodes), 3)
