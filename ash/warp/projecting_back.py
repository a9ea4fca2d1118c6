"""The gradient of `ash.warp.projecting.project`: from splats back to Gaussians."""

from typing import no_type_check

import warp as wp

from ash.warp.projecting import (
    COMPENSATION_MIN,
    Footprint,
    Pinhole,
    colour_of,
    compensation,
    conic_of,
    footprint_of,
    harmonics,
    harmonics_gradient,
    in_camera,
    length_of,
    rotation_gradient,
    rotation_of,
    vec16,
    view_of,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
@no_type_check
def halves_gradient(footprint: Footprint, conic: wp.vec3, g: wp.vec3, g_ratio: float, dilation: float):
    """Gradient in the two halves, from those in the conic (`g`) and in the ratio of determinants (`g_ratio`).

    A function of the inverse Q has the gradient -Q G Q in the covariance: nothing that is small is divided by.
    """
    q = wp.mat22(conic[0], conic[1], conic[1], conic[2])
    product = q @ wp.mat22(g[0], 0.5 * g[1], 0.5 * g[1], g[2]) @ q
    of_det = -g_ratio * footprint.sharp / (footprint.det * footprint.det)
    g_xx = -product[0, 0] + dilation * of_det
    g_yy = -product[1, 1] + dilation * of_det
    g_xy = -2.0 * product[0, 1]
    first, second = footprint.halves[0], footprint.halves[1]
    area = 2.0 * (g_ratio / footprint.det + of_det) * wp.cross(first, second)
    of_first = 2.0 * g_xx * first + g_xy * second + wp.cross(second, area)
    of_second = 2.0 * g_yy * second + g_xy * first + wp.cross(area, first)
    return wp.matrix_from_rows(of_first, of_second, wp.vec3())


@wp.func
@no_type_check
def position_gradient(view: Pinhole, footprint: Footprint, g_rows: wp.mat33, g_centre: wp.vec2, g_depth: float):
    """Gradient in the position in the camera: through the affine map, through the centre, and of the depth."""
    total = wp.vec3(0.0, 0.0, g_depth)
    inverse = 1.0 / footprint.position[2]
    third = view.turn[2]
    for i in range(2):
        focal, plain = view.focal[i], footprint.position[i] * inverse
        g_row = g_rows[i]
        g_inverse = (
            focal * wp.dot(g_row, view.turn[i] - footprint.tangent[i] * third)
            + focal * g_centre[i] * footprint.position[i]
        )
        total[i] += focal * inverse * g_centre[i]
        if plain >= view.low[i] and plain <= view.high[i]:
            g_tangent = -focal * inverse * wp.dot(g_row, third)
            total[i] += g_tangent * inverse
            g_inverse += g_tangent * footprint.position[i]
        total[2] -= g_inverse * inverse * inverse
    return total


@wp.kernel
@no_type_check
def project_backward(
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
    g_means2d: wp.array(dtype=wp.vec2),
    g_shapes: wp.array(dtype=wp.vec4),
    g_looks: wp.array(dtype=wp.vec4),
    g_means: wp.array(dtype=wp.vec3),
    g_quats: wp.array(dtype=wp.vec4),
    g_scales: wp.array(dtype=wp.vec3),
    g_opacities: wp.array(dtype=float),
    g_sh: wp.array(dtype=wp.vec3),
):
    """One Gaussian, over all cameras in their order, so that the sum is reproducible."""
    number = wp.tid()
    coefficients = sh.shape[0] // means.shape[0]
    mean, quat, scale = means[number], quats[number], scales[number]
    length = length_of(quat)
    unit = quat / length
    rotation = rotation_of(unit)
    of_mean, of_scales, of_opacity = wp.vec3(), wp.vec3(), wp.float32(0.0)
    of_rotation = wp.mat33()
    for k in range(coefficients):
        g_sh[number * coefficients + k] = wp.vec3()
    for camera in range(viewmats.shape[0]):
        view = view_of(viewmats[camera], Ks[camera], width, height)
        placed = in_camera(view, mean)
        if placed[2] > wp.float64(near):
            position = wp.vec3(wp.float32(placed[0]), wp.float32(placed[1]), wp.float32(placed[2]))
            footprint = footprint_of(view, position, rotation, scale, dilation)
            g_rows = wp.mat33()
            splat = camera * means.shape[0] + number
            g_shape, g_look = g_shapes[splat], g_looks[splat]
            if footprint.det > 0.0:
                conic = conic_of(footprint, dilation)
                g_ratio = wp.float32(0.0)
                if compensate != 0:
                    factor = compensation(footprint)
                    if footprint.sharp / footprint.det >= COMPENSATION_MIN:
                        g_ratio = 0.5 * g_shape[3] * opacities[number] / factor
                    of_opacity += g_shape[3] * factor
                else:
                    of_opacity += g_shape[3]
                g_conic = wp.vec3(g_shape[0], g_shape[1], g_shape[2])
                g_halves = halves_gradient(footprint, conic, g_conic, g_ratio, dilation)
                mixed = footprint.rows @ rotation
                for i in range(2):
                    of_scales += wp.cw_mul(g_halves[i], mixed[i])
                g_mixed = g_halves @ wp.diag(scale)
                g_rows = g_mixed @ wp.transpose(rotation)
                of_rotation += wp.transpose(footprint.rows) @ g_mixed
            # Colour: through the harmonics into their coefficients, and into the direction.
            away = mean - view.centre
            direction = wp.normalize(away)
            basis = harmonics(direction, coefficients)
            colour = colour_of(basis, sh, number, coefficients)
            g_colour = wp.vec3()
            for i in range(3):
                if colour[i] >= 0.0:
                    g_colour[i] = g_look[i]
            g_basis = vec16()
            for k in range(coefficients):
                g_sh[number * coefficients + k] = g_sh[number * coefficients + k] + basis[k] * g_colour
                g_basis[k] = wp.dot(sh[number * coefficients + k], g_colour)
            g_direction = harmonics_gradient(direction, g_basis, coefficients)
            of_mean += (g_direction - wp.dot(direction, g_direction) * direction) / wp.length(away)
            g_position = position_gradient(view, footprint, g_rows, g_means2d[splat], g_look[3])
            of_mean += wp.transpose(view.turn) @ g_position
    g_unit = rotation_gradient(unit, of_rotation)
    g_means[number] = of_mean
    g_quats[number] = (g_unit - wp.dot(unit, g_unit) * unit) / length
    g_scales[number] = of_scales
    g_opacities[number] = of_opacity
