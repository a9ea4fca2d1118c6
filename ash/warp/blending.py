"""Eq. 3 on any of Warp's devices: splats to images, and the gradient back.

The image is cut into tiles of 16x16 pixels, one block of threads each, one thread per pixel. A pair is a splat and a
tile that it may touch. Pairs are listed splat by splat, nearest first, and sorted by tile; the gradient of each pair is
summed within its block and written to its place in the first order, where those of one splat lie side by side. So no
sum depends on which block was faster: a backward pass gives the same bits every time, on a GPU too.
"""

from typing import no_type_check

import warp as wp

from ash.warp.projecting import ALPHA_MIN, PIXELS, TILE

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

ALPHA_MAX = wp.constant(0.99)
TRANSMITTANCE_MIN = wp.constant(1e-4)
ENTRY = 10  # Numbers of a pair's gradient: centre 2, conic 3, opacity, colour 3, depth.

vec10 = wp.types.vector(length=ENTRY, dtype=wp.float32)


@wp.kernel
@no_type_check
def list_pairs(
    order: wp.array(dtype=wp.int64),
    ends: wp.array(dtype=wp.int64),
    boxes: wp.array(dtype=wp.vec4i),
    count: int,
    columns: int,
    rows: int,
    tiles: wp.array(dtype=int),
    members: wp.array(dtype=int),
):
    """The pairs of one splat of one camera; `order` has the splats of each camera nearest first, `ends` their sums."""
    thread = wp.tid()
    camera = thread // count
    member = camera * count + int(order[thread])
    box = boxes[member]
    place = int(ends[thread]) - (box[2] - box[0]) * (box[3] - box[1])
    for y in range(box[1], box[3]):
        for x in range(box[0], box[2]):
            tiles[place] = (camera * rows + y) * columns + x
            members[place] = member
            place += 1


@wp.struct
@no_type_check
class Pixel:
    """Where a thread draws."""

    place: wp.vec2  # of its centre, pixels
    index: int  # in the images of all cameras
    inside: bool


@wp.func
@no_type_check
def pixel_of(thread: int, width: int, height: int):
    """The pixel of a thread: tiles one after the other, their pixels row by row."""
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    tile, lane = thread // PIXELS, thread % PIXELS
    column = (tile % columns) * TILE + lane % TILE
    row = (tile // columns) % rows * TILE + lane // TILE
    pixel = Pixel()
    pixel.place = wp.vec2(float(column) + 0.5, float(row) + 0.5)
    pixel.index = (tile // (columns * rows) * height + row) * width + column
    pixel.inside = column < width and row < height
    return pixel


@wp.func
@no_type_check
def falloff(offset: wp.vec2, shape: wp.vec4):
    """The exponential of Eq. 3 at an offset from the centre, pixels."""
    dx, dy = offset[0], offset[1]
    return wp.exp(-0.5 * (shape[0] * dx * dx + shape[2] * dy * dy) - shape[1] * dx * dy)


@wp.kernel
@no_type_check
def blend(
    means2d: wp.array(dtype=wp.vec2),
    shapes: wp.array(dtype=wp.vec4),
    looks: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    width: int,
    height: int,
    rgb: wp.array(dtype=wp.vec3),
    alphas: wp.array(dtype=float),
    depths: wp.array(dtype=float),
    left: wp.array(dtype=float),
    lasts: wp.array(dtype=int),
):
    """One pixel. `left` is its final transmittance, `lasts` one more than the last pair that it took."""
    thread = wp.tid()
    pixel = pixel_of(thread, width, height)
    if not pixel.inside:
        return
    tile = thread // PIXELS
    through = wp.float32(1.0)
    total = wp.vec4()
    last = starts[tile]
    for pair in range(starts[tile], starts[tile + 1]):
        member = members[pair]
        shape = shapes[member]
        alpha = wp.min(shape[3] * falloff(pixel.place - means2d[member], shape), ALPHA_MAX)
        if alpha >= ALPHA_MIN:
            behind = through * (1.0 - alpha)
            if behind < TRANSMITTANCE_MIN:
                break
            total += alpha * through * looks[member]
            through = behind
            last = pair + 1
    rgb[pixel.index] = wp.vec3(total[0], total[1], total[2])
    alphas[pixel.index] = 1.0 - through
    depths[pixel.index] = total[3]
    left[pixel.index] = through
    lasts[pixel.index] = last


@wp.func
@no_type_check
def pair_gradient(offset: wp.vec2, shape: wp.vec4, opacity: float, g_alpha: float, g_look: wp.vec4):
    """Gradient of one pixel in one splat, from those in its alpha and its look; `opacity`: before the upper limit."""
    entry = vec10()
    for i in range(4):
        entry[6 + i] = g_look[i]
    if opacity <= ALPHA_MAX:
        dx, dy, of_power = offset[0], offset[1], g_alpha * opacity
        entry[0] = of_power * (shape[0] * dx + shape[1] * dy)
        entry[1] = of_power * (shape[1] * dx + shape[2] * dy)
        entry[2] = -0.5 * of_power * dx * dx
        entry[3] = -of_power * dx * dy
        entry[4] = -0.5 * of_power * dy * dy
        entry[5] = of_power / shape[3]
    return entry


@wp.kernel
@no_type_check
def blend_backward(
    means2d: wp.array(dtype=wp.vec2),
    shapes: wp.array(dtype=wp.vec4),
    looks: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    width: int,
    height: int,
    left: wp.array(dtype=float),
    lasts: wp.array(dtype=int),
    g_rgb: wp.array(dtype=wp.vec3),
    g_alphas: wp.array(dtype=float),
    g_depths: wp.array(dtype=float),
    slots: wp.array(dtype=wp.int64),
    entries: wp.array(dtype=vec10),
):
    """One pixel, its pairs from the farthest to the nearest; the block adds up what its pixels have of a pair.

    All threads of a block take the same pairs, because sums of a block wait for all. On the processor a block is one
    thread, and adds to what the threads before it left.
    """
    thread = wp.tid()
    pixel = pixel_of(thread, width, height)
    start = starts[thread // PIXELS]
    last = int(start)
    through = wp.float32(1.0)
    g_left = wp.float32(0.0)
    g_look = wp.vec4()
    if pixel.inside:
        last = lasts[pixel.index]
        through = left[pixel.index]
        g_left = g_alphas[pixel.index] * through
        g_colour = g_rgb[pixel.index]
        g_look = wp.vec4(g_colour[0], g_colour[1], g_colour[2], g_depths[pixel.index])
    farthest = wp.tile_max(wp.tile(last))[0]
    behind = wp.float32(0.0)  # Gradient times everything behind the pair, as it reaches the pixel.
    for step in range(farthest - start):
        pair = farthest - 1 - step
        entry = vec10()
        if pair < last:
            member = members[pair]
            shape, look = shapes[member], looks[member]
            offset = pixel.place - means2d[member]
            opacity = shape[3] * falloff(offset, shape)
            alpha = wp.min(opacity, ALPHA_MAX)
            if alpha >= ALPHA_MIN:
                through /= 1.0 - alpha
                shown = wp.dot(g_look, look)
                g_alpha = through * shown + (g_left - behind) / (1.0 - alpha)
                entry = pair_gradient(offset, shape, opacity, g_alpha, alpha * through * g_look)
                behind += alpha * through * shown
        total = wp.tile_sum(wp.tile(entry, preserve_type=True))[0]
        if thread % wp.block_dim() == 0:
            entries[slots[pair]] = entries[slots[pair]] + total


@wp.kernel
@no_type_check
def gather(
    order: wp.array(dtype=wp.int64),
    ends: wp.array(dtype=wp.int64),
    boxes: wp.array(dtype=wp.vec4i),
    count: int,
    entries: wp.array(dtype=vec10),
    g_means2d: wp.array(dtype=wp.vec2),
    g_shapes: wp.array(dtype=wp.vec4),
    g_looks: wp.array(dtype=wp.vec4),
):
    """The gradient of one splat of one camera: the sum over its pairs, in their order."""
    thread = wp.tid()
    member = thread // count * count + int(order[thread])
    box = boxes[member]
    end = int(ends[thread])
    total = vec10()
    for place in range(end - (box[2] - box[0]) * (box[3] - box[1]), end):
        total += entries[place]
    g_means2d[member] = wp.vec2(total[0], total[1])
    g_shapes[member] = wp.vec4(total[2], total[3], total[4], total[5])
    g_looks[member] = wp.vec4(total[6], total[7], total[8], total[9])
