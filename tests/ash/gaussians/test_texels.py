"""The native kernels of the texels against their definitions, in value and gradient."""

from dataclasses import fields, replace

import pytest
import torch
from helpers.captures import tube_model_config, tube_template
from helpers.figures import tube_mesh, tube_motion

from ash.capture.dataset import Motion, Pose
from ash.gaussians import texels
from ash.gaussians.gaussians import Gaussians, raw_channels
from ash.gaussians.texels import Placed, pose, pose_naive, sample_surface, sample_surface_naive
from ash.rotations import RigidTransforms
from ash.template.template import PosedTemplate
from ash.textures import FrameInputs, TexelLattice, build_lattice

pytestmark = pytest.mark.usefixtures("instructions")

LATTICE = build_lattice(tube_mesh(), 70)  # 3,969 texels: two ranges, and no multiple of any vector's width


def posed_tube(motion: Motion | None = None) -> PosedTemplate:
    return tube_template().pose(Pose(motion or tube_motion(), 4))


def frame_inputs(lattice: TexelLattice = LATTICE) -> FrameInputs:
    canonical, normals, transforms = sample_surface_naive(lattice, posed_tube())
    return FrameInputs(
        textures=torch.zeros(0, 1, 1),
        motion=torch.zeros(2, 9),
        root_translation=torch.zeros(3),
        canonical=canonical,
        normals=normals,
        transforms=transforms,
    )


def raw_and_light(sh_degree: int, count: int = len(LATTICE.texels)) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    channels = raw_channels(tube_model_config(sh_degree=sh_degree))
    raw = torch.randn(count, channels, generator=generator)
    raw[:, 3:6] -= 4
    return raw, 0.3 * torch.randn(9, 3, generator=generator)


def test_texels_are_placed_as_defined():
    expected_canonical, expected_normals, expected = sample_surface_naive(LATTICE, posed_tube())
    for threads in (1, 2):
        canonical, normals, transforms = sample_surface(LATTICE, posed_tube(), threads=threads)
        torch.testing.assert_close(canonical, expected_canonical, atol=1e-6, rtol=0)
        torch.testing.assert_close(normals, expected_normals, atol=2e-6, rtol=0)
        torch.testing.assert_close(transforms.quats, expected.quats, atol=1e-6, rtol=0)
        torch.testing.assert_close(transforms.translations, expected.translations, atol=2e-6, rtol=0)


def bent(angle: float) -> Motion:
    """The tube's motion, the joint in its middle bent by so many radians."""
    motion = tube_motion()
    motion.dofs[:, 6:9] = (angle, 0.0, 0.0)
    return motion


def farthest_from_the_triangles(posed: PosedTemplate, placed: Placed) -> float:
    """How far the posed texels lie from where the mesh has them on its posed triangles, metres."""
    canonical, _, transforms = placed
    corners = posed.vertices[LATTICE.corners].double()
    on_triangles = (LATTICE.barycentric.double()[..., None] * corners).sum(1)
    return float((transforms.apply(canonical) - on_triangles).norm(dim=1).max())


@pytest.mark.parametrize(("angle", "least", "most"), [(0.0, 0.0, 1e-6), (0.3, 1e-3, 1e-2), (1.5, 1e-2, 5e-2)])
def test_blended_texels_leave_the_posed_triangles_where_a_joint_is_bent(angle, least, most, monkeypatch):
    posed = posed_tube(bent(angle))
    naive = sample_surface_naive(LATTICE, posed)
    monkeypatch.setattr(texels, "sample_surface_naive", pytest.fail)
    for placed in (naive, sample_surface(LATTICE, posed)):
        assert least <= farthest_from_the_triangles(posed, placed) <= most


def test_opposite_quaternions_of_neighbours_are_the_same_rotation():
    posed = posed_tube()
    signs = torch.where(torch.arange(len(posed.vertices)) % 3 == 0, -1.0, 1.0)[:, None]
    flipped = RigidTransforms(quats=signs * posed.transforms.quats, translations=posed.transforms.translations)
    _, _, transforms = sample_surface(LATTICE, replace(posed, transforms=flipped))
    _, _, defined = sample_surface_naive(LATTICE, replace(posed, transforms=flipped))
    torch.testing.assert_close(transforms.quats, defined.quats, atol=1e-6, rtol=0)
    points = torch.randn(len(LATTICE.texels), 3, generator=torch.Generator().manual_seed(1))
    _, _, unflipped = sample_surface(LATTICE, posed)
    torch.testing.assert_close(transforms.apply(points), unflipped.apply(points), atol=1e-5, rtol=0)


@pytest.mark.parametrize("sh_degree", [0, 2])
@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize("changes", [{}, {"offset": False}, {"quat_frame": "world"}])
def test_gaussians_are_posed_as_defined(sh_degree, lit, changes):
    config = tube_model_config(sh_degree=sh_degree, **changes)
    raw, light = raw_and_light(sh_degree)
    results = []
    for function, dtype in ((pose, torch.float32), (pose_naive, torch.float32), (pose_naive, torch.float64)):
        leaves = [leaf.to(dtype, copy=True).requires_grad_() for leaf in ((raw, light) if lit else (raw,))]
        here = frame_inputs()
        turned = RigidTransforms(
            quats=here.transforms.quats.to(dtype), translations=here.transforms.translations.to(dtype)
        )
        here = replace(here, canonical=here.canonical.to(dtype), normals=here.normals.to(dtype), transforms=turned)
        posed = function(leaves[0], here, config, leaves[1] if lit else None)
        values = [getattr(posed, field.name) for field in fields(Gaussians)]
        generator = torch.Generator().manual_seed(2)
        sum((value * torch.randn(value.shape, generator=generator).to(dtype)).sum() for value in values).backward()
        results.append([value.detach().double() for value in (*values, *(leaf.grad for leaf in leaves))])
    for native, float32, truth in zip(*results, strict=True):
        scale = truth.abs().max()
        assert (native - truth).abs().max() <= max(2 * (float32 - truth).abs().max(), 2e-6 * scale)


def test_any_number_of_threads_gives_the_same_bits():
    config, light = tube_model_config(), raw_and_light(0)[1]
    gradients = []
    for threads in (1, 3):
        raw, leaf = raw_and_light(0)[0].requires_grad_(), light.clone().requires_grad_()
        posed = pose(raw, frame_inputs(), config, leaf, threads=threads)
        (posed.means.sum() + posed.sh.square().sum() + posed.quats.sum()).backward()
        gradients.append((posed.means.detach(), raw.grad, leaf.grad))
    assert all(torch.equal(one, other) for one, other in zip(*gradients, strict=True))


def test_gradients_of_the_surface_go_through_the_definition():
    raw, _ = raw_and_light(0)
    here = frame_inputs()
    canonical = here.canonical.clone().requires_grad_()
    pose(raw, replace(here, canonical=canonical), tube_model_config(), None).means.sum().backward()
    assert canonical.grad.abs().min() > 0


@pytest.mark.parametrize("column", [0, 3, 6, 10, 11])
def test_what_is_not_finite_stays_so(column):
    """The splatter must see it, and the training with it."""
    raw, light = raw_and_light(0)
    raw[5, column] = float("nan")
    posed = pose(raw, frame_inputs(), tube_model_config(), light)
    finite = [bool(torch.isfinite(getattr(posed, field.name)).all()) for field in fields(Gaussians)]
    assert finite.count(False) == 1
