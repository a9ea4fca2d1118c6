// A textured mesh in pixels: shaded samples, their means, and the texture that a network adds to.
#include <algorithm>
#include <cstring>

#include "dispatch.h"
#include "team.h"

using namespace ash;

namespace {

// `FACTOR`: of the usual ones, for straight code; 0: any.
template <int FACTOR>
void shuffle_by(const float* texture, const float* decoded, int channels, int height, int width, int any, bool backward, float* out) {
    const int factor = FACTOR ? FACTOR : any;
    const int64_t line = int64_t(width) * factor, pixel = int64_t(channels) * factor * factor;
    for (int c = 0; c < channels; ++c)
        for (int y = 0; y < height; ++y)
            for (int dy = 0; dy < factor; ++dy) {
                const int64_t wide = (int64_t(c) * height * factor + y * factor + dy) * line;
                const int64_t narrow = y * width * pixel + (c * factor + dy) * factor;
                for (int x = 0; x < width; ++x) {
                    const float* from = texture + wide + x * factor;
                    if (backward) {
                        std::memcpy(out + narrow + x * pixel, from, factor * sizeof(float));
                        continue;
                    }
                    const float* added = decoded + narrow + x * pixel;
                    float* __restrict to = out + wide + x * factor;
                    for (int dx = 0; dx < factor; ++dx) to[dx] = from[dx] + added[dx];
                }
            }
}

struct Point {
    double x, y, z;
};
Point point(const float* all, int64_t i) { return {all[3 * i], all[3 * i + 1], all[3 * i + 2]}; }
Point cross(Point a, Point b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
double dot(Point a, Point b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
void add(double factor, Point p, float* to) { to[0] += float(factor * p.x), to[1] += float(factor * p.y), to[2] += float(factor * p.z); }

Point centre_of(int64_t sample, int width) {
    const uint32_t at = uint32_t(sample), row = at / uint32_t(width);  // of an image of at most 2^15 pixels a side
    return {double(at - row * uint32_t(width)) + 0.5, double(row) + 0.5, 1.0};
}

struct Volumes {  // that a sample spans with two corners each
    double of[3], total;
};
Volumes volumes_at(const float* corners, const int64_t* face, int64_t sample, int width) {
    const Point s = centre_of(sample, width);
    const Point a = point(corners, face[0]), b = point(corners, face[1]), c = point(corners, face[2]);
    Volumes v{{dot(cross(b, c), s), dot(cross(c, a), s), dot(cross(a, b), s)}, 0};
    v.total = v.of[0] + v.of[1] + v.of[2];
    return v;
}

int64_t pixel_of(int64_t sample, uint32_t samples_in_row, int width, int factor) {
    const uint32_t at = uint32_t(sample), y = at / samples_in_row, x = at - y * samples_in_row;
    return int64_t(y / uint32_t(factor)) * width + x / uint32_t(factor);
}

}  // namespace

extern "C" {

// texture: [3, height, width]; light: [9, 3] or null; triangles, uv_faces, faces: int64; weights: [n, 3].
void ash_shade(const float* texture, int height, int width, const float* light, const int64_t* triangles, const float* weights,
               int64_t count, const float* uvs, const int64_t* uv_faces, const float* normals, const int64_t* faces, int threads,
               float* colours) {
    constexpr int64_t RANGE = 1024;
    ShadeArgs args{texture, light, weights, uvs, normals, triangles, uv_faces, faces, height, width};
    args.colours = colours;
    in_ranges(threads, count, RANGE, [&](int64_t, int64_t first, int64_t last) { kernels().shade(args, first, last); });
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
    const uint32_t row = uint32_t(width) * factor;
    for (int64_t i = 0; i < count; ++i) {
        float* to = image + 4 * pixel_of(covered[i], row, width, factor);
        for (int c = 0; c < 3; ++c) to[c] += share * (colours[3 * i + c] - background[c]);
        to[3] += share;
    }
}

void ash_resolve_backward(const float* grad_image, const int64_t* covered, int64_t count, int width, int factor, float* grad_colours) {
    const float share = 1.0f / float(factor * factor);
    const uint32_t row = uint32_t(width) * factor;
    for (int64_t i = 0; i < count; ++i) {
        const float* from = grad_image + 4 * pixel_of(covered[i], row, width, factor);
        for (int c = 0; c < 3; ++c) grad_colours[3 * i + c] = share * from[c];
    }
}

// out [c, h f, w f] = texture + decoded [h, w, c f f] with its pixels shuffled up; or back, when `backward`: out [h, w, c f f].
void ash_shuffle(const float* texture, const float* decoded, int channels, int height, int width, int factor, int backward, float* out) {
    auto shuffle = factor == 8 ? shuffle_by<8> : (factor == 4 ? shuffle_by<4> : shuffle_by<0>);
    shuffle(texture, decoded, channels, height, width, factor, backward != 0, out);
}

// Perspective-correct weights [n, 3] of the corners of triangles [n] at samples [n] (row-major, `width` of them in a row). corners: [v, 3]
// homogeneous; faces: [f, 3].
void ash_corner_weights(const float* corners, const int64_t* faces, const int64_t* triangles, const int64_t* samples, int64_t count,
                        int width, float* weights) {
    for (int64_t i = 0; i < count; ++i) {
        const Volumes v = volumes_at(corners, faces + 3 * triangles[i], samples[i], width);
        for (int k = 0; k < 3; ++k) weights[3 * i + k] = float(v.of[k] / v.total);
    }
}

// Writes grad_corners [v, 3]; on one thread, as triangles share corners.
void ash_corner_weights_backward(const float* corners, const int64_t* faces, const int64_t* triangles, const int64_t* samples,
                                 int64_t count, int width, int64_t corner_count, const float* grad, float* grad_corners) {
    std::fill(grad_corners, grad_corners + 3 * corner_count, 0.0f);
    for (int64_t i = 0; i < count; ++i) {
        const int64_t* face = faces + 3 * triangles[i];
        const Volumes v = volumes_at(corners, face, samples[i], width);
        double mean = 0;
        for (int k = 0; k < 3; ++k) mean += grad[3 * i + k] * v.of[k] / v.total;
        const Point s = centre_of(samples[i], width);
        for (int k = 0; k < 3; ++k) {  // volume k = (p x q) s, of the two other corners p and q
            const int64_t p = face[(k + 1) % 3], q = face[(k + 2) % 3];
            const double share = (grad[3 * i + k] - mean) / v.total;
            add(share, cross(point(corners, q), s), grad_corners + 3 * p);
            add(share, cross(s, point(corners, p)), grad_corners + 3 * q);
        }
    }
}
}
