"""Lens distortion after Brown and Conrady: k1 k2 p1 p2, on image coordinates at unit depth, as OpenCV has it."""

import numpy as np

ROUNDS = 12  # of Newton's method; an invertible lens needs four or five


def distort(points: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Where a lens with `distortion` `[4]` (k1 k2 p1 p2) puts ideal points `[..., 2]` (x/z, y/z).

    x' = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2), y' likewise with p1 and p2 exchanged.
    """
    k1, k2, p1, p2 = distortion
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + k2 * r2)
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
        axis=-1,
    )


def undistort(points: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """The ideal points `[..., 2]` that a lens puts at `points`: Newton's method from the points themselves.

    Raises:
        ValueError: some point has no ideal one: the lens folds the picture over there.
    """
    k1, k2, p1, p2 = distortion
    ideal = np.array(points, dtype=np.float64)
    with np.errstate(all="ignore"):  # A lens that folds divides by zero; that is found below.
        for _ in range(ROUNDS):
            x, y = ideal[..., 0], ideal[..., 1]
            r2 = x * x + y * y
            radial, slope = 1 + r2 * (k1 + k2 * r2), 2 * (k1 + 2 * k2 * r2)
            xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
            error = distort(ideal, distortion) - points
            determinant = xx * yy - xy * xy
            step = np.stack([yy * error[..., 0] - xy * error[..., 1], xx * error[..., 1] - xy * error[..., 0]], axis=-1)
            ideal = ideal - step / determinant[..., None]
        solved = np.abs(distort(ideal, distortion) - points).max(initial=0.0) < 1e-9
    # Where the slope is not positive definite, the solution lies beyond the fold.
    if not solved or not ((determinant > 0) & (xx + yy > 0)).all():
        raise ValueError("the lens folds the picture: some pixel has no direction")
    return ideal
