// The U-Net of ash/decoders.py, forward and backward, for one image. Activations and their gradients lie in planes (convolutions.h);
// skips are written where the concatenation is read.
#include <algorithm>
#include <cstring>
#include <memory>
#include <mutex>
#include <new>
#include <vector>

#include "convolutions.h"

using namespace ash;

namespace {

// Planes one after the other; measured first, then given memory.
struct Arena {
    std::unique_ptr<float[]> memory;
    int64_t used = 0;  // floats
    Plane plane(int height, int width, int channels) {
        const int64_t before = used;
        used += (int64_t(height + 2) * (width + 2) * channels + 15) / 16 * 16;
        Plane plane{nullptr, height, width, channels, channels};
        if (memory) plane.first = aligned(memory.get()) + before + plane.row() + plane.step;
        return plane;
    }
    float* numbers(int64_t count) {
        const int64_t before = used;
        used += (count + 15) / 16 * 16;
        return memory ? aligned(memory.get()) + before : nullptr;
    }
};

struct Shape {  // of the network; as the caller gives it
    int height, width, inputs, outputs, channels, levels, features, halves;
    bool operator==(const Shape& o) const { return !std::memcmp(this, &o, sizeof o); }
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
    Scratch scratch;

    explicit Network(const Shape& s) : shape(s), levels(s.levels + 1) {
        lay_out();
        const int64_t size = arena.used + 64;  // products read up to a block of columns beyond the end
        arena.memory.reset(new float[size]());
        arena.used = 0;
        lay_out();
    }

    int channels(int level) const { return shape.channels << level; }

    // Space for the halves of every 3x3 convolution.
    void lay_out_halves() {
        int64_t plane = 0, weights = 0, turned = 0, pairs = 0;
        auto convolution = [&](int level, int from, int to) {
            const int h = shape.height >> level, w = shape.width >> level;
            plane = std::max({plane, tiles()->plane_size(h, w, from), tiles()->plane_size(h, w, to)});
            weights = std::max(weights, tiles()->weights_size(to, from));
            turned = std::max(turned, tiles()->turned_size(h, w, to)), pairs = std::max(pairs, tiles()->pairs_size(h, w, from));
        };
        for (int l = 0; l <= shape.levels; ++l) {
            convolution(l, l ? channels(l - 1) : shape.inputs, channels(l));
            convolution(l, 2 * channels(l), channels(l));
        }
        auto halves = [&](int64_t count) { return reinterpret_cast<Half*>(arena.numbers((count + 1) / 2)); };
        scratch.plane = halves(plane), scratch.weights = halves(weights), scratch.turned = halves(turned), scratch.pairs = halves(pairs);
    }

    void lay_out() {
        input = arena.plane(shape.height, shape.width, shape.inputs);
        int64_t widest = int64_t(16) * shape.channels + 16 * shape.outputs * (1 + shape.channels / 16);
        int64_t winograd = 0;
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
            winograd = std::max(winograd, int64_t(36) * joined * c);
        }
        widest = std::max(widest, int64_t(9) * (shape.inputs + 16) * (shape.channels + 16));
        scratch.packed = arena.numbers(widest), scratch.winograd = arena.numbers(winograd);
        scratch.halves = shape.halves != 0;
        if (scratch.halves) lay_out_halves();
    }
};

// Two convolutions, the gradient of whose result is in `at.grad`; that of the input goes to `to`, if it is wanted.
void backward_block(const Layer* layers, const Level& at, const Plane& in, const Plane& middle, const Plane* to, const Scratch& scratch, int threads) {
    backward_weights(layers[1], at.grad, middle, scratch, threads);
    backward_input(layers[1], at.grad, at.grad_middle, &middle, scratch, threads);
    backward_weights(layers[0], at.grad_middle, in, scratch, threads);
    if (to) backward_input(layers[0], at.grad_middle, *to, nullptr, scratch, threads);
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

// Which parts of the output are wanted: of its lines y the parts picks[lines[y]] ... picks[lines[y + 1] - 1], of `part` floats each,
// written one after the other. All of it where there are none.
struct Picks {
    const int* picks;
    const int64_t* lines;
    int part;
    void take(int y, const float* line, float* to) const {
        for (int64_t i = lines[y]; i < lines[y + 1]; ++i) std::memcpy(to + i * part, line + int64_t(picks[i]) * part, part * sizeof(float));
    }
    void spread(int y, const float* from, float* line) const {
        for (int64_t i = lines[y]; i < lines[y + 1]; ++i) std::memcpy(line + int64_t(picks[i]) * part, from + i * part, part * sizeof(float));
    }
};

// The head's gradients, and that of its input. Picked parts are put into a few lines at a time, between zeros.
void backward_head(const Network& n, const Layer& head, const Plane& last, const float* grad, const Picks& picked, int threads) {
    const int outputs = n.shape.outputs, height = n.shape.height, width = n.shape.width;
    const int64_t line = int64_t(width) * outputs;
    const int lines = picked.picks ? std::max(1, std::min(height, 256 / width)) : height;  // as many as `correlate` takes at once
    std::vector<float> spread(picked.picks ? lines * line : 0), sums(outputs);
    const Plane& to = n.levels[0].grad;
    kernels().pack({head.weights, last.channels, 1, outputs, 1, 0, last.channels, n.scratch.packed});
    std::fill(head.grad_bias, head.grad_bias + outputs, 0.0f);
    for (int y = 0; y < height; y += lines) {
        const int count = std::min(lines, height - y);
        const float* here = grad + y * line;
        if (picked.picks) {
            std::fill(spread.begin(), spread.end(), 0.0f);
            for (int i = 0; i < count; ++i) picked.spread(y + i, grad, spread.data() + i * line);
            here = spread.data();
        }
        correlate(here, line, outputs, outputs, last.at(y), last.row(), last.step, last.channels, count, width, head.grad_weights,
                  last.channels, y > 0);
        sum_pixels(here, line, outputs, count, width, outputs, sums.data());
        for (int c = 0; c < outputs; ++c) head.grad_bias[c] += sums[c];
        Product product{};
        product.a_step = outputs, product.b = n.scratch.packed, product.c_step = to.step;
        product.active = last.at(y), product.active_step = last.step;
        const Plane part_of_it{to.at(y), count, width, to.channels, to.step};
        convolve(product, {1, {0}}, outputs, part_of_it, threads, [&](int i) { return here + i * line; });
    }
}

}  // namespace

extern "C" {

// shape: height, width, inputs, outputs, channels of the first level, levels, features at the bottleneck, and whether 3x3 convolutions
// are done in bfloat16 on tiles, which takes widths of whole 16s. texture: [inputs, h, w] with
// the given strides. weights: of every layer, in the order of `Layers`, weights and bias. out: [h, w, outputs], or, where `picks` are
// given, only the picked of its parts. Returns what ash_unet_backward needs, or null if memory is short.
void* ash_unet(const int* numbers, const float* texture, const int64_t* strides, const float* features, const float* const* weights,
               const int* picks, const int64_t* lines, int part, int threads, float* out) try {
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
        forward(layers.down(l)[0], l ? at.pooled : n.input, at.middle, n.scratch, threads);
        forward(layers.down(l)[1], at.middle, at.skip, n.scratch, threads);
    }
    const Level& lowest = n.levels[bottom];
    for (int y = 0; y < lowest.joined.height && shape.features; ++y)
        for (int x = 0; x < lowest.joined.width; ++x)
            std::copy(features, features + shape.features, lowest.joined.at(y, x) + n.channels(bottom));
    for (int l = bottom - 1; l >= 0; --l) {
        Level& at = n.levels[l];
        forward_up(layers.up(l), l + 1 == bottom ? lowest.joined : n.levels[l + 1].merged, at.up, n.scratch.packed, threads);
        forward(layers.merge(l)[0], at.joined, at.merged_middle, n.scratch, threads);
        forward(layers.merge(l)[1], at.merged_middle, at.merged, n.scratch, threads);
    }
    const Plane& last = bottom ? n.levels[0].merged : n.levels[0].joined;
    const int64_t zero[1] = {0};
    kernels().pack({layers.head().weights, shape.outputs, 1, last.channels, last.channels, 0, 1, n.scratch.packed});
    const Picks picked{picks, lines, part};
    in_bands(threads, shape.height, [&](int y) {
        Product product{};
        product.a = last.at(y), product.a_step = last.step, product.a_inner = 1;
        product.b = n.scratch.packed, product.b_inner = PRODUCT_COLUMNS, product.b_block = int64_t(last.channels) * PRODUCT_COLUMNS;
        product.a_at = product.b_at = zero, product.segments = 1, product.steps = last.channels;
        product.rows = shape.width, product.columns = shape.outputs, product.start = layers.head().bias;
        std::vector<float> line(picks ? shape.width * shape.outputs : 0);
        product.c = picks ? line.data() : out + int64_t(y) * shape.width * shape.outputs, product.c_step = shape.outputs;
        kernels().multiply(product);
        if (picks) picked.take(y, line.data(), out);
    });
    return network.release();
} catch (const std::bad_alloc&) {
    return nullptr;
}

// grad: of what ash_unet wrote. Writes every layer's gradients, and the features' where there are any. Returns 0, or 1 if memory is
// short.
int ash_unet_backward(void* handle, const float* grad, const float* const* weights, float* const* grads, const int* picks,
                      const int64_t* lines, int part, float* grad_features, int threads) try {
    Network& n = *static_cast<Network*>(handle);
    const Shape& shape = n.shape;
    const Layers layers = layers_of(shape, weights, grads);
    const int bottom = shape.levels;
    const Layer& head = layers.head();
    const Plane& last = bottom ? n.levels[0].merged : n.levels[0].joined;
    backward_head(n, head, last, grad, {picks, lines, part}, threads);
    for (int l = 0; l < bottom; ++l) {
        Level &at = n.levels[l], &below = n.levels[l + 1];
        backward_block(layers.merge(l), at, at.joined, at.merged_middle, &at.grad_joined, n.scratch, threads);
        const Plane grad_up = at.grad_joined.part(0, n.channels(l));
        const bool lowest = l + 1 == bottom;
        const Plane& in = lowest ? below.joined : below.merged;
        backward_up_weights(layers.up(l), grad_up, in, threads);
        const Plane active = lowest ? below.skip : below.merged;
        backward_up_input(layers.up(l), grad_up, 0, below.grad, &active, n.scratch.packed, threads);
        if (!lowest || !shape.features) continue;
        const Plane of_features = below.grad_joined.part(0, shape.features);  // that gradient is needed nowhere else
        backward_up_input(layers.up(l), grad_up, n.channels(bottom), of_features, nullptr, n.scratch.packed, threads);
        sum_pixels(of_features.first, of_features.row(), of_features.step, of_features.height, of_features.width, shape.features,
                   grad_features);
    }
    for (int l = bottom; l > 0; --l) {
        Level &at = n.levels[l], &above = n.levels[l - 1];
        backward_block(layers.down(l), at, at.pooled, at.middle, &at.grad_pooled, n.scratch, threads);
        backward_pool(above.skip, at.pooled, at.grad_pooled, above.grad_joined.part(n.channels(l - 1), n.channels(l - 1)), above.grad,
                      threads);
    }
    backward_block(layers.down(0), n.levels[0], n.input, n.levels[0].middle, nullptr, n.scratch, threads);
    return 0;
} catch (const std::bad_alloc&) {
    return 1;
}

void ash_unet_release(void* handle) {
    std::unique_ptr<Network> network(static_cast<Network*>(handle));
    std::lock_guard<std::mutex> lock(free_mutex);
    if (free_networks.size() < FREE_NETWORKS) free_networks.push_back(std::move(network));
}
}
