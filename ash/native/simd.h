// A vector of floats as wide as the instruction set of this translation unit: 16 (AVX-512), 8 (AVX2) or 4 (anything else).
//
// Everything lives in a namespace named after the instruction set, and no standard header with inline functions is included
// here: the linker would otherwise be free to keep an AVX-512 copy of, say, std::max for the whole library.
#pragma once
#include <cstdint>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace ASH_ISA {

#if defined(__AVX512F__)

constexpr int W = 16;
struct V {
    __m512 x;
};
struct Mask {
    __mmask16 x;
};
inline V all(float s) { return {_mm512_set1_ps(s)}; }
inline V load(const float* p) { return {_mm512_loadu_ps(p)}; }
inline void store(float* p, V a) { _mm512_storeu_ps(p, a.x); }
inline V operator+(V a, V b) { return {_mm512_add_ps(a.x, b.x)}; }
inline V operator-(V a, V b) { return {_mm512_sub_ps(a.x, b.x)}; }
inline V operator*(V a, V b) { return {_mm512_mul_ps(a.x, b.x)}; }
inline V operator/(V a, V b) { return {_mm512_div_ps(a.x, b.x)}; }
inline V fma(V a, V b, V c) { return {_mm512_fmadd_ps(a.x, b.x, c.x)}; }
inline V fnma(V a, V b, V c) { return {_mm512_fnmadd_ps(a.x, b.x, c.x)}; }
inline V min(V a, V b) { return {_mm512_min_ps(a.x, b.x)}; }
inline V max(V a, V b) { return {_mm512_max_ps(a.x, b.x)}; }
inline V sqrt(V a) { return {_mm512_sqrt_ps(a.x)}; }
inline Mask operator<(V a, V b) { return {_mm512_cmp_ps_mask(a.x, b.x, _CMP_LT_OQ)}; }
inline Mask operator>=(V a, V b) { return {_mm512_cmp_ps_mask(a.x, b.x, _CMP_GE_OQ)}; }
inline Mask operator&(Mask a, Mask b) { return {(__mmask16)(a.x & b.x)}; }
inline Mask without(Mask a, Mask b) { return {(__mmask16)(a.x & ~b.x)}; }
inline bool any(Mask a) { return a.x != 0; }
inline V select(Mask m, V a, V b) { return {_mm512_mask_blend_ps(m.x, b.x, a.x)}; }
inline V only(Mask m, V a) { return {_mm512_maskz_mov_ps(m.x, a.x)}; }
// 1 / a to about one unit in the last place, for ordinary a.
inline V reciprocal(V a) {
    V r{_mm512_rcp14_ps(a.x)};
    return fma(r, fnma(a, r, all(1.0f)), r);
}
// 2^a = mantissa * 2^floor(a); `fraction` is a - floor(a).
inline V fraction(V a) { return {_mm512_reduce_ps(a.x, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)}; }
inline V scale_by_floor(V mantissa, V a) { return {_mm512_scalef_ps(mantissa.x, a.x)}; }
// Of ordinary a > 0; absolute error 2e-7 below 1.
inline V log2_of(V a) {
    const V m{_mm512_getmant_ps(a.x, _MM_MANT_NORM_p75_1p5, _MM_MANT_SIGN_zero)};
    const V up = only(m < all(1.0f), all(1.0f)), exponent{_mm512_getexp_ps(a.x)};
    const V s = (m - all(1.0f)) / (m + all(1.0f)), z = s * s;  // log(m) = 2 (s + s^3 / 3 + s^5 / 5 + ...), |s| <= 0.2
    const V series = fma(z, fma(z, fma(z, fma(z, all(0.320598898f), all(0.412198583f)), all(0.577078016f)), all(0.961796694f)), all(2.88539008f));
    return fma(s, series, exponent + up);
}
inline float sum(V a) { return _mm512_reduce_add_ps(a.x); }
inline void transpose_4x4(__m512* r) {
    __m512d a = _mm512_castps_pd(_mm512_unpacklo_ps(r[0], r[1])), b = _mm512_castps_pd(_mm512_unpackhi_ps(r[0], r[1]));
    __m512d c = _mm512_castps_pd(_mm512_unpacklo_ps(r[2], r[3])), d = _mm512_castps_pd(_mm512_unpackhi_ps(r[2], r[3]));
    r[0] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c)), r[1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
    r[2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d)), r[3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
}
// Four columns of W rows that lie `stride` floats apart: out[c] holds column c.
inline void load_columns(const float* p, int64_t stride, V* out) {
    __m512 r[4];
    for (int j = 0; j < 4; ++j) {
        r[j] = _mm512_castps128_ps512(_mm_loadu_ps(p + j * stride));
        r[j] = _mm512_insertf32x4(r[j], _mm_loadu_ps(p + (4 + j) * stride), 1);
        r[j] = _mm512_insertf32x4(r[j], _mm_loadu_ps(p + (8 + j) * stride), 2);
        r[j] = _mm512_insertf32x4(r[j], _mm_loadu_ps(p + (12 + j) * stride), 3);
    }
    transpose_4x4(r);
    for (int j = 0; j < 4; ++j) out[j].x = r[j];
}
inline void store_columns(const V* in, float* p, int64_t stride) {
    __m512 r[4] = {in[0].x, in[1].x, in[2].x, in[3].x};
    transpose_4x4(r);
    for (int j = 0; j < 4; ++j) {
        _mm_storeu_ps(p + j * stride, _mm512_castps512_ps128(r[j]));
        _mm_storeu_ps(p + (4 + j) * stride, _mm512_extractf32x4_ps(r[j], 1));
        _mm_storeu_ps(p + (8 + j) * stride, _mm512_extractf32x4_ps(r[j], 2));
        _mm_storeu_ps(p + (12 + j) * stride, _mm512_extractf32x4_ps(r[j], 3));
    }
}
// to[i] = the sum of v[i], for four vectors.
inline void sums_of_four(const V* v, float* to) {
    auto pair = [](__m512 a, __m512 b) { return _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b)); };
    __m512d ab = _mm512_castps_pd(pair(v[0].x, v[1].x)), cd = _mm512_castps_pd(pair(v[2].x, v[3].x));
    __m512 all4 = _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd)), _mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd)));
    __m256 half = _mm256_add_ps(_mm512_castps512_ps256(all4), _mm512_extractf32x8_ps(all4, 1));
    _mm_storeu_ps(to, _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1)));
}

#elif defined(__AVX2__)

constexpr int W = 8;
struct V {
    __m256 x;
};
struct Mask {
    __m256 x;
};
inline V all(float s) { return {_mm256_set1_ps(s)}; }
inline V load(const float* p) { return {_mm256_loadu_ps(p)}; }
inline void store(float* p, V a) { _mm256_storeu_ps(p, a.x); }
inline V operator+(V a, V b) { return {_mm256_add_ps(a.x, b.x)}; }
inline V operator-(V a, V b) { return {_mm256_sub_ps(a.x, b.x)}; }
inline V operator*(V a, V b) { return {_mm256_mul_ps(a.x, b.x)}; }
inline V operator/(V a, V b) { return {_mm256_div_ps(a.x, b.x)}; }
inline V fma(V a, V b, V c) { return {_mm256_fmadd_ps(a.x, b.x, c.x)}; }
inline V fnma(V a, V b, V c) { return {_mm256_fnmadd_ps(a.x, b.x, c.x)}; }
inline V min(V a, V b) { return {_mm256_min_ps(a.x, b.x)}; }
inline V max(V a, V b) { return {_mm256_max_ps(a.x, b.x)}; }
inline V sqrt(V a) { return {_mm256_sqrt_ps(a.x)}; }
inline Mask operator<(V a, V b) { return {_mm256_cmp_ps(a.x, b.x, _CMP_LT_OQ)}; }
inline Mask operator>=(V a, V b) { return {_mm256_cmp_ps(a.x, b.x, _CMP_GE_OQ)}; }
inline Mask operator&(Mask a, Mask b) { return {_mm256_and_ps(a.x, b.x)}; }
inline Mask without(Mask a, Mask b) { return {_mm256_andnot_ps(b.x, a.x)}; }
inline bool any(Mask a) { return _mm256_movemask_ps(a.x) != 0; }
inline V select(Mask m, V a, V b) { return {_mm256_blendv_ps(b.x, a.x, m.x)}; }
inline V only(Mask m, V a) { return {_mm256_and_ps(m.x, a.x)}; }
inline V reciprocal(V a) {
    V r{_mm256_rcp_ps(a.x)};
    r = fma(r, fnma(a, r, all(1.0f)), r);
    return fma(r, fnma(a, r, all(1.0f)), r);
}
inline V fraction(V a) { return {_mm256_sub_ps(a.x, _mm256_floor_ps(a.x))}; }
inline V scale_by_floor(V mantissa, V a) {
    __m256i exponent = _mm256_cvtps_epi32(_mm256_floor_ps(a.x));
    __m256i bits = _mm256_add_epi32(_mm256_castps_si256(mantissa.x), _mm256_slli_epi32(exponent, 23));
    return {_mm256_castsi256_ps(bits)};
}
inline float sum(V a) {
    __m128 s = _mm_add_ps(_mm256_castps256_ps128(a.x), _mm256_extractf128_ps(a.x, 1));
    s = _mm_add_ps(s, _mm_movehl_ps(s, s));
    return _mm_cvtss_f32(_mm_add_ss(s, _mm_shuffle_ps(s, s, 1)));
}
inline void transpose_4x4(__m256* r) {
    __m256d a = _mm256_castps_pd(_mm256_unpacklo_ps(r[0], r[1])), b = _mm256_castps_pd(_mm256_unpackhi_ps(r[0], r[1]));
    __m256d c = _mm256_castps_pd(_mm256_unpacklo_ps(r[2], r[3])), d = _mm256_castps_pd(_mm256_unpackhi_ps(r[2], r[3]));
    r[0] = _mm256_castpd_ps(_mm256_unpacklo_pd(a, c)), r[1] = _mm256_castpd_ps(_mm256_unpackhi_pd(a, c));
    r[2] = _mm256_castpd_ps(_mm256_unpacklo_pd(b, d)), r[3] = _mm256_castpd_ps(_mm256_unpackhi_pd(b, d));
}
inline void load_columns(const float* p, int64_t stride, V* out) {
    __m256 r[4];
    for (int j = 0; j < 4; ++j)
        r[j] = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p + j * stride)), _mm_loadu_ps(p + (4 + j) * stride), 1);
    transpose_4x4(r);
    for (int j = 0; j < 4; ++j) out[j].x = r[j];
}
inline void store_columns(const V* in, float* p, int64_t stride) {
    __m256 r[4] = {in[0].x, in[1].x, in[2].x, in[3].x};
    transpose_4x4(r);
    for (int j = 0; j < 4; ++j) {
        _mm_storeu_ps(p + j * stride, _mm256_castps256_ps128(r[j]));
        _mm_storeu_ps(p + (4 + j) * stride, _mm256_extractf128_ps(r[j], 1));
    }
}
inline void sums_of_four(const V* v, float* to) {
    __m256 all4 = _mm256_hadd_ps(_mm256_hadd_ps(v[0].x, v[1].x), _mm256_hadd_ps(v[2].x, v[3].x));
    _mm_storeu_ps(to, _mm_add_ps(_mm256_castps256_ps128(all4), _mm256_extractf128_ps(all4, 1)));
}

#else

constexpr int W = 4;
typedef float Lanes __attribute__((vector_size(16)));
typedef int32_t Bits __attribute__((vector_size(16)));
struct V {
    Lanes x;
};
struct Mask {
    Bits x;
};
inline V all(float s) { return {Lanes{s, s, s, s}}; }
inline V load(const float* p) {
    V a;
    __builtin_memcpy(&a.x, p, 16);
    return a;
}
inline void store(float* p, V a) { __builtin_memcpy(p, &a.x, 16); }
inline V operator+(V a, V b) { return {a.x + b.x}; }
inline V operator-(V a, V b) { return {a.x - b.x}; }
inline V operator*(V a, V b) { return {a.x * b.x}; }
inline V operator/(V a, V b) { return {a.x / b.x}; }
inline V fma(V a, V b, V c) { return {a.x * b.x + c.x}; }
inline V fnma(V a, V b, V c) { return {c.x - a.x * b.x}; }
inline Mask operator<(V a, V b) { return {a.x < b.x}; }
inline Mask operator>=(V a, V b) { return {a.x >= b.x}; }
inline Mask operator&(Mask a, Mask b) { return {a.x & b.x}; }
inline Mask without(Mask a, Mask b) { return {a.x & ~b.x}; }
inline bool any(Mask a) { return (a.x[0] | a.x[1] | a.x[2] | a.x[3]) != 0; }
inline V select(Mask m, V a, V b) { return {(Lanes)((m.x & (Bits)a.x) | (~m.x & (Bits)b.x))}; }
inline V only(Mask m, V a) { return {(Lanes)(m.x & (Bits)a.x)}; }
inline V min(V a, V b) { return select(a < b, a, b); }
inline V max(V a, V b) { return select(a < b, b, a); }
inline V sqrt(V a) {
    for (int i = 0; i < W; ++i) a.x[i] = __builtin_sqrtf(a.x[i]);
    return a;
}
inline V reciprocal(V a) { return all(1.0f) / a; }
inline Bits floor_of(V a) {
    Bits whole = __builtin_convertvector(a.x, Bits);
    return whole + (__builtin_convertvector(whole, Lanes) > a.x);  // a true comparison is -1
}
inline V fraction(V a) { return {a.x - __builtin_convertvector(floor_of(a), Lanes)}; }
inline V scale_by_floor(V mantissa, V a) { return {(Lanes)((Bits)mantissa.x + (floor_of(a) << 23))}; }
inline float sum(V a) { return (a.x[0] + a.x[2]) + (a.x[1] + a.x[3]); }
inline void load_columns(const float* p, int64_t stride, V* out) {
    for (int c = 0; c < 4; ++c) out[c].x = Lanes{p[c], p[stride + c], p[2 * stride + c], p[3 * stride + c]};
}
inline void store_columns(const V* in, float* p, int64_t stride) {
    for (int j = 0; j < W; ++j)
        for (int c = 0; c < 4; ++c) p[j * stride + c] = in[c].x[j];
}
inline void sums_of_four(const V* v, float* to) {
    for (int i = 0; i < 4; ++i) to[i] = sum(v[i]);
}

#endif

inline V operator-(V a) { return all(0.0f) - a; }
inline V magnitude(V a) { return max(a, -a); }

#if !defined(__AVX512F__)
inline V log2_of(V a) {
    alignas(64) float lanes[W];
    store(lanes, a);
    for (float& one : lanes) one = __builtin_log2f(one);
    return load(lanes);
}
#endif

// 2^a for `N` vectors with a in [-126, 1), step by step for all: a polynomial of degree 5 on [0, 1), relative error 2e-7.
template <int N> inline void exp2_of(const V* a, V* y) {
    constexpr float COEFFICIENTS[] = {1.877576608e-3f, 8.989340252e-3f, 5.582631792e-2f, 2.401536171e-1f, 6.931530732e-1f, 9.999999251e-1f};
    V f[N];
    for (int j = 0; j < N; ++j) f[j] = fraction(a[j]), y[j] = all(COEFFICIENTS[0]);
    for (int i = 1; i < 6; ++i)
        for (int j = 0; j < N; ++j) y[j] = fma(y[j], f[j], all(COEFFICIENTS[i]));
    for (int j = 0; j < N; ++j) y[j] = scale_by_floor(y[j], a[j]);
}

}  // namespace ASH_ISA
