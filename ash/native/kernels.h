// What the kernels of one instruction set offer, and the plain data that goes in and out. No inline functions here (see simd.h).
#pragma once
#include <cstdint>

namespace ash {

constexpr float ALPHA_MIN = 1.0f / 255.0f;
constexpr float LOG2_ALPHA_MIN = -7.99435344f;
constexpr float ALPHA_MAX = 0.99f;
constexpr float TRANSMITTANCE_MIN = 1e-4f;
constexpr float COMPENSATION_MIN = 1e-6f;
constexpr float NOT_DRAWN = -1e30f;  // log2 opacity of a splat that is drawn nowhere

// A tile is 32x32 pixels = 8x8 blocks of 4x4 pixels: one bit of a 64-bit mask per block, one AVX-512 register per block.
constexpr int TILE = 32;
constexpr int BLOCK = 4;
constexpr int BLOCKS = TILE / BLOCK;
constexpr int LANES = BLOCK * BLOCK;

// The splats' parameters as the blend wants them ("packed", one row per camera and Gaussian). With dx, dy in pixels from the
// centre, u = a dx + b dy and v = e dy:  log2 alpha = l - u^2 - v^2.
enum Packed { PACKED_A, PACKED_B, PACKED_E, PACKED_L, PACKED_R, PACKED_G, PACKED_BLUE, PACKED_Z, PACKED };

// Gradients collected per splat and tile: sums over pixels of q = dL/d(ln alpha) times 1, u, v, uu, uv, vv; then of the
// blending weight times dL/d(rgb, depth).
enum Sums { SUM_Q, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, SUM_R, SUM_G, SUM_BLUE, SUM_Z, SUMS };
constexpr int SLOT = 12;  // floats from one slot to the next

struct ProjectArgs {
    const float *means, *quats, *scales, *opacities, *sh;
    const float *viewmats, *Ks;  // [c, 4, 4], [c, 3, 3]
    int64_t count;
    int cameras, coefficients, width, height, compensate;
    float dilation, near;
    float *means2d, *packed;  // [c, n, 2], [c, n, PACKED]
    double* depths;           // [c, n]; what the order is taken from
    // Backward only.
    const float *grad_means2d, *grad_packed;
    float *grad_means, *grad_quats, *grad_scales, *grad_opacities, *grad_sh;
};

// One splat in one image, 64 bytes.
struct Splat {
    float x, y, a, b, e, l, red, green, blue, z;
    float reach;   // u^2 + v^2 at the rim
    float lean;    // dy at the rim's rightmost point
    float half_height;
    float inverse_a, slope;  // 1 / a, b / a
    float half_width;
};

// The tiles that a splat may reach, the last ones excluded; none: not drawn.
struct Rect {
    uint16_t left, top, right, bottom;
};

struct Entry {  // a splat in a tile, and where its gradient in that tile goes
    uint32_t splat, slot;
};

// Entries are blended 64 at a time: one bit of a 64-bit mask per entry.
constexpr int CHUNK = 64;

struct Tile {
    int camera, x, y;  // upper left pixel
    int64_t first, count;  // entries
    int64_t chunks;        // first mask: for every chunk of entries one mask per block
    int64_t done;          // entries looked at before the tile was finished
};

struct BlendArgs {
    const Splat* splats;
    const Entry* entries;
    uint64_t* masks;  // which entries of a chunk a block sees; written by the forward pass
    int width, height;
    float background[3];
    float *rgb, *alpha, *depth;                               // [c, h, w, 3], [c, h, w], [c, h, w]
    const float *grad_rgb, *grad_alpha, *grad_depth;          // any of them may be null
    float* slots;
};

struct SsimArgs {
    const float *image, *target;                  // [h, 3 w]
    const float* weights;                         // [h, w] or null: 1 everywhere
    float* grad;                                  // [h, 3 w] or null
    int width, height;
    int top, bottom;             // rows outside have weight 0
    float l1_scale, ssim_scale;  // factors of sum |I - T| and of sum SSIM in the loss
    double* row_l1;              // [h] sums
    double* row_ssim;
};

struct PlaceArgs {
    const float *vertices, *barycentric;  // [v, 16], [n, 3]
    const int* corners;                   // [n, 3]
    float *quats, *translations, *canonical, *normals;
};

struct PoseArgs {
    const float *raw, *canonical, *normals, *turns, *translations;  // [n, 11 + 3 k], [n, 3], [n, 3], [n, 4], [n, 3]
    const float* light;                                             // [9, 3] or null
    int coefficients;   // k
    float offset_unit;  // metres per unit of a raw offset; 0: no offset
    int canonical_frame;  // rotations turn with the surface
    float *means, *quats, *scales, *opacities, *sh;
    // Backward only.
    const float *grad_means, *grad_quats, *grad_scales, *grad_opacities, *grad_sh;
    float* grad_raw;
};

struct AdamArgs {
    float* parameter;
    const float* grad;
    float *mean, *square;  // moments
    float new_mean, new_square, beta2, eps;  // 1 - beta1, 1 - beta2
    float step_size;     // learning rate / (1 - beta1^t)
    float inverse_root;  // 1 / sqrt(1 - beta2^t)
};

struct TurnArgs {
    const float *quats, *sh;          // [n, 4], [n, coefficients, 3]
    const float *directions, *fits;   // of degree 1, 2, ...: [4 l + 2, 3] fixed directions, [2 l + 1, 4 l + 2] from values to coefficients
    int coefficients, inverse;        // inverse: turned back
    float* turned;                    // [n, coefficients, 3]
};

struct ShadeArgs {
    const float *texture, *light, *weights;  // [3, height, width], [9, 3] or null, [n, 3]
    const float *uvs, *normals;              // [u, 2], [v, 3]
    const int64_t *triangles, *uv_faces, *faces;  // [n], [f, 3], [f, 3]
    int height, width;
    float* colours = nullptr;
    // Backward only.
    const float* grad = nullptr;
    float *grad_texture = nullptr, *grad_weights = nullptr;  // the latter may be null
};

struct Triangle {
    double edges[3][3];  // opposite corner 0, 1, 2: factors of x, y and 1; positive inside
    double volume;  // positive
    int left, right, top, bottom;  // pixels that may lie inside, the last ones excluded
    bool front[3];  // a pixel exactly on the edge is inside: left and top edges
};

struct RasterBand {
    int top, bottom;  // rows of the image, the last one excluded
    int64_t stride;   // of a row
    double near;      // least visible depth
    double* nearest;  // depths, infinite at first
    int64_t* visible; // triangles
};

constexpr int PRODUCT_COLUMNS = 16;

// c[p][j] = start[j] + sum over segments s and steps i of a[p a_step + a_at[s] + i a_inner] b[b_at[s] + i b_inner + j], for rows p and
// columns j; then added to what is there, without what is negative, or 0 where `active` is not positive. Columns of b are read 16 at a
// time, also beyond the last; from one 16 to the next are b_block floats.
struct Product {
    const float* a;
    int64_t a_step, a_inner;
    const float* b;
    int64_t b_inner, b_block;
    const int64_t *a_at, *b_at;
    int segments;
    int64_t steps, rows, columns;
    float* c;
    int64_t c_step;
    const float* start = nullptr;
    const float* active = nullptr;
    int64_t active_step = 0;
    bool add = false, relu = false;
};

// Weights as a product's b: to[block][tap][step][16] = from[column column_step + tap tap_step + step inner_step], 0 beyond the columns.
struct Packing {
    const float* from;
    int columns, taps, steps;
    int64_t column_step, tap_step, inner_step;
    float* to;
};

// One pixel of a pool and the four that it was made of, which came out of a ReLU.
struct PoolGradient {
    const float *in[4], *pooled, *grad_pooled, *grad_skip[4];
    float* grad_in[4];
    int channels;
};

// Tiles of 4x4 pixels of a plane, `across` of them in a line, row by row; `stride`: floats from one of the 36 factors to the next.
struct WinogradTiles {
    float* pixels;  // pixel (0, 0)
    int64_t row, step;
    int across, channels;  // channels: whole 16s
    int64_t first, count, stride;
    int64_t at(int64_t tile) const { return 4 * (tile / across * row + tile % across * step); }
};

// What is wrong with an input, noticed while it is read. 0: nothing.
enum Fault : int64_t { FAULT_MEANS = 1, FAULT_QUATS, FAULT_ZERO_QUAT, FAULT_SCALES, FAULT_OPACITIES, FAULT_SH };

struct Kernels {
    const char* name;
    int64_t (*project)(const ProjectArgs&, int64_t first, int64_t last);  // 0, or fault + 16 * index
    void (*project_backward)(const ProjectArgs&, int64_t first, int64_t last, double* grad_views);  // adds to [c, 12], unless null
    void (*prepare)(const float* means2d, const float* packed, int columns, int rows, Splat* splats, Rect* rects, int64_t first,
                    int64_t last);
    void (*blend)(const BlendArgs&, Tile&);
    void (*blend_backward)(const BlendArgs&, const Tile&);
    void (*gather)(const Splat*, const float* slots, const int64_t* offsets, int64_t first, int64_t last, float* grad_means2d,
                   float* grad_packed);
    void (*ssim_rows)(const SsimArgs&, int first, int last, float* scratch);
    int64_t (*ssim_scratch)(int width);  // floats
    double (*fma_work)(int64_t rounds);  // floating point operations done
    void (*place_texels)(const PlaceArgs&, int64_t first, int64_t last);
    void (*pose)(const PoseArgs&, int64_t first, int64_t last);
    void (*pose_backward)(const PoseArgs&, int64_t first, int64_t last, double* grad_light);  // adds to [9, 3]
    void (*turn_sh)(const TurnArgs&, int64_t first, int64_t last);
    bool (*adam)(const AdamArgs&, int64_t first, int64_t last);  // false: a gradient is NaN or infinite
    void (*shade)(const ShadeArgs&, int64_t first, int64_t last);
    void (*shade_backward)(const ShadeArgs&, int64_t first, int64_t last, double* grad_light);  // adds to [9, 3]
    void (*multiply)(const Product&);
    void (*pack)(const Packing&);
    void (*pool_backward)(const PoolGradient&);
    void (*raster_band)(const Triangle*, const int* members, int64_t count, const RasterBand&);
    void (*winograd_weights)(const float* packed, int blocks, int64_t steps, bool flipped, float* to);
    void (*winograd_weights_backward)(const float* sums, int64_t stride, int outs, int ins, float* grad);
    void (*winograd_input)(const WinogradTiles&, float* to);
    void (*winograd_output)(const WinogradTiles&, const float* products, const float* start, bool relu, const float* active,
                            int64_t active_row, int64_t active_step);
    void (*winograd_output_backward)(const WinogradTiles&, float* to);
};

extern const Kernels avx512_kernels, avx2_kernels, plain_kernels;

}  // namespace ash
