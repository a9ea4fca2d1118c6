"""The factor scene of known Gaussians: a capture like any other, in which the truth is what the splatter draws."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.scoring import foreground_psnr

from ash.avatar import AshAvatar
from ash.capture.dataset import Pose
from ash.capture.formats import load_capture, read_template_truth
from ash.capture.manifest import verify_capture
from ash.presets import plus
from ash.template.template import RestDeformation, Template
from benchmarks.suites.captures import make_capture
from benchmarks.suites.splats import CI_COUNT, draw_view, known_avatar
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
    model = known_avatar(template, count=CI_COUNT, seed=0)
    camera, frame = capture.splits["novel_pose"].views[0]
    np.testing.assert_array_equal(
        draw_view(model, Pose(capture.motion, frame), capture.cameras[camera]), capture.image(camera, frame)
    )
    image = capture.image(camera, frame)
    inside = image[..., 3] > 200
    assert 0.02 < inside.mean() < 0.6
    assert image[inside][:, :3].std() > 20  # There is something to recover.


def test_the_truth_is_none_of_the_methods_gaussians(capture):
    avatar = AshAvatar.from_capture(plus("ci"), capture.training_only())
    known = known_avatar(avatar.template, count=CI_COUNT, seed=0)
    assert len(known.base_texels) > 1.5 * len(avatar.module.base_texels)
    rest = torch.from_numpy(capture.template.vertices).float()
    own, theirs = avatar.lattice.interpolate(rest), known.lattice.interpolate(rest)
    nearest = torch.cdist(theirs, own).min(1).values
    pitch = float(torch.cdist(own[:500], own).sort(1).values[:, 1].median())
    assert float(nearest.median()) > 0.2 * pitch, "they do not lie on the texels"
    scales = known.base_texels.detach()[:, 3:6].exp()
    assert float((scales.max(1).values / scales.min(1).values).std()) > 0.5, "of many shapes"
    opacities = known.base_texels.detach()[:, 10].sigmoid()
    assert float(opacities.min()) < 0.4 and float(opacities.max()) > 0.95


def test_ash_recovers_them_by_training(capture, tmp_path):
    avatar = AshAvatar.from_capture(replace(plus("ci"), model=replace(plus("ci").model, motion=False)), capture)
    seen = capture.training_only()
    camera, frame = capture.splits["novel_pose"].views[0]
    before = foreground_psnr(avatar, capture, [(camera, frame)])
    avatar.fit(seen, folder=tmp_path)
    assert foreground_psnr(avatar, capture, [(camera, frame)]) > max(before + 8, 21)
