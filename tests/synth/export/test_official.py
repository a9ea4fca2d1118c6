"""The release's form is read back by plain parsers written from its description, sharing no code with the writer.

What `helpers.outsider_release` measures of it is asserted in tests/test_outsiders.py.
"""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import fakes
from helpers.outsider_release import Skeletool, project, read_cameras, read_motion, read_obj
from PIL import Image

from ash.capture.dataset import Capture, TemplateMesh
from ash.capture.formats import load_capture, read_template_truth
from ash.files import InputError
from synth.export.formats import export
from synth.export.official import cached_arrays, graph_faces, graph_nodes, taken_vertices
from synth.posing import bone_frames, linear_blend_skinning


@pytest.fixture(scope="module")
def capture(small_capture: Path) -> Capture:
    return load_capture(small_capture)


@pytest.fixture(scope="module")
def meta(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(capture, tmp_path_factory.mktemp("official"), form="ash") / "meta_data" / "Synthetic"


def _skin(path: Path, skeleton: Skeletool) -> np.ndarray:
    """Dense weights over joints: a bone belongs to the last joint whose name begins with it."""
    lines = path.read_text().splitlines()
    bones = lines[2].split()
    owner = [max(j for j, name in enumerate(skeleton.names) if name.split("_")[0] == bone) for bone in bones]
    weights = np.zeros((len(lines) - 4, len(skeleton.names)))
    for line in lines[4:]:
        vertex, *pairs = line.split()
        values = [float(value) for value in pairs[1::2]]
        assert len(values) == 6 and values == sorted(values, reverse=True)
        for bone, value in zip(pairs[::2], values, strict=True):
            weights[int(vertex), owner[int(bone)]] += value
    return weights


def test_skinning_the_rest_pose_reproduces_the_obj(meta: Path, capture: Capture):
    skeleton = Skeletool(meta / "ddc.skeleton")
    rest = read_motion(meta / "ddc.motion")
    vertices, uvs, faces = read_obj(meta / "ddc.obj")
    weights = _skin(meta / "ddc.skin", skeleton)
    assert (meta / "ddc.skin").read_text().splitlines()[:2] == ["Skeletool character skinning file V1.0", "bones:"]
    assert rest.shape == (1, 66) and np.abs(weights.sum(axis=1) - 1).max() < 1e-6
    relative = skeleton.frames(rest[0]) @ np.linalg.inv(skeleton.frames(rest[0]))
    weights /= weights.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(linear_blend_skinning(vertices, weights, relative), vertices, atol=1e-9)
    np.testing.assert_allclose(vertices, capture.template.vertices * 1000, atol=1e-6)
    np.testing.assert_array_equal(faces[..., 0], capture.template.faces)
    np.testing.assert_allclose(uvs[faces[..., 1]], capture.template.uvs[capture.template.uv_faces], atol=1e-8)


def test_exported_motion_moves_the_exported_skeleton_as_ours(meta: Path, capture: Capture):
    skeleton = Skeletool(meta / "ddc.skeleton")
    both = [read_motion(meta / name / "poseAngles.motion") for name in ("skeletoolToGTPose", "skeletoolToGTPoseTest")]
    ours = bone_frames(capture.skeleton, capture.motion.dofs)
    words = [name.split("_") for name in capture.skeleton.names]
    bones = [first + "".join(word.capitalize() for word in rest) for first, *rest in words]
    last = [max(j for j, name in enumerate(skeleton.names) if name.split("_")[0] == bone) for bone in bones]
    for dofs, frames in zip(np.concatenate(both), ours, strict=True):
        theirs = skeleton.frames(dofs)[last]
        np.testing.assert_allclose(theirs[:, :3, :3], frames[:, :3, :3], atol=1e-9)
        np.testing.assert_allclose(theirs[:, :3, 3], frames[:, :3, 3] * 1000, atol=1e-6)


def test_motion_normalisation_follows_the_rule(meta: Path):
    dofs = read_motion(meta / "skeletoolToGTPose" / "poseAngles.motion")
    rows = read_motion(meta / "skeletoolToGTPose" / "poseAnglesRotationNormalized.motion")
    assert len(rows) == 3 * len(dofs)
    for f in range(2, len(dofs)):
        for place, k in enumerate((f - 2, f - 1, f)):
            angle = -3 * dofs[f, 3]
            turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
            row = rows[3 * f + place]
            np.testing.assert_allclose(row[:3], turn @ (dofs[k, :3] - dofs[f, :3]), atol=1e-9)
            np.testing.assert_allclose(row[3], dofs[k, 3] - dofs[f, 3], atol=1e-9)
            np.testing.assert_array_equal(row[4:], dofs[k, 4:])


def test_official_cameras_project_as_ours(meta: Path, capture: Capture):
    points = capture.template.vertices[::50]
    cameras = read_cameras(meta / "cameras.json")
    lines = (meta / "cameras.calibration").read_text().splitlines()[1:]
    names = capture.splits["train"].cameras
    assert len(lines) == 7 * len(names) == 7 * len(cameras)
    for index, name in enumerate(names):
        expected, _ = capture.cameras[name].project(points)
        block = dict(line.split(" ", 1) for line in lines[7 * index : 7 * index + 7])
        intrinsic, extrinsic = (
            np.array(block[k].split(), dtype=float).reshape(4, 4) for k in ("intrinsic", "extrinsic")
        )
        image = (np.concatenate([points * 1000, np.ones((len(points), 1))], axis=1) @ (intrinsic @ extrinsic).T)[:, :3]
        assert np.abs(image[:, :2] / image[:, 2:] - expected).max() < 0.01
        assert np.abs(project(points * 1000, cameras[index]) + 0.5 - expected).max() < 0.01


def test_cached_arrays_hold_the_true_template_of_three_frames(meta: Path, capture: Capture):
    folder = meta.parent.parent / "cached_files"
    arrays = {path.stem: pickle.loads(path.read_bytes()) for path in folder.glob("*.pkl")}
    assert len(arrays) == 6
    truth = read_template_truth(capture) * 1000
    for frame in capture.splits["train"].frames:
        canonical = arrays["cached_ret_canonical_delta"][frame]
        np.testing.assert_allclose(
            arrays["cached_ret_posed_delta"][frame], truth[[frame, max(frame - 1, 0), max(frame - 2, 0)]]
        )
        assert canonical.shape == (3, len(truth[0]), 4) and (canonical[..., 3] == 1).all()
        assert arrays["cached_temp_vert_normal"][frame].shape == (3, len(truth[0]), 3)
        assert arrays["cached_joints"][frame].shape == (66, 3)


def _release_graph(vertices: np.ndarray, faces: np.ndarray, nodes: np.ndarray) -> tuple[list[int], np.ndarray]:
    """The release's rule, plainly: each node takes the nearest free vertex; edges from there to every vertex."""
    around: list[set[int]] = [set() for _ in vertices]
    for a, b, c in faces.tolist():
        around[a] |= {b, c}
        around[b] |= {a, c}
        around[c] |= {a, b}
    taken: list[int] = []
    for node in nodes:
        order = np.argsort(np.linalg.norm(vertices - node, axis=1), kind="stable")
        taken.append(next(int(v) for v in order if v not in taken))
    hops = np.full((len(taken), len(vertices)), 10**6)
    for row, start in enumerate(taken):
        front, distance = {start}, 0
        while front:
            hops[row, list(front)] = distance
            front = {n for v in front for n in around[v] if hops[row, n] == 10**6}
            distance += 1
    assert all(around[vertex] for vertex in taken), "the release takes the maximum over a node's neighbours"
    return taken, hops


def test_every_vertex_has_graph_nodes_in_reach(meta: Path):
    vertices, _, faces = read_obj(meta / "ddc.obj")
    nodes, _, node_faces = read_obj(meta / "ddc_graph.obj")
    _, hops = _release_graph(vertices, faces[..., 0], nodes)
    assert (hops.min(axis=0) <= 3).all()
    assert len(nodes) < len(vertices) / 3 and len(node_faces) > len(nodes) / 2
    assert node_faces[..., 0].min() >= 0 and node_faces[..., 0].max() < len(nodes)


def test_a_graph_spans_every_piece_of_a_mesh_even_where_two_touch():
    """A sheet, its double at the same place, and a single triangle."""
    side = 12
    grid = np.array([[x, y, 0.0] for y in range(side) for x in range(side)])
    steps = range(side - 1)
    corner = np.array([[y * side + x, y * side + x + 1, (y + 1) * side + x] for y in steps for x in steps])
    sheet = np.concatenate([corner, np.stack([corner[:, 1], corner[:, 2] + 1, corner[:, 2]], axis=1)])
    vertices = np.concatenate([grid, grid, [[50.0, 0, 0], [51, 0, 0], [50, 1, 0]]])
    faces = np.concatenate([sheet, sheet + len(grid), [[2 * len(grid), 2 * len(grid) + 1, 2 * len(grid) + 2]]])
    template = TemplateMesh(
        vertices=vertices, faces=faces, uvs=vertices[:, :2], uv_faces=faces, skin_weights=np.ones((len(vertices), 1))
    )
    nodes = graph_nodes(template)
    taken, hops = _release_graph(vertices, faces, vertices[nodes])
    assert taken == taken_vertices(vertices, nodes).tolist()
    assert (hops.min(axis=0) <= 3).all()
    assert len(graph_faces(template, nodes)) > len(nodes) / 2


def test_a_mesh_whose_faces_share_no_vertices_is_refused():
    """The release takes one vertex of several at a point, and never reaches the others' pieces."""
    with pytest.raises(InputError, match="expected faces that share their vertices"):
        graph_nodes(fakes.template())


def test_without_truth_the_cached_arrays_are_the_skinned_template(capture: Capture, tmp_path: Path):
    cached = cached_arrays(replace(capture, folder=tmp_path))
    frame = capture.splits["train"].frames[-1]
    rest = cached["cached_ret_canonical_delta"][frame][..., :3]
    np.testing.assert_allclose(rest, 1000 * np.stack([capture.template.vertices] * 3), atol=1e-9)
    truth = cached_arrays(capture)
    for name in ("cached_joints", "cached_fin_rotation_quad", "cached_fin_translation_quad"):
        np.testing.assert_array_equal(cached[name][frame], truth[name][frame])
    assert np.abs(cached["cached_ret_posed_delta"][frame] - truth["cached_ret_posed_delta"][frame]).max() > 1


def test_cached_normals_are_means_of_unit_normals(meta: Path, capture: Capture):
    folder = meta.parent.parent / "cached_files"
    normals, posed = (
        pickle.loads((folder / f"{name}.pkl").read_bytes())
        for name in ("cached_temp_vert_normal", "cached_ret_posed_delta")
    )
    frame = capture.splits["train"].frames[-1]
    mesh = posed[frame][0]
    sums = np.zeros_like(mesh)
    for face in capture.template.faces:
        a, b, c = mesh[face]
        across = np.cross(b - a, c - a)
        sums[face] += across / np.linalg.norm(across)
    cosine = np.einsum("va,va->v", sums / np.linalg.norm(sums, axis=1, keepdims=True), normals[frame][0])
    assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max() < 0.01


def test_every_training_image_is_there_with_a_mask_of_black_and_white(meta: Path, capture: Capture):
    training = meta.parent.parent / "raw_data" / "Synthetic" / "metadata" / "training"
    folder, train = training / "foregroundSegmentation", capture.splits["train"]
    for each in (training / "images", folder):
        assert len(list(each.rglob("image_c_*_f_*.png"))) == len(train.cameras) * len(train.frames)
    for index, camera in enumerate(train.cameras):
        alpha = capture.image(camera, train.frames[0])[..., 3]
        with Image.open(folder / f"{index}/image_c_{index}_f_{train.frames[0]}.png") as image:
            mask = np.array(image)
        np.testing.assert_array_equal(mask, np.repeat(np.where(alpha >= 128, 255, 0)[..., None], 3, axis=-1))
