"""Exports of a finished capture: the released code's formats, nerfstudio, COLMAP text, and an animated GLB."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ash.capture.dataset import Capture, Split
from ash.files import InputError, write_atomic, write_image, write_json
from synth.person.body import vertex_normals
from synth.posing import bone_frames, dual_quaternion_skinning, rotmat_to_unitquat, skinning_transforms
from synth.readers.official import export_official


def export_nerfstudio(capture: Capture, folder: Path, *, split: str = "train", frame: int | None = None) -> Path:
    """`transforms.json` per frame folder, OpenGL cameras, images with alpha: one static scene per frame of a split."""
    chosen = _split(capture, split)
    frames = chosen.frames if frame is None else (_frame(chosen, split, frame),)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    for index in frames:
        target = folder / f"frame_{index:06d}"
        rows = []
        for name in chosen.seeing(index):
            camera = capture.cameras[name]
            write_image(target / "images" / f"{name}.png", capture.image(name, index))
            rows.append(
                {
                    "file_path": f"images/{name}.png",
                    "fl_x": float(camera.K[0, 0]), "fl_y": float(camera.K[1, 1]),
                    "cx": float(camera.K[0, 2]), "cy": float(camera.K[1, 2]),
                    "w": camera.width, "h": camera.height,
                    **dict(zip(("k1", "k2", "p1", "p2"), camera.distortion.tolist(), strict=True)),
                    "transform_matrix": (np.linalg.inv(camera.viewmat) @ flip).tolist(),
                }
            )  # fmt: skip
        write_json(target / "transforms.json", {"camera_model": "OPENCV", "frames": rows})
    count = f"{len(frames)} frame{'s' if len(frames) > 1 else ''}"
    by = f"{len(chosen.seeing(frames[0]))} of its {len(chosen.cameras)} cameras"
    _say(capture, folder, f"{count} of split {split}, a folder each, seen by {by}")
    return folder


def export_colmap(capture: Capture, folder: Path, *, split: str = "train", frame: int | None = None) -> Path:
    """COLMAP text model of a frame (by default the first): cameras, images, points of the skinned template."""
    chosen = _split(capture, split)
    frame = chosen.frames[0] if frame is None else _frame(chosen, split, frame)
    cameras, images = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS"], ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"]
    seeing = chosen.seeing(frame)
    for index, name in enumerate(seeing, start=1):
        camera = capture.cameras[name]
        K = [float(value) for value in camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]]
        model = "PINHOLE" if camera.is_pinhole else "OPENCV"
        K += [] if camera.is_pinhole else camera.distortion.tolist()
        cameras.append(f"{index} {model} {camera.width} {camera.height} " + " ".join(map(repr, K)))
        pose = (*rotmat_to_unitquat(camera.viewmat[:3, :3]), *camera.viewmat[:3, 3])
        images += [f"{index} " + " ".join(repr(float(v)) for v in pose) + f" {index} {name}.png", ""]
        write_image(folder / "images" / f"{name}.png", capture.image(name, frame))
    points = ["# POINT3D_ID X Y Z R G B ERROR TRACK"]
    transforms = skinning_transforms(capture.skeleton, capture.motion.dofs[[frame]])[0]
    posed = dual_quaternion_skinning(capture.template.vertices, capture.template.skin_weights, transforms)
    for index, point in enumerate(posed, start=1):
        points.append(f"{index} " + " ".join(repr(float(v)) for v in point) + " 128 128 128 0")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        text = "\n".join(lines) + "\n"
        write_atomic(folder / "sparse" / "0" / f"{name}.txt", text.encode())
    what = f"split {split}, frame {frame}, seen by {len(seeing)} of its {len(chosen.cameras)} cameras"
    _say(capture, folder, f"{what}; the points are the template's vertices, skinned to that frame")
    return folder


def _split(capture: Capture, name: str) -> Split:
    if name not in capture.splits:
        raise InputError(f"{capture.folder}: no split {name!r}, expected one of {', '.join(capture.splits)}")
    return capture.splits[name]


def _frame(split: Split, name: str, frame: int) -> int:
    if frame not in split.frames:
        known = ", ".join(str(known) for known in split.frames[:20]) + (", ..." if len(split.frames) > 20 else "")
        raise InputError(f"no frame {frame} in split {name}, expected one of {known}")
    return frame


def _say(capture: Capture, folder: Path, what: str) -> None:
    """State in the export's folder what of the capture it holds."""
    write_atomic(folder / "ABOUT.txt", f"{capture.scene}, capture {capture.identity[:12]}: {what}.\n".encode())


def export_glb(capture: Capture, folder: Path) -> Path:
    """`human.glb`: the skinned, textured, animated template for any viewer. glTF skins linearly: joints are softer."""
    template, skeleton = capture.template, capture.skeleton
    pairs, corners = np.unique(
        np.stack([template.faces.ravel(), template.uv_faces.ravel()], axis=1), axis=0, return_inverse=True
    )
    order = np.argsort(-template.skin_weights[pairs[:, 0]], axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(template.skin_weights[pairs[:, 0]], order, axis=1)
    buffer = GlbBuffer()
    normals = vertex_normals(template.vertices, template.faces)[pairs[:, 0]]
    attributes = {
        "POSITION": buffer.add(template.vertices[pairs[:, 0]].astype(np.float32), "VEC3", bounds=True),
        "NORMAL": buffer.add(normals.astype(np.float32), "VEC3"),
        "TEXCOORD_0": buffer.add((template.uvs[pairs[:, 1]] * [1, -1] + [0, 1]).astype(np.float32), "VEC2"),
        "JOINTS_0": buffer.add(order.astype(np.uint16), "VEC4"),
        "WEIGHTS_0": buffer.add((weights / weights.sum(axis=1, keepdims=True)).astype(np.float32), "VEC4"),
    }
    indices = buffer.add(corners.reshape(-1).astype(np.uint32), "SCALAR")
    inverse = np.tile(np.eye(4), (len(skeleton.names), 1, 1))
    inverse[:, :3, 3] = -skeleton.heads
    binds = buffer.add(np.swapaxes(inverse, 1, 2).reshape(-1, 16).astype(np.float32), "MAT4")
    nodes, animation = _joint_nodes(capture, buffer)
    document = {
        "asset": {"version": "2.0", "generator": "ash-bench"},
        "scene": 0,
        "scenes": [{"nodes": [0, len(nodes)]}],
        "nodes": [*nodes, {"mesh": 0, "skin": 0, "name": "human"}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "skins": [{"joints": list(range(len(nodes))), "inverseBindMatrices": binds}],
        "animations": [animation],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "doubleSided": True}],
    }
    texture = capture.folder / "truth" / "texture.png"
    if texture.is_file():
        document["images"] = [{"bufferView": buffer.raw(texture.read_bytes()), "mimeType": "image/png"}]
        document["textures"] = [{"source": 0}]
        document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}  # type: ignore[index]
    write_atomic(folder / "human.glb", buffer.pack(document))
    return folder


def _joint_nodes(capture: Capture, buffer: "GlbBuffer") -> tuple[list[dict], dict]:
    """glTF nodes of the joints, and the animation that moves them."""
    skeleton, motion = capture.skeleton, capture.motion
    frames = bone_frames(skeleton, motion.dofs)
    times = buffer.add(np.arange(len(frames), dtype=np.float32) / motion.fps, "SCALAR", bounds=True)
    nodes: list[dict] = []
    channels: list[dict] = []
    samplers: list[dict] = []
    for j, (name, parent) in enumerate(zip(skeleton.names, skeleton.parents, strict=True)):
        rest = skeleton.heads[j] - (skeleton.heads[parent] if parent >= 0 else 0)
        children = [int(k) for k in np.flatnonzero(skeleton.parents == j)]
        nodes.append({"name": name, "translation": rest.tolist(), **({"children": children} if children else {})})
        above = frames[:, parent, :3, :3] if parent >= 0 else np.eye(3)
        quats = rotmat_to_unitquat(np.swapaxes(above, -1, -2) @ frames[:, j, :3, :3])
        tracks = [("rotation", quats[:, [1, 2, 3, 0]], "VEC4")]
        if parent < 0:
            tracks.append(("translation", frames[:, 0, :3, 3], "VEC3"))
        for path, values, kind in tracks:
            channels.append({"sampler": len(samplers), "target": {"node": j, "path": path}})
            samplers.append({"input": times, "output": buffer.add(values.astype(np.float32), kind)})
    return nodes, {"channels": channels, "samplers": samplers}


COMPONENT_TYPES = {"float32": 5126, "uint32": 5125, "uint16": 5123}


class GlbBuffer:
    """The binary chunk of a GLB and the accessors into it."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def raw(self, content: bytes) -> int:
        """Append bytes as a buffer view of their own, and return its index."""
        self.content += b"\0" * (-len(self.content) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content)})
        self.content += content
        return len(self.views) - 1

    def add(self, array: np.ndarray, kind: str, *, bounds: bool = False) -> int:
        """Append an array as an accessor of glTF type `kind`, with its bounds where glTF asks for them; its index."""
        accessor = {
            "bufferView": self.raw(np.ascontiguousarray(array).tobytes()),
            "componentType": COMPONENT_TYPES[str(array.dtype)],
            "count": len(array),
            "type": kind,
        }
        if bounds:
            flat = array.reshape(len(array), -1)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def pack(self, document: dict) -> bytes:
        """The whole file: the document, completed by what was added, and the binary chunk."""
        self.content += b"\0" * (-len(self.content) % 4)
        document = {**document, "buffers": [{"byteLength": len(self.content)}]}
        document |= {"bufferViews": self.views, "accessors": self.accessors}
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(self.content)
        head = struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self.content), b"BIN\0") + bytes(self.content)


FORMATS: dict[str, Callable[..., Path]] = {
    "ash": export_official,
    "nerfstudio": export_nerfstudio,
    "colmap": export_colmap,
    "glb": export_glb,
}


CHOOSING = ("nerfstudio", "colmap")  # A frame and a split can be chosen; the others hold what their name says.
WHOLE = {"ash": "ash holds the whole training part, as the release reads it", "glb": "glb holds the whole motion"}


def export(capture: Capture, folder: Path, *, form: str, split: str | None = None, frame: int | None = None) -> Path:
    """Write a capture into `folder` in one of the `FORMATS`; of nerfstudio and COLMAP a split and a frame.

    Raises:
        InputError: an unknown format, split or frame, or a folder that cannot be written.
    """
    if form not in FORMATS:
        raise InputError(f"unknown format {form!r}, expected one of {', '.join(FORMATS)}")
    if form in WHOLE and (split, frame) != (None, None):
        raise InputError(f"{WHOLE[form]}; a split or a frame is chosen with {' or '.join(CHOOSING)}")
    choice = {} if form in WHOLE else {"split": split or "train", "frame": frame}
    try:
        return FORMATS[form](capture, folder, **choice)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from error
