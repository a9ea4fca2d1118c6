// Triangles to pixels by 2D homogeneous rasterisation (Olano and Greer 1997): a vertex is (x w, y w, w) with w its depth, an edge is the
// cross product of two vertices, and neither division nor clipping is needed for triangles that cross the camera's plane.
//
// Everything is double precision. An edge is computed from its lower-numbered vertex, whichever triangle asks, so that the two triangles
// that share it see exactly opposite numbers: no pixel is drawn twice or left out along it.
#include <algorithm>
#include <cmath>
#include <new>
#include <vector>

#include "team.h"

namespace {

constexpr int BAND = 16;  // rows handed out at once

struct Vec3 {
    double x, y, z;
};

Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

struct Triangle {
    Vec3 edges[3];  // opposite vertex 0, 1, 2; positive inside
    double volume;  // positive
    int left, right, top, bottom;  // pixels that may lie inside, the last ones excluded
    bool front[3];  // a pixel exactly on the edge is inside: left and top edges
};

Vec3 edge_between(const Vec3* v, int a, int b, double sign) {
    Vec3 e = a < b ? cross(v[a], v[b]) : cross(v[b], v[a]);
    double s = a < b ? sign : -sign;
    return {s * e.x, s * e.y, s * e.z};
}

int bounded(double x, int limit) { return x <= 0 ? 0 : (x >= limit ? limit : int(x)); }

// False if the triangle covers no pixel.
bool set_up(const Vec3* v, const int* face, int width, int height, double near, Triangle& t) {
    Vec3 forward = edge_between(v, face[1], face[2], 1.0);
    const Vec3& p = v[face[0]];
    double volume = forward.x * p.x + forward.y * p.y + forward.z * p.z;
    if (!(std::abs(volume) > 0) || !std::isfinite(volume)) return false;
    double sign = volume > 0 ? 1.0 : -1.0;
    t.volume = std::abs(volume);
    t.left = t.top = 0, t.right = width, t.bottom = height;
    bool all_in_front = true, none_in_front = true;
    for (int i = 0; i < 3; ++i) {
        t.edges[i] = edge_between(v, face[(i + 1) % 3], face[(i + 2) % 3], sign);
        t.front[i] = t.edges[i].x > 0 || (t.edges[i].x == 0 && t.edges[i].y > 0);
        bool in_front = v[face[i]].z >= near;
        all_in_front &= in_front, none_in_front &= !in_front;
    }
    if (none_in_front) return false;
    // The projected corners bound the triangle only if all lie in front; else every pixel is asked.
    if (all_in_front) {
        double x0 = INFINITY, x1 = -INFINITY, y0 = INFINITY, y1 = -INFINITY;
        for (int i = 0; i < 3; ++i) {
            const Vec3& c = v[face[i]];
            x0 = std::min(x0, c.x / c.z), x1 = std::max(x1, c.x / c.z), y0 = std::min(y0, c.y / c.z), y1 = std::max(y1, c.y / c.z);
        }
        // Pixels whose centres lie between the corners; the slack forgives the divisions' rounding.
        constexpr double SLACK = 1e-3;
        t.left = bounded(std::ceil(x0 - 0.5 - SLACK), width), t.right = bounded(std::floor(x1 - 0.5 + SLACK) + 1, width);
        t.top = bounded(std::ceil(y0 - 0.5 - SLACK), height), t.bottom = bounded(std::floor(y1 - 0.5 + SLACK) + 1, height);
    }
    return t.left < t.right && t.top < t.bottom;
}

struct Target {
    int width;
    double near;
    int* triangle;
    float *barycentric, *depth;
    double* nearest;
};

void draw(const Triangle& t, int number, int top, int bottom, const Target& target) {
    for (int y = std::max(top, t.top); y < std::min(bottom, t.bottom); ++y) {
        double py = y + 0.5, at[3];
        for (int i = 0; i < 3; ++i) at[i] = t.edges[i].y * py + t.edges[i].z;
        for (int x = t.left; x < t.right; ++x) {
            double px = x + 0.5, e[3];
            bool inside = true;
            for (int i = 0; i < 3; ++i) {
                e[i] = t.edges[i].x * px + at[i];
                inside &= e[i] > 0 || (e[i] == 0 && t.front[i]);
            }
            if (!inside) continue;
            double sum = e[0] + e[1] + e[2], depth = t.volume / sum;
            int64_t pixel = int64_t(y) * target.width + x;
            // Of two at the same depth the one listed first is seen.
            if (!(depth >= target.near && depth < target.nearest[pixel])) continue;
            target.nearest[pixel] = depth;
            target.triangle[pixel] = number;
            target.depth[pixel] = float(depth);
            for (int i = 0; i < 3; ++i) target.barycentric[3 * pixel + i] = float(e[i] / sum);
        }
    }
}

}  // namespace

extern "C" {

// vertices: [v, 3] doubles (x w, y w, w); faces: [f, 3] within range. Returns 0, or 1 if memory is short.
int ash_rasterize(const double* vertices, const int* faces, int64_t face_count, int width, int height, double near, int threads,
                  int* triangle, float* barycentric, float* depth) try {
    const auto* v = reinterpret_cast<const Vec3*>(vertices);
    const int bands = (height + BAND - 1) / BAND;
    std::vector<Triangle> triangles(face_count);
    std::vector<std::vector<int>> members(bands);
    for (int64_t f = 0; f < face_count; ++f) {
        Triangle& t = triangles[f];
        if (!set_up(v, faces + 3 * f, width, height, near, t)) continue;
        for (int band = t.top / BAND; band <= (t.bottom - 1) / BAND; ++band) members[band].push_back(int(f));
    }
    std::vector<double> nearest(int64_t(width) * height, INFINITY);
    const Target target{width, near, triangle, barycentric, depth, nearest.data()};
    ash::in_parallel(threads, bands, [&](int64_t band) {
        int top = int(band) * BAND, bottom = std::min(height, top + BAND);
        const int64_t from = int64_t(top) * width, until = int64_t(bottom) * width;
        std::fill(triangle + from, triangle + until, -1);
        std::fill(depth + from, depth + until, 0.0f);
        std::fill(barycentric + 3 * from, barycentric + 3 * until, 0.0f);
        for (int number : members[band]) draw(triangles[number], number, top, bottom, target);
    });
    return 0;
} catch (const std::bad_alloc&) {
    return 1;
}
}
