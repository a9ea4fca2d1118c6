// 3x3 convolutions whose factors are rounded to bfloat16 and whose sums are float32, on the processor's matrix tiles (Intel AMX). The
// float32 ones, which they stand in for where a training asks for it, are in convolutions.h. No inline functions here (see simd.h).
#pragma once
#include <cstdint>

namespace ash {

typedef uint16_t Half;  // a bfloat16

// A plane of convolutions.h, with its border: pixel (0, 0), and floats from one pixel to the next.
struct TilePlane {
    float* first;
    int height, width, channels;
    int64_t step;
};

// Sizes are in `Half`s.
struct TileConvolution {
    const Half *plane, *weights;  // as `plane` and `weights` below make them
    int inputs;
    TilePlane out;        // as high and wide
    const float* start;   // bias, or null
    const float* active;  // pixel (0, 0) of what must be positive, else the result is 0; or null
    int64_t active_step;
    bool relu;
};

struct TileCorrelation {  // of a convolution's input with the gradient of its result: the gradient of its weights
    const Half *turned, *pairs;  // the gradient, the input
    int height, width, outputs, inputs;
    float* grad_weights;  // [out][tap][in]
};

struct TileKernels {
    // Pixels one after the other with their border, [(height + 2) (width + 2)][channels], and zeros to be read beyond them.
    int64_t (*plane_size)(int height, int width, int channels);
    void (*plane)(const TilePlane& from, Half* to);
    // Weights [out][tap][in] as a product wants them; `backward`: for the gradient of the input.
    int64_t (*weights_size)(int outputs, int inputs);
    void (*weights)(const float* weights, int outputs, int inputs, bool backward, Half* to);
    int64_t (*blocks)(int height, int width);  // pieces of the work, of which some are done
    void (*convolve)(const TileConvolution& work, int64_t first, int64_t last);
    // A plane as [channel][pixel] between zeros, and as [pixel / 2][channel][2].
    int64_t (*turned_size)(int height, int width, int channels);
    void (*turned)(const Half* plane, int height, int width, int channels, Half* to);
    int64_t (*pairs_size)(int height, int width, int channels);
    void (*pairs)(const Half* plane, int height, int width, int channels, Half* to);
    int64_t (*correlations)(int outputs, int inputs);  // pieces of the work
    void (*correlate)(const TileCorrelation& work, int64_t first, int64_t last);
};

extern const TileKernels amx_kernels;
const TileKernels* tiles();  // null where the processor, the system or the compiler knows none

}  // namespace ash
