// Adam over many tensors in one call.
#include <atomic>
#include <cmath>

#include "dispatch.h"
#include "team.h"

using namespace ash;

extern "C" {

// Per tensor its numbers, gradients and moments in one order of memory, their count, and its own number of steps, which goes up by one.
// Returns 1 if every gradient was finite, else 0: then the numbers are not worth keeping.
int ash_adam(int tensors, float* const* parameters, const float* const* grads, float* const* means, float* const* squares,
             float* const* steps, const int64_t* counts, double lr, double beta1, double beta2, double eps, int threads) {
    constexpr int64_t RANGE = 1 << 15;
    std::atomic<bool> finite{true};
    for (int k = 0; k < tensors; ++k) {
        const double step = ++*steps[k];
        const AdamArgs args{parameters[k],
                            grads[k],
                            means[k],
                            squares[k],
                            float(1 - beta1),
                            float(1 - beta2),
                            float(beta2),
                            float(eps),
                            float(lr / (1 - std::pow(beta1, step))),
                            float(1 / std::sqrt(1 - std::pow(beta2, step)))};
        in_ranges(threads, counts[k], RANGE, [&](int64_t, int64_t first, int64_t last) {
            if (!kernels().adam(args, first, last)) finite = false;
        });
    }
    return finite;
}
}
