// A textured mesh in pixels: shaded samples, their means, and the texture that a network adds to.
#include <algorithm>
#include <cstring>

#include "dispatch.h"
#include "team.h"

using namespace ash;

extern "C" {

// texture: [3, height, width]; light: [9, 3] or null; triangles, uv_faces, faces: int64; weights: [n, 3].
void ash_shade(const float* texture, int height, int width, const float* light, const int64_t* triangles, const float* weights,
               int64_t count, const float* uvs, const int64_t* uv_faces, const float* normals, const int64_t* faces, int threads,
               float* colours) {
    constexpr int64_t RANGE = 1024;
    ShadeArgs args{texture, light, weights, uvs, normals, triangles, uv_faces, faces, height, width};
    args.colours = colours;
    in_parallel(threads, (count + RANGE - 1) / RANGE,
                [&](int64_t part) { kernels().shade(args, part * RANGE, std::min(count, (part + 1) * RANGE)); });
}

// Writes grad_texture, grad_light [9, 3] (if there is a light) and grad_weights (unless null); on one thread, as points share texels.
void ash_shade_backward(const float* texture, int height, int width, const float* light, const int64_t* triangles, const float* weights,
                        int64_t count, const float* uvs, const int64_t* uv_faces, const float* normals, const int64_t* faces,
                        const float* grad, float* grad_texture, double* grad_light, float* grad_weights) {
    ShadeArgs args{texture, light, weights, uvs, normals, triangles, uv_faces, faces, height, width};
    args.grad = grad, args.grad_texture = grad_texture, args.grad_weights = grad_weights;
    std::fill(grad_texture, grad_texture + int64_t(3) * height * width, 0.0f);
    std::fill(grad_light, grad_light + 27, 0.0);
    kernels().shade_backward(args, 0, count, grad_light);
}

// Means over factor x factor samples: `covered` samples (row-major) have colours, the others are background. image: [h, w, 4].
void ash_resolve(const float* colours, const int64_t* covered, int64_t count, int width, int height, int factor, const float* background,
                 float* image) {
    const float share = 1.0f / float(factor * factor);
    for (int64_t i = 0; i < int64_t(width) * height; ++i) {
        std::copy(background, background + 3, image + 4 * i);
        image[4 * i + 3] = 0;
    }
    const int64_t row = int64_t(width) * factor;
    for (int64_t i = 0; i < count; ++i) {
        float* to = image + 4 * (covered[i] / row / factor * width + covered[i] % row / factor);
        for (int c = 0; c < 3; ++c) to[c] += share * (colours[3 * i + c] - background[c]);
        to[3] += share;
    }
}

void ash_resolve_backward(const float* grad_image, const int64_t* covered, int64_t count, int width, int factor, float* grad_colours) {
    const float share = 1.0f / float(factor * factor);
    const int64_t row = int64_t(width) * factor;
    for (int64_t i = 0; i < count; ++i) {
        const float* from = grad_image + 4 * (covered[i] / row / factor * width + covered[i] % row / factor);
        for (int c = 0; c < 3; ++c) grad_colours[3 * i + c] = share * from[c];
    }
}

// out [c, h f, w f] = texture + decoded [h, w, c f f] with its pixels shuffled up; or back, when `backward`: out [h, w, c f f].
void ash_shuffle(const float* texture, const float* decoded, int channels, int height, int width, int factor, int backward, float* out) {
    const int64_t line = int64_t(width) * factor, pixel = int64_t(channels) * factor * factor;
    for (int c = 0; c < channels; ++c)
        for (int y = 0; y < height; ++y)
            for (int dy = 0; dy < factor; ++dy) {
                const int64_t at = (int64_t(c) * height * factor + y * factor + dy) * line;
                const int64_t from = y * width * pixel + (c * factor + dy) * factor;
                for (int x = 0; x < width; ++x)
                    for (int dx = 0; dx < factor; ++dx) {
                        const int64_t wide = at + x * factor + dx, narrow = from + x * pixel + dx;
                        if (backward)
                            out[narrow] = texture[wide];
                        else
                            out[wide] = texture[wide] + decoded[narrow];
                    }
            }
}
}
