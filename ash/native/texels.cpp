// Texels to Gaussians: hands ranges of texels to the kernels.
#include <algorithm>
#include <new>
#include <vector>

#include "dispatch.h"
#include "team.h"

using namespace ash;

static constexpr int64_t RANGE = 2048;

extern "C" {

// Per vertex 16 floats, see texels.inc; per texel three corners (vertices) and their weights.
void ash_place_texels(const float* vertices, const int* corners, const float* barycentric, int64_t count, int threads, float* quats,
                      float* translations, float* canonical, float* normals) {
    PlaceArgs args{vertices, barycentric, corners, quats, translations, canonical, normals};
    in_ranges(threads, count, RANGE, [&](int64_t, int64_t first, int64_t last) { kernels().place_texels(args, first, last); });
}

// light: [9, 3] or null.
void ash_pose(const float* raw, const float* canonical, const float* normals, const float* turns, const float* translations,
              const float* light, int64_t count, int coefficients, float offset_unit, int canonical_frame, int threads, float* means,
              float* quats, float* scales, float* opacities, float* sh) {
    PoseArgs args{};
    args.raw = raw, args.canonical = canonical, args.normals = normals, args.turns = turns, args.translations = translations;
    args.light = light, args.coefficients = coefficients, args.offset_unit = offset_unit, args.canonical_frame = canonical_frame;
    args.means = means, args.quats = quats, args.scales = scales, args.opacities = opacities, args.sh = sh;
    in_ranges(threads, count, RANGE, [&](int64_t, int64_t first, int64_t last) { kernels().pose(args, first, last); });
}

void ash_turn_sh(const float* quats, const float* sh, const float* directions, const float* fits, int64_t count, int coefficients,
                 int inverse, int threads, float* turned) {
    const TurnArgs args{quats, sh, directions, fits, coefficients, inverse, turned};
    in_ranges(threads, count, RANGE, [&](int64_t, int64_t first, int64_t last) { kernels().turn_sh(args, first, last); });
}

// grad_light: [9, 3], written; null without light. Returns 0, or 1 if memory is short.
int ash_pose_backward(const float* raw, const float* normals, const float* turns, const float* light, int64_t count, int coefficients,
                      float offset_unit, int canonical_frame, int threads, const float* grad_means, const float* grad_quats,
                      const float* grad_scales, const float* grad_opacities, const float* grad_sh, float* grad_raw,
                      double* grad_light) try {
    PoseArgs args{};
    args.raw = raw, args.normals = normals, args.turns = turns, args.light = light, args.coefficients = coefficients;
    args.offset_unit = offset_unit, args.canonical_frame = canonical_frame;
    args.grad_means = grad_means, args.grad_quats = grad_quats, args.grad_scales = grad_scales;
    args.grad_opacities = grad_opacities, args.grad_sh = grad_sh, args.grad_raw = grad_raw;
    std::vector<double> sums(27 * ((count + RANGE - 1) / RANGE), 0.0);
    in_ranges(threads, count, RANGE, [&](int64_t part, int64_t first, int64_t last) {
        kernels().pose_backward(args, first, last, sums.data() + 27 * part);
    });
    if (light) {
        std::fill(grad_light, grad_light + 27, 0.0);
        for (size_t i = 0; i < sums.size(); ++i) grad_light[i % 27] += sums[i];
    }
    return 0;
} catch (const std::bad_alloc&) {
    return 1;
}
}
