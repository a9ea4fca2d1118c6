"""Scans: what a studio reconstructs of a frame's surface from its training cameras.

The true surface where two cameras see it, off along its normal: partly by bumps, partly by grain, more where no two
cameras look at it squarely. What fewer than two see is a hole: under arms, between legs.
"""

import numpy as np

from ash.capture.dataset import Camera
from synth.camera.render import Studio
from synth.person.body import vertex_normals
from synth.scene import Scanner

NEEDED = 2  # cameras that must see a point of the surface
FACING = 0.15  # cosine from which a camera sees it at all
SQUARE = 0.3  # cosine below which the error grows no further
SEEN_WITHIN_M = 0.002  # of a vertex: a ray that meets the surface there has met the vertex
WAVES = 64


def scan(studio: Studio, cameras: list[Camera], scanner: Scanner, *, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Scan the person as the `studio` is dressed: vertices `[n, 3]` float32, metres, and faces `[f, 3]` int32.

    Vertices come in no order that two frames share. Their error along the normal is `scanner.rms_mm` rms.
    """
    rng = np.random.default_rng(seed)
    surface = studio.vertices.astype(np.float64)
    normals = vertex_normals(surface, studio.surface.faces)
    squarely = facing_of_second(studio, cameras, surface, normals)
    seen = squarely > FACING
    faces = studio.surface.faces[seen[studio.surface.faces].all(axis=1)]
    order = rng.permutation(np.unique(faces))
    height = _error(surface[order], squarely[order], scanner, rng)
    place = np.full(len(surface), -1, dtype=np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    return (surface[order] + height[:, None] * normals[order]).astype(np.float32), rng.permutation(place[faces])


def facing_of_second(studio: Studio, cameras: list[Camera], surface: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Cosine at which the second-best of the cameras that see a vertex sees it, `[s]`; 0: fewer than two see it."""
    best = np.zeros((NEEDED, len(surface)))
    for camera in cameras:
        towards = camera.position - surface
        facing = (towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
        some = np.flatnonzero(facing > FACING)
        hit, triangle = studio.hits(camera.position, surface[some])
        met = (triangle >= 0) & (np.linalg.norm(hit - surface[some], axis=1) < SEEN_WITHIN_M)
        cosines = np.zeros(len(surface))
        cosines[some[met]] = facing[some[met]]
        best = np.sort(np.concatenate([best, cosines[None]]), axis=0)[-NEEDED:]
    return best[0]


def _error(points: np.ndarray, squarely: np.ndarray, scanner: Scanner, rng: np.random.Generator) -> np.ndarray:
    """How far each point is off along its normal, metres: exactly the stated rms over all of them."""
    waves = rng.standard_normal((3, WAVES)) * 1000 / scanner.bump_mm
    bumps = np.cos(points @ waves + rng.uniform(0, 2 * np.pi, WAVES)) @ rng.standard_normal(WAVES) * np.sqrt(2 / WAVES)
    grain = rng.standard_normal(len(points))
    mixed = np.sqrt(scanner.bump_share) * bumps + np.sqrt(1 - scanner.bump_share) * grain
    grown = mixed / np.maximum(squarely, SQUARE)
    return scanner.rms_mm / 1000 * grown / max(float(np.sqrt(np.mean(grown**2))) if len(grown) else 1.0, 1e-12)
