// Standard normals from Philox4x32-10 by Box and Muller, as draws.py makes them, in one pass.
//
// A compiler of tensor expressions has no 32 x 32 -> 64 bit product of unsigned lanes and takes the 64 x 64 one, which costs three
// times as much; the generator is a third of a bootstrap filter's step, so it has this one loop of its own.
#include <cmath>
#include <cstdint>
#ifdef __AVX2__
#include <immintrin.h>
#endif

namespace {
constexpr int BLOCK = 64;  // counters whose words stay in the first-level cache

constexpr uint32_t M0 = 0xD2511F53u, M1 = 0xCD9E8D57u, W0 = 0x9E3779B9u, W1 = 0xBB67AE85u;

// Four words for each of n counters (quarter, component, step, run), quarters from `first` on.
inline void words(uint32_t first, uint32_t component, uint32_t step, uint32_t run, uint32_t k0, uint32_t k1, int n,
                  uint32_t* a, uint32_t* b, uint32_t* c, uint32_t* d) {
    for (int i = 0; i < n; ++i) a[i] = first + static_cast<uint32_t>(i);
    int i = 0;
#ifdef __AVX2__
    const auto multiply = [](__m256i v, __m256i m, __m256i& low) {  // both halves of eight 32 x 32 bit products
        const __m256i even = _mm256_mul_epu32(v, m), odd = _mm256_mul_epu32(_mm256_srli_epi64(v, 32), m);
        low = _mm256_blend_epi32(even, _mm256_slli_epi64(odd, 32), 0xAA);
        return _mm256_blend_epi32(_mm256_srli_epi64(even, 32), odd, 0xAA);
    };
    const __m256i m0 = _mm256_set1_epi32(static_cast<int>(M0)), m1 = _mm256_set1_epi32(static_cast<int>(M1));
    for (; i < n; i += 8) {  // beyond n lie words that nobody reads
        __m256i c0 = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(a + i)), c1 = _mm256_set1_epi32(static_cast<int>(component));
        __m256i c2 = _mm256_set1_epi32(static_cast<int>(step)), c3 = _mm256_set1_epi32(static_cast<int>(run)), low0, low1;
        uint32_t x = k0, y = k1;
        for (int round = 0; round < 10; ++round, x += W0, y += W1) {
            const __m256i high0 = multiply(c0, m0, low0), high1 = multiply(c2, m1, low1);
            c0 = _mm256_xor_si256(_mm256_xor_si256(high1, c1), _mm256_set1_epi32(static_cast<int>(x)));
            c2 = _mm256_xor_si256(_mm256_xor_si256(high0, c3), _mm256_set1_epi32(static_cast<int>(y)));
            c1 = low1;
            c3 = low0;
        }
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(a + i), c0);
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(b + i), c1);
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(c + i), c2);
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(d + i), c3);
    }
#endif
    for (; i < n; ++i) {
        uint32_t c0 = a[i], c1 = component, c2 = step, c3 = run, x = k0, y = k1;
        for (int round = 0; round < 10; ++round, x += W0, y += W1) {
            const uint64_t p0 = uint64_t{M0} * c0, p1 = uint64_t{M1} * c2;
            c0 = static_cast<uint32_t>(p1 >> 32) ^ c1 ^ x;
            c1 = static_cast<uint32_t>(p1);
            c2 = static_cast<uint32_t>(p0 >> 32) ^ c3 ^ y;
            c3 = static_cast<uint32_t>(p0);
        }
        a[i] = c0;
        b[i] = c1;
        c[i] = c2;
        d[i] = c3;
    }
}

// cos(pi v) and sin(pi v) / v as polynomials in v^2, v in [-1, 1): Chebyshev fits of degree 6, off by less than 1e-6 in this arithmetic.
constexpr float COSINE[] = {1.0f, -4.9348011f, 4.05869484f, -1.33515847f, 0.235029802f, -0.0253589842f, 0.00159391074f};
constexpr float SINE[] = {3.14159274f, -5.16771269f, 2.55016041f, -0.59924233f, 0.0820818916f, -0.00727531593f, 0.000395280455f};

inline float horner(const float (&coefficients)[7], float z) {
    float value = coefficients[6];
    for (int k = 5; k >= 0; --k) value = value * z + coefficients[k];
    return value;
}

inline void pairs(const uint32_t* radial, const uint32_t* angular, int n, float* first, float* second) {
#pragma omp simd
    for (int i = 0; i < n; ++i) {
        const float radius = std::sqrt(-2.0f * std::log((static_cast<float>(radial[i]) + 0.5f) * 0x1p-32f));
        const float v = static_cast<float>(static_cast<int32_t>(angular[i])) * 0x1p-31f;
        first[i] = radius * horner(COSINE, v * v);
        second[i] = radius * v * horner(SINE, v * v);
    }
}
}  // namespace

// out [W, R, 4 Q] of runs [R], W components and Q quarters.
extern "C" void normals(float* out, const int64_t* run, int64_t runs, int64_t components, int64_t quarters, int64_t step, int64_t key0,
                        int64_t key1) {
    alignas(64) uint32_t a[BLOCK], b[BLOCK], c[BLOCK], d[BLOCK];
    for (int64_t w = 0; w < components; ++w)
        for (int64_t r = 0; r < runs; ++r, out += 4 * quarters)
            for (int64_t q = 0; q < quarters; q += BLOCK) {
                const int n = static_cast<int>(quarters - q < BLOCK ? quarters - q : BLOCK);
                words(static_cast<uint32_t>(q), static_cast<uint32_t>(w), static_cast<uint32_t>(step), static_cast<uint32_t>(run[r]),
                      static_cast<uint32_t>(key0), static_cast<uint32_t>(key1), n, a, b, c, d);
                pairs(a, b, n, out + q, out + quarters + q);
                pairs(c, d, n, out + 2 * quarters + q, out + 3 * quarters + q);
            }
}

// Uniforms on (0, 1): out [W, R, 4 Q], as normals.
extern "C" void uniforms(double* out, const int64_t* run, int64_t runs, int64_t components, int64_t quarters, int64_t step, int64_t key0,
                         int64_t key1) {
    alignas(64) uint32_t word[4][BLOCK];
    for (int64_t w = 0; w < components; ++w)
        for (int64_t r = 0; r < runs; ++r, out += 4 * quarters)
            for (int64_t q = 0; q < quarters; q += BLOCK) {
                const int n = static_cast<int>(quarters - q < BLOCK ? quarters - q : BLOCK);
                words(static_cast<uint32_t>(q), static_cast<uint32_t>(w), static_cast<uint32_t>(step), static_cast<uint32_t>(run[r]),
                      static_cast<uint32_t>(key0), static_cast<uint32_t>(key1), n, word[0], word[1], word[2], word[3]);
                for (int k = 0; k < 4; ++k)
                    for (int i = 0; i < n; ++i) out[k * quarters + q + i] = (word[k][i] + 0.5) * 0x1p-32;
            }
}
