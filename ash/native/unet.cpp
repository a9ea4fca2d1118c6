// The U-Net of ash/decoders.py, forward and backward, for one image. Activations and their gradients lie in planes whose border of one
// pixel is zero, so that a 3x3 convolution needs no other case; skips are written where the concatenation is read.
#include <algorithm>
#include <cstring>
#include <memory>
#include <mutex>
#include <new>
#include <vector>

#include "dispatch.h"
#include "team.h"

using namespace ash;

namespace {

// Pixels (y, x) inside a border of zeros; `step` floats from one pixel to the next, `channels` of which are meant.
struct Plane {
    float* first = nullptr;  // pixel (0, 0)
    int height = 0, width = 0, channels = 0;
    int64_t step = 0;
    int64_t row() const { return (width + 2) * step; }
    float* at(int y, int x = 0) const { return first + y * row() + x * step; }
    Plane part(int from, int count) const { return {first + from, height, width, count, step}; }
};

// Planes one after the other; measured first, then given memory.
struct Arena {
    std::unique_ptr<float[]> memory;
    int64_t used = 0;
    Plane plane(int height, int width, int channels) {
        const int64_t before = used;
        used += (int64_t(height + 2) * (width + 2) * channels + 15) / 16 * 16;
        Plane plane{nullptr, height, width, channels, channels};
        if (memory) plane.first = memory.get() + before + plane.row() + plane.step;
        return plane;
    }
    float* numbers(int64_t count) {
        const int64_t before = used;
        used += (count + 15) / 16 * 16;
        return memory ? memory.get() + before : nullptr;
    }
};

struct Shape {  // of the network; as the caller gives it
    int height, width, inputs, outputs, channels, levels, features;
    bool operator==(const Shape& o) const { return !std::memcmp(this, &o, sizeof o); }
};

struct Layer {  // weights and bias; a convolution's lie [out][tap][in], a transposed one's [in][tap][out]
    const float *weights, *bias;
    float *grad_weights, *grad_bias;
};

struct Level {
    // joined: what came up beside the skip; at the lowest level the features beside it.
    Plane pooled, middle, joined, skip, up, merged_middle, merged;
    Plane grad, grad_middle, grad_joined, grad_pooled;
};

struct Network {
    Shape shape;
    Arena arena;
    Plane input;
    std::vector<Level> levels;
    float* packed = nullptr;

    explicit Network(const Shape& s) : shape(s), levels(s.levels + 1) {
        lay_out();
        const int64_t size = arena.used + 64;  // products read up to a block of columns beyond the end
        arena.memory.reset(new float[size]());
        arena.used = 0;
        lay_out();
    }

    int channels(int level) const { return shape.channels << level; }

    void lay_out() {
        input = arena.plane(shape.height, shape.width, shape.inputs);
        int64_t widest = int64_t(16) * shape.channels + 16 * shape.outputs * (1 + shape.channels / 16);
        for (int l = 0; l <= shape.levels; ++l) {
            Level& at = levels[l];
            const int h = shape.height >> l, w = shape.width >> l, c = channels(l);
            const int joined = l < shape.levels ? 2 * c : c + shape.features;
            auto plane = [&](int count) { return arena.plane(h, w, count); };
            if (l) at.pooled = plane(c / 2), at.grad_pooled = plane(c / 2);
            at.middle = plane(c), at.joined = plane(joined), at.merged_middle = plane(c), at.merged = plane(c);
            at.grad = plane(c), at.grad_middle = plane(c), at.grad_joined = plane(joined);
            at.up = at.joined.part(0, c), at.skip = at.joined.part(l < shape.levels ? c : 0, c);
            widest = std::max(widest, int64_t(9) * (joined + 16) * (c + 16) * 2);
        }
        widest = std::max(widest, int64_t(9) * (shape.inputs + 16) * (shape.channels + 16));
        packed = arena.numbers(widest);
    }
};

constexpr int BAND = 4;  // image rows handed out at once

template <class Work> void in_bands(int threads, int height, const Work& work) {
    in_parallel(threads, (height + BAND - 1) / BAND, [&](int64_t band) {
        for (int y = int(band) * BAND; y < std::min(height, int(band + 1) * BAND); ++y) work(y);
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

Taps around(const Plane& in, int sign) {
    Taps taps{9, {}};
    for (int t = 0; t < 9; ++t) taps.at[t] = sign * ((t / 3 - 1) * in.row() + (t % 3 - 1) * in.step);
    return taps;
}

// A 3x3 convolution with ReLU.
void forward(const Layer& layer, const Plane& in, const Plane& out, float* packed, int threads) {
    const int ci = in.channels, co = out.channels;
    kernels().pack({layer.weights, co, 9, ci, int64_t(9) * ci, ci, 1, packed});
    Product product{};
    product.a_step = in.step, product.b = packed, product.c_step = out.step, product.start = layer.bias, product.relu = true;
    convolve(product, around(in, 1), ci, out, threads, [&](int y) { return in.at(y); });
}

// The gradient of its input, 0 where `active` (the input, if it came out of a ReLU) is not positive.
void backward_input(const Layer& layer, const Plane& grad, const Plane& to, const Plane* active, float* packed, int threads) {
    const int ci = to.channels, co = grad.channels;
    kernels().pack({layer.weights, ci, 9, co, 1, ci, int64_t(9) * ci, packed});
    Product product{};
    product.a_step = grad.step, product.b = packed, product.c_step = to.step;
    if (active) product.active = active->first, product.active_step = active->step;
    convolve(product, around(grad, -1), co, to, threads, [&](int y) { return grad.at(y); });
}

// c[j][k] = the sum over pixels of a's channel j times b's channel k; a's pixels lie `a_row` and `a_pixel` floats apart, b's likewise.
void correlate(const float* a, int64_t a_row, int64_t a_pixel, int rows, const float* b, int64_t b_row, int64_t b_pixel, int columns,
               int height, int width, float* c, int64_t c_step) {
    constexpr int MOST = 32;
    const int band = std::max(1, std::min(MOST, 256 / width));  // what is read stays in the first-level cache for all sums
    int64_t a_at[MOST], b_at[MOST];
    for (int y = 0; y < band; ++y) a_at[y] = y * a_row, b_at[y] = y * b_row;
    for (int y = 0; y < height; y += band) {
        Product product{};
        product.a = a + y * a_row, product.a_step = 1, product.a_inner = a_pixel;
        product.b = b + y * b_row, product.b_inner = b_pixel, product.b_block = PRODUCT_COLUMNS;
        product.a_at = a_at, product.b_at = b_at, product.segments = std::min(band, height - y), product.steps = width;
        product.rows = rows, product.columns = columns, product.c = c, product.c_step = c_step, product.add = y > 0;
        kernels().multiply(product);
    }
}

void sum_pixels(const float* from, int64_t row, int64_t pixel, int height, int width, int channels, float* to) {
    std::fill(to, to + channels, 0.0f);
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x)
            for (int c = 0; c < channels; ++c) to[c] += from[y * row + x * pixel + c];
}

void backward_weights(const Layer& layer, const Plane& grad, const Plane& in, int threads) {
    const int ci = in.channels;
    const Taps taps = around(in, 1);
    in_parallel(threads, 9, [&](int64_t t) {
        correlate(grad.first, grad.row(), grad.step, grad.channels, in.first + taps.at[t], in.row(), in.step, ci, grad.height, grad.width,
                  layer.grad_weights + t * ci, int64_t(9) * ci);
    });
    sum_pixels(grad.first, grad.row(), grad.step, grad.height, grad.width, grad.channels, layer.grad_bias);
}

// Two convolutions, the gradient of whose result is in `at.grad`; that of the input goes to `to`, if it is wanted.
void backward_block(const Layer* layers, const Level& at, const Plane& in, const Plane& middle, const Plane* to, float* packed, int threads) {
    backward_weights(layers[1], at.grad, middle, threads);
    backward_input(layers[1], at.grad, at.grad_middle, &middle, packed, threads);
    backward_weights(layers[0], at.grad_middle, in, threads);
    if (to) backward_input(layers[0], at.grad_middle, *to, nullptr, packed, threads);
}

// Every pixel makes 2x2 of them.
void forward_up(const Layer& layer, const Plane& in, const Plane& out, float* packed, int threads) {
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

void backward_up_weights(const Layer& layer, const Plane& grad, const Plane& in, int threads) {
    const int co = grad.channels;
    in_parallel(threads, 4, [&](int64_t t) {
        correlate(in.first, in.row(), in.step, in.channels, grad.at(int(t / 2), int(t % 2)), 2 * grad.row(), 2 * grad.step, co, in.height,
                  in.width, layer.grad_weights + t * co, int64_t(4) * co);
    });
    sum_pixels(grad.first, grad.row(), grad.step, grad.height, grad.width, co, layer.grad_bias);
}

// Gradients of the input's channels from `from` on.
void backward_up_input(const Layer& layer, const Plane& grad, int from, const Plane& to, const Plane* active, float* packed, int threads) {
    const int co = grad.channels;
    kernels().pack({layer.weights + int64_t(from) * 4 * co, to.channels, 4, co, int64_t(4) * co, co, 1, packed});
    Product product{};
    product.a_step = 2 * grad.step, product.b = packed, product.c_step = to.step;
    if (active) product.active = active->first, product.active_step = active->step;
    const Taps taps{4, {0, grad.step, grad.row(), grad.row() + grad.step}};
    convolve(product, taps, co, to, threads, [&](int y) { return grad.at(2 * y); });
}

void pool(const Plane& in, const Plane& out, int threads) {
    in_bands(threads, out.height, [&](int y) {
        for (int x = 0; x < out.width; ++x) {
            const float *a = in.at(2 * y, 2 * x), *b = a + in.step, *c = in.at(2 * y + 1, 2 * x), *d = c + in.step;
            float* to = out.at(y, x);
            for (int i = 0; i < out.channels; ++i) to[i] = std::max(std::max(a[i], b[i]), std::max(c[i], d[i]));
        }
    });
}

// grad_in = (grad_skip + grad_pooled where the pixel is the first largest of its four), 0 where the input is not positive.
void backward_pool(const Plane& in, const Plane& pooled, const Plane& grad_pooled, const Plane& grad_skip, const Plane& grad_in, int threads) {
    in_bands(threads, pooled.height, [&](int y) {
        for (int x = 0; x < pooled.width; ++x) {
            const float *most = pooled.at(y, x), *grad = grad_pooled.at(y, x);
            const float *v[4], *s[4];
            float* to[4];
            for (int k = 0; k < 4; ++k) {
                const int yy = 2 * y + k / 2, xx = 2 * x + k % 2;
                v[k] = in.at(yy, xx), s[k] = grad_skip.at(yy, xx), to[k] = grad_in.at(yy, xx);
            }
            for (int i = 0; i < pooled.channels; ++i) {
                float left = grad[i];  // goes to the first that has the largest value
                for (int k = 0; k < 4; ++k) {
                    const bool largest = v[k][i] == most[i];
                    const float value = s[k][i] + (largest ? left : 0.0f);
                    left = largest ? 0.0f : left;
                    to[k][i] = v[k][i] > 0 ? value : 0.0f;
                }
            }
        }
    });
}

std::mutex free_mutex;
std::vector<std::unique_ptr<Network>> free_networks;
constexpr size_t FREE_NETWORKS = 4;

std::unique_ptr<Network> take_network(const Shape& shape) {
    {
        std::lock_guard<std::mutex> lock(free_mutex);
        for (auto& one : free_networks)
            if (one->shape == shape) {
                auto network = std::move(one);
                free_networks.erase(free_networks.begin() + (&one - free_networks.data()));
                return network;
            }
    }
    return std::make_unique<Network>(shape);
}

// Layers in order: two of the first block; two per level down; then per level up the transposed one and two; the head.
struct Layers {
    std::vector<Layer> all;
    int levels;
    const Layer* down(int level) const { return all.data() + 2 * level; }
    const Layer& up(int level) const { return all[2 * (levels + 1) + 3 * (levels - 1 - level)]; }
    const Layer* merge(int level) const { return &up(level) + 1; }
    const Layer& head() const { return all.back(); }
};

Layers layers_of(const Shape& shape, const float* const* weights, float* const* grads) {
    Layers layers{{}, shape.levels};
    for (int i = 0; i < 2 * (shape.levels + 1) + 3 * shape.levels + 1; ++i)
        layers.all.push_back({weights[2 * i], weights[2 * i + 1], grads ? grads[2 * i] : nullptr, grads ? grads[2 * i + 1] : nullptr});
    return layers;
}

}  // namespace

extern "C" {

// shape: height, width, inputs, outputs, channels of the first level, levels, features at the bottleneck. texture: [inputs, h, w] with
// the given strides. weights: of every layer, in the order of `Layers`, weights and bias. out: [h, w, outputs]. Returns what
// ash_unet_backward needs, or null if memory is short.
void* ash_unet(const int* numbers, const float* texture, const int64_t* strides, const float* features, const float* const* weights,
               int threads, float* out) try {
    Shape shape;
    std::memcpy(&shape, numbers, sizeof shape);
    auto network = take_network(shape);
    Network& n = *network;
    const Layers layers = layers_of(shape, weights, nullptr);
    const int bottom = shape.levels;
    in_bands(threads, shape.height, [&](int y) {
        for (int x = 0; x < shape.width; ++x)
            for (int c = 0; c < shape.inputs; ++c) n.input.at(y, x)[c] = texture[c * strides[0] + y * strides[1] + x * strides[2]];
    });
    for (int l = 0; l <= bottom; ++l) {
        Level& at = n.levels[l];
        if (l) pool(n.levels[l - 1].skip, at.pooled, threads);
        forward(layers.down(l)[0], l ? at.pooled : n.input, at.middle, n.packed, threads);
        forward(layers.down(l)[1], at.middle, at.skip, n.packed, threads);
    }
    const Level& lowest = n.levels[bottom];
    for (int y = 0; y < lowest.joined.height && shape.features; ++y)
        for (int x = 0; x < lowest.joined.width; ++x)
            std::copy(features, features + shape.features, lowest.joined.at(y, x) + n.channels(bottom));
    for (int l = bottom - 1; l >= 0; --l) {
        Level& at = n.levels[l];
        forward_up(layers.up(l), l + 1 == bottom ? lowest.joined : n.levels[l + 1].merged, at.up, n.packed, threads);
        forward(layers.merge(l)[0], at.joined, at.merged_middle, n.packed, threads);
        forward(layers.merge(l)[1], at.merged_middle, at.merged, n.packed, threads);
    }
    const Plane& last = bottom ? n.levels[0].merged : n.levels[0].joined;
    const int64_t zero[1] = {0};
    kernels().pack({layers.head().weights, shape.outputs, 1, last.channels, last.channels, 0, 1, n.packed});
    in_bands(threads, shape.height, [&](int y) {
        Product product{};
        product.a = last.at(y), product.a_step = last.step, product.a_inner = 1;
        product.b = n.packed, product.b_inner = PRODUCT_COLUMNS, product.b_block = int64_t(last.channels) * PRODUCT_COLUMNS;
        product.a_at = product.b_at = zero, product.segments = 1, product.steps = last.channels;
        product.rows = shape.width, product.columns = shape.outputs, product.start = layers.head().bias;
        product.c = out + int64_t(y) * shape.width * shape.outputs, product.c_step = shape.outputs;
        kernels().multiply(product);
    });
    return network.release();
} catch (const std::bad_alloc&) {
    return nullptr;
}

// grad: [h, w, outputs]. Writes every layer's gradients, and the features' where there are any.
void ash_unet_backward(void* handle, const float* grad, const float* const* weights, float* const* grads, float* grad_features, int threads) {
    Network& n = *static_cast<Network*>(handle);
    const Shape& shape = n.shape;
    const Layers layers = layers_of(shape, weights, grads);
    const int bottom = shape.levels, outputs = shape.outputs;
    const Layer& head = layers.head();
    const Plane& last = bottom ? n.levels[0].merged : n.levels[0].joined;
    const int64_t line = int64_t(shape.width) * outputs;
    correlate(grad, line, outputs, outputs, last.first, last.row(), last.step, last.channels, shape.height, shape.width, head.grad_weights,
              last.channels);
    sum_pixels(grad, line, outputs, shape.height, shape.width, outputs, head.grad_bias);
    kernels().pack({head.weights, last.channels, 1, outputs, 1, 0, last.channels, n.packed});
    Product product{};
    product.a_step = outputs, product.b = n.packed, product.c_step = n.levels[0].grad.step;
    product.active = last.first, product.active_step = last.step;
    convolve(product, {1, {0}}, outputs, n.levels[0].grad, threads, [&](int y) { return grad + y * line; });
    for (int l = 0; l < bottom; ++l) {
        Level &at = n.levels[l], &below = n.levels[l + 1];
        backward_block(layers.merge(l), at, at.joined, at.merged_middle, &at.grad_joined, n.packed, threads);
        const Plane grad_up = at.grad_joined.part(0, n.channels(l));
        const bool lowest = l + 1 == bottom;
        const Plane& in = lowest ? below.joined : below.merged;
        backward_up_weights(layers.up(l), grad_up, in, threads);
        const Plane active = lowest ? below.skip : below.merged;
        backward_up_input(layers.up(l), grad_up, 0, below.grad, &active, n.packed, threads);
        if (!lowest || !shape.features) continue;
        const Plane of_features = below.grad_joined.part(0, shape.features);  // that gradient is needed nowhere else
        backward_up_input(layers.up(l), grad_up, n.channels(bottom), of_features, nullptr, n.packed, threads);
        sum_pixels(of_features.first, of_features.row(), of_features.step, of_features.height, of_features.width, shape.features,
                   grad_features);
    }
    for (int l = bottom; l > 0; --l) {
        Level &at = n.levels[l], &above = n.levels[l - 1];
        backward_block(layers.down(l), at, at.pooled, at.middle, &at.grad_pooled, n.packed, threads);
        backward_pool(above.skip, at.pooled, at.grad_pooled, above.grad_joined.part(n.channels(l - 1), n.channels(l - 1)), above.grad,
                      threads);
    }
    backward_block(layers.down(0), n.levels[0], n.input, n.levels[0].middle, nullptr, n.packed, threads);
}

void ash_unet_release(void* handle) {
    std::unique_ptr<Network> network(static_cast<Network*>(handle));
    std::lock_guard<std::mutex> lock(free_mutex);
    if (free_networks.size() < FREE_NETWORKS) free_networks.push_back(std::move(network));
}
}
