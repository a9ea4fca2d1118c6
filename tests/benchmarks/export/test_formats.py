"""Every format is read back by another program's reader and drawn by our splatter, beside our own picture."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.gaussian_files import read_gltf, read_ply, read_spz
from helpers.scoring import psnr
from plyfile import PlyData

from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import splat
from benchmarks.export.gaussians import ply_bytes, spz_bytes, turned
from benchmarks.export.gltf import gaussians_gltf

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


WRITERS = {
    "ply": (ply_bytes, read_ply),
    "spz": (spz_bytes, read_spz),
    "gltf": (partial(gaussians_gltf, binary=True), read_gltf),
    "gltf json": (partial(gaussians_gltf, binary=False), read_gltf),
}


def there_and_back(form: str, gaussians: Gaussians) -> Gaussians:
    """What another program reads of a written file."""
    write, read = WRITERS[form]
    return read(write(gaussians))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("form", WRITERS)
def test_a_file_gives_our_picture_back(form: str, degree: int) -> None:
    written = cloud(degree)
    if form == "spz":
        written.sh[:, 1:].clamp_(-1, 1)
    assert agreement_db(there_and_back(form, written), written) > (40 if form == "spz" else 100)


def test_spz_keeps_every_number_to_the_step_that_the_format_has() -> None:
    written = cloud(3)
    read = read_spz(spz_bytes(written))
    torch.testing.assert_close(read.means, written.means, atol=2**-20, rtol=0)
    torch.testing.assert_close(read.scales.log(), written.scales.log(), atol=1 / 31, rtol=0)
    torch.testing.assert_close(read.opacities, written.opacities, atol=0.51 / 255, rtol=0)
    torch.testing.assert_close(read.sh[:, 0], written.sh[:, 0], atol=0.51 / 255 / 0.15, rtol=0)
    torch.testing.assert_close(read.sh[:, 1:], written.sh[:, 1:].clamp(-1, 127 / 128), atol=0.51 / 128, rtol=0)
    unit = torch.nn.functional.normalize(written.quats, dim=-1)
    assert (read.quats * unit).sum(-1).abs().min() > 1 - 1e-5
    far = replace(written, means=100 * written.means)
    torch.testing.assert_close(read_spz(spz_bytes(far)).means, far.means, atol=2**-15, rtol=0)
    with pytest.raises(InputError, match="4096 m"):
        spz_bytes(replace(far, means=1e5 * far.means))


def test_a_wrong_turn_would_be_seen() -> None:
    """What the tests above hold: turned by one degree, or with rotations conjugated, the pictures part."""
    written = cloud(1)
    read = there_and_back("ply", written)  # which loses nothing by itself
    angle = math.radians(0.5)
    assert agreement_db(turned(read, (math.cos(angle), math.sin(angle), 0.0, 0.0)), written) < 40
    mirrored = replace(read, quats=read.quats * torch.tensor([1.0, -1, -1, -1]))
    assert agreement_db(mirrored, written) < 40


@pytest.mark.parametrize("form", WRITERS)
def test_what_cannot_be_written_in_numbers_is_bounded(form: str) -> None:
    edge = cloud(0)
    edge.opacities[:3] = torch.tensor([0.0, 1.0, 1e-12])
    edge.scales[:3] = 0.0
    read = there_and_back(form, edge)
    assert all(bool(torch.isfinite(getattr(read, name)).all()) for name in ("means", "quats", "scales", "sh"))
    assert agreement_db(read, edge) > (40 if form == "spz" else 90)


def test_ply_has_the_62_floats_that_readers_expect(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply_bytes(cloud(1)))
    names = [p.name for p in PlyData.read(path)["vertex"].properties]
    assert len(names) == 62 and names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
