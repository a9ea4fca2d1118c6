"""The rung of known Gaussians: a capture like any other, in which the truth is what the splatter draws."""

import numpy as np
import pytest
import torch

from ash.avatar import AshAvatar
from ash.capture.dataset import Pose
from ash.capture.formats import load_capture, read_template_truth
from ash.capture.manifest import verify_capture
from ash.presets import named
from ash.protocol import StageClock
from ash.template.template import RestDeformation, Template
from benchmarks.suites.captures import make_capture
from benchmarks.suites.splats import CI_TEXELS, draw_view, known_avatar
from benchmarks.suites.suites import CaptureSpec


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    drawn = make_capture(CaptureSpec(scene="splats", size="ci"), folder, workers=1)
    assert make_capture(CaptureSpec(scene="splats", size="ci"), folder, workers=1) == drawn
    return load_capture(drawn)


def test_the_capture_is_whole_and_its_template_exact(capture):
    assert verify_capture(capture.folder) == []
    template = Template(capture.template, capture.skeleton, RestDeformation(capture.template))
    posed = template.pose(Pose(capture.motion, 3)).vertices.numpy()
    np.testing.assert_allclose(posed, read_template_truth(capture)[3], atol=1e-6)


def test_the_known_gaussians_lose_nothing_but_the_quantisation(capture):
    template = Template(capture.template, capture.skeleton, RestDeformation(capture.template))
    model = known_avatar(template, texels=CI_TEXELS, seed=0)
    camera, frame = capture.splits["novel_pose"].views[0]
    np.testing.assert_array_equal(
        draw_view(model, Pose(capture.motion, frame), capture.cameras[camera]), capture.image(camera, frame)
    )
    image = capture.image(camera, frame)
    inside = image[..., 3] > 200
    assert 0.02 < inside.mean() < 0.6
    assert image[inside][:, :3].std() > 20  # There is something to recover.


def test_given_the_known_gaussians_ash_draws_the_images(capture):
    """The preset's lattice holds the truth: what remains between 42 dB and perfect is training."""
    avatar = AshAvatar(named("ci"), capture.training_only())
    known = known_avatar(avatar.template, texels=CI_TEXELS, seed=0)
    assert torch.equal(known.lattice.texels, avatar.lattice.texels)
    with torch.no_grad():
        avatar.module.base.copy_(known.base)
    avatar.end_warmup()  # The static avatar, which counts in poses never seen, starts from there.
    camera, frame = capture.splits["novel_pose"].views[0]
    drawn = avatar.render(Pose(capture.motion, frame), capture.cameras[camera], clock=StageClock())
    truth = capture.image(camera, frame).astype(np.float64) / 255
    foreground = truth[..., 3] > 0.5
    error = (drawn[..., :3] - truth[..., :3] * truth[..., 3:])[foreground]
    assert -10 * np.log10((error**2).mean()) > 50
