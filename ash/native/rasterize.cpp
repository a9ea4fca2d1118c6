// Triangles to pixels by 2D homogeneous rasterisation (Olano and Greer 1997): a vertex is (x w, y w, w) with w its depth, an edge is the
// cross product of two vertices, and neither division nor clipping is needed for triangles that cross the camera's plane.
//
// Everything is double precision. An edge is computed from its lower-numbered vertex, whichever triangle asks, so that the two triangles
// that share it see exactly opposite numbers: no pixel is drawn twice or left out along it.
#include <algorithm>
#include <cmath>
#include <memory>
#include <new>
#include <vector>

#include "dispatch.h"
#include "team.h"

using namespace ash;

namespace {

constexpr int BAND = 16;  // rows handed out at once
constexpr int BEYOND = 8;  // samples after a row's last that are drawn into, see rasterize.inc

struct Vec3 {
    double x, y, z;
};

Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

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
        const Vec3 edge = edge_between(v, face[(i + 1) % 3], face[(i + 2) % 3], sign);
        t.edges[i][0] = edge.x, t.edges[i][1] = edge.y, t.edges[i][2] = edge.z;
        t.front[i] = edge.x > 0 || (edge.x == 0 && edge.y > 0);
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
    int* triangle;
    float *barycentric, *depth;
};

// Writes the samples of a row from column `left` on; samples without a triangle are written already.
void write_row(const Triangle* triangles, const double* nearest, const int64_t* visible, int left, int right, int y, const Target& target) {
    for (int x = left; x < right; ++x) {
        if (visible[x] < 0) continue;
        const int64_t pixel = int64_t(y) * target.width + x;
        const Triangle& t = triangles[visible[x]];
        double px = x + 0.5, py = y + 0.5, e[3];
        for (int i = 0; i < 3; ++i) e[i] = t.edges[i][0] * px + (t.edges[i][1] * py + t.edges[i][2]);
        const double sum = e[0] + e[1] + e[2];
        target.triangle[pixel] = int(visible[x]);
        target.depth[pixel] = float(nearest[x]);
        for (int i = 0; i < 3; ++i) target.barycentric[3 * pixel + i] = float(e[i] / sum);
    }
}

}  // namespace

extern "C" {

// vertices: [v, 3] doubles (x w, y w, w); faces: [f, 3] within range. Returns 0, or 1 if memory is short.
int ash_rasterize(const double* vertices, const int* faces, int64_t face_count, int width, int height, double near, int threads,
                  int* triangle, float* barycentric, float* depth) try {
    const auto* v = reinterpret_cast<const Vec3*>(vertices);
    const int bands = (height + BAND - 1) / BAND;
    const std::unique_ptr<Triangle[]> triangles(new Triangle[face_count]);
    std::vector<std::vector<int>> members(bands);
    for (int64_t f = 0; f < face_count; ++f) {
        Triangle& t = triangles[f];
        if (!set_up(v, faces + 3 * f, width, height, near, t)) continue;
        for (int band = t.top / BAND; band <= (t.bottom - 1) / BAND; ++band) members[band].push_back(int(f));
    }
    const Target target{width, triangle, barycentric, depth};
    const int64_t stride = width + BEYOND, samples = bands * BAND * stride;
    const std::unique_ptr<double[]> all_nearest(new double[samples]);
    const std::unique_ptr<int64_t[]> all_seen(new int64_t[samples]);
    in_parallel(threads, bands, [&](int64_t number) {
        const int top = int(number) * BAND, bottom = std::min(height, top + BAND);
        const int64_t from = int64_t(top) * width, until = int64_t(bottom) * width;
        std::fill(triangle + from, triangle + until, -1);
        std::fill(depth + from, depth + until, 0.0f);
        std::fill(barycentric + 3 * from, barycentric + 3 * until, 0.0f);
        int left = width, right = 0;
        for (int f : members[number]) left = std::min(left, triangles[f].left), right = std::max(right, triangles[f].right);
        const RasterBand band{top, bottom, stride, near, all_nearest.get() + top * stride, all_seen.get() + top * stride};
        for (int y = 0; y < bottom - top && left < right; ++y) {
            std::fill(band.nearest + y * stride + left, band.nearest + y * stride + right + BEYOND, INFINITY);
            std::fill(band.visible + y * stride + left, band.visible + y * stride + right + BEYOND, -1);
        }
        kernels().raster_band(triangles.get(), members[number].data(), int64_t(members[number].size()), band);
        for (int y = top; y < bottom; ++y)
            write_row(triangles.get(), band.nearest + (y - top) * stride, band.visible + (y - top) * stride, left, right, y, target);
    });
    return 0;
} catch (const std::bad_alloc&) {
    return 1;
}
}
