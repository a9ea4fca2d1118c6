from dataclasses import replace

import numpy as np
import pytest
from helpers.squares import camera, squares, studio

from synth.camera.lighting import is_plain, make_integrator, make_lamps, make_sky, sky_and_lamps
from synth.camera.render import Studio, probe
from synth.camera.rig import look_at
from synth.scene import Light

VIEW = camera(64, 64, fx=60.0, fy=60.0)
# One square before another one, which it shades, and a third seen from behind.
PLACES = np.array([[0.0, 0.3, 0.0], [0.25, 0.6, 0.6], [-0.6, -0.5, 0.2]])


def _mean(place: Studio, pose: np.ndarray, samples: int) -> tuple[np.ndarray, float]:
    """Colour of the squares, mean over their pixels in 0..1, and the mean variance of a pixel."""
    picture = place.render(pose, [VIEW], samples=samples, seeds=[7])[0]
    inside = picture.rgba[..., 3] == 255
    return picture.rgba[inside][:, :3].mean(axis=0) / 255, float(picture.noise[inside].mean())


@pytest.mark.parametrize("light", [Light(), Light(falloff=1.0), Light(sky=0.2)], ids=["plain", "lamp", "dim"])
def test_sky_and_lamps_gather_what_the_general_estimator_does(light: Light):
    renderer = probe()
    if not renderer.libllvm:
        pytest.skip("scalar_rgb always uses the general estimator")
    surface = studio(3).surface
    pose = squares(PLACES, 0.35)
    pose[8:] = pose[8:][[1, 0, 3, 2]]  # Wound the other way: its back is seen.
    place = Studio(renderer, surface, np.full((8, 8, 3), 128, dtype=np.uint8), light, depth=2)
    assert is_plain(light, depth=2, vectorised=True)
    fast, noise = _mean(place, pose, 800)
    place.plain, place.lights["sky"] = False, make_sky(place.mi, light)
    place.integrator = make_integrator(place.mi, light, depth=2)
    place.dress(pose)
    general, general_noise = _mean(place, pose, 800)
    np.testing.assert_allclose(fast, general, rtol=2e-3)
    assert noise < 1.3 * general_noise
    assert 0.1 < fast.mean() < 0.9


@pytest.mark.parametrize("gloss", [0.0, 0.5, 1.0])
def test_only_gloss_looks_different_from_elsewhere(gloss: float):
    """A square under the key lamp, seen from where the lamp mirrors in it, from above, and with a lamp behind it."""
    centre = np.array([0.0, 1.0, 0.0])
    mirrored = np.array([-10.4, -10.4, 12.8])
    colours = []
    place = Studio(probe(), studio(1).surface, np.full((8, 8, 3), 128, dtype=np.uint8), Light(gloss=gloss), depth=2)
    for towards in (mirrored, [3.0, 9.0, 9.0], [5.0, -4.0, 12.0]):
        position = centre + 3 * np.array(towards) / np.linalg.norm(towards)
        view = replace(VIEW, viewmat=look_at(position, centre))
        picture = place.render(squares(centre[None], 0.3), [view], samples=200, seeds=[1])[0]
        assert abs(int((picture.rgba[..., 3] > 127).sum()) - int((picture.triangle >= 0).sum())) < 8  # No lamp is seen.
        colours.append(picture.rgba[picture.rgba[..., 3] == 255][:, :3].mean(axis=0) / 255)
    highlight, *others = np.array(colours)
    assert np.abs(others[0] - others[1]).max() < 0.03
    if gloss == 0:
        assert np.abs(highlight - others).max() < 0.005
    else:
        assert (highlight - others).min() > 0.2 * gloss
        assert np.ptp(np.mean(others, axis=0)) < 0.08  # Grey cloth stays grey beside the highlight.


def test_gloss_bounces_and_other_renderers_use_the_general_one():
    assert not is_plain(Light(gloss=0.5), depth=2, vectorised=True)
    assert not is_plain(Light(), depth=3, vectorised=True)
    assert not is_plain(Light(), depth=2, vectorised=False)
    mi = studio(1).mi
    assert set(make_lamps(mi, Light())) == {"key", "fill", "rim"} and not make_lamps(mi, Light(area=0.0))
    assert sky_and_lamps(mi, Light()) is not None
