// Splatting from arrays to arrays: hands Gaussians to the kernels in ranges, orders splats by depth, lists them per tile, and hands
// out tiles. Nothing here depends on the number of threads but the time it takes.
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

constexpr int64_t RANGE = 512;  // Gaussians handed out at once; a camera's gradient is summed range by range

// An array that grows without being cleared or copied.
template <class T> struct Buffer {
    std::unique_ptr<T[]> data;
    size_t capacity = 0;
    T* reserve(size_t count) {
        if (count > capacity) {
            data.reset();
            capacity = 0;
            data.reset(new T[count + count / 4]);
            capacity = count + count / 4;
        }
        return data.get();
    }
    T* get() const { return data.get(); }
};

struct Ranked {
    uint32_t key, splat;
};

// What the forward pass leaves for the backward pass. Kept for the next call when released: fresh memory costs page faults.
struct Drawing {
    int64_t count = 0;  // splats: cameras times Gaussians
    int cameras = 0, width = 0, height = 0;
    float background[3];
    Buffer<Splat> splats;
    Buffer<Rect> rects;
    Buffer<int64_t> offsets, fill;  // first slot per splat; next entry per tile
    Buffer<Entry> entries;
    Buffer<uint64_t> masks;
    Buffer<Ranked> ranked, spare;
    Buffer<float> slots;
    std::vector<Tile> tiles;
};

std::mutex free_mutex;
std::vector<std::unique_ptr<Drawing>> free_drawings;
constexpr size_t FREE_DRAWINGS = 4;

std::unique_ptr<Drawing> take_drawing() {
    std::lock_guard<std::mutex> lock(free_mutex);
    if (free_drawings.empty()) return std::make_unique<Drawing>();
    auto drawing = std::move(free_drawings.back());
    free_drawings.pop_back();
    return drawing;
}

int64_t tiles_in(Rect r) {
    return r.right > r.left && r.bottom > r.top ? int64_t(r.right - r.left) * (r.bottom - r.top) : 0;
}

constexpr int DIGIT = 11;  // bits of a key that a pass sorts by; two passes
constexpr int64_t DIGITS = int64_t(1) << DIGIT;

// Splats in front of the camera, nearest first, equal depths in the order given.
int64_t order_by_depth(Drawing& d, const double* depths, int64_t first, int64_t count) {
    Ranked *from = d.ranked.reserve(count), *to = d.spare.reserve(count);
    auto bits = [](double depth) {
        uint64_t b;
        std::memcpy(&b, &depth, 8);
        return b;
    };
    uint64_t lowest = ~uint64_t(0), highest = 0;
    int64_t drawn = 0;
    for (int64_t i = 0; i < count; ++i) {
        if (tiles_in(d.rects.get()[first + i]) == 0) continue;
        from[drawn++].splat = uint32_t(first + i);
        lowest = std::min(lowest, bits(depths[i])), highest = std::max(highest, bits(depths[i]));
    }
    if (drawn == 0) return 0;
    int shift = 0;
    while (((highest - lowest) >> shift) >> (2 * DIGIT)) ++shift;
    std::vector<uint32_t> starts(size_t(2) << DIGIT, 0);
    for (int64_t i = 0; i < drawn; ++i) {
        const uint32_t key = from[i].key = uint32_t((bits(depths[from[i].splat - first]) - lowest) >> shift);
        ++starts[key & (DIGITS - 1)], ++starts[DIGITS + (key >> DIGIT)];
    }
    for (int pass = 0; pass < 2; ++pass) {
        uint32_t total = 0, *start = starts.data() + pass * DIGITS;
        for (int64_t digit = 0; digit < DIGITS; ++digit) {
            const uint32_t here = start[digit];
            start[digit] = total;
            total += here;
        }
        for (int64_t i = 0; i < drawn; ++i) to[start[(from[i].key >> (DIGIT * pass)) & (DIGITS - 1)]++] = from[i];
        std::swap(from, to);
    }
    // Equal keys need not be equal depths. Runs of them are short, or equal throughout.
    for (int64_t i = 1; i < drawn; ++i)
        for (int64_t j = i; j > 0 && from[j - 1].key == from[j].key &&
                            depths[from[j].splat - first] < depths[from[j - 1].splat - first];
             --j)
            std::swap(from[j - 1], from[j]);
    if (from != d.ranked.get()) std::swap(d.ranked, d.spare);
    return drawn;
}

// Entries of every tile, nearest splat first; slots numbered splat by splat.
void list_entries(Drawing& d, const double* depths) {
    const int columns = (d.width + TILE - 1) / TILE, rows = (d.height + TILE - 1) / TILE;
    const int64_t per_camera = d.count / d.cameras;
    d.tiles.clear();
    int64_t* offsets = d.offsets.reserve(d.count + 1);
    int64_t* fill = d.fill.reserve(int64_t(columns) * rows);
    int64_t slots = 0;
    std::vector<int64_t> counts(size_t(d.cameras) * columns * rows, 0);
    for (int64_t i = 0; i < d.count; ++i) {
        offsets[i] = slots;
        const Rect r = d.rects.get()[i];
        int64_t* count = counts.data() + (i / per_camera) * columns * rows;
        for (int y = r.top; y < r.bottom; ++y)
            for (int x = r.left; x < r.right; ++x) ++count[y * columns + x];
        slots += tiles_in(r);
    }
    offsets[d.count] = slots;
    if (slots > int64_t(0xffffffff)) throw std::bad_alloc();
    Entry* entries = d.entries.reserve(slots);
    int64_t first = 0, chunks = 0;
    for (int camera = 0; camera < d.cameras; ++camera) {
        for (int tile = 0; tile < columns * rows; ++tile) {
            int64_t count = counts[size_t(camera) * columns * rows + tile];
            fill[tile] = first;
            d.tiles.push_back({camera, tile % columns * TILE, tile / columns * TILE, first, count, chunks, 0});
            first += count;
            chunks += (count + CHUNK - 1) / CHUNK * CHUNK;
        }
        int64_t drawn = order_by_depth(d, depths + camera * per_camera, camera * per_camera, per_camera);
        for (int64_t i = 0; i < drawn; ++i) {
            uint32_t splat = d.ranked.get()[i].splat;
            const Rect r = d.rects.get()[splat];
            uint32_t slot = uint32_t(offsets[splat]);
            for (int y = r.top; y < r.bottom; ++y)
                for (int x = r.left; x < r.right; ++x) entries[fill[y * columns + x]++] = {splat, slot++};
        }
    }
    d.masks.reserve(chunks);
    // The long ones first, so that no thread is left with one at the end.
    std::stable_sort(d.tiles.begin(), d.tiles.end(), [](const Tile& a, const Tile& b) { return a.count > b.count; });
}

int64_t ranges(int64_t count) { return (count + RANGE - 1) / RANGE; }

}  // namespace

extern "C" {

// Returns 0, or what is wrong with the first bad Gaussian: Fault + 16 * index.
int64_t ash_project(const float* means, const float* quats, const float* scales, const float* opacities, const float* sh,
                    const float* viewmats, const float* Ks, int64_t count, int cameras, int coefficients, int width, int height,
                    int compensate, float dilation, float near, int threads, float* means2d, float* packed, double* depths) {
    ProjectArgs args{};
    args.means = means, args.quats = quats, args.scales = scales, args.opacities = opacities, args.sh = sh;
    args.viewmats = viewmats, args.Ks = Ks, args.count = count, args.cameras = cameras, args.coefficients = coefficients;
    args.width = width, args.height = height, args.compensate = compensate, args.dilation = dilation, args.near = near;
    args.means2d = means2d, args.packed = packed, args.depths = depths;
    Stopwatch watch(STAGE_PROJECT);
    std::atomic<int64_t> fault{INT64_MAX};
    in_ranges(threads, count, RANGE, [&](int64_t, int64_t first, int64_t last) {
        const int64_t here = kernels().project(args, first, last);
        // The lowest index is reported, whichever thread comes first.
        for (int64_t now = fault; here && (here >> 4) < (now >> 4) && !fault.compare_exchange_weak(now, here);) {}
    });
    return fault == INT64_MAX ? 0 : fault.load();
}

// grad_views: [c, 12], the rotation row by row, then the translation, or null where it is not wanted. Returns 0, or 1 if memory is
// short.
int ash_project_backward(const float* means, const float* quats, const float* scales, const float* opacities, const float* sh,
                         const float* viewmats, const float* Ks, int64_t count, int cameras, int coefficients, int width,
                         int height, int compensate, float dilation, float near, int threads, const float* packed,
                         const float* grad_means2d, const float* grad_packed, float* grad_means, float* grad_quats,
                         float* grad_scales, float* grad_opacities, float* grad_sh, double* grad_views) try {
    ProjectArgs args{};
    args.means = means, args.quats = quats, args.scales = scales, args.opacities = opacities, args.sh = sh;
    args.viewmats = viewmats, args.Ks = Ks, args.count = count, args.cameras = cameras, args.coefficients = coefficients;
    args.width = width, args.height = height, args.compensate = compensate, args.dilation = dilation, args.near = near;
    args.packed = const_cast<float*>(packed), args.grad_means2d = grad_means2d, args.grad_packed = grad_packed;
    args.grad_means = grad_means, args.grad_quats = grad_quats, args.grad_scales = grad_scales;
    args.grad_opacities = grad_opacities, args.grad_sh = grad_sh;
    Stopwatch watch(STAGE_PROJECT_BACKWARD);
    std::vector<double> partial(grad_views ? size_t(ranges(count)) * cameras * 12 : 0, 0.0);
    in_ranges(threads, count, RANGE, [&](int64_t range, int64_t first, int64_t last) {
        kernels().project_backward(args, first, last, grad_views ? partial.data() + range * cameras * 12 : nullptr);
    });
    for (int i = 0; grad_views && i < cameras * 12; ++i) {
        grad_views[i] = 0;
        for (int64_t range = 0; range < ranges(count); ++range) grad_views[i] += partial[range * cameras * 12 + i];
    }
    return 0;
} catch (const std::bad_alloc&) {
    return 1;
}

// Returns the drawing for ash_blend_backward, or null if memory is short.
void* ash_blend(const float* means2d, const float* packed, const double* depths, int64_t count, int cameras, int width, int height,
                const float* background, int threads, float* rgb, float* alpha, float* depth) try {
    auto drawing = take_drawing();
    Drawing& d = *drawing;
    d.count = count * cameras, d.cameras = cameras, d.width = width, d.height = height;
    std::copy(background, background + 3, d.background);
    {
        Stopwatch watch(STAGE_LIST);
        d.splats.reserve(d.count), d.rects.reserve(d.count);
        const int columns = (width + TILE - 1) / TILE, rows = (height + TILE - 1) / TILE;
        in_ranges(threads, d.count, RANGE, [&](int64_t, int64_t first, int64_t last) {
            kernels().prepare(means2d, packed, columns, rows, d.splats.get(), d.rects.get(), first, last);
        });
        list_entries(d, depths);
    }
    Stopwatch watch(STAGE_BLEND);
    BlendArgs args{};
    args.splats = d.splats.get(), args.entries = d.entries.get(), args.masks = d.masks.get(), args.width = width, args.height = height;
    std::copy(background, background + 3, args.background);
    args.rgb = rgb, args.alpha = alpha, args.depth = depth;
    in_parallel(threads, int64_t(d.tiles.size()), [&](int64_t tile) { kernels().blend(args, d.tiles[tile]); });
    return drawing.release();
} catch (const std::bad_alloc&) {
    return nullptr;
}

// Any of the three gradients may be null. Returns 0, or 1 if memory is short.
int ash_blend_backward(void* handle, const float* rgb, const float* alpha, const float* depth, const float* grad_rgb,
                       const float* grad_alpha, const float* grad_depth, int threads, float* grad_means2d, float* grad_packed) try {
    Drawing& d = *static_cast<Drawing*>(handle);
    BlendArgs args{};
    args.splats = d.splats.get(), args.entries = d.entries.get(), args.masks = d.masks.get(), args.width = d.width, args.height = d.height;
    args.rgb = const_cast<float*>(rgb), args.alpha = const_cast<float*>(alpha), args.depth = const_cast<float*>(depth);
    args.grad_rgb = grad_rgb, args.grad_alpha = grad_alpha, args.grad_depth = grad_depth;
    args.slots = d.slots.reserve(size_t(d.offsets.get()[d.count]) * SLOT);
    {
        Stopwatch watch(STAGE_BLEND_BACKWARD);
        in_parallel(threads, int64_t(d.tiles.size()), [&](int64_t tile) { kernels().blend_backward(args, d.tiles[tile]); });
    }
    Stopwatch watch(STAGE_GATHER);
    in_ranges(threads, d.count, RANGE, [&](int64_t, int64_t first, int64_t last) {
        kernels().gather(d.splats.get(), d.slots.get(), d.offsets.get(), first, last, grad_means2d, grad_packed);
    });
    return 0;
} catch (const std::bad_alloc&) {
    return 1;
}

// The six stages' seconds in the last calls: project, list, blend, blend_backward, gather, project_backward.
void ash_stage_seconds(double* seconds) {
    for (int i = 0; i < STAGES; ++i) seconds[i] = stage_seconds[i];
}

void ash_release(void* handle) {
    std::unique_ptr<Drawing> drawing(static_cast<Drawing*>(handle));
    std::lock_guard<std::mutex> lock(free_mutex);
    if (free_drawings.size() < FREE_DRAWINGS) free_drawings.push_back(std::move(drawing));
}
}
