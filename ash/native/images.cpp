// Windows of stored images, as a step of training wants them.
#include <cstdint>

extern "C" {

// Straight RGBA bytes, rows `stride` bytes apart, over a background: rgb [h, w, 3] and alpha [h, w], 0..1.
void ash_composite(const uint8_t* rgba, int64_t stride, int width, int height, const float* background, float* rgb, float* alpha) {
    for (int y = 0; y < height; ++y, rgba += stride, rgb += 3 * width, alpha += width)
        for (int x = 0; x < width; ++x) {
            const float a = alpha[x] = float(rgba[4 * x + 3]) / 255.0f;
            for (int c = 0; c < 3; ++c) rgb[3 * x + c] = float(rgba[4 * x + c]) / 255.0f * a + (1.0f - a) * background[c];
        }
}
}
