"""Times of the kernels beside their definitions, all in one run: `ash-bench speed kernels`.

The subject is a person made of capsules, as Gaussians on its surface and as a mesh.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

import ash.gaussians.splatting
from ash.devices import CPU, moved
from ash.files import write_json
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import splat, splat_naive
from ash.mesh.rasterizing import project_vertices, rasterize_mesh, rasterize_mesh_naive
from ash.native.library import fma_peak, instruction_set, stage_ms
from ash.rotations import rotmat_to_unitquat
from ash.training.losses import l1_ssim_loss, l1_ssim_loss_naive, ssim_target
from benchmarks.cell.sandbox import peak_memory_mb
from benchmarks.speed.timing import Candidate, SpeedRow, as_json, print_head, print_rows, rows_of, time_interleaved

# Floating point operations of one splat at one pixel, counted in native/blend.inc: the exponent and its power of two,
# the cap and the transmittance, four accumulated channels; backward all but the channels again, and the gradients.
FORWARD_FLOPS = 36
BACKWARD_FLOPS = 66
LOSS_SIZES = {"256": (256, 256), "512": (512, 512), "1285x940": (940, 1285)}
# Capsules of a standing person with spread arms, metres, y up: ends and radius.
BODY = (
    ((0.0, 0.85, 0.0), (0.0, 1.35, 0.0), 0.20),
    ((0.0, 1.58, 0.0), (0.0, 1.66, 0.0), 0.12),
    ((0.20, 1.38, 0.0), (0.62, 1.15, 0.05), 0.07),
    ((-0.20, 1.38, 0.0), (-0.62, 1.15, 0.05), 0.07),
    ((0.10, 0.80, 0.0), (0.17, 0.08, 0.0), 0.10),
    ((-0.10, 0.80, 0.0), (-0.17, 0.08, 0.0), 0.10),
)


@dataclass(frozen=True, kw_only=True)
class SplatScene:
    """Gaussians on the surface of a person who fills the image's height."""

    name: str
    gaussians: Gaussians
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int

    @property
    def cameras(self) -> dict[str, Any]:
        """As the splatter takes them."""
        return {"viewmats": self.viewmats, "Ks": self.Ks, "width": self.width, "height": self.height}


# Gaussians, width, height, their standard deviation in metres, and how many image heights the body is tall. P covers
# 21 % of its pixels with 52 contributing splats each, S 23 % with 43.
SIZES = {"S": (3_000, 256, 256, 0.034, 0.68), "P": (40_000, 1285, 940, 0.0080, 0.98)}


def splat_scene(name: str) -> SplatScene:
    """Flat Gaussians of many opacities on the body, spherical harmonics of degree 3, seen from 3 m."""
    count, width, height, spread, fill = SIZES[name]
    generator = torch.Generator().manual_seed(0)
    mesh = body()
    drawn, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    points, normals = (torch.from_numpy(np.ascontiguousarray(v)).float() for v in (drawn, mesh.face_normals[faces]))
    tangents = torch.linalg.cross(normals, torch.tensor([0.3, 0.5, 0.8]).expand_as(normals))
    frame = torch.stack([tangents / tangents.norm(dim=1, keepdim=True), torch.zeros_like(normals), normals], -1)
    frame[..., 1] = torch.linalg.cross(frame[..., 2], frame[..., 0])
    scales = spread * torch.exp(0.3 * torch.randn(count, 3, generator=generator))
    scales[:, 2] *= 0.2
    sh = 0.2 * torch.randn(count, 16, 3, generator=generator)
    sh[:, 1:] *= 0.3
    viewmat, K = _camera(width, height, fill)
    gaussians = Gaussians(
        means=points,
        quats=rotmat_to_unitquat(frame),
        scales=scales,
        opacities=0.05 + 0.45 * torch.rand(count, generator=generator),
        sh=sh,
    )
    return SplatScene(name=name, gaussians=gaussians, viewmats=viewmat[None], Ks=K[None], width=width, height=height)


def body() -> trimesh.Trimesh:
    """The capsules as one mesh."""
    parts: list[trimesh.Trimesh] = []
    for start, end, radius in BODY:
        along = np.subtract(end, start)
        place = trimesh.geometry.align_vectors((0, 0, 1), along)
        place[:3, 3] = np.add(start, end) / 2
        length = float(np.linalg.norm(along))
        parts.append(trimesh.creation.capsule(length, radius, count=(14, 14), transform=place))
    return sum(parts[1:], parts[0])


def _camera(width: int, height: int, fill: float) -> tuple[Tensor, Tensor]:
    distance, tall = 3.0, 1.75
    viewmat = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    viewmat[:3, 3] = torch.tensor([0.0, 0.5 * tall, distance])
    focal = fill * height * distance / tall
    return viewmat, torch.tensor([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])


@dataclass(frozen=True, kw_only=True)
class SplatDetail:
    """Where the time of the native splatter goes in one scene."""

    size: str
    threads: int
    covered: float  # share of the pixels that any splat reaches
    pairs: int  # splats blended, summed over pixels
    stages_ms: dict[str, float]  # minimum of each
    forward_pairs_per_second: float
    backward_pairs_per_second: float
    forward_peak_share: float  # of the measured peak of fused multiply-adds
    backward_peak_share: float


def speed_kernels(
    *, rounds: int = 3, threads: tuple[int, ...] = (1, 2), device: torch.device = CPU
) -> Iterator[list[SpeedRow] | SplatDetail]:
    """Time splatting, loss and rasteriser, naive and native interleaved; yields results one by one.

    On a GPU one number of threads is timed, and the loss is the definition.
    """
    threads = threads if device == CPU else (1,)
    for scene in (splat_scene("S"), splat_scene("P")):
        yield from time_splat(moved(scene, device), rounds=rounds, threads=threads)
    for size, (height, width) in LOSS_SIZES.items():
        yield _time_loss(size, height, width, rounds=rounds, threads=threads, device=device)
    for size, pixels in (("256", 256), ("512", 512)):
        yield _time_rasterizer(size, pixels, rounds=rounds, threads=threads, device=device)


def _candidates(
    naive: Callable[[], object], native: Callable[..., object], threads: tuple[int, ...]
) -> list[Candidate]:
    """The definition on the threads that torch has, and its kernel, ten calls each, on each number of `threads`."""
    kernels = [
        Candidate(name="native", threads=n, call=_without_result(native, threads=n), repeats=10) for n in threads
    ]
    return [Candidate(name="naive", threads=torch.get_num_threads(), call=_without_result(naive)), *kernels]


def _without_result(call: Callable[..., object], **options: int) -> Callable[[int], None]:
    def run(number: int) -> None:
        call(**options)

    return run


def time_splat(scene: SplatScene, *, rounds: int, threads: tuple[int, ...]) -> Iterator[list[SpeedRow] | SplatDetail]:
    """Rows of forward and of forward with backward, interleaved; on the CPU a detail per number of threads."""
    device = scene.gaussians.means.device
    leaves = {name: getattr(scene.gaussians, name).clone().requires_grad_() for name in Gaussians.__slots__}
    gradient = torch.randn(1, scene.height, scene.width, 3, generator=torch.Generator().manual_seed(1)).to(device)
    stages: dict[int, list[dict[str, float]]] = {count: [] for count in threads}

    def forward(draw: Callable[..., ash.gaussians.splatting.Splatted], **more: int) -> None:
        with torch.no_grad():
            draw(scene.gaussians, **scene.cameras, **more)

    def both(draw: Callable[..., ash.gaussians.splatting.Splatted], **more: int) -> None:
        for leaf in leaves.values():
            leaf.grad = None
        torch.autograd.backward(draw(Gaussians(**leaves), **scene.cameras, **more).rgb, gradient)
        if more and device == CPU:
            stages[more["threads"]].append(stage_ms())

    for pass_, run in (("forward", forward), ("forward+backward", both)):
        candidates = _candidates(partial(run, splat_naive), partial(run, splat), threads)
        yield rows_of("splat", scene.name, pass_, time_interleaved(candidates, rounds=rounds, device=device), device)
    if device != CPU:
        return
    covered, pairs = count_pairs(scene)
    for count in threads:
        minima = {stage: min(sample[stage] for sample in stages[count]) for stage in stages[count][0]}
        peak = fma_peak(count)
        forward_rate, backward_rate = (1e3 * pairs / minima[stage] for stage in ("blend", "blend_backward"))
        yield SplatDetail(
            size=scene.name,
            threads=count,
            covered=covered,
            pairs=pairs,
            stages_ms=minima,
            forward_pairs_per_second=forward_rate,
            backward_pairs_per_second=backward_rate,
            forward_peak_share=forward_rate * FORWARD_FLOPS / peak,
            backward_peak_share=backward_rate * BACKWARD_FLOPS / peak,
        )


def count_pairs(scene: SplatScene) -> tuple[float, int]:
    """The share of covered pixels, and the pairs of a pixel and a splat that contributes to it, by the definition."""
    gaussians, counted, covered = scene.gaussians, 0, 0
    projected = ash.gaussians.splatting._project_naive(
        gaussians,
        ash.gaussians.splatting._project_means(gaussians.means, scene.viewmats[0], scene.Ks[0], near=0.01),
        scene.viewmats[0],
        scene.Ks[0],
        width=scene.width,
        height=scene.height,
        dilation=0.3,
        compensate=False,
        near=0.01,
    )

    def count(splats: Tensor, pixels: Tensor) -> Tensor:
        nonlocal counted, covered
        alpha, left = ash.gaussians.splatting._opacities_naive(splats, pixels)
        contributes = ((alpha > 0) & (left >= ash.gaussians.splatting.TRANSMITTANCE_MIN)).sum(0)
        counted += int(contributes.sum())
        covered += int((contributes > 0).sum())
        return torch.zeros(len(pixels), 5)

    ash.gaussians.splatting._draw_naive(projected, width=scene.width, height=scene.height, tile=16, composite=count)
    return covered / (scene.width * scene.height), counted


def _time_loss(
    size: str, height: int, width: int, *, rounds: int, threads: tuple[int, ...], device: torch.device
) -> list[SpeedRow]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(height, width, 3, generator=generator)
    image = (target + 0.1 * torch.randn(height, width, 3, generator=generator)).to(device).requires_grad_()
    target = target.to(device)
    cached = ssim_target(target)

    def run(loss: Callable[..., Tensor], **more: int) -> None:
        image.grad = None
        loss(image, cached, l1_weight=0.9, ssim_weight=0.1, **more).backward()

    candidates = _candidates(partial(run, l1_ssim_loss_naive), partial(run, l1_ssim_loss), threads)
    times = time_interleaved(candidates, rounds=2 * rounds, device=device)
    return rows_of("l1_ssim", size, "forward+backward", times, device)


def _time_rasterizer(
    size: str, pixels: int, *, rounds: int, threads: tuple[int, ...], device: torch.device
) -> list[SpeedRow]:
    mesh = body()
    vertices = project_vertices(torch.from_numpy(np.array(mesh.vertices)).float(), *_camera(pixels, pixels, 0.9))
    vertices, faces = moved((vertices, torch.from_numpy(np.array(mesh.faces))), device)
    naive, native = (
        partial(draw, vertices, faces, width=pixels, height=pixels) for draw in (rasterize_mesh_naive, rasterize_mesh)
    )
    candidates = _candidates(naive, native, threads)
    times = time_interleaved(candidates, rounds=max(1, rounds // 3), device=device)
    return rows_of("rasterize_mesh", size, "forward", times, device)


def _print_detail(detail: SplatDetail) -> None:
    stages = ", ".join(f"{stage} {ms:.2f}" for stage, ms in detail.stages_ms.items())
    print(
        f"  {detail.size}, {detail.threads} thread(s): {stages} ms\n"
        f"  {detail.pairs / 1e6:.2f} M pairs on {100 * detail.covered:.1f} % of the pixels;"
        f" blended per second: {detail.forward_pairs_per_second / 1e9:.2f} G forward"
        f" ({100 * detail.forward_peak_share:.1f} % of the FMA peak),"
        f" {detail.backward_pairs_per_second / 1e9:.2f} G backward ({100 * detail.backward_peak_share:.1f} %)",
        flush=True,
    )


def main(json_path: Path | None, device: torch.device = CPU) -> int:
    """Print the table, and write it to `json_path`; returns the exit code."""
    print(f"device {device}")
    print(f"instruction set {instruction_set()}, FMA peak {1e-9 * fma_peak(1):.0f} GFLOP/s on one thread", end="")
    print(f" and {1e-9 * fma_peak(2):.0f} on two; torch {torch.__version__}, {torch.get_num_threads()} thread(s)")
    print_head()
    rows: list[SpeedRow] = []
    details: list[SplatDetail] = []
    for result in speed_kernels(device=device):
        if isinstance(result, SplatDetail):
            details.append(result)
            _print_detail(result)
        else:
            rows += result
            print_rows(result)
    peak_mb = peak_memory_mb(os.getpid())
    print(f"peak memory of this process, torch and the definitions included: {peak_mb:.0f} MB")
    if json_path is not None:
        write_json(
            json_path,
            {
                "rows": [as_json(row) for row in rows],
                "splat_details": [vars(detail) for detail in details],
                "peak_rss_mb": peak_mb,
                "instruction_set": instruction_set(),
                "device": str(device),
            },
        )
    return 0
