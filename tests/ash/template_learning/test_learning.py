"""The learned template: tracked on training frames, regressed on the pose, kept for the next method."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
import trimesh
from helpers.captures import write_tube_capture
from helpers.figures import tube_mesh, tube_motion, tube_skeleton

from ash.capture.dataset import Capture, Motion, Pose, scan_path, surface_path
from ash.capture.formats import load_capture, read_scan, read_surface_mesh_truth, read_template_truth
from ash.config import TemplateConfig
from ash.files import InputError, write_arrays, write_atomic
from ash.rotations import RigidTransforms
from ash.template.skinning import SkinWeights, dual_quaternion_skinning
from ash.template.template import RestDeformation, Template, skinned_template, vertex_normals
from ash.template_learning import learning, tracking
from ash.template_learning.deforming import LinearDeformation, joint_reach
from ash.template_learning.graph_nets import GraphDeformation
from ash.template_learning.learning import learned_template, template_key, template_of
from ash.template_learning.regressing import fit_graph, fit_linear, held_out_frames
from ash.template_learning.tracking import Tracked, template_error_mm, track_scans
from benchmarks.cell.sandbox import seen_by_method, watched

SMALL = {"kind": "learned", "nodes": 30, "window": 2, "supervision": "scans"}
BULGE_M = 0.012
UNUSED = RigidTransforms(quats=torch.zeros(0, 4), translations=torch.zeros(0, 3))


def in_sequences(motion: Motion, count: int) -> Motion:
    """The same frames as so many takes of one length."""
    return replace(motion, sequence=np.repeat(np.arange(count), len(motion.dofs) // count))


def bulged(motion, frame: int) -> np.ndarray:
    """The tube's true canonical shape: a bulge that is always there, and one that grows as the tube bends."""
    rest = tube_mesh().vertices
    outward = rest * [1, 0, 1] / 0.1
    always = np.exp(-(((rest[:, 1:2] - 0.25) / 0.2) ** 2))
    bent = np.exp(-(((rest[:, 1:2] - 0.7) / 0.2) ** 2)) * motion.dofs[frame, 6]
    return rest + BULGE_M * (always + bent) * outward


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Capture:
    """The tube with a bulging surface; of the surface only the training frames have a scan."""
    made = write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")
    motion, folder = in_sequences(tube_motion(24), 4), made.folder
    at_rest = skinned_template(made)
    transforms = [at_rest.pose(Pose(motion, f)).transforms for f in range(24)]
    posed = np.stack([t.apply(torch.from_numpy(bulged(motion, f)).float()) for f, t in enumerate(transforms)])
    write_arrays(folder / "truth" / "template.npz", vertices=posed)
    for frame in range(24):
        write_arrays(surface_path(folder, frame), vertices=posed[frame])
    for frame in range(18):
        write_arrays(scan_path(folder, frame), vertices=posed[frame], faces=tube_mesh().faces)
    splits = {"train": replace(made.splits["train"], frames=tuple(range(18)))}
    return replace(made, motion=motion, splits=splits)


@pytest.fixture
def exact_scans(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tube is open at its ends, and its scans are exact there."""
    monkeypatch.setattr(tracking, "SCAN_RIM", 0)


def true_canonical(capture: Capture, template: Template) -> torch.Tensor:
    """The true vertices of the training frames in canonical space, `[t, v, 3]` metres."""
    truth = torch.from_numpy(read_template_truth(capture)).float()
    frames = capture.splits["train"].frames
    return torch.stack([template.pose(Pose(capture.motion, f)).transforms.apply_inverse(truth[f]) for f in frames])


def rms_mm(template: Template, capture: Capture, frames) -> float:
    return float(np.sqrt((template_error_mm(template, capture, tuple(frames)) ** 2).mean()))


@pytest.mark.usefixtures("exact_scans")
def test_a_surface_without_correspondences_does_nearly_as_well(capture):
    skinned = skinned_template(capture)
    learned = template_of(TemplateConfig(**SMALL), capture, seed=0)
    train, test = range(18), range(18, 24)
    assert rms_mm(learned, capture, train) < 0.4 * rms_mm(skinned, capture, train)
    assert rms_mm(learned, capture, test) < 0.5 * rms_mm(skinned, capture, test)


def fitted(shift: torch.Tensor) -> torch.Tensor:
    """By how much the vertices move in every frame `[t, v, 3]`, learned from tracks that are off by `[t, 3]`."""
    motion, rest = tube_motion(len(shift)), torch.from_numpy(tube_mesh().vertices).float()
    tracked = Tracked(frames=tuple(range(len(shift))), canonical=rest + shift[:, None].expand(-1, len(rest), -1))
    deformation = LinearDeformation(TemplateConfig(**SMALL), tube_mesh(), tube_skeleton())
    fit_linear(deformation, motion, tracked)
    return torch.stack([deformation.canonical(Pose(motion, f), UNUSED) for f in tracked.frames]) - rest


def test_what_all_frames_share_is_kept_and_noise_of_the_tracks_is_damped():
    noise = torch.from_numpy(0.004 * np.random.default_rng(0).standard_normal((16, 3))).float()
    shift = torch.tensor([0.01, 0.0, 0.0]) + noise
    moved = fitted(shift)
    torch.testing.assert_close(moved.mean(0), shift.mean(0).expand_as(moved[0]), atol=1e-5, rtol=0)
    assert (moved - shift.mean(0)).square().mean() < 0.25 * (shift - shift.mean(0)).square().mean()


def test_whole_sequences_are_held_out_or_a_stretch_of_the_only_one():
    held = [held_out_frames(np.repeat([3, 5, 7, 8, 9], 2), seed) for seed in range(4)]
    assert held[0].tolist() == [True] * 2 + [False] * 6 + [True] * 2
    assert torch.stack(held).sum(0).tolist() == [1] * 10
    assert held_out_frames(np.zeros(8), 5).tolist() == [False] * 2 + [True] * 2 + [False] * 4
    assert held_out_frames(np.zeros(2), 1).tolist() == [False, True]
    assert not held_out_frames(np.zeros(1), 0).any()


def test_a_node_feels_its_joint_and_half_its_neighbours():
    reach = joint_reach(tube_mesh(), tube_skeleton())
    weights = torch.from_numpy(tube_mesh().skin_weights).float()
    torch.testing.assert_close(reach[:, 0], weights[:, 0] + 0.5 * weights[:, 1])


def test_graph_networks_learn_from_all_frames_for_as_long_as_those_held_out_gained(capture):
    """The frames held out choose the number of steps, and are learned from like the others: moved, they move it."""
    at_rest = skinned_template(capture)
    tracked = Tracked(frames=capture.splits["train"].frames, canonical=true_canonical(capture, at_rest))
    config = TemplateConfig(network="graph", blocks=1, **SMALL)

    def learned(tracked: Tracked) -> tuple[int, GraphDeformation]:
        torch.manual_seed(0)
        deformation = GraphDeformation(config, tube_mesh(), tube_skeleton())
        return fit_graph(deformation, capture.motion, tracked, steps=60, seed=0), deformation

    kept, deformation = learned(tracked)
    assert 0 < kept <= 60
    template = Template(tube_mesh(), tube_skeleton(), deformation)
    assert rms_mm(template, capture, range(18)) < 0.5 * rms_mm(at_rest, capture, range(18))
    torch.testing.assert_close(deformation.static, tracked.canonical.mean(0) - deformation.rest)
    again = learned(tracked)[1].state_dict()
    assert all(torch.equal(value, again[name]) for name, value in deformation.state_dict().items())
    held = held_out_frames(capture.motion.sequence[list(tracked.frames)], 0)
    moved = tracked.canonical + 0.002 * held[:, None, None]
    other_kept, other = learned(replace(tracked, canonical=moved))
    assert not torch.equal(other.static, deformation.static) and other_kept >= 0


def test_the_key_names_what_decides_a_template_and_nothing_else(capture):
    train = capture.splits["train"]
    fewer, one = (replace(capture, splits={"train": train.only(**c)}) for c in ({"frames": [0]}, {"cameras": ["cam1"]}))

    def key(capture: Capture = capture, seed: int = 0, device: str = "cpu", **changes: object) -> str:
        return template_key(TemplateConfig(**SMALL | changes), capture, seed=seed, device=torch.device(device))

    assert key() == key(seed=1) == key(one)  # Nothing in it is random, and scans are seen by no camera.
    assert key() not in (key(nodes=31), key(fewer), key(device="cuda:1"))  # A GPU rounds otherwise.
    assert key(network="graph") != key(network="graph", seed=1)
    assert key(supervision="images") != key(one, supervision="images")


def test_scans_are_there_for_training_frames_only(capture):
    vertices, faces = read_scan(capture, 3)
    assert vertices.shape[1] == faces.shape[1] == 3
    for frame in (18, 99):
        with pytest.raises(InputError, match=f"scan of training frame {frame}, found none"):
            read_scan(capture, frame)


def test_noise_and_holes_of_a_scan_are_borne(capture, tmp_path):
    """Grain of 2 mm, a hole, strays 4 cm off: nothing follows strays, or is drawn across the hole."""
    shutil.copytree(capture.folder, tmp_path, dirs_exist_ok=True)
    train = replace(capture.splits["train"], frames=(0, 6, 12))
    whole, at_rest = replace(capture, folder=tmp_path, splits={"train": train}), skinned_template(capture)
    rng = np.random.default_rng(0)
    hole = (tube_mesh().vertices[:, 2] > 0.04) & (np.abs(tube_mesh().vertices[:, 1] - 0.25) < 0.2)
    for frame in train.frames:
        vertices, faces = read_surface_mesh_truth(capture, frame)
        faces = faces[~hole[faces].any(1)]
        for _ in range(3):
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
        height = 0.002 * rng.standard_normal(len(vertices))
        height[rng.integers(len(vertices), size=20)] = 0.04
        write_arrays(scan_path(tmp_path, frame), vertices=vertices + height[:, None] * normals, faces=faces)
    tracked, true = track_scans(whole, at_rest).canonical, true_canonical(whole, at_rest)
    rest = torch.from_numpy(tube_mesh().vertices).float()
    left, before = ((canonical - true).norm(dim=-1) for canonical in (tracked, rest))
    assert left[:, ~hole].mean() < 0.5 * before[:, ~hole].mean()
    assert left[:, hole].mean() < 1.1 * before[:, hole].mean()


def test_skinning_through_the_graph_blends_the_nodes_transforms(capture):
    deformation = LinearDeformation(TemplateConfig(released=True, **SMALL), tube_mesh(), tube_skeleton())
    unlearned = Template(tube_mesh(), tube_skeleton(), RestDeformation(tube_mesh()), through=deformation.graph)
    tracked = Tracked(frames=tuple(range(18)), canonical=true_canonical(capture, unlearned))
    fit_linear(deformation, capture.motion, tracked)
    template = unlearned.deformed_by(deformation)
    graph, pose = template.deformation.graph, Pose(capture.motion, 5)
    posed, joints = template.pose(pose), skinned_template(capture).pose(pose).transforms
    nodes = RigidTransforms(quats=joints.quats[graph.nodes], translations=joints.translations[graph.nodes])
    expected = dual_quaternion_skinning(nodes, SkinWeights(joints=graph.links, weights=graph.weights))
    torch.testing.assert_close(posed.transforms.translations, expected.translations, atol=1e-5, rtol=0)
    assert not torch.allclose(posed.transforms.translations, joints.translations, atol=1e-4)
    # What the blend gets wrong is learned with the rest.
    assert rms_mm(template, capture, range(18)) < 0.8 * rms_mm(unlearned, capture, range(18))


def test_a_method_learns_its_template_from_what_it_is_given_and_leaves_it_for_the_next(tmp_path, small_capture: Path):
    """A rendered capture, sealed as the harness seals it: no truth, scans of training frames, a store beside it."""
    whole = load_capture(small_capture)
    config = TemplateConfig(kind="learned", nodes=60, supervision="scans")
    with seen_by_method(whole, tmp_path / "input", oracle=False, store=tmp_path / "store") as seen:
        with watched(whole, seen):
            learned = learned_template(config, seen, seed=0)
        scanned = sorted(int(path.stem) for path in (seen.folder / "scans").glob("0*.npz"))
        assert scanned == sorted(whole.splits["train"].frames)
        assert not (seen.folder / "truth").exists()
    with seen_by_method(whole, tmp_path / "other", oracle=False, store=tmp_path / "store") as seen:
        assert learned_template(config, seen, seed=1).learned == learned.learned
    assert len(list((tmp_path / "store").glob("[!t]*.safetensors"))) == 1
    frames = whole.splits["train"].frames
    assert rms_mm(learned, whole, frames) < rms_mm(skinned_template(whole), whole, frames)


def test_configurations_share_what_is_tracked(capture: Capture, tmp_path: Path, monkeypatch) -> None:
    calls = []

    def counted(*arguments: object, **options: object) -> Tracked:
        calls.append(arguments)
        return track_scans(*arguments, **options)

    monkeypatch.setattr(learning, "track_scans", counted)
    configs = [TemplateConfig(**SMALL | {"window": window}) for window in (1, 2)]
    kept = replace(capture, store=tmp_path)
    shared = [learned_template(config, kept, seed=0) for config in configs]
    assert len(calls) == 1
    again = learned_template(configs[0], kept, seed=0)
    assert again.learned == shared[0].learned, "read and not learned again"
    for config, template in zip(configs, shared, strict=True):
        alone = learned_template(config, capture, seed=0)
        pose = Pose(capture.motion, 5)
        assert torch.equal(alone.pose(pose).vertices, template.pose(pose).vertices)
    assert shared[0].learned.seconds > 0
    (tracks,) = tmp_path.glob("tracked-*.safetensors")
    write_atomic(tracks, safetensors.torch.save({"canonical": torch.zeros(1)}, metadata={"seconds": "1"}))
    with pytest.raises(InputError, match="expected the template in 18 training frames"):
        learned_template(TemplateConfig(**SMALL | {"window": 3}), kept, seed=0)
