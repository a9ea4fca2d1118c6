import numpy as np
import torch
from helpers.captures import tube_template
from helpers.figures import tube_mesh, tube_motion
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Motion, Pose
from ash.rotations import RigidTransforms, rotvec_to_unitquat
from ash.template.motion import normalised_motion
from ash.textures import TextureDrawer, build_lattice, motion_aware_textures, texture_statistics

RESOLUTION = 16
LATTICE = build_lattice(tube_mesh(), RESOLUTION)
TEMPLATE = tube_template()


def covered(texture: torch.Tensor) -> torch.Tensor:
    return texture.flatten(1).T[LATTICE.texels]


def test_texels_lie_where_the_atlas_says():
    """The tube's atlas is its unrolling, so a texel's row gives its height and its column its angle."""
    points = LATTICE.interpolate(torch.from_numpy(tube_mesh().vertices).float()).numpy()
    rows, columns = np.divmod(LATTICE.texels.numpy(), RESOLUTION)
    u, v = (columns + 0.5) / RESOLUTION, 1 - (rows + 0.5) / RESOLUTION
    np.testing.assert_allclose(points[:, 1], (v - 0.05) / 0.9, atol=1e-5)
    angle = np.arctan2(points[:, 0], points[:, 2])
    expected = (u - 0.05) / 0.9 * 2 * np.pi
    assert np.abs((angle - expected + np.pi) % (2 * np.pi) - np.pi).max() < 0.05  # A chord of 30 degrees, not an arc.


def test_every_texel_inside_the_atlas_is_covered_once():
    inside = (np.arange(RESOLUTION) + 0.5) / RESOLUTION
    covered = ((inside > 0.05) & (inside < 0.95)).sum()
    assert len(LATTICE.texels) == covered**2
    assert len(torch.unique(LATTICE.texels)) == len(LATTICE.texels)
    torch.testing.assert_close(LATTICE.barycentric.sum(1), torch.ones(len(LATTICE.texels)))
    assert (LATTICE.barycentric >= 0).all()


def test_texture_and_texels_are_inverse():
    values = torch.randn(len(LATTICE.texels), 5)
    texture = LATTICE.to_texture(values)
    assert texture.shape == (5, RESOLUTION, RESOLUTION)
    assert torch.equal(covered(texture), values)
    row, column = divmod(int(LATTICE.texels[7]), RESOLUTION)
    assert torch.equal(texture[:, row, column], values[7])
    assert int((texture.abs().sum(0) > 0).sum()) == len(values)


def test_texel_transforms_of_a_rigid_motion_are_that_motion():
    quat, shift = rotvec_to_unitquat(torch.tensor([0.4, 2.0, -1.0])), torch.tensor([1.0, 2.0, 3.0])
    signs = torch.where(torch.arange(len(tube_mesh().vertices)) % 3 == 0, -1.0, 1.0)[:, None]
    rigid = RigidTransforms(quats=signs * quat, translations=shift.expand(len(signs), 3))
    texel = LATTICE.interpolate_transforms(rigid)
    points = torch.randn(len(LATTICE.texels), 3)
    expected = RigidTransforms(quats=quat.expand(len(points), 4), translations=shift.expand(len(points), 3)).apply(
        points
    )
    torch.testing.assert_close(texel.apply(points), expected, atol=2e-5, rtol=0)


def test_posed_texels_are_close_to_the_posed_surface():
    """Carrying a texel (Eq. 5) and interpolating posed vertices agree up to the bend of one triangle."""
    posed = TEMPLATE.pose(Pose(tube_motion(), 5))
    carried = LATTICE.interpolate_transforms(posed.transforms).apply(LATTICE.interpolate(posed.canonical))
    assert float((carried - LATTICE.interpolate(posed.vertices)).norm(dim=1).max()) < 0.01


def moved(motion: Motion, shift, yaw: float) -> Motion:
    turn = Rotation.from_rotvec([0, yaw, 0])
    dofs = motion.dofs.copy()
    dofs[:, :3] = turn.apply(dofs[:, :3]) + shift
    dofs[:, 3:6] = (turn * Rotation.from_rotvec(dofs[:, 3:6])).as_rotvec()
    return Motion(dofs=dofs, sequence=motion.sequence, fps=motion.fps)


def textures(motion, *, yaw_normalise: bool) -> torch.Tensor:
    return motion_aware_textures(TEMPLATE, LATTICE, Pose(motion, 4), window=3, yaw_normalise=yaw_normalise)


def test_textures_ignore_where_the_person_stands_and_on_request_where_it_faces():
    motion = tube_motion()
    for yaw_normalise in (True, False):
        here = textures(motion, yaw_normalise=yaw_normalise)
        there = textures(moved(motion, [5.0, 0, -2.0], 0.0), yaw_normalise=yaw_normalise)
        torch.testing.assert_close(there, here, atol=1e-5, rtol=0)
    turned = moved(motion, [0, 0, 0], 1.1)
    straight = textures(motion, yaw_normalise=True)
    torch.testing.assert_close(textures(turned, yaw_normalise=True), straight, atol=1e-5, rtol=0)
    unturned = textures(motion, yaw_normalise=False)
    assert not torch.allclose(textures(turned, yaw_normalise=False), unturned, atol=0.1)


def test_textures_hold_normals_then_positions_newest_frame_first():
    motion = tube_motion()
    posed = TEMPLATE.pose(Pose(motion, 4))
    stacked = covered(textures(motion, yaw_normalise=False))
    assert stacked.shape[1] == 18
    torch.testing.assert_close(stacked[:, :3], LATTICE.interpolate(posed.normals))
    root = torch.from_numpy(motion.dofs[4, :3]).float()
    torch.testing.assert_close(stacked[:, 3:6], LATTICE.interpolate(posed.vertices) - root, atol=1e-6, rtol=0)
    before = TEMPLATE.pose(Pose(motion, 3))
    torch.testing.assert_close(stacked[:, 9:12], LATTICE.interpolate(before.vertices) - root, atol=1e-6, rtol=0)


def test_normalised_motion_ignores_where_the_person_stands_and_if_asked_where_it_faces():
    motion = tube_motion()
    here = normalised_motion(Pose(motion, 4), window=3, yaw_normalise=True)
    there = normalised_motion(Pose(moved(motion, [5.0, 0, -2.0], 1.1), 4), window=3, yaw_normalise=True)
    torch.testing.assert_close(there, here, atol=1e-5, rtol=0)
    assert not here[0, :3].any()
    unchanged = torch.from_numpy(motion.dofs[[4, 3, 2], 6:]).float()
    assert torch.equal(here[:, 6:], unchanged)
    as_it_is = normalised_motion(Pose(motion, 4), window=3, yaw_normalise=False)
    shifted = normalised_motion(Pose(moved(motion, [5.0, 0, -2.0], 0.0), 4), window=3, yaw_normalise=False)
    turned = normalised_motion(Pose(moved(motion, [0.0, 0, 0.0], 1.1), 4), window=3, yaw_normalise=False)
    torch.testing.assert_close(shifted, as_it_is, atol=1e-5, rtol=0)
    torch.testing.assert_close(as_it_is[:, 3:], torch.from_numpy(motion.dofs[[4, 3, 2], 3:]).float())
    assert (turned[:, 3:6] - as_it_is[:, 3:6]).norm(dim=1).min() > 0.5


def test_statistics_are_of_the_motion_not_of_the_body():
    motion = tube_motion()
    drawn = [
        motion_aware_textures(TEMPLATE, LATTICE, Pose(motion, frame), window=2, yaw_normalise=True)
        for frame in range(6)
    ]
    mean, deviation = texture_statistics(drawn)
    standardised = torch.stack([covered((texture - mean) / deviation) for texture in drawn])
    torch.testing.assert_close(standardised.mean(0), torch.zeros_like(standardised[0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(standardised.square().mean((0, 1)).sqrt(), torch.ones(12), atol=1e-3, rtol=0)


def test_a_standardised_drawer_is_restored_by_its_checkpoint():
    motion = tube_motion()
    plain, seen, restored = (
        TextureDrawer(LATTICE, window=2, yaw_normalise=True, standardise=standardise)
        for standardise in (False, True, True)
    )
    seen.fit_normalization(TEMPLATE, motion, (0, 1, 2, 3))
    restored.load_state_dict(seen.state_dict())
    assert torch.equal(restored(TEMPLATE, Pose(motion, 5)), seen(TEMPLATE, Pose(motion, 5)))
    mean, spread = texture_statistics([plain(TEMPLATE, Pose(motion, frame)) for frame in (0, 1, 2, 3)])
    expected = ((plain(TEMPLATE, Pose(motion, 5)) - mean) / spread).clamp(-3, 3)
    assert torch.equal(seen(TEMPLATE, Pose(motion, 5)), expected)
    assert not plain.state_dict()


def test_what_was_never_seen_is_not_far_from_what_was():
    motion = tube_motion()
    drawer = TextureDrawer(LATTICE, window=2, yaw_normalise=True, standardise=True)
    drawer.fit_normalization(TEMPLATE, motion, (0, 0))  # One pose: every other one is infinitely unusual.
    assert not drawer(TEMPLATE, Pose(motion, 0)).any()
    assert drawer(TEMPLATE, Pose(motion, 5)).abs().max() == 3
