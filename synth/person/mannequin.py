"""A small procedural humanoid of tubes with rectangular UV charts. No download, no cache: the body of tests."""

import numpy as np

from synth.person.body import PARTS, Body, Face, Surface
from synth.person.tubes import Tube, chain_weights, chart_uvs, grid_faces, lattice, skirt_weights
from synth.skeleton import SIDES, SIGNS, make_skeleton

ATLAS = 1.87  # metres of cloth along the side of the UV square


def heads() -> dict[str, np.ndarray]:
    """Rest position of each joint, metres: 1.72 m tall, arms at 45 degrees."""
    result: dict[str, tuple[float, ...]] = {
        "pelvis": (0, 0.95, 0),
        "spine": (0, 1.06, 0),
        "chest": (0, 1.20, 0),
        "neck": (0, 1.45, 0),
        "head": (0, 1.53, 0.01),
    }
    for side, sign in zip(SIDES, SIGNS, strict=True):
        arm = np.array([0.7071 * sign, -0.7071, 0])
        shoulder = np.array([0.17 * sign, 1.39, 0])
        result |= {
            f"clavicle_{side}": (0.03 * sign, 1.40, 0),
            f"upper_arm_{side}": tuple(shoulder),
            f"forearm_{side}": tuple(shoulder + 0.28 * arm),
            f"hand_{side}": tuple(shoulder + 0.52 * arm),
            f"thigh_{side}": (0.09 * sign, 0.90, 0),
            f"shin_{side}": (0.095 * sign, 0.50, 0.012),
            f"foot_{side}": (0.10 * sign, 0.09, -0.01),
            f"toe_{side}": (0.105 * sign, 0.03, 0.10),
        }
    return {name: np.array(value, dtype=np.float64) for name, value in result.items()}


def _tubes(*, skirt: bool) -> list[Tube]:
    up = (0.0, 0.0, 1.0)
    torso = np.array([[0, 0.84, 0], [0, 0.9, 0], [0, 1.06, 0], [0, 1.25, 0], [0, 1.38, 0], [0, 1.44, 0], [0, 1.46, 0]])
    width = np.array(
        [[0.02, 0.02], [0.16, 0.11], [0.14, 0.1], [0.165, 0.115], [0.165, 0.1], [0.075, 0.07], [0.05, 0.05]]
    )
    head = np.array([[0, 1.44, 0], [0, 1.5, 0], [0, 1.54, 0.02], [0, 1.63, 0.015], [0, 1.7, 0], [0, 1.725, 0]])
    skull = np.array([[0.05, 0.05], [0.052, 0.055], [0.065, 0.085], [0.08, 0.1], [0.05, 0.06], [0.004, 0.004]])
    tubes = [
        Tube(part="shirt", knots=torso, radii=width, front=up, chain=("pelvis", "spine", "chest", "neck"),
             borders=(0.3, 0.52, 0.97), rings=19, segments=24, chart=(0.95, 0.42, 0.9, 0.62)),
        Tube(part="skin", knots=head, radii=skull, front=up, chain=("neck", "head"), borders=(0.3,), rings=14,
             segments=20, chart=(0.95, 1.06, 0.55, 0.36)),
    ]  # fmt: skip
    joints = heads()
    for k, (side, sign) in enumerate(zip(SIDES, SIGNS, strict=True)):
        shoulder, wrist = joints[f"upper_arm_{side}"], joints[f"hand_{side}"]
        arm = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
        along = np.array([0.7, 0.62, 0.56, 0.5, 0.28, 0.1, -0.02, -0.06])[:, None]
        thick = np.array([[0.004, 0.01], [0.02, 0.045], [0.022, 0.048], [0.03, 0.03], [0.042, 0.042], [0.05, 0.052],
                          [0.05, 0.055], [0.01, 0.01]])  # fmt: skip
        tubes.append(
            Tube(part="shirt", knots=shoulder + along * arm, radii=thick, front=up,
                 chain=(f"hand_{side}", f"forearm_{side}", f"upper_arm_{side}", "chest"), borders=(0.25, 0.58, 0.97),
                 rings=18, segments=12, chart=(0.31 * k, 1.31, 0.29, 0.55), blend=0.07)
        )  # fmt: skip
        hip, knee, ankle = (joints[f"{name}_{side}"] for name in ("thigh", "shin", "foot"))
        leg = np.array([ankle - [0, 0.05, 0], ankle, (knee + 2 * ankle) / 3, (2 * knee + ankle) / 3, knee,
                        (hip + 2 * knee) / 3, (2 * hip + knee) / 3, hip, hip - [0.02 * sign, -0.06, 0]])  # fmt: skip
        calf = np.array([[0.03, 0.03], [0.042, 0.046], [0.05, 0.058], [0.056, 0.062], [0.058, 0.062], [0.068, 0.073],
                         [0.08, 0.085], [0.085, 0.095], [0.02, 0.02]])  # fmt: skip
        tubes.append(
            Tube(part="trousers", knots=leg, radii=calf, front=up,
                 chain=(f"foot_{side}", f"shin_{side}", f"thigh_{side}", "pelvis"), borders=(0.08, 0.5, 0.96),
                 rings=22, segments=14, chart=(0.47 * k, 0.42, 0.45, 0.87), blend=0.06)
        )  # fmt: skip
        toe = joints[f"toe_{side}"] * [1, 0, 1] + [0, 0.035, 0]
        sole = np.array([toe - [0, 0.004, -0.09], toe - [0, 0, -0.07], toe, toe - [0, -0.01, 0.08],
                         toe - [0, -0.014, 0.15],
                         toe - [0, -0.01, 0.175]])  # fmt: skip
        thick = np.array([[0.01, 0.006], [0.034, 0.026], [0.046, 0.034], [0.04, 0.045], [0.036, 0.048], [0.012, 0.015]])
        tubes.append(
            Tube(part="shoes", knots=sole, radii=thick, front=(0.0, 1.0, 0.0), chain=(f"toe_{side}", f"foot_{side}"),
                 borders=(0.38,), rings=9, segments=12, chart=((1.42, 0.0), (1.55, 1.06))[k] + (0.3, 0.26))
        )  # fmt: skip
    if skirt:
        hem = np.array([[0, 0.60, 0], [0, 0.7, 0], [0, 0.84, 0], [0, 0.98, 0], [0, 1.02, 0]])
        wide = np.array([[0.27, 0.24], [0.24, 0.21], [0.2, 0.165], [0.165, 0.13], [0.155, 0.12]])
        tubes.append(
            Tube(part="skirt", knots=hem, radii=wide, front=up, chain=("pelvis",), borders=(), rings=12, segments=30,
                 chart=(0.0, 0.0, 1.4, 0.4))
        )  # fmt: skip
    return tubes


def mannequin(*, skirt: bool) -> Body:
    """Build the mannequin; the template keeps every second ring and every second segment."""
    skeleton = make_skeleton(heads())
    vertices, weights, uvs, faces, uv_faces, part = [], [], [], [], [], []
    surface_vertices, template_faces, template_uv_faces, template_part = [], [], [], []
    vertex_count = uv_count = template_count = 0
    for tube in _tubes(skirt=skirt):
        points, along = lattice(tube, 2 * tube.rings - 1, 2 * tube.segments)
        rows, columns = points.shape[:2]
        flat = points.reshape(-1, 3)
        vertices.append(flat)
        rings = chain_weights(tube, along, skeleton.names)
        skirted = tube.part == "skirt"
        weights.append(
            skirt_weights(flat, skeleton.names, top=1.0, length=0.4) if skirted else np.repeat(rings, columns, axis=0)
        )
        u, v, width, height = tube.chart
        uvs.append(([u + 0.005, v + 0.005] + chart_uvs(rows, columns) * [width, height]) / ATLAS)
        faces.append(vertex_count + grid_faces(rows, columns, stride=columns, wrap=columns))
        uv_faces.append(uv_count + grid_faces(rows, columns, stride=columns + 1, wrap=columns + 1))
        part.append(np.full(len(faces[-1]), PARTS.index(tube.part)))
        even_rows, even_columns = (rows + 1) // 2, columns // 2
        surface_vertices.append(
            vertex_count + (2 * np.arange(even_rows)[:, None] * columns + 2 * np.arange(even_columns)).ravel()
        )
        template_faces.append(
            template_count + grid_faces(even_rows, even_columns, stride=even_columns, wrap=even_columns)
        )
        template_part.append(np.full(len(template_faces[-1]), part[-1][0]))
        coarse = grid_faces(even_rows, even_columns, stride=even_columns + 1, wrap=even_columns + 1)
        row, column = np.divmod(coarse, even_columns + 1)
        template_uv_faces.append(uv_count + 2 * row * (columns + 1) + 2 * column)
        vertex_count += rows * columns
        uv_count += rows * (columns + 1)
        template_count += even_rows * even_columns
    surface = Surface(
        vertices=np.concatenate(vertices),
        faces=np.concatenate(faces),
        uvs=np.concatenate(uvs),
        uv_faces=np.concatenate(uv_faces),
        part=np.concatenate(part),
    )
    triangles = np.concatenate(template_faces)
    cage, cage_faces = np.unique(
        triangles[np.concatenate(template_part) == PARTS.index("skirt")], return_inverse=True
    )  # fmt: skip
    return Body(
        skeleton=skeleton,
        surface=surface,
        skin_weights=np.concatenate(weights),
        face=Face(
            eyes=np.array([[0.03, 1.63, 0.1], [-0.03, 1.63, 0.1]]), mouth=np.array([0, 1.565, 0.1]), modelled=False
        ),
        template_to_surface=np.concatenate(surface_vertices),
        template_faces=triangles,
        template_uv_faces=np.concatenate(template_uv_faces),
        cage=np.concatenate(surface_vertices)[cage],
        cage_faces=cage_faces.reshape(-1, 3),
    )
