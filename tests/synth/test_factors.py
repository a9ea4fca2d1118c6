"""Every factor scene adds its phenomenon, and nothing else, to `skinned`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ash.capture.dataset import Capture, Motion
from ash.capture.formats import load_capture
from ash.files import InputError
from synth import presets
from synth.camera.render import probe
from synth.capture import describe, finish
from synth.cloth.surface import Folds, true_surface
from synth.motion.clips import make_motion
from synth.person.body import PARTS
from synth.person.mannequin import mannequin
from synth.rendering import render_views
from synth.scene import Clip, Outfit, Rig, Scene
from synth.truth import pixels as truth
from synth.views import by_frame, splits, wanted_views

BODY = mannequin(skirt=True)


def _tiny(scene: Scene) -> Scene:
    """The factor scene with four small cameras and two frames of standing, 0.6 m apart on the floor."""
    clips = tuple(Clip(generator="stand", frames=2, shift=(x, 0.0)) for x in (0.3, -0.3))
    return replace(
        scene,
        rig=Rig(cameras=4, held_out=1, width=64, height=64),
        train=clips,
        test=(Clip(generator="stand", frames=2),),
        **presets.ALONE,
        novel_view_stride=2,
        samples=32,
        texture=256,
    )


def _captured(scene: Scene, folder: Path, frames: tuple[int, ...]) -> Capture:
    """Of the images only the training views of some frames."""
    folder.mkdir()
    describe(scene, folder)
    cameras = splits(scene)["train"].cameras
    for views in by_frame([view for view in wanted_views(scene) if view.frame in frames and view.camera in cameras]):
        render_views(scene, folder, probe(), views)
    finish(scene, folder, probe())
    return load_capture(folder)


@pytest.mark.parametrize("name", presets.FACTORS)
@pytest.mark.parametrize("size", presets.SIZES)
def test_strength_zero_is_skinned_itself(name: str, size: str):
    """Equal parameters make equal bytes, so this is equality of every image."""
    skinned = presets.scene("skinned", size=size)
    assert replace(presets.factor_scene(name, size=size, strength=0.0), name="skinned") == skinned
    changed = presets.scene(name, size=size)
    keys = ("outfit", "light", "train", "test", "near", "far")
    different = [key for key in keys if getattr(changed, key) != getattr(skinned, key)]
    assert len(different) == (5 if name == "lit" else 1)  # Fall-off is seen by people in several places.
    assert replace(changed, name="skinned", **{key: getattr(skinned, key) for key in different}) == skinned


def test_unknown_factor_scenes_are_refused():
    with pytest.raises(InputError, match="wrinkles, swing"):
        presets.factor_scene("creases", size="ci")


def test_wrinkles_move_cloth_by_millimetres_and_depend_on_the_pose_only():
    motion = make_motion(BODY.skeleton, (Clip(generator="reach", frames=6),), fps=12.0, seed=0)
    outfit = presets.scene("wrinkles", size="ci").outfit
    plain, folded = (true_surface(BODY, motion, o, seed=3) for o in (Outfit(skirt=True), outfit))
    moved = np.linalg.norm(folded - plain, axis=-1)
    assert 0.002 < np.sqrt(np.mean(moved[:, BODY.surface.vertices_of("shirt")] ** 2)) < 0.008
    bare = BODY.surface.vertices_of("skin", "shoes") & ~BODY.surface.vertices_of("shirt", "trousers")
    assert moved[:, bare].max() == 0
    # The same pose at another time, place and heading folds in the same way.
    elsewhere = replace(motion, dofs=motion.dofs[::-1].copy())
    elsewhere.dofs[:, :3] += [0.4, 0, 0.1]
    again = true_surface(BODY, elsewhere, outfit, seed=3)[::-1] - [0.4, 0, 0.1]
    np.testing.assert_allclose(again, folded, atol=1e-12)


def test_folds_move_smoothly_with_the_pose():
    """Neighbouring poses fold alike, so that folds can be learned from few frames; far poses do not."""
    clips = tuple(Clip(generator=name, frames=8) for name in ("walk", "dance"))
    motion = make_motion(BODY.skeleton, clips, fps=12.0, seed=0)
    poses = motion.dofs[:, 3:].reshape(16, -1, 3)
    for seed in range(3):
        folds = Folds.of(BODY, seed=seed)
        direction = np.random.default_rng(seed).normal(size=poses[0].shape)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        moved = poses + np.deg2rad(1) * direction
        fields = np.stack([folds.displacement(BODY, pose)[folds.strength > 0.5] for pose in (*poses, *moved)])
        alike = np.corrcoef(fields)  # of walk, dance, and both again moved by a degree
        assert np.diag(alike[:16, 16:]).min() > 0.99
        assert np.median([alike[k, k + 1] for k in range(7)]) > 0.8
        assert np.median(alike[:8, 8:16]) < 0.6
        turned = poses[0].copy()
        turned[0] = [0, 2.0, 0]
        np.testing.assert_array_equal(folds.displacement(BODY, turned), folds.displacement(BODY, poses[0]))


def test_the_main_scenes_have_everything_on():
    for name in ("tight", "loose"):
        scene = presets.scene(name, size="quick")
        assert min(scene.light.falloff, scene.light.gloss, scene.outfit.folds_mm, scene.outfit.scan_mm) > 0
        assert scene.depth == 3 and scene.outfit.skirt == (name == "loose")
    assert scene.outfit.swing >= 0.6 and scene.outfit.slack_mm > 0


def test_swing_depends_on_history_and_the_skinned_skirt_does_not():
    """Two sequences end in the same pose: one stood there all along, the other one stepped sideways."""
    still = make_motion(BODY.skeleton, (Clip(generator="stand", frames=8),), fps=12.0, seed=0).dofs
    moving = still.copy()
    moving[:, 0] -= 0.25 * np.cos(np.arange(8) * np.pi / 7) + 0.25
    motion = Motion(dofs=np.concatenate([still, moving]), sequence=np.repeat([0, 1], 8), fps=12.0)
    skirt = BODY.surface.vertices_of("skirt")
    swung = true_surface(BODY, motion, presets.scene("swing", size="ci").outfit, seed=0)[:, skirt]
    skinned = true_surface(BODY, motion, Outfit(skirt=True), seed=0)[:, skirt]
    assert np.abs(skinned[7] - skinned[15]).max() < 1e-12
    assert np.linalg.norm(swung[7] - swung[15], axis=-1).max() > 0.02


def test_turning_shows_headings_that_training_never_had():
    skinned, turning = (presets.scene(name, size="quick") for name in ("skinned", "turning"))
    headings = []
    for clips in (skinned.train, skinned.test, turning.test):
        motion = make_motion(BODY.skeleton, clips, fps=12.0, seed=0)
        headings.append(np.rad2deg(np.linalg.norm(motion.dofs[:, 3:6], axis=1)))
    assert headings[0].max() < 60 and headings[1].max() < 60
    assert headings[2].min() > 80


def test_people_in_lit_stand_in_several_places_and_are_tested_between_them():
    scene = presets.scene("lit", size="factor")
    x = {}
    for part in ("train", "test", "near", "far"):
        motion = make_motion(BODY.skeleton, getattr(scene, part), fps=12.0, seed=0)
        sequences = [motion.dofs[motion.sequence == one, 0].mean() for one in np.unique(motion.sequence)]
        x[part] = np.array(sequences)
    assert np.ptp(x["train"]) > 0.8
    for part in ("test", "near", "far"):
        assert np.ptp(x[part]) > 0.3
        assert x["train"].min() < x[part].min() and x[part].max() < x["train"].max()
    kinds = [clip.generator for clip in scene.train]
    assert all(len({clip.shift for clip in scene.train if clip.generator == kind}) > 1 for kind in kinds)


def test_light_varies_over_the_floor_in_lit_only_and_gloss_adds_highlights_alone(tmp_path: Path):
    captures = {
        name: _captured(_tiny(presets.scene(name, size="ci")), tmp_path / name, frames=(1, 3))
        for name in ("skinned", "lit", "glossy")
    }
    change = {}
    for name in ("skinned", "lit"):
        capture, shading = captures[name], []
        for frame in (1, 3):
            ratios = []
            for camera in capture.splits["train"].cameras:
                pixels = truth.pixel_truth(capture, camera, frame)
                seen = truth.parts(capture, pixels) == PARTS.index("shirt")
                linear = (capture.image(camera, frame)[seen][:, :3] / 255.0) ** 2.2
                ratios.append(linear.sum() / (truth.albedo(capture, pixels)[seen] ** 2.2).sum())
            shading.append(np.mean(ratios))
        change[name] = abs(np.log(shading[0] / shading[1]))
    assert change["skinned"] < 0.06
    assert change["lit"] > 0.12
    plain, glossy = captures["skinned"], captures["glossy"]
    camera = plain.splits["train"].cameras[0]
    before, after = (truth.pixel_truth(capture, camera, 1) for capture in (plain, glossy))
    np.testing.assert_array_equal(before.triangle, after.triangle)
    difference = glossy.image(camera, 1)[..., :3].astype(float) - plain.image(camera, 1)[..., :3]
    assert np.abs(difference[before.covered]).mean() > 2
    assert difference.max() > 20
    ratio = [np.median(c.image(camera, 1)[before.covered][:, 0] / 255.0) for c in (plain, glossy)]
    assert abs(ratio[1] - ratio[0]) < 0.08  # No milk over the cloth: its typical colour is kept.
