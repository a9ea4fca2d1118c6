"""The painted texture: every texel knows where on the rest surface it lies, and is painted from there.

Painting in space makes patterns run across chart borders. Detail is fine on purpose (stripes of 2 cm, weave, printed
words): it is what a blurry method loses.
"""

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import distance_transform_edt, gaussian_filter

from synth.person.body import PARTS, Body, vertex_normals
from synth.person.cast import FIRST, Complexion, Shirt, Shoes, Skirt, Subject, Trousers
from synth.person.prints import edge, mix, plain, printed, stripes

SKIN, HAIR, SHIRT = (PARTS.index(name) for name in ("skin", "hair", "shirt"))
LIMBS = ("torso", "left arm", "right arm", "left leg", "right leg")


@dataclass(frozen=True, kw_only=True, slots=True)
class Texels:
    """The covered texels of an atlas, `n` of them."""

    rows: np.ndarray  # [n] from the top of the image
    columns: np.ndarray  # [n]
    face: np.ndarray  # [n] the face each lies on
    position: np.ndarray  # [n, 3] on the rest surface, metres
    normal: np.ndarray  # [n, 3]
    limb: np.ndarray  # [n] index into LIMBS


def rasterize_charts(
    uvs: np.ndarray, uv_faces: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Which face covers each texel centre: rows, columns, face, barycentrics `[n, 3]`; row 0 is the top (v = 1)."""
    corners = uvs[uv_faces] * size  # in texels, v up
    low = np.floor(corners.min(axis=1) - 0.5).astype(np.int64)
    extent = (np.ceil(corners.max(axis=1) + 0.5).astype(np.int64) - low).max(axis=1)
    pieces: list[tuple[np.ndarray, ...]] = []
    width = 2
    while width < 2 * extent.max():
        # Faces of similar size are tested together, a few million texels at a time.
        group = np.flatnonzero((extent <= width) & (extent > width // 2) if width > 2 else extent <= width)
        for chunk in np.array_split(group, max(1, len(group) * width * width // 2_000_000)):
            pieces.append(_cover(corners[chunk], low[chunk], chunk, width, size))
        width *= 2
    columns, heights, face, weights = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    return size - 1 - heights, columns, face, weights


def _cover(corners: np.ndarray, low: np.ndarray, faces: np.ndarray, width: int, size: int) -> tuple[np.ndarray, ...]:
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(width), indexing="ij"), axis=-1).reshape(-1, 2)
    texel = low[:, None] + grid
    a, b, c = (corners[:, None, k] for k in range(3))
    centre = texel + 0.5

    def area(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])

    whole = area(a, b, c)
    whole = np.where(np.abs(whole) < 1e-12, np.inf, whole)
    weights = np.stack([area(centre, b, c), area(a, centre, c), area(a, b, centre)], axis=-1) / whole[..., None]
    inside = (weights >= -1e-9).all(axis=-1) & np.isfinite(whole) & ((texel >= 0) & (texel < size)).all(axis=-1)
    owner = np.broadcast_to(faces[:, None], inside.shape)
    return texel[inside][:, 0], texel[inside][:, 1], owner[inside], weights[inside]


def locate(body: Body, size: int) -> Texels:
    """Where on the rest surface every covered texel lies."""
    surface = body.surface
    rows, columns, face, weights = rasterize_charts(surface.uvs, surface.uv_faces, size)
    corners = surface.faces[face]

    def mix(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nka->na", weights, values[corners])

    names = body.skeleton.names
    shares = np.zeros((len(surface.vertices), len(LIMBS)))
    for j, name in enumerate(names):
        arm = any(word in name for word in ("arm", "hand"))
        leg = any(word in name for word in ("thigh", "shin", "foot", "toe"))
        limb = 0 if not (arm or leg) else (1 if arm else 3) + ("right" in name)
        shares[:, limb] += body.skin_weights[:, j]
    return Texels(
        rows=rows,
        columns=columns,
        face=face,
        position=mix(surface.vertices),
        normal=mix(vertex_normals(surface.vertices, surface.faces)),
        limb=np.argmax(mix(shares), axis=1),
    )


def paint(body: Body, *, size: int, seed: int, subject: Subject = FIRST) -> np.ndarray:
    """Paint a subject's body and clothes: uint8 sRGB `[size, size, 3]`, row 0 at v = 1.

    Colours run past chart borders.
    """
    rng = np.random.default_rng(seed)
    texels = locate(body, size)
    grain = _grain(rng, size)[texels.rows, texels.columns]
    part = body.surface.part[texels.face]
    along = _along(body, texels)
    # Labels end at faces, paint does not: hairline and collar are smooth lines across faces.
    part = np.where(
        np.isin(part, (SKIN, HAIR)), np.where(_hairline(body, texels.position, grain) > 0, HAIR, SKIN), part
    )
    # A modelled collar ends where it ends; a painted one does so by colour alone.
    throat = (not body.face.modelled) & (part == SHIRT) & (texels.limb == 0) & (body.collar(texels.position) < 0)
    beyond = (not body.face.modelled) & (part == SKIN) & (np.abs(_past_collar(body, texels)) < 0.03)
    part = np.where(throat, SKIN, np.where(beyond, SHIRT, part))
    colour = np.empty((len(part), 3))
    painters = {
        "skin": lambda m: _skin(body, subject.head, texels.position[m], grain[m]),
        "hair": lambda m: _hair(subject.head, texels.position[m], grain[m]),
        "eyes": lambda m: _eyes(body, subject.head, texels.position[m]),
        "shirt": lambda m: _shirt(body, subject.shirt, _pick(texels, m), along[m], grain[m]),
        "trousers": lambda m: _trousers(body, subject.trousers, _pick(texels, m), along[m], grain[m]),
        "skirt": lambda m: _skirt(subject.skirt, texels.position[m], grain[m]),
        "shoes": lambda m: _shoes(subject.shoes, texels.position[m], grain[m]),
    }
    for index, name in enumerate(PARTS):
        chosen = part == index
        if chosen.any():
            colour[chosen] = painters[name](chosen)
    image = np.zeros((size, size, 3))
    covered = np.zeros((size, size), dtype=bool)
    image[texels.rows, texels.columns] = np.clip(colour, 0, 1)
    covered[texels.rows, texels.columns] = True
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return np.round(image[tuple(nearest)] * 255).astype(np.uint8)


def _hairline(body: Body, position: np.ndarray, grain: np.ndarray) -> np.ndarray:
    """Positive where hair grows, in metres from the hairline, ragged by single strands."""
    return body.scalp(position) + 0.0006 * np.sin(900 * position[:, 0]) + 0.0008 * grain


def _past_collar(body: Body, texels: Texels) -> np.ndarray:
    """Metres outside of the collar on the trunk's skin; far where the collar does not matter."""
    beyond = body.collar(texels.position)
    return np.where(
        (texels.limb == 0) & (beyond > 0) & (texels.position[:, 1] < body.face.mouth[1] - 0.06), beyond, 1.0
    )


def _pick(texels: Texels, chosen: np.ndarray) -> Texels:
    return Texels(**{name: getattr(texels, name)[chosen] for name in Texels.__slots__})


def _grain(rng: np.random.Generator, size: int) -> np.ndarray:
    """Noise of about unit spread on several scales, `[size, size]`."""
    fine = rng.standard_normal((size, size), dtype=np.float32)
    coarse = gaussian_filter(rng.standard_normal((size, size), dtype=np.float32), size / 250, mode="wrap")
    return 0.6 * fine + coarse / coarse.std() * 0.8


def _along(body: Body, texels: Texels) -> np.ndarray:
    """Metres along the limb from its root, or the height on the torso: what stripes are measured in."""
    head = {name: body.skeleton.heads[j] for j, name in enumerate(body.skeleton.names)}
    result = texels.position[:, 1].copy()
    for limb, (start, end) in enumerate(
        (
            ("upper_arm_left", "hand_left"),
            ("upper_arm_right", "hand_right"),
            ("thigh_left", "foot_left"),
            ("thigh_right", "foot_right"),
        )
    ):
        chosen = texels.limb == limb + 1
        axis = (head[end] - head[start]) / np.linalg.norm(head[end] - head[start])
        result[chosen] = (texels.position[chosen] - head[start]) @ axis
    return result


def _weave(position: np.ndarray, grain: np.ndarray, strength: float = 0.06) -> np.ndarray:
    """Threads of 4 mm crossing each other, and grain."""
    x, y, z = position.T
    return 1 + strength * np.sin(2 * np.pi * (x + z) / 0.004) * np.sin(2 * np.pi * y / 0.004) + 0.035 * grain


def print_words(words: str, *, width: int = 640) -> np.ndarray:
    """Words as coverage `[h, w]` in 0..1, with a margin."""
    font = ImageFont.load_default(200)
    left, top, right, bottom = (int(v) for v in font.getbbox(words))
    image = Image.new("L", (right - left + 40, bottom - top + 40))
    ImageDraw.Draw(image).text((20 - left, 20 - top), words, fill=255, font=font, stroke_width=6, stroke_fill=255)
    return np.asarray(image.resize((width, round(width * image.height / image.width))), dtype=np.float64) / 255


def _stamp(words: str, x: np.ndarray, y: np.ndarray, *, width: float) -> np.ndarray:
    """Coverage of words `width` metres wide, centred on x = y = 0, y up."""
    coverage = print_words(words)
    scale = coverage.shape[1] / width
    column = np.round(x * scale + coverage.shape[1] / 2).astype(np.int64)
    row = np.round(coverage.shape[0] / 2 - y * scale).astype(np.int64)
    inside = (column >= 0) & (column < coverage.shape[1]) & (row >= 0) & (row < coverage.shape[0])
    result = np.zeros(len(x))
    result[inside] = coverage[row[inside], column[inside]]
    return result


def _around(body: Body, texels: Texels) -> np.ndarray:
    """Metres around the trunk, or around an arm, from its back."""
    x, _, z = texels.position.T
    result = np.arctan2(x, z) * 0.14
    for side, limb in (("left", 1), ("right", 2)):
        start, end = (
            body.skeleton.heads[body.skeleton.names.index(f"{bone}_{side}")] for bone in ("upper_arm", "hand")
        )
        axis = (end - start) / np.linalg.norm(end - start)
        chosen = texels.limb == limb
        apart = texels.position[chosen] - start
        front = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
        result[chosen] = np.arctan2(apart @ np.cross(axis, front), apart @ front) * 0.05
    return result


def _shirt(body: Body, shirt: Shirt, texels: Texels, along: np.ndarray, grain: np.ndarray) -> np.ndarray:
    position, normal = texels.position, texels.normal
    colour = printed(shirt.cloth, _around(body, texels), along)
    torso = texels.limb == 0
    chest = body.skeleton.heads[body.skeleton.names.index("chest")]
    y = position[:, 1] - chest[1] - 0.1
    for words, facing in zip(shirt.words or (), (1.0, -1.0), strict=False):
        side = torso & (normal[:, 2] * facing > 0.2)
        panel = side * edge(0.055 - np.abs(y), 0.002) * edge(0.125 - np.abs(position[:, 0]), 0.002)
        colour = mix(colour, shirt.panel, panel)
        colour = mix(colour, shirt.ink, panel * _stamp(words, facing * position[:, 0], y, width=0.2))
    collar = body.collar(position)
    colour = mix(colour, shirt.collar, torso * edge(0.018 - collar, 0.003))
    seam = torso * edge(0.0025 - np.abs(position[:, 2]), 0.001)
    colour = mix(colour, shirt.seam, 0.6 * seam)
    if shirt.buttons is not None:
        x, front = position[:, 0], torso * (normal[:, 2] > 0.1) * (collar > 0.012)
        colour = mix(colour, shirt.seam, front * edge(0.002 - np.abs(x - 0.02), 0.001))
        height = (position[:, 1] / 0.11) % 1.0 - 0.5
        colour = mix(colour, shirt.buttons, front * edge(0.009 - np.hypot(x, 0.11 * height), 0.002))
    return colour * _weave(position, grain)[:, None]


def _trousers(body: Body, trousers: Trousers, texels: Texels, along: np.ndarray, grain: np.ndarray) -> np.ndarray:
    position = texels.position
    around = np.arctan2(position[:, 0] - np.where(position[:, 0] > 0, 0.095, -0.095), position[:, 2]) * 0.07
    colour = printed(trousers.cloth, around, along)
    outer = np.abs(position[:, 0]) - 0.095
    colour = mix(colour, trousers.line, (outer > 0) * edge(0.006 - np.abs(position[:, 2]), 0.002))
    waist = body.skeleton.heads[0][1] + 0.06
    belt = edge(0.02 - np.abs(position[:, 1] - waist), 0.002)
    colour = mix(colour, trousers.belt, belt)
    buckle = belt * edge(0.03 - np.abs(position[:, 0]), 0.002) * (texels.normal[:, 2] > 0)
    colour = mix(colour, trousers.buckle, buckle)
    return colour * _weave(position, grain, 0.1)[:, None]


def _skirt(skirt: Skirt, position: np.ndarray, grain: np.ndarray) -> np.ndarray:
    around = np.arctan2(position[:, 0], position[:, 2]) * 0.2
    height = position[:, 1]
    colour = printed(skirt.cloth, around, height)
    twill = 0.06 * np.sin(2 * np.pi * (around + height) / 0.005)
    hem = edge(0.012 - (height - height.min()), 0.002)
    colour = mix(colour, skirt.hem, hem)
    return colour * (1 + twill + 0.03 * grain)[:, None]


def _shoes(shoes: Shoes, position: np.ndarray, grain: np.ndarray) -> np.ndarray:
    x, y, z = position.T
    colour = plain(len(position), shoes.leather)
    sole = edge(0.022 - y, 0.002)
    colour = mix(colour, shoes.sole, sole)
    middle = np.abs(np.abs(x) - 0.105)
    laces = stripes(z, 0.016, 0.4) * edge(0.022 - middle, 0.002) * (y > 0.045) * (z > -0.02) * (z < 0.09)
    colour = mix(colour, shoes.laces, laces)
    colour = mix(colour, shoes.stripes, (1 - sole) * stripes(z - 0.4 * y, 0.03, 0.25) * (middle > 0.03) * (z < 0.06))
    return colour * (1 + 0.04 * grain)[:, None]


def _hair(head: Complexion, position: np.ndarray, grain: np.ndarray) -> np.ndarray:
    x, y, z = position.T
    around = np.arctan2(x, z - 0.01)
    strand = np.sin(260 * around + 25 * np.sin(60 * y) + 2.5 * grain) + 0.6 * np.sin(97 * around + 40 * y)
    base = plain(len(position), head.hair)
    return base * (1 + 0.28 * strand + 0.1 * grain)[:, None]


def _skin(body: Body, head: Complexion, position: np.ndarray, grain: np.ndarray) -> np.ndarray:
    x, y, z = position.T
    colour = plain(len(position), head.skin) * (1 + 0.018 * grain)[:, None]
    eyes, mouth = body.face.eyes, body.face.mouth
    front = z > eyes[0, 2] - 0.06
    gap = eyes[0, 0] - eyes[1, 0]
    for eye, sign in zip(eyes, (1.0, -1.0), strict=True):
        dx, dy = (x - eye[0]) / gap, (y - eye[1]) / gap
        brow = (
            front
            * edge(0.045 - np.abs(dy - 0.3 + 0.25 * (dx - 0.05 * sign) ** 2), 0.02)
            * edge(0.36 - np.abs(dx - 0.04 * sign), 0.06)
        )
        colour = mix(colour, head.brow, 0.85 * brow)
        blush = front * np.exp(-((dx - 0.15 * sign) ** 2 + (dy + 0.65) ** 2) / 0.06)
        colour = mix(colour, head.blush, 0.3 * blush)
        if not body.face.modelled:
            white = front * edge(1 - np.hypot(dx / 0.27, dy / 0.13), 0.15)
            iris = front * edge(1 - np.hypot(dx, dy) / 0.12, 0.15)
            colour = mix(mix(colour, (0.95, 0.95, 0.93), white), (0.15, 0.25, 0.3), iris * white)
    wide, tall = (x - mouth[0]) / gap, (y - mouth[1]) / gap
    lips = front * edge(1 - np.hypot(wide / 0.4, tall / (0.14 * np.maximum(1 - 0.5 * np.abs(wide), 0.3))), 0.2)
    colour = mix(colour, head.lips, 0.8 * lips)
    colour = mix(colour, head.mouth, 0.8 * lips * edge(0.018 - np.abs(tall), 0.02))
    return colour


def _eyes(body: Body, head: Complexion, position: np.ndarray) -> np.ndarray:
    """Eyeballs: white, iris, pupil, seen from the front."""
    colour = plain(len(position), (0.93, 0.93, 0.91))
    for eye in body.face.eyes:
        near = np.abs(position[:, 0] - eye[0]) < 0.03
        radius = np.hypot(position[:, 0] - eye[0], position[:, 1] - eye[1]) + np.where(
            near & (position[:, 2] > eye[2]), 0, 1
        )
        colour = mix(colour, head.iris, edge(0.0062 - radius, 0.0006))
        colour = mix(colour, (0.03, 0.03, 0.03), edge(0.0028 - radius, 0.0006))
    return colour
