"""Stg. 4: Gaussians to images. `splat_naive` is the definition (ASH Eq. 1-3), `splat` the same function, fast.

Kerbl et al.'s constants, here and in the native and Warp kernels: a splat's opacity at a pixel lies in [1/255, 0.99],
smaller ones are skipped; a pixel is finished before the splat that would take its transmittance below 1e-4; 0.3 px^2
is added to both axes of every projected covariance (an argument: at 256x256 pixels 0.05 gains over a decibel). A splat
reaches as far as its opacity exceeds 1/255: no fixed number of standard deviations. Equal depths are drawn as they
come.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.harmonics import sh_basis
from ash.native.library import float32_on_cpu
from ash.native.splatting import Viewport, draw
from ash.rotations import unitquat_to_rotmat

ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
# Below this ratio of determinants a compensated splat cannot reach 1/255: the square root needs no smaller argument.
COMPENSATION_MIN = 1e-6
NAIVE_TILE = 16


@dataclass(frozen=True, kw_only=True, slots=True)
class Splatted:
    """Images of one or several cameras, all premultiplied: sums over splats weighted by w = alpha' prod(1 - alpha')."""

    rgb: Float[Tensor, "c h w 3"]  # sum of w times colour, plus (1 - alpha) times the background
    alpha: Float[Tensor, "c h w"]  # sum of w
    depth: Float[Tensor, "c h w"]  # sum of w times camera z, metres; divide by alpha for the mean depth
    means2d: Float[Tensor, "c n 2"]  # projected centres, pixels, (0, 0) behind the near plane; part of the graph


def check_cameras(
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    *,
    width: int,
    height: int,
    near: float,
    dilation: float,
) -> None:
    """Raise an InputError unless the cameras are pinholes without skew and the numbers are usable."""
    if len(viewmats) == 0 or len(Ks) != len(viewmats):
        raise InputError(f"viewmats and Ks: expected as many of both, got {len(viewmats)} and {len(Ks)}")
    # A few dozen numbers are looked at faster in Python than by as many tensor operations.
    for viewmat, K in zip(viewmats.tolist(), Ks.tolist(), strict=True):
        for name, matrix in (("viewmats", viewmat), ("Ks", K)):
            if not all(math.isfinite(number) for row in matrix for number in row):
                raise InputError(f"{name}: expected finite numbers, got NaN or infinity")
        axes = [row[:3] for row in viewmat[:3]]
        for i in range(3):
            for j in range(i, 3):
                if abs(sum(x * y for x, y in zip(axes[i], axes[j], strict=True)) - (i == j)) > 1e-3:
                    raise InputError(
                        "viewmats: expected a rotation in the upper left 3x3, got one that scales or shears"
                    )
        if not (K[0][0] > 0 and K[1][1] > 0 and K[0][1] == 0):
            raise InputError("Ks: expected positive focal lengths and no skew")
    if not (1 <= width <= 1 << 15 and 1 <= height <= 1 << 15):
        raise InputError(f"image size: expected 1 to 32768 pixels a side, got {width} x {height}")
    if not (near > 0 and dilation >= 0):
        raise InputError(f"expected near > 0 and dilation >= 0, got near = {near} and dilation = {dilation}")


def check_gaussians(gaussians: Gaussians) -> None:
    """Raise an InputError that names the first tensor with a bad number, a zero quaternion, or a value out of range."""
    for name in ("means", "quats", "scales", "opacities", "sh"):
        if not bool(torch.isfinite(getattr(gaussians, name)).all()):
            raise InputError(f"{name}: expected finite numbers, got NaN or infinity")
    if bool((gaussians.quats == 0).all(dim=1).any()):
        raise InputError("quats: expected quaternions that are not zero, got a zero quaternion")
    if bool((gaussians.scales < 0).any()):
        raise InputError("scales: expected standard deviations >= 0, got a negative one")
    if bool(((gaussians.opacities < 0) | (gaussians.opacities > 1)).any()):
        raise InputError("opacities: expected numbers in [0, 1]")
    check_sh(gaussians.sh)


def check_sh(sh: Float[Tensor, "n k 3"]) -> None:
    """Raise an InputError unless the number of coefficients belongs to a degree from 0 to 3."""
    if sh.shape[1] not in (1, 4, 9, 16):
        raise InputError(f"sh: expected 1, 4, 9 or 16 coefficients per channel (degree 0 to 3), got {sh.shape[1]}")


# ---------------------------------------------------------------------------------------------------------------------
# The definition


@dataclass(frozen=True, kw_only=True, slots=True)
class _Projected:
    """Gaussians in one image: those in front of the near plane, nearest first."""

    means2d: Tensor  # [m, 2] pixels
    conics: Tensor  # [m, 3] inverse covariance: xx, xy, yy, 1 / px^2
    opacities: Tensor  # [m]
    colours: Tensor  # [m, 3]
    depths: Tensor  # [m] metres
    extents: Tensor  # [m, 2] pixels: half the box beyond which the opacity is below ALPHA_MIN; no gradient


def _project_means(means: Tensor, viewmat: Tensor, K: Tensor, *, near: float) -> Tensor:
    """Centres in the image, `[n, 2]` pixels; (0, 0) behind the near plane."""
    in_camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    visible = in_camera[:, 2:].detach() > near
    z = torch.where(visible, in_camera[:, 2:], 1.0)
    return torch.where(visible, in_camera[:, :2] / z * K[[0, 1], [0, 1]] + K[:2, 2], 0.0)


def _project_naive(
    gaussians: Gaussians,
    means2d: Tensor,
    viewmat: Tensor,
    K: Tensor,
    *,
    width: int,
    height: int,
    dilation: float,
    compensate: bool,
    near: float,
) -> _Projected:
    """Eq. 2, and the colour H of Eq. 3."""
    to_camera, centre = viewmat[:3, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]
    in_camera = gaussians.means @ to_camera.T + viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    order = torch.argsort(in_camera[:, 2].detach(), stable=True)
    order = order[in_camera[order, 2].detach() > near]

    x, y, z = in_camera[order].unbind(-1)
    # The affine approximation is taken no further outside the image than by Kerbl et al.: 15 % of its size.
    tan_x = torch.clamp(x / z, -(cx + 0.15 * width) / fx, (1.15 * width - cx) / fx)
    tan_y = torch.clamp(y / z, -(cy + 0.15 * height) / fy, (1.15 * height - cy) / fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * tan_x / z, zero, fy / z, -fy * tan_y / z], dim=-1).reshape(-1, 2, 3)
    rotations = unitquat_to_rotmat(torch.nn.functional.normalize(gaussians.quats[order], dim=-1, eps=0))
    half = jacobian @ to_camera @ (rotations * gaussians.scales[order][:, None, :])
    covariance = half @ half.mT
    a, b, c = covariance[:, 0, 0] + dilation, covariance[:, 0, 1], covariance[:, 1, 1] + dilation
    # det(half half^T) as a sum of squared minors (Cauchy-Binet) does not cancel where the splat is a needle.
    sharp = torch.linalg.cross(half[:, 0], half[:, 1]).square().sum(-1)
    det = sharp + dilation * (covariance[:, 0, 0] + covariance[:, 1, 1]) + dilation**2
    drawn = det.detach() > 0
    conics = torch.stack([c, -b, a], dim=-1) / torch.where(drawn, det, 1.0)[:, None]
    opacities = gaussians.opacities[order] * drawn
    if compensate:
        opacities = opacities * torch.sqrt(torch.clamp(sharp / torch.where(drawn, det, 1.0), min=COMPENSATION_MIN))

    directions = torch.nn.functional.normalize(gaussians.means[order] - centre, dim=-1)
    basis = sh_basis(directions, math.isqrt(gaussians.sh.shape[1]) - 1)
    colours = torch.clamp_min(0.5 + (basis[:, :, None] * gaussians.sh[order]).sum(1), 0.0)

    reach = 2 * torch.log(torch.clamp_min(opacities.detach() / ALPHA_MIN, 1.0))
    extents = torch.sqrt(reach[:, None] * torch.stack([a, c], dim=-1).detach())
    extents = torch.where((opacities.detach() >= ALPHA_MIN)[:, None], extents, -torch.inf)
    return _Projected(
        means2d=means2d[order], conics=conics, opacities=opacities, colours=colours, depths=z, extents=extents
    )


def _opacities_naive(projected: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Of every splat at every pixel, `[m, p]`: alpha' of Eq. 3, and the transmittance behind it, finished or not."""
    dx, dy = (pixels[None, :, i] - projected[:, i, None] for i in range(2))
    a, b, c = (projected[:, i, None] for i in (2, 3, 4))
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
    alpha = torch.clamp_max(projected[:, 5, None] * torch.exp(power), ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    return alpha, torch.cumprod(1 - alpha, dim=0)


def _composite_naive(projected: Tensor, pixels: Tensor) -> Tensor:
    """Eq. 3 for `[p, 2]` pixel centres: `[p, 5]` = premultiplied colour, depth, alpha.

    `projected` is `[m, 10]`, nearest first: means2d, conics, opacity, colour, depth.
    """
    alpha, left = _opacities_naive(projected, pixels)
    # `left` never grows, so a finished pixel stays finished.
    alpha = torch.where(left >= TRANSMITTANCE_MIN, alpha, 0.0)
    before = torch.cat([torch.ones_like(left[:1]), left[:-1]])
    weights = alpha * before
    features = torch.cat([projected[:, 6:10], torch.ones_like(projected[:, :1])], dim=1)
    return weights.T @ features


def splat_naive(
    gaussians: Gaussians,
    *,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    background: Float[Tensor, " 3"] | None = None,
    dilation: float = 0.3,
    compensate: bool = False,
    near: float = 0.01,
    tile: int = NAIVE_TILE,
) -> Splatted:
    """Draw Gaussians: the definition, ASH Eq. 1-3 in plain torch, for any float dtype, differentiable in every tensor.

    The arguments are those of `splat`. The image is composited in squares of `tile` pixels, only to bound the memory.
    """
    check_gaussians(gaussians)
    check_cameras(viewmats, Ks, width=width, height=height, near=near, dilation=dilation)
    cameras = list(zip(viewmats, Ks, strict=True))
    means2d = torch.stack([_project_means(gaussians.means, viewmat, K, near=near) for viewmat, K in cameras])
    images = []
    for centres, (viewmat, K) in zip(means2d, cameras, strict=True):
        projected = _project_naive(
            gaussians,
            centres,
            viewmat,
            K,
            width=width,
            height=height,
            dilation=dilation,
            compensate=compensate,
            near=near,
        )
        images.append(_draw_naive(projected, width=width, height=height, tile=tile))
    image = torch.stack(images)
    rgb, depth, alpha = image[..., :3], image[..., 3], image[..., 4]
    if background is not None:
        rgb = rgb + (1 - alpha)[..., None] * background
    return Splatted(rgb=rgb, alpha=alpha, depth=depth, means2d=means2d)


def _draw_naive(
    projected: _Projected,
    *,
    width: int,
    height: int,
    tile: int,
    composite: Callable[[Tensor, Tensor], Tensor] = _composite_naive,
) -> Tensor:
    """One image `[h, w, 5]`, composited square by square."""
    columns, rows = -(-width // tile), -(-height // tile)
    # A hair wider than exact: the threshold on alpha decides, not this box.
    low = (projected.means2d.detach() - projected.extents - 0.6) / tile
    high = (projected.means2d.detach() + projected.extents + 0.6) / tile
    record = torch.cat(
        [
            projected.means2d,
            projected.conics,
            projected.opacities[:, None],
            projected.colours,
            projected.depths[:, None],
        ],
        dim=1,
    )
    members = []
    for row in range(rows):
        in_row = torch.nonzero((low[:, 1] < row + 1) & (high[:, 1] > row))[:, 0]
        for column in range(columns):
            inside = (low[in_row, 0] < column + 1) & (high[in_row, 0] > column)
            members.append(in_row[inside])
    # One gather for all squares: a gather per square would write a whole gradient per square.
    records = record[torch.cat(members)].split([len(m) for m in members])
    steps = torch.arange(tile, dtype=record.dtype, device=record.device) + 0.5
    lattice = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2)
    empty = torch.zeros(tile * tile, 5, dtype=record.dtype, device=record.device)
    squares = []
    for number, entries in enumerate(records):
        corner = torch.tensor([number % columns, number // columns], dtype=record.dtype, device=record.device) * tile
        squares.append(composite(entries, lattice + corner) if len(entries) else empty)
    image = torch.stack(squares).reshape(rows, columns, tile, tile, 5).transpose(1, 2)
    return image.reshape(rows * tile, columns * tile, 5)[:height, :width]


# ---------------------------------------------------------------------------------------------------------------------
# The fast version


def splat(
    gaussians: Gaussians,
    *,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    background: Float[Tensor, " 3"] | None = None,
    dilation: float = 0.3,
    compensate: bool = False,
    near: float = 0.01,
    threads: int = 1,
) -> Splatted:
    """Draw Gaussians in one or several cameras: `splat_naive` by native kernels on the CPU, by Warp's on CUDA.

    ASH Eq. 1-3. Differentiable in every Gaussian parameter; in `viewmats` on the CPU only; not in `Ks` and
    `background`. Float32 only. The same numbers come out for any number of threads, and on a GPU every time. Both have
    the constants of the definition. The Gaussians' device decides; cameras and background may lie on the CPU.

    Args:
        gaussians: in the world's frame.
        viewmats: world to camera, OpenCV axes, metres.
        Ks: pixels, no skew, any principal point; pixel centres at +0.5.
        width: pixels.
        height: pixels.
        background: RGB behind the splats, black if None.
        dilation: px^2, added to both axes of a projected covariance.
        compensate: scale a splat's opacity by the root of the ratio of determinants before and after dilation.
        near: metres; a Gaussian is drawn if its centre lies beyond this depth.
        threads: CPU threads of this call.

    Raises:
        InputError: a tensor holds NaN or infinity, a quaternion is zero, a number is out of range; names the tensor.
    """
    check_cameras(viewmats, Ks, width=width, height=height, near=near, dilation=dilation)
    check_sh(gaussians.sh)
    for name, tensor in (("Ks", Ks), ("background", background)):
        if tensor is not None and tensor.requires_grad:
            raise InputError(f"{name}: splat has no gradient for it; splat_naive does")
    if background is not None and not bool(torch.isfinite(background).all()):
        raise InputError("background: expected finite numbers, got NaN or infinity")
    if threads < 1:
        raise InputError(f"threads: expected at least 1, got {threads}")
    view = Viewport(width, height, int(compensate), dilation, near, threads)
    if gaussians.means.is_cuda:
        return splat_by_warp(gaussians, viewmats, Ks, view, background)
    tensors = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    arrays = [float32_on_cpu(name, tensor) for name, tensor in (tensors | {"viewmats": viewmats, "Ks": Ks}).items()]
    behind = [0.0, 0.0, 0.0] if background is None else background.tolist()
    rgb, alpha, depth, means2d = draw(view, behind, arrays)
    return Splatted(rgb=rgb, alpha=alpha, depth=depth, means2d=means2d)


def splat_by_warp(
    gaussians: Gaussians,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    view: Viewport,
    background: Float[Tensor, " 3"] | None,
) -> Splatted:
    """What `splat` does on CUDA, on any device of Warp's: tests run it on the CPU."""
    from ash.warp import splatting  # Warp takes a second to import.

    if viewmats.requires_grad:
        raise InputError("viewmats: splat has no gradient for it on CUDA; on the CPU it has")
    device = gaussians.means.device
    cameras = {"viewmats": viewmats.to(device), "Ks": Ks.to(device)}
    tensors = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")} | cameras
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32 or tensor.device != device:
            raise InputError(f"{name}: expected float32 on {device}, got {tensor.dtype} on {tensor.device}")
    rgb, alpha, depth, means2d = splatting.draw(view, [tensor.contiguous() for tensor in tensors.values()])
    if background is not None:
        rgb = rgb + (1 - alpha)[..., None] * background.to(device)
    return Splatted(rgb=rgb, alpha=alpha, depth=depth, means2d=means2d)
