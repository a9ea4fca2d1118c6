// The fused L1 + SSIM loss: hands bands of rows to the kernels. Every row is computed alike whichever band it falls into.
#include <algorithm>
#include <memory>
#include <new>
#include <vector>

#include "dispatch.h"
#include "team.h"

using namespace ash;

extern "C" {

// sums: [2], of the weighted |I - T| and SSIM. weights, grad may be null. Returns 0, or 1 if memory is short.
int ash_l1_ssim(const float* image, const float* target, const float* weights, int width, int height, int top, int bottom, float l1_scale, float ssim_scale, int threads, float* grad, double* sums) try {
    std::vector<double> rows(2 * size_t(height));
    SsimArgs args{image, target, weights, grad, width, height, top, bottom, l1_scale, ssim_scale,
                  rows.data(), rows.data() + height};
    const Kernels& k = kernels();
    const int bands = std::max(1, std::min(threads, height / 16));
    const int64_t scratch_size = k.ssim_scratch(width);
    std::unique_ptr<float[]> scratch(new float[scratch_size * bands]);
    in_parallel(bands, bands, [&](int64_t band) {
        k.ssim_rows(args, int(band * height / bands), int((band + 1) * height / bands), scratch.get() + band * scratch_size);
    });
    sums[0] = sums[1] = 0;
    for (int y = 0; y < height; ++y) sums[0] += args.row_l1[y], sums[1] += args.row_ssim[y];
    return 0;
} catch (const std::bad_alloc&) {
    return 1;
}
}
