"""Export in the formats of the released ASH code: a capture that its trainer reads as if it came from a studio.

Lengths are millimetres there. A ball joint is a chain of three one-axis joints; the root's yaw comes first and its
angles count three times, as in the released skeletons, because the released code relies on it.
"""

import pickle
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation
from trimesh.geometry import mean_vertex_normals

from ash.capture.dataset import Camera, Capture, Skeleton, TemplateMesh
from ash.capture.formats import read_template_truth
from ash.files import InputError, write_atomic, write_image, write_json
from synth.posing import (
    blended_dual_quaternions,
    bone_frames,
    dual_quaternion_skinning,
    rotvec_to_rotmat,
    skinning_transforms,
)

MM = 1000.0
YAW_WEIGHT = 3.0
INFLUENCES = 6
SUBJECT = "Synthetic"
FOREGROUND = 127  # alpha above which the release's binary masks are on
AXES = {"rx": (1, 0, 0), "ry": (0, 1, 0), "rz": (0, 0, 1)}


def bone_name(joint: str) -> str:
    """A joint's name without underscores: what follows an underscore tells the axis there."""
    first, *rest = joint.split("_")
    return first + "".join(word.capitalize() for word in rest)


def skeleton_text(skeleton: Skeleton) -> str:
    """`ddc.skeleton`: three prismatic root joints, then three revolute joints per ball joint, and one DoF for each."""
    joints, dofs = [], []
    offset = skeleton.heads[0] * MM
    for k, axis in enumerate("xyz"):
        parent = "none" if k == 0 else f"root_t{'xyz'[k - 1]}"
        offset_mm = offset if k == 0 else np.zeros(3)
        joints.append((f"root_t{axis}", "prismatic", parent, offset_mm, np.eye(3)[k]))
        dofs.append((f"root_t{axis}", MM))
    for j, name in enumerate(skeleton.names):
        order = ("ry", "rz", "rx") if j == 0 else ("rz", "ry", "rx")
        above = "root_tz" if j == 0 else f"{bone_name(skeleton.names[skeleton.parents[j]])}_rx"
        offset_mm = np.zeros(3) if j == 0 else (skeleton.heads[j] - skeleton.heads[skeleton.parents[j]]) * MM
        for axis in order:
            full = f"{bone_name(name)}_{axis}"
            joints.append((full, "revolute", above, offset_mm, np.array(AXES[axis], dtype=np.float64)))
            dofs.append((full, YAW_WEIGHT if j == 0 else 1.0))
            above, offset_mm = full, np.zeros(3)
    lines = ["Skeletool Skeleton Definition V1.0", f"joints: {len(joints)}"]
    for name, kind, parent, offset_mm, axis in joints:
        numbers = " ".join(f"{value:.12g}" for value in (*offset_mm, *axis, 1.0))
        lines.append(f"{name} {kind} {parent} {numbers}")
    lines += ["markers: 0", "scaling joints: 0", f"dofs: {len(dofs)}"]
    for name, weight in dofs:
        lines += [f"{name} 1", "nolimits", f"{name} {weight:.12g}"]
    return "\n".join(lines) + "\n"


def to_official_dofs(dofs: np.ndarray) -> np.ndarray:
    """Our degrees of freedom `[t, 3 + 3 j]` as those of `skeleton_text`; the root's angles are thirds."""
    angles = np.empty((len(dofs), dofs.shape[1] // 3 - 1, 3))
    for joint in range(angles.shape[1]):
        rotations = Rotation.from_rotvec(dofs[:, 3 + 3 * joint : 6 + 3 * joint])
        angles[:, joint] = rotations.as_euler("ZYX" if joint else "YZX")  # about axes that turn along
    angles = np.unwrap(angles, axis=0)
    angles[:, 0] /= YAW_WEIGHT
    return np.concatenate([dofs[:, :3], angles.reshape(len(dofs), -1)], axis=1)


def motion_text(dofs: np.ndarray) -> str:
    """A motion file: a header, then a frame number and its degrees of freedom per line."""
    lines = ["Skeletool Motion File V1.0"]
    lines += [f"{frame} " + " ".join(f"{value:.12g}" for value in row) for frame, row in enumerate(dofs)]
    return "\n".join(lines) + "\n"


def normalise_motion(dofs: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """Translation and yaw relative to each frame: rows f-2, f-1, f (oldest first) for every frame f, `[3 t, d]`.

    t' = R_y(-3 d3_f) (t_k - t_f), d3' = d3_k - d3_f, all else unchanged. `windows` `[t, 3]` holds f, f-1, f-2.
    """
    rows = []
    for frame, window in enumerate(windows):
        back = rotvec_to_rotmat(np.array([0, -YAW_WEIGHT * dofs[frame, 3], 0]))
        for k in window[::-1]:
            row = dofs[k].copy()
            row[:3] = back @ (dofs[k, :3] - dofs[frame, :3])
            row[3] -= dofs[frame, 3]
            rows.append(row)
    return np.array(rows)


def skin_text(skeleton: Skeleton, weights: np.ndarray) -> str:
    """`ddc.skin`: bone names, then the six heaviest weights of every vertex, heaviest first."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
    heaviest = np.take_along_axis(weights, order, axis=1)
    heaviest = heaviest / heaviest.sum(axis=1, keepdims=True)
    lines = [
        "Skeletool character skinning file V1.0",
        "bones:",
        " ".join(bone_name(name) for name in skeleton.names),
        "vertex weights:",
    ]
    for vertex, (bones, values) in enumerate(zip(order, heaviest, strict=True)):
        pairs = " ".join(f"{bone} {value:.9f}" for bone, value in zip(bones, values, strict=True))
        lines.append(f"{vertex} {pairs}")
    return "\n".join(lines) + "\n"


def obj_text(vertices: np.ndarray, faces: np.ndarray, *, uvs: np.ndarray, uv_faces: np.ndarray) -> str:
    """An OBJ in millimetres as the released reader wants it: colours behind vertices, `v/vt` faces."""
    lines = ["mtllib ./ddc.obj.mtl"]
    lines += ["v {:.9f} {:.9f} {:.9f} 0.7 0.7 0.7".format(*point) for point in vertices * MM]
    lines += ["vt {:.9f} {:.9f}".format(*uv) for uv in uvs]
    for face, uv in zip(faces + 1, uv_faces + 1, strict=True):
        lines.append("f " + " ".join(f"{v}/{t}" for v, t in zip(face, uv, strict=True)))
    return "\n".join(lines) + "\n"


def calibration_text(cameras: list[Camera]) -> str:
    """`cameras.calibration`: seven lines per camera, extrinsics from world to camera in millimetres."""
    lines = ["Skeletool Camera Calibration File V1.0"]
    for index, camera in enumerate(cameras):
        intrinsic = np.eye(4)
        intrinsic[:3, :3] = camera.K
        extrinsic = camera.viewmat.copy()
        extrinsic[:3, 3] *= MM
        size = f"{camera.width} {camera.height}"
        lines += [f"name {index}", f"sensor {size}", f"size {size}", "animated 0"]
        for name, matrix in (("intrinsic", intrinsic), ("extrinsic", extrinsic)):
            lines.append(f"{name} " + " ".join(f"{value:.12g}" for value in matrix.ravel()))
        lines.append("radial 0")
    return "\n".join(lines) + "\n"


def cameras_json(cameras: list[Camera]) -> dict:
    """`cameras.json` of the release: camera to world, OpenCV axes, in a world whose axes are permuted to (z, x, y)."""
    frames = []
    for index, camera in enumerate(cameras):
        pose = np.linalg.inv(camera.viewmat)[[2, 0, 1, 3]]
        fx, fy = camera.K[0, 0], camera.K[1, 1]
        frames.append(
            {
                "file_path": f"{index:06d}",
                "camera_angle_x": float(2 * np.arctan(camera.width / (2 * fx))),
                "camera_angle_y": float(2 * np.arctan(camera.height / (2 * fy))),
                "fl_x": float(fx),
                "fl_y": float(fy),
                "cx": float(camera.K[0, 2]),
                "cy": float(camera.K[1, 2]),
                "transform_matrix": pose.tolist(),
            }
        )
    size = {"w": float(cameras[0].width), "h": float(cameras[0].height)}
    return {"k1": 0, "k2": 0, "p1": 0, "p2": 0, **size, "aabb_scale": 16, "frames": frames}


def cached_arrays(capture: Capture) -> dict[str, dict[int, np.ndarray]]:
    """The six arrays per training frame that the released trainer caches of its template, from the truth instead.

    Of a capture without truth they are those of the template that the skeleton alone moves.
    """
    template, motion, skeleton = capture.template, capture.motion, capture.skeleton
    transforms = skinning_transforms(skeleton, motion.dofs)
    if (capture.folder / "truth" / "template.npz").is_file():
        posed = read_template_truth(capture) * MM
    else:
        rest, weights = template.vertices, template.skin_weights
        posed = MM * np.stack([dual_quaternion_skinning(rest, weights, moved) for moved in transforms])
    transforms[..., :3, 3] *= MM
    heads = bone_frames(skeleton, motion.dofs)[:, :, :3, 3] * MM
    # The root slides along x, then y, then z; the three joints of a ball joint are at one point.
    sliding = MM * (skeleton.heads[0] + np.tril(np.ones((3, 3))) * motion.dofs[:, None, :3])
    joints = np.concatenate([sliding, np.repeat(heads, 3, axis=1)], axis=1)
    result: dict[str, dict[int, np.ndarray]] = defaultdict(dict)
    for frame in sorted(capture.splits["train"].frames):
        window = motion.window(frame, 3)
        pieces = [blended_dual_quaternions(template.skin_weights, transforms[k]) for k in window]
        canonical = np.stack([_unpose(posed[k], *piece) for k, piece in zip(window, pieces, strict=True)])
        result["cached_joints"][frame] = joints[frame]
        result["cached_ret_posed_delta"][frame] = posed[window]
        result["cached_ret_canonical_delta"][frame] = np.concatenate(
            [canonical, np.ones((*canonical.shape[:2], 1))], axis=-1
        )
        result["cached_fin_rotation_quad"][frame], result["cached_fin_translation_quad"][frame] = pieces[0]
        result["cached_temp_vert_normal"][frame] = np.stack([unit_normals(posed[k], template.faces) for k in window])
    return result


def unit_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals `[v, 3]` as the release has them: the mean of the adjacent faces' unit normals, not weighted by area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    return mean_vertex_normals(len(vertices), faces, across)


def _unpose(posed: np.ndarray, real: np.ndarray, dual: np.ndarray) -> np.ndarray:
    """Invert the rigid motion of unit dual quaternions: x = R^T (y - t)."""
    shift = 2 * (real[:, :1] * dual[:, 1:] - dual[:, :1] * real[:, 1:] + np.cross(real[:, 1:], dual[:, 1:]))
    return Rotation.from_quat(real, scalar_first=True).apply(posed - shift, inverse=True)


def graph_nodes(template: TemplateMesh) -> np.ndarray:
    """Vertices that serve as nodes of the embedded graph, each more than two edges from all others.

    The release reaches vertices up to three edges from a node. It looks a node up as the nearest vertex that is not
    taken yet, so of two vertices at one point it may take the other one; what that leaves out of reach becomes a node.

    Raises:
        InputError: the mesh is in so many pieces with vertices at one point that this never ends.
    """
    step = _edges(template) + eye_array(len(template.vertices), format="csr")
    near = step @ step
    reach = near @ step
    nodes: list[int] = []
    far = np.arange(len(template.vertices))
    while len(far):
        covered, before = near[np.array(nodes, dtype=np.int64)].sum(axis=0) > 0, len(nodes)
        for vertex in far:
            if not covered[vertex]:
                nodes.append(int(vertex))
                covered[near.indices[near.indptr[vertex] : near.indptr[vertex + 1]]] = True
        if len(nodes) == before:
            raise InputError(
                f"template.npz: the release's graph cannot reach {len(far)} vertices, as others lie at the same points;"
                " expected faces that share their vertices"
            )
        far = np.flatnonzero(reach[taken_vertices(template.vertices, nodes)].sum(axis=0) == 0)
    return np.array(nodes)


def taken_vertices(vertices: np.ndarray, nodes: Sequence[int]) -> np.ndarray:
    """Which vertex the release takes for each node, in the order of the graph's file."""
    free = np.ones(len(vertices), dtype=bool)
    taken = []
    for node in nodes:
        distance = np.where(free, np.linalg.norm(vertices - vertices[node], axis=1), np.inf)
        taken.append(int(np.argmin(distance)))
        free[taken[-1]] = False
    return np.array(taken)


def graph_faces(template: TemplateMesh, nodes: np.ndarray) -> np.ndarray:
    """Triangles `[f, 3]` of nodes whose regions (of nearest vertices along edges) meet in a face of the template."""
    _, _, nearest = dijkstra(
        _edges(template), directed=False, indices=nodes, unweighted=True, min_only=True, return_predecessors=True
    )
    index = np.full(len(template.vertices), -1)
    index[nodes] = np.arange(len(nodes))
    corners = index[nearest[template.faces]]
    distinct = (np.diff(np.sort(corners, axis=1), axis=1) > 0).all(axis=1)
    _, first = np.unique(np.sort(corners[distinct], axis=1), axis=0, return_index=True)
    return corners[distinct][np.sort(first)]


def _edges(template: TemplateMesh) -> csr_array:
    one, other = template.faces.ravel(), template.faces[:, [1, 2, 0]].ravel()
    ends = np.concatenate([one, other]), np.concatenate([other, one])
    count = len(template.vertices)
    return coo_array((np.ones(len(ends[0])), ends), shape=(count, count)).tocsr()


def export_official(capture: Capture, folder: Path) -> Path:
    """Write everything that the released trainer reads of a subject. Training views only, as there."""
    skeleton, template, train = capture.skeleton, capture.template, capture.splits["train"]
    cameras = [capture.cameras[name] for name in train.cameras]
    _require_readable(capture, cameras)
    meta = folder / "meta_data" / SUBJECT
    dofs = to_official_dofs(capture.motion.dofs)
    windows = np.stack([capture.motion.window(frame, 3) for frame in range(len(dofs))])
    training = max(train.frames) + 1
    nodes = graph_nodes(template)
    node_faces = graph_faces(template, nodes)
    hands = dict.fromkeys(skeleton.names, "0\n") | {"hand_left": "1\n", "hand_right": "2\n"}
    texts = {
        "ddc.skeleton": skeleton_text(skeleton),
        "ddc.skin": skin_text(skeleton, template.skin_weights),
        "ddc.motion": motion_text(np.zeros((1, dofs.shape[1]))),
        "ddc.obj": obj_text(template.vertices, template.faces, uvs=template.uvs, uv_faces=template.uv_faces),
        "ddc.obj.mtl": "newmtl cloth\nmap_Kd ddc.png\n",
        "ddc_graph.obj": obj_text(
            template.vertices[nodes], node_faces, uvs=np.zeros((len(nodes), 2)), uv_faces=node_faces
        ),
        "segmentation.txt": "0\n" * len(template.vertices),
        "hand_segmentation.txt": "".join(hands[skeleton.names[j]] for j in np.argmax(template.skin_weights, axis=1)),
        "real_translation.txt": "0 0 0\n",
        "cameras.calibration": calibration_text(cameras),
    }
    relative = normalise_motion(dofs, windows)
    for name, first, last in (("skeletoolToGTPose", 0, training), ("skeletoolToGTPoseTest", training, len(dofs))):
        if first < last:
            texts[f"{name}/poseAngles.motion"] = motion_text(dofs[first:last])
            texts[f"{name}/poseAnglesRotationNormalized.motion"] = motion_text(relative[3 * first : 3 * last])
    for name, text in texts.items():
        write_atomic(meta / name, text.encode())
    write_json(meta / "cameras.json", cameras_json(cameras))
    texture = capture.folder / "truth" / "texture.png"
    if texture.is_file():
        write_atomic(meta / "ddc.png", texture.read_bytes())
    for name, array in cached_arrays(capture).items():
        write_atomic(folder / "cached_files" / f"{name}.pkl", pickle.dumps(array, protocol=4))
    images = folder / "raw_data" / SUBJECT / "metadata" / "training"
    for index, camera in enumerate(train.cameras):
        for frame in train.frames:
            rgba = capture.image(camera, frame)
            name = f"{index}/image_c_{index}_f_{frame}.png"
            write_image(images / "images" / name, rgba[..., :3])
            mask = np.where(rgba[..., 3:] > FOREGROUND, np.uint8(255), np.uint8(0))
            write_image(images / "foregroundSegmentation" / name, np.repeat(mask, 3, axis=-1))
    return folder


def _require_readable(capture: Capture, cameras: list[Camera]) -> None:
    """The release reads pinholes, an image of every camera in every frame, and no vertex that belongs to no face."""
    if not all(camera.is_pinhole for camera in cameras):
        raise InputError(f"{capture.folder}: a lens distorts; expected pinholes: ash-bench export --format undistorted")
    if capture.splits["train"].parts:
        raise InputError(
            f"{capture.folder}: a part of the cameras saw each frame, and the release reads an image of every camera in"
            " every frame; make the capture with --rig.cameras-per-frame 0"
        )
    unused = len(capture.template.vertices) - len(np.unique(capture.template.faces))
    if unused:
        raise InputError(f"{capture.folder}/template.npz: {unused} vertices belong to no face, expected none")
