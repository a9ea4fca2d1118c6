"""The references: what a method must beat, and the bounds it is measured against."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.captures import tiny_plus, tiny_preset
from helpers.figures import tube_mesh
from helpers.scoring import draw, foreground_psnr

from ash import presets
from ash.capture.dataset import Camera, Capture, Motion, Pose, image_path
from ash.capture.formats import load_capture, write_template
from ash.files import InputError, write_image
from ash.presets import ash_plus
from ash.protocol import Avatar, StageClock
from baselines.ablations import smpl
from baselines.field import neural_actor
from baselines.nearest import central_frame, move_image, nearest, see_root
from baselines.oracle_texture import oracle_texture
from baselines.per_frame import PerFrameAvatar, per_frame
from baselines.static import of_one_frame, static
from benchmarks.cell.registry import WRONG_BY_MM, find_method


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(presets.PRESETS, "ci", partial(tiny_preset, steps=40, warmup_steps=10))


def test_nearest_gives_a_training_image_back(capture):
    made = nearest(capture.training_only(), seed=0, preset="ci")
    assert isinstance(made, Avatar)
    for camera, frame in capture.splits["train"].views:
        truth = capture.image(camera, frame).astype(np.float32) / 255
        drawn = draw(made, capture, camera, frame)
        np.testing.assert_allclose(drawn[..., :3], truth[..., :3] * truth[..., 3:], atol=1e-4)
        np.testing.assert_allclose(drawn[..., 3], truth[..., 3], atol=1e-4)


def test_nearest_takes_the_neighbouring_camera_and_the_most_alike_pose(capture):
    made = nearest(capture.training_only(), seed=0, preset="ci")
    turned = capture.motion.dofs.copy()
    turned[:, 6:] += 0.01  # A little different from training, most alike its own frame.
    motion = Motion(dofs=turned, sequence=capture.motion.sequence, fps=capture.motion.fps)
    for frame in capture.splits["train"].frames:
        drawn = made.render(Pose(motion, frame), capture.cameras["cam0"], clock=StageClock())
        expected = [draw(made, capture, side, frame) for side in ("cam1", "cam4")]
        assert min(np.abs(drawn[..., 3].mean() - image[..., 3].mean()) for image in expected) < 0.03


def test_an_image_is_moved_and_scaled_to_where_the_root_is_seen(capture):
    camera, frame = capture.cameras["cam1"], 0
    closer = replace(camera, viewmat=camera.viewmat.copy(), K=camera.K * np.array([[2.0], [2.0], [1.0]]))
    wide = Camera(name="wide", width=96, height=96, K=closer.K, viewmat=camera.viewmat)
    seen, wanted = (see_root(capture.skeleton, Pose(capture.motion, frame), c) for c in (camera, wide))
    image = capture.image("cam1", frame)
    moved = move_image(image, seen, wanted, wide)
    assert moved.shape == (96, 96, 4)
    assert moved[..., 3].sum() == pytest.approx(4 * (image[..., 3] / 255).sum(), rel=0.03)


def test_the_central_frame_is_nearest_to_the_others_whatever_its_heading():
    dofs = np.zeros((3, 12))
    dofs[0, 6:9], dofs[0, 9:12] = (0.0, 0.3, 0.0), (0.0, 0.0, 0.4)
    dofs[1, 6:9] = (0.5, 0.0, 0.0)
    dofs[2, 3:6] = (0.0, 2.0, 0.0)  # turned, and straight
    motion = Motion(dofs=dofs, sequence=np.zeros(3, dtype=np.int64), fps=1.0)
    assert central_frame(motion, (0, 1, 2)) == 2


def test_static_learns_its_one_frame_and_reads_no_other(capture, tmp_path):
    seen = capture.training_only()
    (frame,) = of_one_frame(seen).splits["train"].frames
    assert frame in seen.splits["train"].frames
    alone = replace(seen, folder=tmp_path / "alone")
    for camera in seen.splits["train"].cameras:
        there = image_path(alone.folder, camera, frame)
        there.parent.mkdir(parents=True)
        shutil.copy(image_path(capture.folder, camera, frame), there)
    made = static(alone, seed=0, preset="ci")
    views = [(camera, frame) for camera in seen.splits["train"].cameras]
    before = foreground_psnr(made, capture, views)
    made.fit(alone, folder=tmp_path / "run")
    assert foreground_psnr(made, capture, views) > before + 2
    assert not made.config.model.motion


def test_oracle_texture_recovers_a_texture_on_the_exact_surface(capture, tmp_path):
    known = oracle_texture(capture, seed=0, preset="ci")
    assert known.parameter_count() == known.module.base_texture.numel() + 27
    known.module.base_texture.data = torch.rand(3, 8, 8).repeat_interleave(4, 1).repeat_interleave(4, 2)
    folder = shutil.copytree(capture.folder, tmp_path / "capture")
    for camera, frame in {view for split in capture.splits.values() for view in split.views}:
        drawn = draw(known, capture, camera, frame)
        straight = np.concatenate([drawn[..., :3] / np.maximum(drawn[..., 3:], 0.25), drawn[..., 3:]], -1)
        write_image(image_path(folder, camera, frame), (255 * straight).round().astype(np.uint8))
    redrawn = load_capture(folder)
    made = oracle_texture(redrawn, seed=0, preset="ci")
    views = redrawn.splits["novel_view"].views
    before = foreground_psnr(made, redrawn, views)
    made.fit(redrawn, folder=tmp_path / "run")
    assert foreground_psnr(made, redrawn, views) > before + 3
    made.save(tmp_path / "model.safetensors")
    again = oracle_texture(redrawn, seed=1, preset="ci")
    again.load(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(draw(again, redrawn, "cam0", 1), draw(made, redrawn, "cam0", 1))


def test_what_is_wrong_by_so_much_is_wrong_by_so_much_whoever_draws_it(capture):
    for error_mm, row in WRONG_BY_MM.items():
        for method in row:
            avatar = find_method(method).load()(capture, seed=0, preset="ci")
            assert (avatar.config.template.kind, avatar.config.template.error_mm) == ("exact", error_mm), method


@pytest.mark.parametrize("method", [smpl, neural_actor], ids=["smpl", "neural_actor"])
def test_the_bare_body_is_the_template_and_a_capture_without_one_is_refused(method, capture, tmp_path):
    with pytest.raises(InputError, match="no bare body"):
        method(capture.training_only(), seed=0, preset="ci")
    mesh = tube_mesh()
    thin = replace(mesh, vertices=mesh.vertices * [0.5, 1.0, 0.5])
    write_template(tmp_path / "body.npz", thin)
    for name in ("frames", "manifest.json"):
        (tmp_path / name).symlink_to(capture.folder / name)
    made = method(replace(capture.training_only(), folder=tmp_path), seed=0, preset="ci")
    posed = made.template.pose(Pose(capture.motion, 0)).vertices.numpy()
    radius = np.linalg.norm(posed[:12, [0, 2]] - posed[:12, [0, 2]].mean(0), axis=1)
    assert radius.mean() == pytest.approx(0.05, rel=0.2)
    assert made.template_vertices(Pose(capture.motion, 0)).shape == (0, 3), "as many vertices, but others"


# --- Gaussians that are free in every training frame: each learns its own, and new poses get the nearest ones ---------


def own_gaussians(capture: Capture) -> PerFrameAvatar:
    config = tiny_plus({"training.learning_rate": 0.02}, steps=12, warmup_steps=2)
    return PerFrameAvatar.from_capture(config, capture)


def test_a_frame_draws_its_own_gaussians_and_another_pose_those_of_the_nearest(capture: Capture) -> None:
    avatar = own_gaussians(capture)
    table = avatar.module.decoders
    for row, frame in enumerate(table.frames):
        frame.data.fill_(float(row))
    frames = capture.splits["train"].frames
    decoded = [table([avatar._inputs_of(frame)])[0].mean().item() for frame in frames]
    assert decoded == [0.0, 1.0, 2.0, 3.0]
    moved = replace(capture.motion, dofs=capture.motion.dofs.copy())
    moved.dofs[2, :3] += 1.0  # Elsewhere in the room it is the same pose,
    moved.dofs[2, 8] += 1e-3  # and nearly the same one a little bent.
    assert table([avatar.module.frame_inputs(Pose(moved, 2))])[0].mean().item() == 2.0


def test_a_step_moves_the_frame_that_was_drawn_and_training_is_resumed(capture: Capture, tmp_path: Path) -> None:
    avatar = own_gaussians(capture)
    avatar.fit(capture.training_only(), folder=tmp_path / "run")
    assert all(bool(frame.any()) for frame in avatar.module.decoders.frames)
    again = own_gaussians(capture)
    again.fit(capture.training_only(), folder=tmp_path / "run")
    np.testing.assert_array_equal(*(draw(one, capture, "cam0", 5) for one in (avatar, again)))
    alone = own_gaussians(capture)
    inputs = [alone._inputs_of(1)]
    alone.module.decoders(inputs).sum().backward()
    grads = [frame.grad is not None for frame in alone.module.decoders.frames]
    assert grads == [False, True, False, False]


def test_it_learns_as_fast_as_static_texels_and_is_else_as_ash_plus() -> None:
    config, plus = per_frame.config("cpu"), ash_plus.config("cpu")
    assert config.training.learning_rate == plus.training.base_learning_rate
    assert replace(config, training=replace(config.training, learning_rate=plus.training.learning_rate)) == plus
