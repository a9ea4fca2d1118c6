from dataclasses import replace

import numpy as np
import pytest

from ash.capture.dataset import Motion
from ash.files import InputError
from synth.cloth.checks import penetrations, self_intersections, stretch
from synth.cloth.draping import swing
from synth.cloth.layers import layers_of, tuck_in
from synth.cloth.surface import true_surface
from synth.motion.clips import make_motion
from synth.person.mannequin import mannequin
from synth.posing import dual_quaternion_skinning, skinning_transforms
from synth.scene import Clip, Outfit

BODY = mannequin(skirt=True)
SKIRT = BODY.surface.vertices_of("skirt")
SWING = Outfit(skirt=True, swing=1.0)


def _skinned(motion: Motion) -> np.ndarray:
    transforms = skinning_transforms(BODY.skeleton, motion.dofs)
    return np.stack([dual_quaternion_skinning(BODY.surface.vertices, BODY.skin_weights, frame) for frame in transforms])


def _clips(*names: str, frames: int, seed: int = 0) -> Motion:
    return make_motion(
        BODY.skeleton, tuple(Clip(generator=name, frames=frames) for name in names), fps=12.0, seed=seed
    )  # fmt: skip


def test_the_skirt_neither_stretches_nor_lets_legs_through():
    """A jump and a squat, each in less than a second: the skinned skirt stretches to half as long again."""
    motion = _clips("jump", "squat", frames=10)
    swung = true_surface(BODY, motion, SWING, seed=0)
    assert stretch(BODY, _skinned(motion), "skirt").max() > 1.4
    assert stretch(BODY, swung, "skirt").max() < 1.08
    found = penetrations(BODY, swung)
    assert found.share.max() < 0.005 and np.median(found.deepest) < 0.003
    # The waistband goes with the hips, the hem does not: nothing hovers, nothing is thrown off.
    distance = np.linalg.norm(swung - _skinned(motion), axis=-1)[:, SKIRT]
    depth = BODY.surface.vertices[SKIRT, 1].max() - BODY.surface.vertices[SKIRT, 1]
    assert distance[:, depth < 0.02].max() < 5e-3
    assert 0.02 < np.sqrt(np.mean(distance**2)) < 0.1 and distance.max() < 0.4


def test_the_skirt_does_not_pass_through_itself():
    """Of the triangles of the simulated cage, in a walk and a dance, at most one in two hundred is pierced."""
    motion = _clips("walk", "dance", frames=8)
    swung = true_surface(BODY, motion, SWING, seed=0)[:, BODY.cage]
    assert max(self_intersections(place, BODY.cage_faces).mean() for place in swung) < 0.005


def test_a_sequence_is_the_same_alone_and_among_others():
    both = _clips("walk", "stand", frames=2)
    alone = Motion(dofs=both.dofs[2:], sequence=both.sequence[2:], fps=both.fps)
    posed = _skinned(both)
    np.testing.assert_array_equal(
        swing(BODY, both, posed, 1.0)[2:], swing(BODY, alone, posed[2:], 1.0)
    )  # fmt: skip


def test_strength_goes_from_the_skinned_skirt_to_the_free_one():
    motion = _clips("squat", frames=3)
    posed = _skinned(motion)
    np.testing.assert_array_equal(true_surface(BODY, motion, Outfit(skirt=True), seed=0), posed)
    swung = [swing(BODY, motion, posed, strength) for strength in (1e-6, 0.1, 1.0)]
    away = [np.sqrt(np.mean((each - posed)[:, SKIRT] ** 2)) for each in swung]
    assert away[0] < 1e-6 and away == sorted(away)
    assert away[2] > 2 * away[1]
    np.testing.assert_array_equal(swung[1][:, ~SKIRT], posed[:, ~SKIRT])


def test_a_single_frame_is_a_sequence_too():
    motion = _clips("stand", frames=2)
    one = Motion(dofs=motion.dofs[:1], sequence=motion.sequence[:1], fps=12.0)
    assert np.isfinite(swing(BODY, one, _skinned(one), 1.0)).all()


@pytest.mark.parametrize("strength", [-0.1, 1.1, float("nan"), float("inf")])
def test_wrong_strengths_are_refused(strength: float):
    with pytest.raises(InputError, match="swing"):
        Outfit(skirt=True, swing=strength)


def test_what_pokes_out_is_pressed_back_and_nothing_else_moves():
    rest = BODY.surface.vertices
    layers = layers_of(BODY)
    np.testing.assert_array_equal(tuck_in(layers, rest), rest)
    tight = rest.copy()
    tight[SKIRT] *= [0.72, 1, 0.8]
    assert penetrations(BODY, tight[None]).deepest[0] > 0.008
    tucked = tuck_in(layers, tight)
    assert penetrations(BODY, tucked[None]).share[0] < 0.3 * penetrations(BODY, tight[None]).share[0]
    moved = np.linalg.norm(tucked - tight, axis=1)
    assert 0.008 < moved.max() <= 0.031 and moved[SKIRT].max() == 0
    assert moved[BODY.surface.vertices_of("skin", "shoes")].max() == 0


def test_garments_keep_their_own_folds_and_a_simulated_skirt_its_own():
    motion = _clips("reach", frames=2)
    plain, folded = (true_surface(BODY, motion, replace(SWING, folds_mm=mm), seed=1) for mm in (0.0, 6.0))
    moved = np.linalg.norm(folded - plain, axis=-1)
    assert moved[:, SKIRT].max() == 0
    assert moved[:, BODY.surface.vertices_of("shirt")].max() > 0.003
