// Convolutions, their transposes and pools, forward and backward, in planes whose border of one pixel is zero, so that a 3x3
// convolution needs no other case.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

#include "dispatch.h"
#include "team.h"
#include "tiles.h"

namespace ash {

// Pixels (y, x) inside a border of zeros; `step` floats from one pixel to the next, `channels` of which are meant.
struct Plane {
    float* first = nullptr;  // pixel (0, 0)
    int height = 0, width = 0, channels = 0;
    int64_t step = 0;
    int64_t row() const { return (width + 2) * step; }
    float* at(int y, int x = 0) const { return first + y * row() + x * step; }
    Plane part(int from, int count) const { return {first + from, height, width, count, step}; }
};

struct Layer {  // weights and bias; a convolution's lie [out][tap][in], a transposed one's [in][tap][out]
    const float *weights, *bias;
    float *grad_weights, *grad_bias;
};

// Where factors are put in the order that products want, one layer after the other.
struct Scratch {
    float *packed = nullptr, *winograd = nullptr;
    bool halves = false;  // 3x3 convolutions in bfloat16, by the kernels of tiles.h
    Half *plane = nullptr, *weights = nullptr, *turned = nullptr, *pairs = nullptr;
};

constexpr int BAND = 4;  // image rows handed out at once

template <class Work> void in_bands(int threads, int height, const Work& work) {
    in_ranges(threads, height, BAND, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t y = first; y < last; ++y) work(int(y));
    });
}

// A stencil: which pixel each tap reads, relative to the pixel that is made, and how far apart those read are.
struct Taps {
    int count;
    int64_t at[9];
};

// out = the products of what the taps read with packed weights, row by row. `from`: of output row y, the first pixel of its input.
template <class From> void convolve(Product product, const Taps& taps, int steps, const Plane& out, int threads, const From& from) {
    int64_t b_at[9];
    for (int t = 0; t < taps.count; ++t) b_at[t] = int64_t(t) * steps * PRODUCT_COLUMNS;
    product.a_inner = 1, product.b_inner = PRODUCT_COLUMNS, product.b_block = int64_t(taps.count) * steps * PRODUCT_COLUMNS;
    product.a_at = taps.at, product.b_at = b_at, product.segments = taps.count, product.steps = steps;
    product.rows = out.width, product.columns = out.channels;
    const float* active = product.active;
    in_bands(threads, out.height, [&](int y) {
        Product here = product;
        here.a = from(y);
        here.c = out.at(y);
        if (active) here.active = active + y * (out.width + 2) * product.active_step;
        kernels().multiply(here);
    });
}

inline Taps around(const Plane& in, int sign) {
    Taps taps{9, {}};
    for (int t = 0; t < 9; ++t) taps.at[t] = sign * ((t / 3 - 1) * in.row() + (t % 3 - 1) * in.step);
    return taps;
}

inline TilePlane tile_plane_of(const Plane& p) { return {p.first, p.height, p.width, p.channels, p.step}; }

inline void convolve_in_tiles(const Plane& in, const TileConvolution& given, const Scratch& scratch, int threads) {
    constexpr int64_t RANGE = 16;
    TileConvolution work = given;
    work.plane = scratch.plane, work.weights = scratch.weights, work.inputs = in.channels;
    tiles()->plane(tile_plane_of(in), scratch.plane);
    const int64_t blocks = tiles()->blocks(in.height, in.width);
    in_ranges(threads, blocks, RANGE, [&](int64_t, int64_t first, int64_t last) { tiles()->convolve(work, first, last); });
}

// Whether 3x3 convolutions between two planes are done by Winograd's algorithm (winograd.inc): 4x4 pixels at a time, whole vectors.
inline bool in_winograd(const Plane& in, const Plane& out) {
    return in.height % 4 == 0 && in.width % 4 == 0 && in.channels % PRODUCT_COLUMNS == 0 && out.channels % PRODUCT_COLUMNS == 0;
}

// The next address at which a line of the cache begins, at most 15 floats on.
inline float* aligned(float* p) { return reinterpret_cast<float*>((reinterpret_cast<uintptr_t>(p) + 63) / 64 * 64); }

constexpr int64_t WINOGRAD_TILES = 32, WINOGRAD_CORRELATED = 64;  // done at once: in a convolution, in the gradient of its weights

// `count` tiles of a plane from `first` on. The odd stride keeps the factors of a tile in different sets of the cache.
inline WinogradTiles winograd_tiles(const Plane& p, int64_t first, int64_t count) {
    return {p.first, p.row(), p.step, p.width / 4, p.channels, first, count, WINOGRAD_CORRELATED * p.channels + PRODUCT_COLUMNS};
}

// Room for the factors of tiles of `channels`, of this thread; `which`: the first or the second.
inline float* winograd_room(int which, int64_t channels) {
    thread_local std::vector<float> rooms[2];
    const size_t size = 36 * (WINOGRAD_CORRELATED * channels + PRODUCT_COLUMNS) + PRODUCT_COLUMNS;
    if (rooms[which].size() < size) rooms[which].resize(size);
    return aligned(rooms[which].data());
}

// As `convolve` with nine taps and the weights that are packed; `flipped`: of the last tap first.
inline void convolve_in_winograd(const Plane& in, const Plane& out, bool flipped, const float* start, bool relu, const Plane* active,
                                 const Scratch& scratch, int threads) {
    const int64_t steps = in.channels, of_block = steps * PRODUCT_COLUMNS;
    kernels().winograd_weights(scratch.packed, out.channels / PRODUCT_COLUMNS, steps, flipped, scratch.winograd);
    const int64_t tiles = int64_t(in.height) * in.width / 16, zero = 0;
    in_ranges(threads, tiles, WINOGRAD_TILES, [&](int64_t, int64_t first, int64_t last) {
        const WinogradTiles from = winograd_tiles(in, first, last - first), to = winograd_tiles(out, first, last - first);
        float *factors = winograd_room(0, in.channels), *products = winograd_room(1, out.channels);
        kernels().winograd_input(from, factors);
        Product product{};
        product.a_step = product.steps = steps, product.a_inner = 1;
        product.b_inner = PRODUCT_COLUMNS, product.b_block = 36 * of_block;
        product.a_at = product.b_at = &zero, product.segments = 1;
        product.rows = last - first, product.columns = product.c_step = out.channels;
        for (int place = 0; place < 36; ++place) {
            product.a = factors + place * from.stride, product.b = scratch.winograd + place * of_block, product.c = products + place * to.stride;
            kernels().multiply(product);
        }
        kernels().winograd_output(to, products, start, relu, active ? active->first : nullptr, active ? active->row() : 0, active ? active->step : 0);
    });
}

// The gradient of the weights [out][tap][in].
inline void correlate_in_winograd(const Plane& grad, const Plane& in, float* grad_weights, const Scratch& scratch, int threads) {
    const int64_t tiles = int64_t(in.height) * in.width / 16, size = int64_t(grad.channels) * in.channels, zero = 0;
    float *factors = winograd_room(0, in.channels), *products = winograd_room(1, grad.channels);
    for (int64_t first = 0; first < tiles; first += WINOGRAD_CORRELATED) {
        const int64_t count = std::min(WINOGRAD_CORRELATED, tiles - first);
        const WinogradTiles of_in = winograd_tiles(in, first, count), of_grad = winograd_tiles(grad, first, count);
        kernels().winograd_input(of_in, factors);
        kernels().winograd_output_backward(of_grad, products);
        in_parallel(threads, 36, [&](int64_t place) {
            Product product{};
            product.a = products + place * of_grad.stride, product.a_step = 1, product.a_inner = grad.channels;
            product.b = factors + place * of_in.stride, product.b_inner = in.channels, product.b_block = PRODUCT_COLUMNS;
            product.a_at = product.b_at = &zero, product.segments = 1, product.steps = count;
            product.rows = grad.channels, product.columns = product.c_step = in.channels;
            product.c = scratch.winograd + place * size, product.add = first > 0;
            kernels().multiply(product);
        });
    }
    kernels().winograd_weights_backward(scratch.winograd, size, grad.channels, in.channels, grad_weights);
}

inline void sum_pixels(const float* from, int64_t row, int64_t pixel, int height, int width, int channels, float* to) {
    std::fill(to, to + channels, 0.0f);
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x)
            for (int c = 0; c < channels; ++c) to[c] += from[y * row + x * pixel + c];
}

// A 3x3 convolution with ReLU.
inline void forward(const Layer& layer, const Plane& in, const Plane& out, const Scratch& scratch, int threads) {
    const int ci = in.channels, co = out.channels;
    if (scratch.halves) {
        tiles()->weights(layer.weights, co, ci, false, scratch.weights);
        return convolve_in_tiles(in, {nullptr, nullptr, 0, tile_plane_of(out), layer.bias, nullptr, 0, true}, scratch, threads);
    }
    float* const packed = scratch.packed;
    kernels().pack({layer.weights, co, 9, ci, int64_t(9) * ci, ci, 1, packed});
    if (in_winograd(in, out)) return convolve_in_winograd(in, out, false, layer.bias, true, nullptr, scratch, threads);
    Product product{};
    product.a_step = in.step, product.b = packed, product.c_step = out.step, product.start = layer.bias, product.relu = true;
    convolve(product, around(in, 1), ci, out, threads, [&](int y) { return in.at(y); });
}

// The gradient of its input, 0 where `active` (the input, if it came out of a ReLU) is not positive.
inline void backward_input(const Layer& layer, const Plane& grad, const Plane& to, const Plane* active, const Scratch& scratch, int threads) {
    const int ci = to.channels, co = grad.channels;
    if (scratch.halves) {
        tiles()->weights(layer.weights, co, ci, true, scratch.weights);
        const TileConvolution work{nullptr, nullptr, 0, tile_plane_of(to), nullptr, active ? active->first : nullptr, active ? active->step : 0, false};
        return convolve_in_tiles(grad, work, scratch, threads);
    }
    float* const packed = scratch.packed;
    kernels().pack({layer.weights, ci, 9, co, 1, ci, int64_t(9) * ci, packed});
    if (in_winograd(grad, to)) return convolve_in_winograd(grad, to, true, nullptr, false, active, scratch, threads);
    Product product{};
    product.a_step = grad.step, product.b = packed, product.c_step = to.step;
    if (active) product.active = active->first, product.active_step = active->step;
    convolve(product, around(grad, -1), co, to, threads, [&](int y) { return grad.at(y); });
}

// c[j][k] = (what is there, if `add`, and) the sum over pixels of a's channel j times b's channel k; a's pixels lie `a_row` and `a_pixel` floats apart, b's likewise.
inline void correlate(const float* a, int64_t a_row, int64_t a_pixel, int rows, const float* b, int64_t b_row, int64_t b_pixel, int columns,
               int height, int width, float* c, int64_t c_step, bool add = false) {
    constexpr int MOST = 32;
    const int band = std::max(1, std::min(MOST, 256 / width));  // what is read stays in the first-level cache for all sums
    int64_t a_at[MOST], b_at[MOST];
    for (int y = 0; y < band; ++y) a_at[y] = y * a_row, b_at[y] = y * b_row;
    for (int y = 0; y < height; y += band) {
        Product product{};
        product.a = a + y * a_row, product.a_step = 1, product.a_inner = a_pixel;
        product.b = b + y * b_row, product.b_inner = b_pixel, product.b_block = PRODUCT_COLUMNS;
        product.a_at = a_at, product.b_at = b_at, product.segments = std::min(band, height - y), product.steps = width;
        product.rows = rows, product.columns = columns, product.c = c, product.c_step = c_step, product.add = add || y > 0;
        kernels().multiply(product);
    }
}

inline void correlate_in_tiles(const Layer& layer, const Plane& grad, const Plane& in, const Scratch& scratch, int threads) {
    const int height = grad.height, width = grad.width, ci = in.channels, co = grad.channels;
    tiles()->plane(tile_plane_of(grad), scratch.plane);
    tiles()->turned(scratch.plane, height, width, co, scratch.turned);
    tiles()->plane(tile_plane_of(in), scratch.plane);
    tiles()->pairs(scratch.plane, height, width, ci, scratch.pairs);
    const TileCorrelation work{scratch.turned, scratch.pairs, height, width, co, ci, layer.grad_weights};
    in_parallel(threads, tiles()->correlations(co, ci), [&](int64_t piece) { tiles()->correlate(work, piece, piece + 1); });
}

// The gradient of the weights [out][tap][in], tap by tap. Columns of a product are done 16 at a time: they are of the plane that wastes less.
inline void correlate_taps(const Plane& grad, const Plane& in, float* grad_weights, const Scratch& scratch, int threads) {
    const int ci = in.channels, co = grad.channels;
    const Taps taps = around(in, 1);
    const bool turned = int64_t(ci) * ((co + 15) / 16) < int64_t(co) * ((ci + 15) / 16);
    in_parallel(threads, 9, [&](int64_t t) {
        const float* read = in.first + taps.at[t];
        float* to = grad_weights + t * ci;
        if (!turned)
            return correlate(grad.first, grad.row(), grad.step, co, read, in.row(), in.step, ci, grad.height, grad.width, to, int64_t(9) * ci);
        float* sums = scratch.packed + t * ci * co;
        correlate(read, in.row(), in.step, ci, grad.first, grad.row(), grad.step, co, grad.height, grad.width, sums, co);
        for (int o = 0; o < co; ++o)
            for (int i = 0; i < ci; ++i) to[int64_t(o) * 9 * ci + i] = sums[i * co + o];
    });
}

inline void backward_weights(const Layer& layer, const Plane& grad, const Plane& in, const Scratch& scratch, int threads) {
    if (scratch.halves)
        correlate_in_tiles(layer, grad, in, scratch, threads);
    else if (in_winograd(in, grad))
        correlate_in_winograd(grad, in, layer.grad_weights, scratch, threads);
    else
        correlate_taps(grad, in, layer.grad_weights, scratch, threads);
    sum_pixels(grad.first, grad.row(), grad.step, grad.height, grad.width, grad.channels, layer.grad_bias);
}

// Every pixel makes 2x2 of them.
inline void forward_up(const Layer& layer, const Plane& in, const Plane& out, float* packed, int threads) {
    const int ci = in.channels, co = out.channels;
    const int64_t size = int64_t((co + 15) / 16) * ci * PRODUCT_COLUMNS;
    const Taps here{1, {0}};
    for (int t = 0; t < 4; ++t) {
        kernels().pack({layer.weights + t * co, co, 1, ci, 1, 0, int64_t(4) * co, packed + t * size});
        Product product{};
        product.a_step = in.step, product.b = packed + t * size, product.c_step = 2 * out.step, product.start = layer.bias;
        Plane every_other{out.at(t / 2, t % 2), in.height, in.width, co, 2 * out.step};
        int64_t b_at[1] = {0};
        product.a_inner = 1, product.b_inner = PRODUCT_COLUMNS, product.b_block = int64_t(ci) * PRODUCT_COLUMNS;
        product.a_at = here.at, product.b_at = b_at, product.segments = 1, product.steps = ci;
        product.rows = in.width, product.columns = co;
        in_bands(threads, in.height, [&](int y) {
            Product line = product;
            line.a = in.at(y), line.c = every_other.first + y * 2 * out.row();
            kernels().multiply(line);
        });
    }
}

inline void backward_up_weights(const Layer& layer, const Plane& grad, const Plane& in, int threads) {
    const int co = grad.channels;
    in_parallel(threads, 4, [&](int64_t t) {
        correlate(in.first, in.row(), in.step, in.channels, grad.at(int(t / 2), int(t % 2)), 2 * grad.row(), 2 * grad.step, co, in.height,
                  in.width, layer.grad_weights + t * co, int64_t(4) * co);
    });
    sum_pixels(grad.first, grad.row(), grad.step, grad.height, grad.width, co, layer.grad_bias);
}

// Gradients of the input's channels from `from` on.
inline void backward_up_input(const Layer& layer, const Plane& grad, int from, const Plane& to, const Plane* active, float* packed, int threads) {
    const int co = grad.channels;
    kernels().pack({layer.weights + int64_t(from) * 4 * co, to.channels, 4, co, int64_t(4) * co, co, 1, packed});
    Product product{};
    product.a_step = 2 * grad.step, product.b = packed, product.c_step = to.step;
    if (active) product.active = active->first, product.active_step = active->step;
    const Taps taps{4, {0, grad.step, grad.row(), grad.row() + grad.step}};
    convolve(product, taps, co, to, threads, [&](int y) { return grad.at(2 * y); });
}

inline void pool(const Plane& in, const Plane& out, int threads) {
    in_bands(threads, out.height, [&](int y) {
        for (int x = 0; x < out.width; ++x) {
            const float *a = in.at(2 * y, 2 * x), *b = a + in.step, *c = in.at(2 * y + 1, 2 * x), *d = c + in.step;
            float* to = out.at(y, x);
            for (int i = 0; i < out.channels; ++i) to[i] = std::max(std::max(a[i], b[i]), std::max(c[i], d[i]));
        }
    });
}

// grad_in = (grad_skip + grad_pooled where the pixel is the first largest of its four), 0 where the input is not positive.
inline void backward_pool(const Plane& in, const Plane& pooled, const Plane& grad_pooled, const Plane& grad_skip, const Plane& grad_in, int threads) {
    in_bands(threads, pooled.height, [&](int y) {
        for (int x = 0; x < pooled.width; ++x) {
            PoolGradient pixel{{}, pooled.at(y, x), grad_pooled.at(y, x), {}, {}, pooled.channels};
            for (int k = 0; k < 4; ++k) {
                const int yy = 2 * y + k / 2, xx = 2 * x + k % 2;
                pixel.in[k] = in.at(yy, xx), pixel.grad_skip[k] = grad_skip.at(yy, xx), pixel.grad_in[k] = grad_in.at(yy, xx);
            }
            kernels().pool_backward(pixel);
        }
    });
}

}  // namespace ash
