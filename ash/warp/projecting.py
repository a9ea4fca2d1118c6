"""Eq. 2 and the colour H of Eq. 3 on any of Warp's devices: Gaussians to splats, and the gradient back.

`_project_naive` in `ash.gaussians.splatting` is the definition. Centres are computed in double precision, as the order
of the splats is taken from their depths.
"""

from typing import no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TILE = 16  # Pixels per side of the squares that are blended by one block of threads.
PIXELS = wp.constant(TILE * TILE)
TILE_SIDE = wp.constant(float(TILE))
ALPHA_MIN = wp.constant(1.0 / 255.0)
COMPENSATION_MIN = wp.constant(1e-6)
SLACK = wp.constant(0.6)  # Pixels: half of one, and a hair. The threshold on alpha decides, not the box.
FAULT_CODES = wp.constant(16)  # A fault is a Gaussian's number times this, plus what is wrong with it.

C0 = wp.constant(0.28209479177387814)
C1 = wp.constant(0.4886025119029199)
C2A, C2B, C2C = wp.constant(1.0925484305920792), wp.constant(0.31539156525252005), wp.constant(0.5462742152960396)
C3A, C3B, C3C = wp.constant(0.5900435899266435), wp.constant(2.890611442640554), wp.constant(0.4570457994644658)
C3D, C3E = wp.constant(0.3731763325901154), wp.constant(1.445305721320277)


vec16 = wp.types.vector(length=16, dtype=wp.float32)  # A number per spherical harmonic.


@wp.struct
@no_type_check
class Pinhole:
    """A camera, and the numbers of a call."""

    turn: wp.mat33
    shift: wp.vec3
    centre: wp.vec3  # of the camera, in the world
    focal: wp.vec2
    principal: wp.vec2
    low: wp.vec2  # Limits of x / z and y / z in the Jacobian: 15 % outside the image.
    high: wp.vec2


@wp.func
@no_type_check
def view_of(viewmat: wp.mat44, K: wp.mat33, width: int, height: int):
    """What a kernel needs of a camera."""
    view = Pinhole()
    for i in range(3):
        for j in range(3):
            view.turn[i, j] = viewmat[i, j]
        view.shift[i] = viewmat[i, 3]
    view.centre = -(wp.transpose(view.turn) @ view.shift)
    view.focal = wp.vec2(K[0, 0], K[1, 1])
    view.principal = wp.vec2(K[0, 2], K[1, 2])
    size = wp.vec2(float(width), float(height))
    for i in range(2):
        view.low[i] = -(view.principal[i] + 0.15 * size[i]) / view.focal[i]
        view.high[i] = (1.15 * size[i] - view.principal[i]) / view.focal[i]
    return view


@wp.func
@no_type_check
def in_camera(view: Pinhole, mean: wp.vec3):
    """A point in the camera's frame, in double precision."""
    point = wp.vec3d(wp.float64(mean[0]), wp.float64(mean[1]), wp.float64(mean[2]))
    placed = wp.vec3d()
    for i in range(3):
        placed[i] = wp.float64(view.shift[i])
        for j in range(3):
            placed[i] += wp.float64(view.turn[i, j]) * point[j]
    return placed


@wp.func
@no_type_check
def length_of(quat: wp.vec4):
    """Length of a quaternion whose square may leave the range of float32."""
    largest = wp.max(wp.max(wp.abs(quat[0]), wp.abs(quat[1])), wp.max(wp.abs(quat[2]), wp.abs(quat[3])))
    return largest * wp.length(quat / largest)


@wp.func
@no_type_check
def rotation_of(unit: wp.vec4):
    """Unit quaternion (wxyz) to rotation matrix."""
    w, x, y, z = unit[0], unit[1], unit[2], unit[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.func
@no_type_check
def rotation_gradient(unit: wp.vec4, g: wp.mat33):
    """Gradient in a unit quaternion of a function whose gradient in the rotation matrix is `g`."""
    w, x, y, z = unit[0], unit[1], unit[2], unit[3]
    a, b, c = g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1]
    p, q, r = g[0, 1] + g[1, 0], g[0, 2] + g[2, 0], g[1, 2] + g[2, 1]
    return 2.0 * wp.vec4(
        x * a + y * b + z * c,
        -2.0 * x * (g[1, 1] + g[2, 2]) + y * p + z * q + w * a,
        -2.0 * y * (g[0, 0] + g[2, 2]) + x * p + z * r + w * b,
        -2.0 * z * (g[0, 0] + g[1, 1]) + x * q + y * r + w * c,
    )


@wp.func
@no_type_check
def harmonics(d: wp.vec3, count: int):
    """The first `count` real spherical harmonics in a direction; the others are 0."""
    x, y, z = d[0], d[1], d[2]
    values = vec16()
    values[0] = C0
    if count > 1:
        values[1] = -C1 * y
        values[2] = C1 * z
        values[3] = -C1 * x
    if count > 4:
        values[4] = C2A * x * y
        values[5] = -C2A * y * z
        values[6] = C2B * (3.0 * z * z - 1.0)
        values[7] = -C2A * x * z
        values[8] = C2C * (x * x - y * y)
    if count > 9:
        values[9] = -C3A * y * (3.0 * x * x - y * y)
        values[10] = C3B * x * y * z
        values[11] = -C3C * y * (5.0 * z * z - 1.0)
        values[12] = C3D * z * (5.0 * z * z - 3.0)
        values[13] = -C3C * x * (5.0 * z * z - 1.0)
        values[14] = C3E * z * (x * x - y * y)
        values[15] = -C3A * x * (x * x - 3.0 * y * y)
    return values


@wp.func
@no_type_check
def harmonics_gradient(d: wp.vec3, g: vec16, count: int):
    """Gradient in the direction of a function whose gradient in the harmonics is `g`."""
    x, y, z = d[0], d[1], d[2]
    total = wp.vec3()
    if count > 1:
        total += C1 * wp.vec3(-g[3], -g[1], g[2])
    if count > 4:
        total += C2A * wp.vec3(y * g[4] - z * g[7], x * g[4] - z * g[5], -y * g[5] - x * g[7])
        total += wp.vec3(2.0 * C2C * x * g[8], -2.0 * C2C * y * g[8], 6.0 * C2B * z * g[6])
    if count > 9:
        total += C3A * g[9] * wp.vec3(-6.0 * x * y, 3.0 * (y * y - x * x), 0.0)
        total += C3B * g[10] * wp.vec3(y * z, x * z, x * y)
        total += C3C * g[11] * wp.vec3(0.0, 1.0 - 5.0 * z * z, -10.0 * y * z)
        total += C3D * g[12] * wp.vec3(0.0, 0.0, 15.0 * z * z - 3.0)
        total += C3C * g[13] * wp.vec3(1.0 - 5.0 * z * z, 0.0, -10.0 * x * z)
        total += C3E * g[14] * wp.vec3(2.0 * x * z, -2.0 * y * z, x * x - y * y)
        total += C3A * g[15] * wp.vec3(3.0 * (y * y - x * x), 6.0 * x * y, 0.0)
    return total


@wp.struct
@no_type_check
class Footprint:
    """A Gaussian's projected covariance, and how it came about."""

    position: wp.vec3  # in the camera
    tangent: wp.vec2  # x / z and y / z, limited
    rows: wp.mat33  # two rows: the affine map from the world to pixels
    halves: wp.mat33  # two rows, whose products are the covariance
    xx: float
    xy: float
    yy: float
    sharp: float  # determinant without dilation: a sum of squared minors, which does not cancel for needles
    det: float  # with dilation


@wp.func
@no_type_check
def footprint_of(view: Pinhole, position: wp.vec3, rotation: wp.mat33, scales: wp.vec3, dilation: float):
    """Eq. 2."""
    footprint = Footprint()
    footprint.position = position
    for i in range(2):
        footprint.tangent[i] = wp.clamp(position[i] / position[2], view.low[i], view.high[i])
        for j in range(3):
            footprint.rows[i, j] = (
                view.focal[i] / position[2] * (view.turn[i, j] - footprint.tangent[i] * view.turn[2, j])
            )
    footprint.halves = footprint.rows @ rotation @ wp.diag(scales)
    first, second = footprint.halves[0], footprint.halves[1]
    footprint.xx = wp.dot(first, first)
    footprint.xy = wp.dot(first, second)
    footprint.yy = wp.dot(second, second)
    footprint.sharp = wp.length_sq(wp.cross(first, second))
    footprint.det = footprint.sharp + dilation * (footprint.xx + footprint.yy) + dilation * dilation
    return footprint


@wp.func
@no_type_check
def is_finite(v: wp.vec3):
    """Whether all three are finite."""
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.func
@no_type_check
def fault_of(
    mean: wp.vec3,
    quat: wp.vec4,
    scales: wp.vec3,
    opacity: float,
    sh: wp.array(dtype=wp.vec3),
    number: int,
    coefficients: int,
):
    """What is wrong with a Gaussian, as `FAULTS` numbers it; 0: nothing."""
    if not is_finite(mean):
        return 1
    if not (wp.isfinite(quat[0]) and is_finite(wp.vec3(quat[1], quat[2], quat[3]))):
        return 2
    if quat[0] == 0.0 and quat[1] == 0.0 and quat[2] == 0.0 and quat[3] == 0.0:
        return 3
    if not (is_finite(scales) and wp.min(scales) >= 0.0):
        return 4
    if not (opacity >= 0.0 and opacity <= 1.0):
        return 5
    for k in range(number * coefficients, (number + 1) * coefficients):
        if not is_finite(sh[k]):
            return 6
    return 0


@wp.func
@no_type_check
def tile_box(centre: wp.vec2, reach: wp.vec2, columns: int, rows: int):
    """The tiles that a box of half the size `reach` touches: first column and row, last + 1 of both."""
    x0 = wp.clamp((centre[0] - reach[0] - SLACK) / TILE_SIDE, 0.0, float(columns))
    y0 = wp.clamp((centre[1] - reach[1] - SLACK) / TILE_SIDE, 0.0, float(rows))
    x1 = wp.clamp((centre[0] + reach[0] + SLACK) / TILE_SIDE, 0.0, float(columns))
    y1 = wp.clamp((centre[1] + reach[1] + SLACK) / TILE_SIDE, 0.0, float(rows))
    return wp.vec4i(int(wp.floor(x0)), int(wp.floor(y0)), int(wp.ceil(x1)), int(wp.ceil(y1)))


@wp.func
@no_type_check
def compensation(footprint: Footprint):
    """The root of the ratio of determinants before and after dilation; its square is at least `COMPENSATION_MIN`."""
    return wp.sqrt(wp.max(footprint.sharp / footprint.det, COMPENSATION_MIN))


@wp.func
@no_type_check
def conic_of(footprint: Footprint, dilation: float):
    """The inverse of the dilated covariance: xx, xy, yy, 1 / px^2."""
    return wp.vec3(
        (footprint.yy + dilation) / footprint.det,
        -footprint.xy / footprint.det,
        (footprint.xx + dilation) / footprint.det,
    )


@wp.func
@no_type_check
def colour_of(basis: vec16, sh: wp.array(dtype=wp.vec3), number: int, coefficients: int):
    """The colour of a Gaussian along a direction, before what is negative becomes 0."""
    colour = wp.vec3(0.5, 0.5, 0.5)
    for k in range(coefficients):
        colour += basis[k] * sh[number * coefficients + k]
    return colour


@wp.kernel
@no_type_check
def project(
    means: wp.array(dtype=wp.vec3),
    quats: wp.array(dtype=wp.vec4),
    scales: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float),
    sh: wp.array(dtype=wp.vec3),
    viewmats: wp.array(dtype=wp.mat44),
    Ks: wp.array(dtype=wp.mat33),
    width: int,
    height: int,
    compensate: int,
    dilation: float,
    near: float,
    means2d: wp.array(dtype=wp.vec2),
    shapes: wp.array(dtype=wp.vec4),
    looks: wp.array(dtype=wp.vec4),
    depths: wp.array(dtype=wp.float64),
    boxes: wp.array(dtype=wp.vec4i),
    fault: wp.array(dtype=wp.int64),
):
    """One Gaussian in one camera. Shapes are conic and opacity, looks are colour and depth."""
    thread = wp.tid()
    number = thread % means.shape[0]
    camera = thread // means.shape[0]
    coefficients = sh.shape[0] // means.shape[0]
    means2d[thread] = wp.vec2()
    shapes[thread] = wp.vec4()
    looks[thread] = wp.vec4()
    depths[thread] = wp.float64(0.0)
    boxes[thread] = wp.vec4i()
    mean, quat = means[number], quats[number]
    wrong = fault_of(mean, quat, scales[number], opacities[number], sh, number, coefficients)
    if wrong > 0:
        wp.atomic_min(fault, 0, wp.int64(number) * wp.int64(FAULT_CODES) + wp.int64(wrong))
        return
    view = view_of(viewmats[camera], Ks[camera], width, height)
    placed = in_camera(view, mean)
    if not placed[2] > wp.float64(near):
        return
    depths[thread] = placed[2]
    centre = wp.vec2()
    for i in range(2):
        exact = wp.float64(view.focal[i]) * placed[i] / placed[2] + wp.float64(view.principal[i])
        centre[i] = wp.float32(exact)
    means2d[thread] = centre
    position = wp.vec3(wp.float32(placed[0]), wp.float32(placed[1]), wp.float32(placed[2]))
    footprint = footprint_of(view, position, rotation_of(quat / length_of(quat)), scales[number], dilation)
    if not footprint.det > 0.0:
        return
    opacity = opacities[number]
    if compensate != 0:
        opacity *= compensation(footprint)
    basis = harmonics(wp.normalize(mean - view.centre), coefficients)
    colour = colour_of(basis, sh, number, coefficients)
    conic = conic_of(footprint, dilation)
    shapes[thread] = wp.vec4(conic[0], conic[1], conic[2], opacity)
    looks[thread] = wp.vec4(wp.max(colour[0], 0.0), wp.max(colour[1], 0.0), wp.max(colour[2], 0.0), position[2])
    if opacity < ALPHA_MIN:
        return
    reach = 2.0 * wp.log(opacity / ALPHA_MIN)
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    extent = wp.vec2(wp.sqrt(reach * (footprint.xx + dilation)), wp.sqrt(reach * (footprint.yy + dilation)))
    boxes[thread] = tile_box(centre, extent, columns, rows)
