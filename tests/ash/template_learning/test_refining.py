"""What images add to a template: through the mesh of DDC, and through the splats of ASH."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.captures import paint_tube, tube_model_config, write_tube_capture
from helpers.figures import tube_mesh
from helpers.learning import tiny_mesh

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose
from ash.config import TemplateConfig
from ash.presets import plus
from ash.template.template import skinned_template
from ash.template_learning.refining import UNIT_M, MotionRefinement, Refinement, refined_template
from baselines.ddc import DdcAvatar, ddc_config


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Capture:
    """Pictures of a textured tube, for methods whose template is 15 mm too thick from its waist up."""
    made = write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")
    true = skinned_template(made)
    texture = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0))
    texture, mesh = texture.repeat_interleave(4, 1).repeat_interleave(4, 2), made.template
    paint_tube(made, texture, lambda pose: true.pose(pose).vertices)
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


def let_it_move(refinement: MotionRefinement, spread: float) -> None:
    """Let the heads of its networks say something."""
    torch.manual_seed(0)
    for net in (refinement.nets.graph_net, refinement.nets.displacement_net):
        torch.nn.init.normal_(net.head.weight, std=spread)


def test_a_refined_template_is_the_old_one_moved_and_all_that_is_drawn_from_it_follows(capture):
    old = skinned_template(capture)
    refined, refinement = refined_template(old, TemplateConfig(nodes=30))
    pose = Pose(capture.motion, 2)
    torch.testing.assert_close(refined.pose(pose).vertices, old.pose(pose).vertices, atol=1e-6, rtol=0)
    let_it_move(refinement, 0.01)
    refined.clear_cache()
    shift, other = (refinement(refinement.window(Pose(capture.motion, frame))).detach() for frame in (2, 3))
    assert float(shift.norm(dim=1).max()) > 1e-4 and not torch.equal(shift, other)
    after, before = refined.pose(pose), old.pose(pose)
    torch.testing.assert_close(after.canonical, before.canonical + shift)
    assert not torch.allclose(after.normals, before.normals, atol=1e-4)
    learning = refined.pose_uncached(pose)
    (learning.vertices.square().sum() + learning.normals[:, 0].sum()).backward()
    parameters = [*refinement.nets.networks(), refinement.shared.rough]
    assert all(p.grad is not None and p.grad.any() for p in parameters if p.requires_grad)


def test_splats_of_a_refined_template_see_textures_redrawn_from_it(capture):
    avatar = AshAvatar.from_capture(replace(plus("ci"), model=tube_model_config(refine=True)), capture)
    before = avatar._inputs_of(1)
    assert before.canonical.requires_grad and before.normals.requires_grad and not before.textures.requires_grad
    let_it_move(avatar.module.refinement, 0.05)
    after = avatar._inputs_of(1)
    assert not torch.allclose(after.textures, before.textures, atol=1e-4)
    assert not torch.allclose(after.canonical, before.canonical, atol=1e-5)


def ddc(capture: Capture, *, refine: str) -> DdcAvatar:
    config = tiny_mesh({"training.base_learning_rate": 0.1}, refine=refine, steps=80, warmup_steps=40)
    return DdcAvatar.from_capture(config, capture)


def test_ddc_moves_its_vertices_to_where_the_images_show_them(capture, tmp_path):
    learner = ddc(capture, refine="static")
    assert learner.module.refinement is not None
    rest = torch.from_numpy(capture.template.vertices).float()
    learner.fit(capture, folder=tmp_path)
    after = excess_mm(rest + learner.module.refinement().detach())
    assert excess_mm(rest) > 14 and after < 12  # A pixel is 32 mm wide.
    posed = learner.template_vertices(Pose(capture.motion, 5))  # A frame of the test motion: refined there too.
    before = learner.template.pose(Pose(capture.motion, 5)).vertices.numpy()
    assert np.abs(posed - before).max() > 5e-3


def test_without_refine_ddc_draws_the_template_it_was_given(capture):
    still = ddc(capture, refine="none")
    assert still.module.refinement is None
    inputs = still.module.frame_inputs(Pose(capture.motion, 2))
    posed = still.module.refined(inputs)
    assert posed is inputs.posed
    np.testing.assert_array_equal(still.template_vertices(Pose(capture.motion, 2)), posed.vertices.numpy())


def test_an_exact_surface_is_not_refined():
    exact, off = (TemplateConfig(kind="exact", error_mm=mm) for mm in (0.0, 4.0))
    assert ddc_config(plus("ci"), seed=0, template=exact).refine == "none"
    assert ddc_config(plus("ci"), seed=0, template=off).refine == "static"


def test_splats_pull_at_the_template_where_refine_is_on(capture, tmp_path):
    ash = plus("ci")
    training = replace(ash.training, steps=24, warmup_steps=16, base_learning_rate=0.15)
    config = replace(ash, model=tube_model_config(refine=True, offset=False), training=training)
    learner = AshAvatar.from_capture(config, capture)
    rest = torch.from_numpy(capture.template.vertices).float()
    before = learner.template_vertices(Pose(capture.motion, 1))
    learner.fit(capture, folder=tmp_path)
    assert learner.module.refinement is not None
    assert excess_mm(rest + learner.module.refinement.shared().detach()) < excess_mm(rest) - 1
    assert np.abs(learner.template_vertices(Pose(capture.motion, 1)) - before).max() > 1e-3
    learner.save(tmp_path / "model.safetensors")
    again = AshAvatar.from_capture(config, capture)
    again.load(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(*(each.template_vertices(Pose(capture.motion, 1)) for each in (again, learner)))
