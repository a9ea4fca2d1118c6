"""Reads `export --format ash` as the released code of ASH does, with NumPy and Pillow alone; prints what it measured.

`python outsider_release.py FOLDER`. Written anew from a description of the files, keys and conventions that the release
relies on: `cameras.json` (camera to world, axes z x y, metres; field of view and principal point; a pixel's centre at
+0.5), images and masks by camera and frame, `ddc.skeleton`, `ddc.obj`, the motion, and the six cached arrays (mm).
"""

import json
import pickle
import sys
from pathlib import Path

import numpy as np
from PIL import Image

CACHED = ("joints", "ret_posed_delta", "ret_canonical_delta", "fin_rotation_quad", "fin_translation_quad",
          "temp_vert_normal")  # fmt: skip
NEAR, FAR = 0.01, 100.0
GRID = 12  # points along the edge of a face that stand for the surface


def read_cameras(path):
    """Per camera: the matrix from world (z, x, y) to clip space, width, height. Four keys of a row are read."""
    content = json.loads(path.read_text())
    width, height, cameras = content["w"], content["h"], []
    for row in content["frames"]:
        clip = np.zeros((4, 4))
        clip[0, 0], clip[1, 1] = 1 / np.tan(row["camera_angle_x"] / 2), 1 / np.tan(row["camera_angle_y"] / 2)
        clip[0, 2], clip[1, 2] = 2 * (row["cx"] - width / 2) / width, 2 * (row["cy"] - height / 2) / height
        clip[2, 2], clip[2, 3], clip[3, 2] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR), 1
        cameras.append((clip @ np.linalg.inv(np.array(row["transform_matrix"])), int(width), int(height)))
    return cameras


def project(points_mm, camera):
    """Pixels `[n, 2]` as the rasteriser counts them: the first one's centre is 0."""
    full, width, height = camera
    world = points_mm[:, [2, 0, 1]] / 1000
    clip = np.concatenate([world, np.ones((len(world), 1))], axis=1) @ full.T
    ndc = clip[:, :2] / clip[:, 3:]
    return ((ndc + 1) * (width, height) - 1) / 2


def read_faces(path):
    """Triangles of an OBJ whose vertices have colours and whose faces are v/vt."""
    faces = []
    for line in path.read_text().splitlines():
        kind, *rest = line.split()
        if kind == "v":
            assert len(rest) == 6, line
        if kind == "f":
            faces.append([int(corner.split("/")[0]) - 1 for corner in rest])
    return np.array(faces)


def forward_kinematics(text, dofs):
    """Where the joints of `ddc.skeleton` are, `[j, 3]` mm: one axis per joint, parameters summed from DoFs."""
    lines = iter(text.splitlines()[1:])
    rows = [next(lines).split() for _ in range(int(next(lines).split()[1]))]
    names, parameters = [row[0] for row in rows], np.zeros(len(rows))
    for _ in range(int(next(lines).split()[1])):
        next(lines)  # markers
    assert next(lines) == "scaling joints: 0"
    for dof in dofs[: int(next(lines).split()[1])]:
        entries = int(next(lines).split()[1])
        next(lines)  # limits
        for _ in range(entries):
            joint, weight = next(lines).split()
            parameters[names.index(joint)] += float(weight) * dof
    frames = {}
    for (name, kind, parent, *numbers), parameter in zip(rows, parameters, strict=True):
        offset, axis, scale = np.array(numbers[:3], float), np.array(numbers[3:6], float), float(numbers[6])
        local = np.eye(4)
        local[:3, 3] = offset * scale + (axis * parameter if kind == "prismatic" else 0)
        if kind == "revolute":
            x, y, z = axis / np.linalg.norm(axis)
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            local[:3, :3] += np.sin(parameter) * cross + (1 - np.cos(parameter)) * cross @ cross
        frames[name] = local if parent == "none" else frames[parent] @ local
    return np.array([frames[name][:3, 3] for name in names])


def pose(canonical, real, dual):
    """Vertices `[v, 3]` moved by unit dual quaternions (wxyz)."""
    w, x, y, z = real.T
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
    shift = 2 * (w[:, None] * dual[:, 1:] - dual[:, :1] * real[:, 1:] + np.cross(real[:, 1:], dual[:, 1:]))
    return np.einsum("abv,vb->va", np.array(rows), canonical) + shift


def surface(vertices, faces):
    """Points all over the faces."""
    steps = np.linspace(0, 1, GRID)
    weights = np.array([(1 - u - v, u, v) for u in steps for v in steps if u + v <= 1 + 1e-9])
    return np.einsum("pc,fcd->fpd", weights, vertices[faces]).reshape(-1, 3)


def main(folder):
    """Measure how what is read fits together, and print it as JSON."""
    (meta,) = (folder / "meta_data").iterdir()
    training = folder / "raw_data" / meta.name / "metadata" / "training"
    cached = {name: pickle.loads((folder / "cached_files" / f"cached_{name}.pkl").read_bytes()) for name in CACHED}
    motion = (meta / "skeletoolToGTPose" / "poseAngles.motion").read_text().splitlines()[1:]
    dofs = {int(line.split()[0]): np.array(line.split()[1:], float) for line in motion}
    skeleton, faces = (meta / "ddc.skeleton").read_text(), read_faces(meta / "ddc.obj")
    joints_mm, posed_mm, ious, offset_px = [], [], [], []
    for frame, posed in cached["ret_posed_delta"].items():
        joints_mm.append(np.abs(forward_kinematics(skeleton, dofs[frame]) - cached["joints"][frame]).max())
        canonical = cached["ret_canonical_delta"][frame][0, :, :3]
        moved = pose(canonical, cached["fin_rotation_quad"][frame], cached["fin_translation_quad"][frame])
        posed_mm.append(np.abs(moved - posed[0]).max())
        for number, camera in enumerate(read_cameras(meta / "cameras.json")):
            name = f"{number}/image_c_{number}_f_{frame}.png"
            mask = np.array(Image.open(training / "foregroundSegmentation" / name))[..., -1] > 50
            assert np.array(Image.open(training / "images" / name)).shape == (*mask.shape, 3)
            pixels = project(surface(posed[0], faces), camera)
            central = pixels[(np.abs(pixels - pixels.round()) < 0.2).all(axis=1)]
            column, row = central.round().astype(int).T
            drawn = np.zeros_like(mask)
            within = (row >= 0) & (row < mask.shape[0]) & (column >= 0) & (column < mask.shape[1])
            drawn[row[within], column[within]] = True
            ious.append((drawn & mask).sum() / (drawn | mask).sum())
            offset_px.append(np.argwhere(drawn).mean(axis=0) - np.argwhere(mask).mean(axis=0))
    measured = {"joints_mm": max(joints_mm), "posed_mm": max(posed_mm), "iou": min(ious)}
    measured["offset_px"] = np.abs(np.mean(offset_px, axis=0)).max()  # mean over images, the worse axis
    print(json.dumps({name: float(value) for name, value in measured.items()} | {"images": len(ious)}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
