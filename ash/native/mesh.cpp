// Stg. 1 at the vertices: dual quaternion skinning and normals.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "team.h"

extern "C" {

// joints: [j, 8] real and dual part; skin: [v, k] joints, the strongest first, and their weights.
void ash_skin_vertices(const float* joints, const int64_t* skin, const float* weights, int64_t count, int influences, int threads,
                       float* quats, float* translations) {
    constexpr int64_t RANGE = 1024;
    ash::in_ranges(threads, count, RANGE, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t v = first; v < last; ++v) {
            const float* strongest = joints + 8 * skin[v * influences];
            float sum[8] = {};
            for (int k = 0; k < influences; ++k) {
                const float* joint = joints + 8 * skin[v * influences + k];
                float along = 0;
                for (int i = 0; i < 4; ++i) along += joint[i] * strongest[i];
                const float weight = along < 0 ? -weights[v * influences + k] : weights[v * influences + k];
                for (int i = 0; i < 8; ++i) sum[i] += weight * joint[i];
            }
            const float inverse = 1 / std::sqrt(sum[0] * sum[0] + sum[1] * sum[1] + sum[2] * sum[2] + sum[3] * sum[3]);
            for (float& number : sum) number *= inverse;
            const float *r = sum, *d = sum + 4;
            for (int i = 0; i < 4; ++i) quats[4 * v + i] = r[i];
            // Twice the vector part of dual times conjugate real.
            translations[3 * v] = 2 * (r[0] * d[1] - d[0] * r[1] + r[2] * d[3] - r[3] * d[2]);
            translations[3 * v + 1] = 2 * (r[0] * d[2] - d[0] * r[2] + r[3] * d[1] - r[1] * d[3]);
            translations[3 * v + 2] = 2 * (r[0] * d[3] - d[0] * r[3] + r[1] * d[2] - r[2] * d[1]);
        }
    });
}

// The sum over adjacent faces of their normals, as long as twice their area, brought to unit length; zero without any area.
void ash_vertex_normals(const float* vertices, const int64_t* faces, int64_t vertex_count, int64_t face_count, float* normals) {
    std::fill(normals, normals + 3 * vertex_count, 0.0f);
    for (int64_t f = 0; f < face_count; ++f) {
        const float *a = vertices + 3 * faces[3 * f], *b = vertices + 3 * faces[3 * f + 1], *c = vertices + 3 * faces[3 * f + 2];
        const float p[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]}, q[3] = {c[0] - a[0], c[1] - a[1], c[2] - a[2]};
        const float n[3] = {p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]};
        for (int k = 0; k < 3; ++k)
            for (int i = 0; i < 3; ++i) normals[3 * faces[3 * f + k] + i] += n[i];
    }
    for (int64_t v = 0; v < vertex_count; ++v) {
        float* n = normals + 3 * v;
        const float length = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), inverse = 1 / std::max(length, 1e-12f);
        for (int i = 0; i < 3; ++i) n[i] *= inverse;
    }
}
}
