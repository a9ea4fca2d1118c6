"""Every format is read back by another program's reader and drawn by our splatter, beside our own picture."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.gaussian_files import read_gltf, read_ply, read_splat, read_spz
from plyfile import PlyData

from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import splat
from ash.harmonics import SH_C0
from ash.inference import psnr
from benchmarks.export.axes import turned
from benchmarks.export.formats import FORMATS, GAUSSIAN_FORMATS, suffix_of

SIZE = 96


def cloud(degree: int, *, count: int = 600, seed: int = 0) -> Gaussians:
    """A hollow ball of flat and long Gaussians, coloured from every side differently where the degree allows it."""
    draw = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=-1)
    sh = 0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=draw)
    return Gaussians(
        means=torch.tensor([0.2, 1.0, -0.1]) + 0.4 * directions,
        quats=3 * torch.randn(count, 4, generator=draw),  # Not unit: a decoder's never are.
        scales=torch.exp(-4 + 0.7 * torch.randn(count, 3, generator=draw)),
        opacities=torch.rand(count, generator=draw),
        sh=sh,
    )


def picture(gaussians: Gaussians, side: int = 0) -> np.ndarray:
    """Premultiplied RGBA as seen from one of three sides, y up."""
    position = torch.tensor([[0.0, 1.2, 2.0], [2.0, 0.8, 0.4], [-1.0, 2.2, -1.0]])[side]
    forward = torch.nn.functional.normalize(torch.tensor([0.2, 1.0, -0.1]) - position, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 1.0, 0.0])), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    K = torch.tensor([[SIZE * 1.4, 0, SIZE / 2], [0, SIZE * 1.4, SIZE / 2], [0, 0, 1.0]])
    drawn = splat(gaussians, viewmats=viewmat[None], Ks=K[None], width=SIZE, height=SIZE)
    return torch.cat([drawn.rgb[0], drawn.alpha[0][..., None]], -1).numpy()


def agreement_db(read: Gaussians, written: Gaussians) -> float:
    """The least PSNR of three sides, on what is covered."""
    pairs = [(picture(read, side), picture(written, side)) for side in range(3)]
    assert all((ours[..., 3] > 0.5).mean() > 0.1 for _, ours in pairs), "the cloud is in the picture"
    return min(psnr(theirs[..., :3], ours[..., :3], ours[..., 3]) for theirs, ours in pairs)


READERS = {"ply": read_ply, "splat": read_splat, "spz": read_spz, "gltf": read_gltf}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("form", ["ply", "gltf"])
def test_formats_of_floats_give_our_picture_back(form: str, degree: int) -> None:
    written = cloud(degree)
    assert agreement_db(READERS[form](GAUSSIAN_FORMATS[form].write(written)), written) > 100


def test_splat_files_give_our_picture_back_as_far_as_eight_bits_go() -> None:
    flat = cloud(0)
    flat.sh.clamp_(-0.5 / SH_C0, 0.5 / SH_C0)  # It knows no colours outside of 0..1.
    assert agreement_db(read_splat(GAUSSIAN_FORMATS["splat"].write(flat)), flat) > 47
    bright = cloud(2)
    alone = Gaussians(
        means=bright.means, quats=bright.quats, scales=bright.scales, opacities=bright.opacities, sh=bright.sh[:, :1]
    )
    assert agreement_db(read_splat(GAUSSIAN_FORMATS["splat"].write(bright)), alone) > 47, "the degrees above 0 are lost"


@pytest.mark.parametrize("degree", [0, 3])
def test_spz_files_give_our_picture_back_as_far_as_eight_bits_go(degree: int) -> None:
    written = cloud(degree)
    written.sh[:, 1:].clamp_(-1, 1)
    assert agreement_db(read_spz(GAUSSIAN_FORMATS["spz"].write(written)), written) > 40


def test_spz_keeps_every_number_to_the_step_that_the_format_has() -> None:
    written = cloud(3)
    read = read_spz(GAUSSIAN_FORMATS["spz"].write(written))
    torch.testing.assert_close(read.means, written.means, atol=2**-20, rtol=0)
    torch.testing.assert_close(read.scales.log(), written.scales.log(), atol=1 / 31, rtol=0)
    torch.testing.assert_close(read.opacities, written.opacities, atol=0.51 / 255, rtol=0)
    torch.testing.assert_close(read.sh[:, 0], written.sh[:, 0], atol=0.51 / 255 / 0.15, rtol=0)
    torch.testing.assert_close(read.sh[:, 1:], written.sh[:, 1:].clamp(-1, 127 / 128), atol=0.51 / 128, rtol=0)
    unit = torch.nn.functional.normalize(written.quats, dim=-1)
    assert (read.quats * unit).sum(-1).abs().min() > 1 - 1e-5
    far = Gaussians(
        means=100 * written.means, quats=unit, scales=written.scales, opacities=written.opacities, sh=written.sh
    )
    torch.testing.assert_close(read_spz(GAUSSIAN_FORMATS["spz"].write(far)).means, far.means, atol=2**-15, rtol=0)
    with pytest.raises(InputError, match="4096 m"):
        GAUSSIAN_FORMATS["spz"].write(
            Gaussians(means=1e5 * far.means, quats=unit, scales=far.scales, opacities=far.opacities, sh=far.sh)
        )


@pytest.mark.parametrize("form", GAUSSIAN_FORMATS)
def test_a_wrong_turn_would_be_seen(form: str) -> None:
    """What the tests above hold: turned by one degree, or with rotations conjugated, the pictures part."""
    written = cloud(1)
    read = READERS[form](GAUSSIAN_FORMATS[form].write(written))
    angle = math.radians(0.5)
    assert agreement_db(turned(read, (math.cos(angle), math.sin(angle), 0.0, 0.0)), written) < 40
    mirrored = Gaussians(
        means=read.means,
        quats=read.quats * torch.tensor([1.0, -1, -1, -1]),
        scales=read.scales,
        opacities=read.opacities,
        sh=read.sh,
    )
    assert agreement_db(mirrored, written) < 40


def test_what_cannot_be_written_in_numbers_is_bounded() -> None:
    edge = cloud(0)
    edge.opacities[:3] = torch.tensor([0.0, 1.0, 1e-12])
    edge.scales[:3] = 0.0
    for form, reader in READERS.items():
        read = reader(GAUSSIAN_FORMATS[form].write(edge))
        assert all(bool(torch.isfinite(getattr(read, name)).all()) for name in ("means", "quats", "scales", "sh"))
        assert agreement_db(read, edge) > (90 if form in ("ply", "gltf") else 40)


def test_formats_have_endings_and_unknown_ones_are_refused() -> None:
    assert {suffix_of(form) for form in FORMATS} == {".ply", ".splat", ".spz", ".glb", ".bvh"}
    with pytest.raises(InputError, match="ply, splat, spz, gltf, glb, bvh"):
        suffix_of("obj")


def test_ply_has_the_62_floats_that_readers_expect(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(GAUSSIAN_FORMATS["ply"].write(cloud(1)))
    names = [p.name for p in PlyData.read(path)["vertex"].properties]
    assert len(names) == 62 and names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
