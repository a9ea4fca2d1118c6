"""The Warp splatter in torch's graph: Gaussians -> `_ProjectByWarp` -> splats -> `_BlendByWarp` -> images."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ash.files import InputError
from ash.native.splatting import FAULTS, Viewport
from ash.warp import blending, projecting, projecting_back
from ash.warp.arrays import array, launch

NO_FAULT = torch.iinfo(torch.int64).max
MOST_PAIRS = torch.iinfo(torch.int32).max
GAUSSIANS = (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec3, wp.mat44, wp.mat33)  # The arrays of `draw`.


def draw(view: Viewport, arrays: list[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour over black `[c, h, w, 3]`, alpha `[c, h, w]`, depth `[c, h, w]` and means2d `[c, n, 2]`.

    `arrays` are means, quats, scales, opacities, sh, viewmats and Ks, contiguous float32 on one device of Warp's. The
    images are differentiable in all but the cameras.

    Raises:
        InputError: a Gaussian holds NaN, infinity or a number out of range; names the first that does.
    """
    means2d, shapes, looks, depths, boxes, fault = _ProjectByWarp.apply(view, *arrays)
    pairs = _listed(view, depths, boxes, fault)
    rgb, alpha, depth = _BlendByWarp.apply(view, pairs, means2d, shapes, looks)
    return rgb, alpha, depth, means2d


def _gaussians(arrays: list[Tensor]) -> list[Any]:
    return [array(tensor, dtype) for tensor, dtype in zip(arrays, GAUSSIANS, strict=True)]


def _plain(view: Viewport) -> tuple[Any, ...]:
    """The numbers of a call, in the order in which projection takes them."""
    return view.width, view.height, view.compensate, view.dilation, view.near


class _ProjectByWarp(Function):
    """Gaussians to splats, and to what their order and their places on the image are found from."""

    @staticmethod
    def forward(ctx: Any, view: Viewport, *arrays: Tensor) -> tuple[Tensor, ...]:
        size, device = (len(arrays[5]), len(arrays[0])), arrays[0].device
        means2d, shapes, looks = (torch.empty(*size, width, device=device) for width in (2, 4, 4))
        depths = torch.empty(size, dtype=torch.float64, device=device)
        boxes = torch.empty(*size, 4, dtype=torch.int32, device=device)
        fault = torch.full((1,), NO_FAULT, dtype=torch.int64, device=device)
        made = [(means2d, wp.vec2), (shapes, wp.vec4), (looks, wp.vec4), (depths, wp.float64)]
        outputs = [array(tensor, dtype) for tensor, dtype in [*made, (boxes, wp.vec4i), (fault, wp.int64)]]
        launch(projecting.project, depths.numel(), [*_gaussians(list(arrays)), *_plain(view), *outputs], device)
        ctx.save_for_backward(*arrays)
        ctx.view = view
        ctx.mark_non_differentiable(depths, boxes, fault)
        return means2d, shapes, looks, depths, boxes, fault

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        arrays = list(ctx.saved_tensors)
        whole = [grad.contiguous() for grad in grads[:3]]  # An array holds no reference to what it points at.
        given = [array(grad, dtype) for grad, dtype in zip(whole, (wp.vec2, wp.vec4, wp.vec4), strict=True)]
        made = [torch.empty_like(tensor) for tensor in arrays[:5]]
        outputs = [array(tensor, dtype) for tensor, dtype in zip(made, GAUSSIANS[:5], strict=True)]
        arguments = [*_gaussians(arrays), *_plain(ctx.view), *given, *outputs]
        launch(projecting_back.project_backward, len(arrays[0]), arguments, arrays[0].device)
        return None, *made, None, None


@dataclass(frozen=True, kw_only=True, slots=True)
class _Pairs:
    """Splats and the tiles that they may touch. Pairs lie splat by splat; sorted, tile by tile."""

    order: Tensor  # [c, n] int64: the splats of a camera, nearest first
    ends: Tensor  # [c n] int64: in that order, where the pairs of a splat end
    boxes: Tensor  # [c, n, 4] int32: tiles
    members: Tensor  # [p] int32: the splats of all cameras, sorted
    slots: Tensor  # [p] int64: where a sorted pair lies unsorted
    starts: Tensor  # [tiles + 1] int32: where a tile's sorted pairs begin


def _listed(view: Viewport, depths: Tensor, boxes: Tensor, fault: Tensor) -> _Pairs:
    """List the pairs. Equal depths are drawn in the order of the Gaussians."""
    (cameras, count), device = depths.shape, depths.device
    columns, rows = -(-view.width // projecting.TILE), -(-view.height // projecting.TILE)
    order = torch.argsort(depths, dim=1, stable=True)
    touched = (boxes[..., 2] - boxes[..., 0]).long() * (boxes[..., 3] - boxes[..., 1])
    ends = touched.gather(1, order).flatten().cumsum(0)
    total, wrong = torch.stack([touched.sum(), fault[0]]).tolist()  # The only time that the processor waits.
    if wrong != NO_FAULT:
        raise InputError(f"{FAULTS[wrong % projecting.FAULT_CODES]} at Gaussian {wrong // projecting.FAULT_CODES}")
    if total > MOST_PAIRS:
        raise InputError(f"scales: expected splats that touch at most {MOST_PAIRS} tiles together, got {total}")
    tiles, members = (torch.empty(total, dtype=torch.int32, device=device) for _ in range(2))
    inputs = [array(order, wp.int64), array(ends, wp.int64), array(boxes, wp.vec4i), count, columns, rows]
    outputs = [array(tensor, wp.int32) for tensor in (tiles, members)]
    launch(blending.list_pairs, cameras * count, [*inputs, *outputs], device)
    sorted_tiles, slots = torch.sort(tiles, stable=True)
    edges = torch.arange(cameras * rows * columns + 1, dtype=torch.int32, device=device)
    starts = torch.searchsorted(sorted_tiles, edges, out_int32=True)
    return _Pairs(order=order, ends=ends, boxes=boxes, members=members[slots], slots=slots, starts=starts)


class _BlendByWarp(Function):
    """Splats to images over black, Eq. 3."""

    @staticmethod
    def forward(
        ctx: Any, view: Viewport, pairs: _Pairs, means2d: Tensor, shapes: Tensor, looks: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        size, device = (len(means2d), view.height, view.width), means2d.device
        rgb, alpha, depth, left = (torch.empty(*size, *rest, device=device) for rest in ((3,), (), (), ()))
        lasts = torch.empty(size, dtype=torch.int32, device=device)
        images = [array(rgb, wp.vec3), *(array(image, wp.float32) for image in (alpha, depth, left))]
        arguments = [*_splats(pairs, means2d, shapes, looks), view.width, view.height, *images, array(lasts, wp.int32)]
        launch(blending.blend, _threads(pairs), arguments, device)
        ctx.view, ctx.pairs = view, pairs
        ctx.save_for_backward(means2d, shapes, looks, left, lasts)
        return rgb, alpha, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_images: Tensor) -> tuple[Tensor | None, ...]:
        view, pairs = ctx.view, ctx.pairs
        means2d, shapes, looks, left, lasts = ctx.saved_tensors
        device = means2d.device
        whole = [grad.contiguous() for grad in grad_images]  # An array holds no reference to what it points at.
        given = [array(grad, dtype) for grad, dtype in zip(whole, (wp.vec3, wp.float32, wp.float32), strict=True)]
        entries = torch.zeros(len(pairs.members), blending.ENTRY, device=device)
        inputs = [array(left, wp.float32), array(lasts, wp.int32), *given, array(pairs.slots, wp.int64)]
        places = array(entries, blending.vec10)
        splats = _splats(pairs, means2d, shapes, looks)
        arguments = [*splats, view.width, view.height, *inputs, places]
        launch(blending.blend_backward, _threads(pairs), arguments, device)
        grads = [torch.empty_like(tensor) for tensor in (means2d, shapes, looks)]
        listed = [array(pairs.order, wp.int64), array(pairs.ends, wp.int64), array(pairs.boxes, wp.vec4i)]
        outputs = [array(grad, dtype) for grad, dtype in zip(grads, (wp.vec2, wp.vec4, wp.vec4), strict=True)]
        arguments = [*listed, means2d.shape[1], places, *outputs]
        launch(blending.gather, pairs.order.numel(), arguments, device)
        return None, None, *grads


def _splats(pairs: _Pairs, means2d: Tensor, shapes: Tensor, looks: Tensor) -> list[Any]:
    """The arrays that blending reads, forward and backward."""
    arrays = [array(means2d, wp.vec2), array(shapes, wp.vec4), array(looks, wp.vec4)]
    return [*arrays, array(pairs.members, wp.int32), array(pairs.starts, wp.int32)]


def _threads(pairs: _Pairs) -> int:
    """A thread per pixel of every tile."""
    return (len(pairs.starts) - 1) * projecting.TILE**2
