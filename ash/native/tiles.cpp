// See tiles.h. Pixels are numbered through, border included, so that a tap is a distance; what is computed for the border is not kept.
// The three taps of a row lie side by side in memory: together they are the inner dimension of one product.
#include "tiles.h"

#include <immintrin.h>

namespace ash {

namespace {

constexpr int SIDE = 16;         // rows of a tile, and float32 columns of a tile of sums
constexpr int DEEP = 32;         // bfloat16 factors in a row of a tile
constexpr int TILE_HALVES = SIDE * DEEP;
constexpr int SUM_BYTES = SIDE * sizeof(float);

struct alignas(64) Configuration {
    uint8_t palette = 1, start_row = 0, reserved[14] = {};
    uint16_t bytes_per_row[16] = {64, 64, 64, 64, 64, 64, 64, 64};
    uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
};
const Configuration configuration;

int64_t rounded(int64_t count, int64_t unit) { return (count + unit - 1) / unit * unit; }
int64_t pixels_of(int height, int width) { return int64_t(height + 2) * (width + 2); }
int64_t margin_of(int width) { return rounded(width + 3, DEEP); }  // of zeros, more than the farthest tap
int64_t turned_row(int height, int width) { return rounded(pixels_of(height, width), DEEP) + 2 * margin_of(width); }
int deep_tiles(int inputs) { return int(rounded(3 * inputs, DEEP) / DEEP); }

// Element (i, j) of 16x16 pairs to (j, i).
inline void transpose(__m512i* r) {
    __m512i t[16];
    for (int i = 0; i < 16; i += 2) t[i] = _mm512_unpacklo_epi32(r[i], r[i + 1]), t[i + 1] = _mm512_unpackhi_epi32(r[i], r[i + 1]);
    for (int i = 0; i < 16; i += 4) {
        r[i] = _mm512_unpacklo_epi64(t[i], t[i + 2]), r[i + 1] = _mm512_unpackhi_epi64(t[i], t[i + 2]);
        r[i + 2] = _mm512_unpacklo_epi64(t[i + 1], t[i + 3]), r[i + 3] = _mm512_unpackhi_epi64(t[i + 1], t[i + 3]);
    }
    for (int i = 0; i < 4; ++i) {
        t[i] = _mm512_shuffle_i32x4(r[i], r[i + 4], 0x88), t[i + 4] = _mm512_shuffle_i32x4(r[i], r[i + 4], 0xdd);
        t[i + 8] = _mm512_shuffle_i32x4(r[i + 8], r[i + 12], 0x88), t[i + 12] = _mm512_shuffle_i32x4(r[i + 8], r[i + 12], 0xdd);
    }
    for (int i = 0; i < 4; ++i) {
        r[i] = _mm512_shuffle_i32x4(t[i], t[i + 8], 0x88), r[i + 8] = _mm512_shuffle_i32x4(t[i], t[i + 8], 0xdd);
        r[i + 4] = _mm512_shuffle_i32x4(t[i + 4], t[i + 12], 0x88), r[i + 12] = _mm512_shuffle_i32x4(t[i + 4], t[i + 12], 0xdd);
    }
}

inline __mmask16 first_lanes(int count) { return count >= SIDE ? __mmask16(0xffff) : __mmask16((1u << count) - 1); }
inline __m256i half_of(__m512 x) { return (__m256i)_mm512_cvtneps_pbh(x); }
inline __m512i paired(__m256i low, __m256i high) {
    return _mm512_or_si512(_mm512_cvtepu16_epi32(low), _mm512_slli_epi32(_mm512_cvtepu16_epi32(high), 16));
}

void halve(const float* from, int64_t count, Half* to) {
    for (int64_t i = 0; i < count; i += SIDE) {
        const __mmask16 lanes = first_lanes(count - i < SIDE ? int(count - i) : SIDE);
        _mm256_mask_storeu_epi16(to + i, lanes, half_of(_mm512_maskz_loadu_ps(lanes, from + i)));
    }
}

}  // namespace

static int64_t tile_plane_size(int height, int width, int channels) {
    return (pixels_of(height, width) + 3 * SIDE + width) * channels + DEEP;
}

static void tile_plane(const TilePlane& from, Half* to) {
    const int64_t pixels = pixels_of(from.height, from.width), row = (from.width + 2) * from.step;
    const float* corner = from.first - row - from.step;
    if (from.step == from.channels)
        halve(corner, pixels * from.channels, to);
    else
        for (int64_t p = 0; p < pixels; ++p) halve(corner + p * from.step, from.channels, to + p * from.channels);
    const int64_t written = pixels * from.channels;
    __builtin_memset(to + written, 0, (tile_plane_size(from.height, from.width, from.channels) - written) * sizeof(Half));
}

static int64_t tile_weights_size(int outputs, int inputs) {
    const int64_t forward = rounded(outputs, SIDE) / SIDE * deep_tiles(inputs), back = rounded(inputs, SIDE) / SIDE * deep_tiles(outputs);
    return 3 * TILE_HALVES * (forward > back ? forward : back);
}

// Tiles [block of columns][row of taps][part of its depth]; a tile's row holds two neighbouring factors of the depth for each column.
static void tile_weights(const float* weights, int outputs, int inputs, bool backward, Half* to) {
    const int columns = backward ? inputs : outputs, deep = backward ? outputs : inputs, tiles = deep_tiles(deep);
    for (int block = 0; block * SIDE < columns; ++block)
        for (int row = 0; row < 3; ++row)
            for (int part = 0; part < tiles; ++part, to += TILE_HALVES) {
                __m512i r[SIDE];
                const int first = part * DEEP, valid = columns - block * SIDE;
                for (int i = 0; i < SIDE; ++i) {
                    if (!backward) {  // i is a column, whose factors lie side by side
                        const float* from = weights + (int64_t(block * SIDE + i) * 9 + 3 * row) * inputs + first;
                        const int left = i < valid ? 3 * inputs - first : 0;
                        const __m512 low = _mm512_maskz_loadu_ps(first_lanes(left > 0 ? left : 0), from);
                        const __m512 high = _mm512_maskz_loadu_ps(first_lanes(left > SIDE ? left - SIDE : 0), from + SIDE);
                        r[i] = (__m512i)_mm512_cvtne2ps_pbh(high, low);
                        continue;
                    }
                    __m256i two[2];  // i is a pair of outputs of one tap, counted backwards; their columns lie side by side
                    for (int k = 0; k < 2; ++k) {
                        const int at = first + 2 * i + k, tap = 8 - 3 * row - at / outputs;
                        const float* from = weights + (int64_t(at % outputs) * 9 + tap) * inputs + block * SIDE;
                        two[k] = half_of(_mm512_maskz_loadu_ps(at < 3 * outputs ? first_lanes(valid) : __mmask16(0), from));
                    }
                    r[i] = paired(two[0], two[1]);
                }
                if (!backward) transpose(r);
                for (int i = 0; i < SIDE; ++i) _mm512_storeu_si512(to + i * DEEP, r[i]);
            }
}

static int64_t tile_blocks(int height, int width) {
    const int64_t inside = int64_t(height) * (width + 2) - 2;  // from the first pixel inside the border to the last
    return rounded(inside, 2 * SIDE) / (2 * SIDE);
}

// Sixteen pixels' sums of a block of columns, from pixel `first` on.
static void keep(const TileConvolution& work, const float* sums, int64_t first, int column) {
    const TilePlane& out = work.out;
    const int wide = out.width + 2;
    int y = int(first / wide), x = int(first - int64_t(y) * wide);
    const __m512 start = work.start ? _mm512_loadu_ps(work.start + column) : _mm512_setzero_ps();
    for (int i = 0; i < SIDE; ++i, sums += SIDE) {
        if (x >= 1 && x <= out.width && y >= 1 && y <= out.height) {
            const int64_t at = int64_t(y - 1) * wide + x - 1;
            __m512 value = _mm512_add_ps(_mm512_load_ps(sums), start);
            if (work.relu) value = _mm512_max_ps(value, _mm512_setzero_ps());
            if (work.active) {
                const __m512 active = _mm512_loadu_ps(work.active + at * work.active_step + column);
                value = _mm512_maskz_mov_ps(_mm512_cmp_ps_mask(active, _mm512_setzero_ps(), _CMP_GT_OQ), value);
            }
            _mm512_storeu_ps(out.first + at * out.step + column, value);
        }
        if (++x == wide) x = 0, ++y;
    }
}

// Two times sixteen pixels and two blocks of columns at once.
static void tile_convolve(const TileConvolution& work, int64_t first, int64_t last) {
    _tile_loadconfig(&configuration);
    alignas(64) float sums[SIDE * SIDE];
    const int wide = work.out.width + 2, parts = deep_tiles(work.inputs);
    const int64_t stride = int64_t(work.inputs) * sizeof(Half), of_block = int64_t(3) * parts * TILE_HALVES;
    for (int column = 0; column < work.out.channels; column += 2 * SIDE) {
        const bool two = column + SIDE < work.out.channels;
        const Half* weights = work.weights + column / SIDE * of_block;
        for (int64_t block = first; block < last; ++block) {
            const int64_t pixel = wide + 1 + block * 2 * SIDE;
            _tile_zero(0); _tile_zero(1); _tile_zero(2); _tile_zero(3);
            for (int row = 0; row < 3; ++row) {
                const Half* above = work.plane + (pixel + (row - 1) * wide - 1) * work.inputs;
                for (int part = 0; part < parts; ++part) {
                    const Half *from = above + part * DEEP, *by = weights + (row * parts + part) * TILE_HALVES;
                    _tile_loadd(4, from, stride);
                    _tile_loadd(5, from + SIDE * work.inputs, stride);
                    _tile_loadd(6, by, 64);
                    _tile_dpbf16ps(0, 4, 6); _tile_dpbf16ps(1, 5, 6);
                    if (!two) continue;
                    _tile_loadd(7, by + of_block, 64);
                    _tile_dpbf16ps(2, 4, 7); _tile_dpbf16ps(3, 5, 7);
                }
            }
            _tile_stored(0, sums, SUM_BYTES); keep(work, sums, pixel, column);
            _tile_stored(1, sums, SUM_BYTES); keep(work, sums, pixel + SIDE, column);
            if (!two) continue;
            _tile_stored(2, sums, SUM_BYTES); keep(work, sums, pixel, column + SIDE);
            _tile_stored(3, sums, SUM_BYTES); keep(work, sums, pixel + SIDE, column + SIDE);
        }
    }
    _tile_release();
}

static int64_t tile_turned_size(int height, int width, int channels) { return rounded(channels, SIDE) * turned_row(height, width); }

static void tile_turned(const Half* plane, int height, int width, int channels, Half* to) {
    const int64_t pixels = pixels_of(height, width), row = turned_row(height, width), margin = margin_of(width);
    __builtin_memset(to, 0, tile_turned_size(height, width, channels) * sizeof(Half));
    for (int channel = 0; channel < channels; channel += SIDE) {
        const __mmask16 lanes = first_lanes(channels - channel);
        for (int64_t p = 0; p < pixels; p += DEEP) {
            __m512i r[SIDE];
            for (int i = 0; i < SIDE; ++i) {
                const int64_t at = p + 2 * i;
                const Half* from = plane + at * channels + channel;
                r[i] = paired(_mm256_maskz_loadu_epi16(at < pixels ? lanes : __mmask16(0), from),
                              _mm256_maskz_loadu_epi16(at + 1 < pixels ? lanes : __mmask16(0), from + channels));
            }
            transpose(r);
            for (int i = 0; i < SIDE; ++i) _mm512_storeu_si512(to + (channel + i) * row + margin + p, r[i]);
        }
    }
}

static int64_t tile_pairs_size(int height, int width, int channels) {
    return rounded(pixels_of(height, width), DEEP) * rounded(channels, SIDE);
}

static void tile_pairs(const Half* plane, int height, int width, int channels, Half* to) {
    const int64_t pixels = pixels_of(height, width), padded = rounded(channels, SIDE);
    for (int64_t p = 0; p < rounded(pixels, DEEP); p += 2, to += 2 * padded)
        for (int channel = 0; channel < channels; channel += SIDE) {
            const __mmask16 lanes = first_lanes(channels - channel);
            const Half* from = plane + p * channels + channel;
            _mm512_storeu_si512(to + 2 * channel, paired(_mm256_maskz_loadu_epi16(p < pixels ? lanes : __mmask16(0), from),
                                                         _mm256_maskz_loadu_epi16(p + 1 < pixels ? lanes : __mmask16(0), from + channels)));
        }
}

static int64_t tile_correlations(int outputs, int inputs) { return int64_t(3) * (outputs / SIDE) * (rounded(inputs, SIDE) / SIDE); }

// A piece: sixteen outputs, sixteen inputs, a row of taps. The gradient's pixel lies a tap before the input's.
static void tile_correlate(const TileCorrelation& work, int64_t first, int64_t last) {
    _tile_loadconfig(&configuration);
    alignas(64) float sums[SIDE * SIDE];
    const int64_t pixels = pixels_of(work.height, work.width), row = turned_row(work.height, work.width);
    const int64_t padded = rounded(work.inputs, SIDE);
    for (int64_t piece = first; piece < last; ++piece) {
        const int tap = int(piece % 3) - 1, input = int(piece / 3 % (padded / SIDE)) * SIDE;
        const int output = int(piece / 3 / (padded / SIDE)) * SIDE;
        const Half* turned = work.turned + output * row + margin_of(work.width) - tap * (work.width + 2);
        const Half* pairs = work.pairs + 2 * input;
        _tile_zero(0); _tile_zero(1); _tile_zero(2);
        for (int64_t p = 0; p < pixels; p += DEEP) {
            _tile_loadd(6, pairs + p * padded, padded * 2 * sizeof(Half));
            _tile_loadd(3, turned + p + 1, row * sizeof(Half));
            _tile_loadd(4, turned + p, row * sizeof(Half));
            _tile_loadd(5, turned + p - 1, row * sizeof(Half));
            _tile_dpbf16ps(0, 3, 6); _tile_dpbf16ps(1, 4, 6); _tile_dpbf16ps(2, 5, 6);
        }
        float* to = work.grad_weights + (int64_t(output) * 9 + 3 * (tap + 1)) * work.inputs + input;
        const __mmask16 lanes = first_lanes(work.inputs - input);
        for (int k = 0; k < 3; ++k, to += work.inputs) {
            if (k == 0) _tile_stored(0, sums, SUM_BYTES);
            if (k == 1) _tile_stored(1, sums, SUM_BYTES);
            if (k == 2) _tile_stored(2, sums, SUM_BYTES);
            for (int i = 0; i < SIDE; ++i) _mm512_mask_storeu_ps(to + int64_t(i) * 9 * work.inputs, lanes, _mm512_load_ps(sums + i * SIDE));
        }
    }
    _tile_release();
}

const TileKernels amx_kernels = {tile_plane_size, tile_plane, tile_weights_size, tile_weights, tile_blocks, tile_convolve,
                                 tile_turned_size, tile_turned, tile_pairs_size, tile_pairs, tile_correlations, tile_correlate};

}  // namespace ash
