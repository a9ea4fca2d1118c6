"""What images add to a template: through the mesh of DDC, through the splats of ASH, and from videos alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.captures import tube_model_config, write_tube_capture
from helpers.figures import tube_mesh

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose, image_path
from ash.config import TemplateConfig
from ash.files import InputError, write_image
from ash.mesh.drawing import blend, draw_mesh, sample_texture, topology_of
from ash.presets import named
from ash.template.graph import build_graph
from ash.template.refining import UNIT_M, Refinement
from ash.template.template import skinned_template
from ash.template_learning.image_tracking import track_images
from ash.template_learning.tracking import track_vertices
from baselines.ddc import DdcAvatar, ddc_config


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Capture:
    """Pictures of a textured tube, for methods whose template is 15 mm too thick from its waist up."""
    made = write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")
    true = skinned_template(made)
    texture = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0)).repeat_interleave(4, 1)
    texture, mesh, topology = texture.repeat_interleave(4, 2), made.template, topology_of(true.faces)
    uvs, uv_faces = torch.from_numpy(mesh.uvs).float(), torch.from_numpy(mesh.uv_faces)
    for camera, frame in [view for split in made.splits.values() for view in split.views]:
        posed = true.pose(Pose(made.motion, frame))
        shade = lambda t, w: sample_texture(texture, blend(uvs, uv_faces[t], w))  # noqa: E731
        drawn = draw_mesh(posed.vertices, topology, made.cameras[camera], shade, torch.zeros(3))
        straight = torch.cat([drawn[..., :3] / drawn[..., 3:].clamp(min=0.25), drawn[..., 3:]], -1)
        write_image(image_path(made.folder, camera, frame), (255 * straight).round().to(torch.uint8).numpy())
    thicker = mesh.vertices * np.where(mesh.vertices[:, 1:2] > 0.4, [1.15, 1, 1.15], 1.0)
    return replace(made, template=replace(mesh, vertices=thicker))


def excess_mm(canonical: torch.Tensor) -> float:
    """How much thicker than the truth the upper tube is, on average."""
    rest = tube_mesh().vertices
    upper = (rest[:, 1] > 0.45) & (rest[:, 1] < 0.95)
    return float(1e3 * (canonical[:, [0, 2]].norm(dim=1).numpy()[upper] - 0.1).mean())


def test_a_refinement_starts_at_nothing_and_is_smooth():
    refinement = Refinement(tube_mesh())
    assert not refinement().any()
    with torch.no_grad():
        refinement.rough[50] = 1.0
    moved = refinement().detach()[:, 0]
    assert (moved > 0).sum() > 20 and moved.max() < 0.2 * UNIT_M and moved.argmax() == 50
    refinement().sum().backward()
    assert (refinement.rough.grad > 0).all()


def ddc(capture: Capture, *, refine: bool) -> DdcAvatar:
    ash = named("ci")
    model = replace(ash.model, texels=16, width=4, levels=2, window=2)
    training = replace(ash.training, steps=120, warmup_steps=60, base_learning_rate=0.1)
    config = ddc_config(replace(ash, model=model, training=training), seed=0, template=TemplateConfig())
    return DdcAvatar(replace(config, refine=refine), capture)


def test_ddc_moves_its_vertices_to_where_the_images_show_them(capture, tmp_path):
    learner = ddc(capture, refine=True)
    assert learner.module.refinement is not None
    rest = torch.from_numpy(capture.template.vertices).float()
    learner.fit(capture, folder=tmp_path)
    after = excess_mm(rest + learner.module.refinement().detach())
    assert excess_mm(rest) > 14 and after < 12  # A pixel is 32 mm wide.
    posed = learner.template_vertices(Pose(capture.motion, 5))  # A frame of the test motion: refined there too.
    before = learner.template.pose(Pose(capture.motion, 5)).vertices.numpy()
    assert np.abs(posed - before).max() > 5e-3


def test_without_refine_ddc_draws_the_template_it_was_given(capture):
    still = ddc(capture, refine=False)
    assert still.module.refinement is None
    posed = still.template.pose(Pose(capture.motion, 2))
    assert still.module.refined(posed) is posed
    np.testing.assert_array_equal(still.template_vertices(Pose(capture.motion, 2)), posed.vertices.numpy())


def test_an_exact_surface_is_not_refined():
    exact, off = (TemplateConfig(kind="exact", error_mm=mm) for mm in (0.0, 4.0))
    assert not ddc_config(named("ci"), seed=0, template=exact).refine
    assert ddc_config(named("ci"), seed=0, template=off).refine


def test_splats_pull_at_the_template_where_refine_is_on(capture, tmp_path):
    ash = named("ci")
    training = replace(ash.training, steps=100, warmup_steps=50, base_learning_rate=0.05)
    config = replace(ash, model=tube_model_config(refine=True), training=training)
    learner = AshAvatar(config, capture)
    rest = torch.from_numpy(capture.template.vertices).float()
    before = learner.template_vertices(Pose(capture.motion, 1))
    learner.fit(capture, folder=tmp_path)
    assert learner.module.refinement is not None
    assert excess_mm(rest + learner.module.refinement().detach()) < excess_mm(rest) - 1
    assert np.abs(learner.template_vertices(Pose(capture.motion, 1)) - before).max() > 1e-3
    learner.save(tmp_path / "model.safetensors")
    again = AshAvatar(config, capture)
    again.load(tmp_path / "model.safetensors")
    assert np.array_equal(
        again.template_vertices(Pose(capture.motion, 1)), learner.template_vertices(Pose(capture.motion, 1))
    )


def test_refining_needs_the_offset_it_moves_gaussians_by():
    with pytest.raises(InputError, match="needs offset=True"):
        tube_model_config(refine=True, offset=False)


def test_videos_alone_show_where_the_surface_is(capture, monkeypatch):
    for name, value in {"STEPS": 120, "SHARED_STEPS": 60, "TEXTURE": 32, "RATE": 0.1, "MOVE_RATE": 0.2}.items():
        monkeypatch.setattr(f"ash.template_learning.image_tracking.{name}", value)
    skinned = skinned_template(capture)
    rest = torch.from_numpy(capture.template.vertices).float()
    tracked = track_images(capture, skinned, build_graph(capture.template, nodes=30), seed=0)
    true = track_vertices(capture, skinned)
    assert tracked.canonical.shape == true.canonical.shape
    assert np.mean([abs(excess_mm(frame)) for frame in tracked.canonical]) < 0.65 * excess_mm(rest)
