"""Dressing the realistic body at rest: shirt and trousers as meshes of their own, hair, shoes and a skirt."""

import hashlib
import inspect
import sys
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ash.capture.dataset import Skeleton
from ash.files import InputError, read_arrays, write_arrays
from synth.person import body, garments, mesh, tubes
from synth.person.anny_body import bake_key, baked_body, cache_folder
from synth.person.body import PARTS, Body, Face, Surface, neighbour_mean
from synth.person.cast import FIRST, Skirt, Subject, subject
from synth.person.garments import cut_garment, soft_normals
from synth.person.mesh import Charted, beside, decimate, joined, largest_piece, pack, select, subdivide, uv_charts
from synth.person.tubes import Tube, chain_weights, chart_uvs, grid_faces, lattice, skirt_weights
from synth.skeleton import JOINTS, SIDES, make_skeleton

TEMPLATE_VERTICES = 7000
# Lengths in metres are those of subject 0; others are larger or smaller as their legs, feet and heads are.
WAIST = 0.985  # metres above the floor
UNTUCKED = 0.05  # metres that the shirt hangs over the trousers
BAND = 3  # rings of faces that the skin goes on beneath a hem
ANKLE = 0.085  # where the foot is hidden in its shoe
LEG, FOOT = 0.9198, 0.1505  # metres from hip to floor, and from ankle to ball
EYES = np.array([0, 1.6222, 0.1333])
FLARE = (
    (0.52, 0.115),
    (0.62, 0.095),
    (0.74, 0.072),
    (0.86, 0.05),
    (0.95, 0.022),
    (1.01, 0.006),
)  # of a skirt, by height
YOKE = 0.035  # metres above the joint of the chest from where dresses and smocks hang
SLIT = 0.8  # of a coat's length below the waist, that is open in front
DENSITY = {"head": 1.45, "hand": 1.25, "eye": 2.0}
STORED = (
    "vertices", "weights", "faces", "uvs", "uv_faces", "part", "kept", "template_faces", "template_uv_faces",
    "heads", "eyes", "mouth", "cage", "cage_faces",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Measures:
    """How large a body is beside subject 0's, to a thousandth, so that subject 0 itself is exactly 1."""

    leg: float
    foot: float
    head: np.ndarray  # [3] metres from the eyes of subject 0 to this body's

    @classmethod
    def of(cls, baked: dict[str, np.ndarray]) -> "Measures":
        """Measure a baked body."""
        names = [name for name, _ in JOINTS]
        hip, ankle, ball = (baked["heads"][names.index(f"{bone}_left")] for bone in ("thigh", "foot", "toe"))
        return cls(
            leg=round(float(hip[1] / LEG), 3),
            foot=round(float((ball[2] - ankle[2]) / FOOT), 3),
            head=np.round(baked["eyes"].mean(axis=0) - EYES, 3),
        )


def anny_body(*, skirt: bool, number: int = 0) -> Body:
    """A subject's dressed body: in loose clothes with a skirt, or in tight clothes without."""
    person = subject(number).loose if skirt else subject(number)
    modules = (sys.modules[__name__], garments, mesh, tubes, body)
    source = "".join(inspect.getsource(module) for module in modules)
    cut = (person.head.depth, person.head.nape, person.shirt.sleeve, person.trousers.cuff)
    sewn = (person.skirt.kind, person.skirt.length, person.skirt.fullness) if skirt else ()
    key = hashlib.sha256(f"{skirt} {cut} {sewn} {bake_key(person.shape)} {source}".encode()).hexdigest()[:12]
    path = cache_folder() / f"dressed-{key}.npz"
    if path.is_file():
        try:
            return _unpack(read_arrays(path, expected=STORED), person)
        except InputError:
            path.unlink()
    write_arrays(path, **_dress(person, skirt=skirt))
    return _unpack(read_arrays(path, expected=STORED), person)


def _unpack(stored: dict[str, np.ndarray], person: Subject) -> Body:
    names = [name for name, _ in JOINTS]
    return Body(
        skeleton=make_skeleton(dict(zip(names, stored["heads"], strict=True))),
        surface=Surface(**{name: stored[name] for name in ("vertices", "faces", "uvs", "uv_faces", "part")}),
        skin_weights=stored["weights"],
        face=Face(eyes=stored["eyes"], mouth=stored["mouth"], modelled=True, nape=person.head.nape),
        template_to_surface=stored["kept"],
        template_faces=stored["template_faces"],
        template_uv_faces=stored["template_uv_faces"],
        cage=stored["cage"],
        cage_faces=stored["cage_faces"],
    )


def _dress(person: Subject, *, skirt: bool) -> dict[str, np.ndarray]:
    baked = baked_body(person.number)
    measures = Measures.of(baked)
    skeleton = make_skeleton(dict(zip([name for name, _ in JOINTS], baked["heads"], strict=True)))
    body, chart, density = _clothed(baked, person, "loose" if skirt else "tight")
    tubes = [_shoe(skeleton, side, measures.foot) for side in SIDES]
    if skirt:
        yoke = skeleton.heads[skeleton.names.index("chest"), 1] + YOKE
        tubes.append(_skirt(_trunk(body, skeleton), person.skirt, measures.leg, yoke=yoke))
    for tube in tubes:
        body = _append(body, tube, skeleton, measures.leg)
        chart = np.concatenate([chart, np.full(len(body.faces) - len(chart), chart.max() + 1)])
        density = np.append(density, 1.0)
    body = pack(body, chart, density, gutter=0.004)
    extremities = body.weights[:, [j for j, name in enumerate(skeleton.names) if "hand" in name]].sum(axis=1)
    face = np.exp(-np.sum((body.vertices - baked["eyes"].mean(axis=0)) ** 2, axis=1) / 0.06**2)
    keep = 1 + 2 * face + extremities
    template_faces, template_uv_faces = decimate(body, target=TEMPLATE_VERTICES, keep=keep)
    fine = subdivide(body, np.isin(body.part, [PARTS.index(part) for part in ("shirt", "trousers", "skirt")]))
    used = np.unique(fine.faces)
    number = np.full(len(fine.vertices), -1)
    number[used] = np.arange(len(used))
    template_vertices, template = np.unique(template_faces, return_inverse=True)
    cage, cage_faces = np.unique(body.faces[body.part == PARTS.index("skirt")], return_inverse=True)
    return {
        "vertices": fine.vertices[used],
        "weights": fine.weights[used],
        "faces": number[fine.faces],
        "uvs": fine.uvs,
        "uv_faces": fine.uv_faces,
        "part": fine.part,
        "kept": number[template_vertices],
        "template_faces": template.reshape(-1, 3),
        "template_uv_faces": template_uv_faces,
        "heads": baked["heads"],
        "eyes": baked["eyes"],
        "mouth": baked["mouth"],
        "cage": number[cage],
        "cage_faces": cage_faces.reshape(-1, 3),
    }


def _clothed(
    baked: dict[str, np.ndarray], person: Subject, fit: str
) -> tuple[Charted, np.ndarray, np.ndarray]:  # fmt: skip
    """Skin, hair, eyes, shirt and trousers as one mesh, the chart of each face, and each chart's texel density."""
    bare, kind, group = _bare(baked, person, feet=False)
    leg = Measures.of(baked).leg
    centre = bare.vertices[bare.faces].mean(axis=1)
    neck = baked["heads"][[name for name, _ in JOINTS].index("neck")]
    collar = (np.linalg.norm((centre - neck) * [1, 0.8, 1], axis=1) < 0.085) | (centre[:, 1] > neck[1] + 0.01)
    trunk = kind == "body"
    worn = {
        "shirt": trunk & (centre[:, 1] > leg * (WAIST - UNTUCKED)) & ~collar & ~_past_sleeve(centre, baked, person),
        "trousers": trunk & (centre[:, 1] <= leg * WAIST) & (centre[:, 1] > leg * person.trousers.cuff),
    }
    # Beneath a chin some faces may lie as far from the neck as a shirt does.
    worn["shirt"] = largest_piece(bare.faces, worn["shirt"])
    visible = beside(bare.faces, ~(worn["shirt"] | worn["trousers"]), rings=BAND)
    pieces, groups, kinds = [select(_with_hair(bare, person.head.depth), visible)], [group[visible]], [kind[visible]]
    for layer, (name, faces) in enumerate(worn.items()):
        piece, source = cut_garment(bare, faces, name=name, fit=fit)
        pieces.append(piece)
        groups.append(group[source] + 1000 * (layer + 1))
        kinds.append(kind[source])
    mesh = joined(pieces)
    return mesh, *_charts(mesh, np.concatenate(kinds), np.concatenate(groups))


def body_parts(baked: dict[str, np.ndarray]) -> tuple[Charted, np.ndarray, np.ndarray]:
    """The naked body with its feet, the chart of each face, and each chart's texel density."""
    mesh, kind, group = _bare(baked, FIRST, feet=True)
    return mesh, *_charts(mesh, kind, group)


def _charts(mesh: Charted, kind: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    chart = _merge_small(uv_charts(mesh.uv_faces, group), group)
    return chart, np.array([DENSITY.get(str(kind[chart == k][0]), 1.0) for k in range(chart.max() + 1)])


def _past_sleeve(points: np.ndarray, baked: dict[str, np.ndarray], person: Subject) -> np.ndarray:
    """Which points lie on an arm, beyond the end of the shirt's sleeve."""
    beyond = np.zeros(len(points), dtype=bool)
    names = [name for name, _ in JOINTS]
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        shoulder, wrist = (baked["heads"][names.index(f"{bone}_{side}")] for bone in ("upper_arm", "hand"))
        share = (points - shoulder) @ (wrist - shoulder) / np.sum((wrist - shoulder) ** 2)
        beyond |= (share > person.shirt.sleeve) & (sign * points[:, 0] > abs(shoulder[0]))
    return beyond & (person.shirt.sleeve < 1)


def _bare(baked: dict[str, np.ndarray], person: Subject, *, feet: bool) -> tuple[Charted, np.ndarray, np.ndarray]:
    """Split quads, drop what is never seen (mouth, sockets, feet in shoes), and label hair and eyes.

    Also what each face is of (body, head, hand, eye, foot), and its limb or original chart, which the atlas is cut by.
    """
    quads, uv_quads = baked["quads"], baked["uv_quads"]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    uv_faces = np.concatenate([uv_quads[:, [0, 1, 2]], uv_quads[:, [0, 2, 3]]])
    vertices, weights = baked["vertices"], baked["weights"]
    measures = Measures.of(baked)
    ankle = ANKLE * measures.foot
    centre = vertices[faces].mean(axis=1)
    original = uv_charts(uv_faces, np.zeros(len(faces), dtype=np.int64))
    sizes = np.bincount(original)
    names = np.full(len(sizes), "none", dtype=object)
    body, head = np.argsort(-sizes)[:2]
    for k in range(len(sizes)):
        middle = centre[original == k].mean(axis=0)
        eye = np.linalg.norm(baked["eyes"] - middle, axis=1).min()
        if k in (body, head):
            names[k] = "body" if k == body else "head"
        elif abs(middle[0]) > 0.35:
            names[k] = "hand"
        elif feet and middle[1] < 2 * ankle:
            names[k] = "foot"
        elif eye < 0.03 and sizes[k] < 200 and middle[2] > baked["eyes"][0, 2]:
            names[k] = "eye"
    kind = names[original]
    part = np.full(len(faces), PARTS.index("skin"))
    part[kind == "eye"] = PARTS.index("eyes")
    part[(kind == "head") & _is_scalp(centre - measures.head, person.head.nape)] = PARTS.index("hair")
    seen = (kind != "none") & (feet | ~((kind == "body") & (centre[:, 1] < ankle)))
    group = np.where(kind == "body", _limb(weights[faces].mean(axis=1)), 10 + original)
    mesh = Charted(vertices=vertices, weights=weights, faces=faces, uvs=baked["uvs"], uv_faces=uv_faces, part=part)
    return select(mesh, seen), kind[seen], group[seen]


def _merge_small(chart: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Islands of a few faces that a cut by limbs leaves join the large chart of their group."""
    sizes = np.bincount(chart)
    result = chart.copy()
    for k in np.flatnonzero(sizes < 20):
        alike = group == group[chart == k][0]
        result[chart == k] = np.argmax(np.bincount(chart[alike], minlength=len(sizes)))
    return np.unique(result, return_inverse=True)[1].reshape(-1)


def _is_scalp(points: np.ndarray, nape: float) -> np.ndarray:
    """Above a hairline that slants by `nape`, and not on the ears, for a head that lies where subject 0's does."""
    x, y, z = points.T
    ears = (np.abs(x) > 0.074) & (y < 1.65) & (z > 0.0) & (z < 0.085)
    return (y > 1.553 + 0.98 * z + (nape - 0.98) * (z - EYES[2])) & ~ears


def _limb(weights: np.ndarray) -> np.ndarray:
    """0 torso, 1 and 2 arms, 3 and 4 legs, by the heavier joints."""
    shares = np.zeros((len(weights), 5))
    for j, (name, _) in enumerate(JOINTS):
        arm, leg = "arm" in name or "hand" in name, any(word in name for word in ("thigh", "shin", "foot", "toe"))
        shares[:, (1 if arm else 3) + ("right" in name) if arm or leg else 0] += weights[:, j]
    return np.argmax(shares, axis=1)


def _with_hair(mesh: Charted, most: float) -> Charted:
    """Push the scalp outwards, by `most` metres, less towards the hairline."""
    hair = mesh.part == PARTS.index("hair")
    inner, hairy = np.zeros(len(mesh.vertices), dtype=bool), np.zeros(len(mesh.vertices), dtype=bool)
    hairy[mesh.faces[hair]] = True
    inner[mesh.faces[hair]] = True
    inner[mesh.faces[~hair]] = False
    depth = neighbour_mean(np.where(inner, most, 0.0), mesh.faces, rounds=4) * hairy
    return replace(mesh, vertices=mesh.vertices + depth[:, None] * soft_normals(mesh))


def _shoe(skeleton: Skeleton, side: str, scale: float) -> Tube:
    ankle, ball = (skeleton.heads[skeleton.names.index(f"{name}_{side}")] for name in ("foot", "toe"))
    middle = np.array([(ankle[0] + ball[0]) / 2, 0, ball[2]])
    # Each ring: distance in front of the ball, height of its centre, half its width, half its height.
    rings = scale * np.array(
        [
            (0.107, 0.028, 0.002, 0.002), (0.104, 0.028, 0.016, 0.012), (0.09, 0.030, 0.034, 0.022),
            (0.04, 0.034, 0.050, 0.031), (-0.02, 0.039, 0.050, 0.038),
            (-0.09, 0.050, 0.043, 0.049), (-0.15, 0.066, 0.042, 0.066),
            (-0.195, 0.064, 0.038, 0.062),
            (-0.218, 0.055, 0.02, 0.04), (-0.223, 0.052, 0.002, 0.003),
        ]
    )  # fmt: skip
    knots = middle + np.stack([np.zeros(len(rings)), rings[:, 1], rings[:, 0]], axis=1)
    return Tube(
        part="shoes", knots=knots, radii=rings[:, 2:], front=(0.0, 1.0, 0.0),
        chain=(f"toe_{side}", f"foot_{side}"), borders=(0.36,), rings=20, segments=20,
        chart=(0.0, 0.0, 0.3, 0.33), blend=0.1,
    )  # fmt: skip


def _trunk(body: Charted, skeleton: Skeleton) -> np.ndarray:
    """The points `[n, 3]` of shirt and trousers but the arms, that a garment hangs around."""
    clothed = np.zeros(len(body.vertices), dtype=bool)
    clothed[body.faces[np.isin(body.part, [PARTS.index("shirt"), PARTS.index("trousers")])]] = True
    arms = [j for j, name in enumerate(skeleton.names) if "arm" in name or "hand" in name]
    return body.vertices[clothed & (body.weights[:, arms].sum(axis=1) < 0.4)]


def _skirt(trunk: np.ndarray, skirt: Skirt, leg: float, *, yoke: float) -> Tube:
    """A flared garment that leaves room for the legs: from the waist, or from the `yoke` (metres above the floor)."""
    points = trunk[(np.abs(trunk[:, 0]) < 0.3) & (trunk[:, 1] < max(1.05 * leg, (yoke + 0.05) * skirt.is_yoked))]
    shape = np.array(FLARE)
    top = shape[-1, 0]
    longer = skirt.length / FIRST.skirt.length
    heights = np.round(top - (top - shape[:, 0]) * longer, 9) * leg
    flares = shape[:, 1] * skirt.fullness
    if skirt.is_yoked:
        heights = np.concatenate([heights, np.linspace(heights[-1], yoke, 4)[1:]])
        share = np.clip((yoke - heights) / (yoke - heights[0]), 0, 1)
        flares = flares[-1] + share * (flares[0] - flares[-1]) * (1.0 if skirt.kind == "smock" else share)
    centres, radii = [], []
    for height in heights:
        # Below shorts there is no cloth to measure: the skirt goes on as wide as it is there.
        ring = points[np.abs(points[:, 1] - max(height, points[:, 1].min() + 0.03)) < 0.02]
        low, high = ring.min(axis=0), ring.max(axis=0)
        centres.append([0, height, (low[2] + high[2]) / 2])
        radii.append([(high[k] - low[k]) / 2 for k in (0, 2)])
    wide = np.array(radii)
    if skirt.kind == "smock":  # It falls from the widest place above.
        wide = np.maximum.accumulate(wide[::-1])[::-1]
    length = np.ptp(heights) / np.ptp(shape[:, 0]) / leg
    return Tube(
        part="skirt", knots=np.array(centres), radii=wide + flares[:, None],
        front=(0.0, 0.0, -1.0 if skirt.kind == "coat" else 1.0), chain=("pelvis",), borders=(),
        rings=round(20 * length), segments=56, slit=SLIT if skirt.kind == "coat" else 0.0,
        chart=(0.0, 0.0, 1.5 * max(1.0, skirt.fullness**0.5), 0.5 * length),
    )  # fmt: skip


def _hung_weights(flat: np.ndarray, mesh: Charted, skeleton: Skeleton, leg: float) -> np.ndarray:
    """A skirt's weights up to the waist; above it those of the trunk beneath."""
    weights = skirt_weights(flat, skeleton.names, top=leg, length=0.48 * leg)
    above = np.clip((flat[:, 1] - 1.02 * leg) / 0.08, 0, 1)[:, None]
    if not above.any():
        return weights
    arms = [j for j, name in enumerate(skeleton.names) if "arm" in name or "hand" in name]
    shirt = np.unique(mesh.faces[mesh.part == PARTS.index("shirt")])
    shirt = shirt[mesh.weights[shirt][:, arms].sum(axis=1) < 0.4]
    near = shirt[cKDTree(mesh.vertices[shirt]).query(flat, k=8)[1]]
    trunk = mesh.weights[near].mean(axis=1)
    trunk[:, arms] = 0
    return (1 - above) * weights + above * trunk / trunk.sum(axis=1, keepdims=True)


def _append(mesh: Charted, tube: Tube, skeleton: Skeleton, leg: float) -> Charted:
    points, along = lattice(tube, tube.rings, tube.segments)
    flat = points.reshape(-1, 3)
    if tube.part == "shoes":
        flat[:, 1] = np.maximum(flat[:, 1], 0)  # A flat sole.
        weights = np.repeat(chain_weights(tube, along, skeleton.names), tube.segments, axis=0)
    else:
        weights = _hung_weights(flat, mesh, skeleton, leg)
    faces = grid_faces(tube.rings, tube.segments, stride=tube.segments, wrap=tube.segments)
    uv_faces = grid_faces(tube.rings, tube.segments, stride=tube.segments + 1, wrap=tube.segments + 1)
    row, column = np.divmod(np.arange(len(faces)) // 2, tube.segments)
    closed = (column < tube.segments - 1) | (row >= tube.slit * (tube.rings - 1))
    faces, uv_faces = faces[closed], uv_faces[closed]
    return Charted(
        vertices=np.concatenate([mesh.vertices, flat]),
        weights=np.concatenate([mesh.weights, weights]),
        faces=np.concatenate([mesh.faces, len(mesh.vertices) + faces]),
        uvs=np.concatenate([mesh.uvs, chart_uvs(tube.rings, tube.segments) * tube.chart[2:]]),
        uv_faces=np.concatenate([mesh.uv_faces, len(mesh.uvs) + uv_faces]),
        part=np.concatenate([mesh.part, np.full(len(faces), PARTS.index(tube.part))]),
    )
