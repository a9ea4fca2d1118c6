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


def read_obj(path):
    """Vertices (mm), UVs and faces `[f, 3, 2]` (vertex, UV) of an OBJ whose vertices have colours."""
    vertices, uvs, faces = [], [], []
    for line in path.read_text().splitlines():
        kind, *rest = line.split()
        if kind == "v":
            assert len(rest) == 6, line
            vertices.append([float(value) for value in rest[:3]])
        elif kind == "vt":
            uvs.append([float(value) for value in rest])
        elif kind == "f":
            faces.append([[int(index) - 1 for index in corner.split("/")] for corner in rest])
    return np.array(vertices), np.array(uvs), np.array(faces)


def read_motion(path):
    """Degrees of freedom `[t, d]`, frame by frame."""
    lines = path.read_text().splitlines()
    assert lines[0] == "Skeletool Motion File V1.0"
    return np.array([[float(value) for value in line.split()[1:]] for line in lines[1:]])


class Skeletool:
    """A reader of `ddc.skeleton` and its forward kinematics: one axis per joint, parameters summed from DoFs."""

    def __init__(self, path):
        lines = iter(path.read_text().splitlines())
        assert next(lines).startswith("Skeletool Skeleton Definition")
        self.rows = [next(lines).split() for _ in range(int(next(lines).removeprefix("joints: ")))]
        self.names = [row[0] for row in self.rows]
        assert [next(lines), next(lines)] == ["markers: 0", "scaling joints: 0"]
        dofs = int(next(lines).removeprefix("dofs: "))
        self.mixing = np.zeros((len(self.rows), dofs))
        for dof in range(dofs):
            entries = int(next(lines).split()[1])
            assert next(lines) == "nolimits"
            for _ in range(entries):
                joint, weight = next(lines).split()
                self.mixing[self.names.index(joint), dof] += float(weight)

    def frames(self, dofs):
        """Joint to world `[j, 4, 4]`, mm."""
        frames = {}
        for (name, kind, parent, *numbers), parameter in zip(self.rows, self.mixing @ dofs, strict=True):
            offset, axis, scale = np.array(numbers[:3], float), np.array(numbers[3:6], float), float(numbers[6])
            local = np.eye(4)
            local[:3, 3] = offset * scale + (axis * parameter if kind == "prismatic" else 0)
            if kind == "revolute":
                x, y, z = axis / np.linalg.norm(axis)
                cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
                local[:3, :3] += np.sin(parameter) * cross + (1 - np.cos(parameter)) * cross @ cross
            frames[name] = local if parent == "none" else frames[parent] @ local
        return np.array([frames[name] for name in self.names])


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
    dofs = read_motion(meta / "skeletoolToGTPose" / "poseAngles.motion")
    skeleton, faces = Skeletool(meta / "ddc.skeleton"), read_obj(meta / "ddc.obj")[2][..., 0]
    joints_mm, posed_mm, ious, offset_px = [], [], [], []
    for frame, posed in cached["ret_posed_delta"].items():
        joints_mm.append(np.abs(skeleton.frames(dofs[frame])[:, :3, 3] - cached["joints"][frame]).max())
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
