// Random numbers of all counters of a call in one pass: see generator.h.
//
// A compiler of tensor expressions has no 32 x 32 -> 64 bit product of unsigned lanes and takes the 64 x 64 one, which costs three
// times as much; the generator is a third of a bootstrap filter's step, so it has this one loop of its own.
#include "generator.h"
#ifdef __AVX2__
#include <immintrin.h>
#endif

namespace {
using generator::word;

constexpr int BLOCK = 64;  // counters whose words stay in the first-level cache

typedef word Block[4][BLOCK];

// Four words for each of n counters (quarter, component, step, run), quarters from `first` on.
inline void words(word first, word component, word step, word run, word k0, word k1, int n, Block& out) {
    int i = 0;
#ifdef __AVX2__
    const auto multiply = [](__m256i v, __m256i m, __m256i& low) {  // both halves of eight 32 x 32 bit products
        const __m256i even = _mm256_mul_epu32(v, m), odd = _mm256_mul_epu32(_mm256_srli_epi64(v, 32), m);
        low = _mm256_blend_epi32(even, _mm256_slli_epi64(odd, 32), 0xAA);
        return _mm256_blend_epi32(_mm256_srli_epi64(even, 32), odd, 0xAA);
    };
    const __m256i m0 = _mm256_set1_epi32(static_cast<int>(generator::M0)), m1 = _mm256_set1_epi32(static_cast<int>(generator::M1));
    const __m256i lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
    for (; i < n; i += 16) {  // two chains of products at a time; beyond n lie words that nobody reads
        __m256i c0[2], c1[2], c2[2], c3[2], low0, low1;
        for (int j = 0; j < 2; ++j) {
            c0[j] = _mm256_add_epi32(_mm256_set1_epi32(static_cast<int>(first) + i + 8 * j), lanes);
            c1[j] = _mm256_set1_epi32(static_cast<int>(component));
            c2[j] = _mm256_set1_epi32(static_cast<int>(step));
            c3[j] = _mm256_set1_epi32(static_cast<int>(run));
        }
        word x = k0, y = k1;
        for (int round = 0; round < 10; ++round, x += generator::W0, y += generator::W1)
            for (int j = 0; j < 2; ++j) {
                const __m256i high0 = multiply(c0[j], m0, low0), high1 = multiply(c2[j], m1, low1);
                c0[j] = _mm256_xor_si256(_mm256_xor_si256(high1, c1[j]), _mm256_set1_epi32(static_cast<int>(x)));
                c2[j] = _mm256_xor_si256(_mm256_xor_si256(high0, c3[j]), _mm256_set1_epi32(static_cast<int>(y)));
                c1[j] = low1;
                c3[j] = low0;
            }
        for (int j = 0; j < 2; ++j) {
            _mm256_store_si256(reinterpret_cast<__m256i*>(out[0] + i + 8 * j), c0[j]);
            _mm256_store_si256(reinterpret_cast<__m256i*>(out[1] + i + 8 * j), c1[j]);
            _mm256_store_si256(reinterpret_cast<__m256i*>(out[2] + i + 8 * j), c2[j]);
            _mm256_store_si256(reinterpret_cast<__m256i*>(out[3] + i + 8 * j), c3[j]);
        }
    }
#endif
    for (; i < n; ++i) {
        const generator::Words four = generator::philox(first + i, component, step, run, k0, k1);
        out[0][i] = four.a;
        out[1][i] = four.b;
        out[2][i] = four.c;
        out[3][i] = four.d;
    }
}

void pairs(const Block& high, const Block&, int radial, int n, float* first, float* second) {
    const word *a = high[radial], *b = high[radial + 1];
#pragma omp simd
    for (int i = 0; i < n; ++i) generator::normal_pair(generator::unit(a[i]), generator::half_turns(b[i]), first[i], second[i]);
}

void pairs(const Block& high, const Block& low, int radial, int n, double* first, double* second) {
    const word *a = high[radial], *b = high[radial + 1], *c = low[radial], *d = low[radial + 1];
#pragma omp simd
    for (int i = 0; i < n; ++i)
        generator::normal_pair(generator::unit(a[i], c[i]), generator::half_turns(b[i], d[i]), first[i], second[i]);
}

// Fills out [W, R, 4 Q] of runs [R], W components from `first` on and Q quarters: by work(high words, low words, n, first of n numbers).
template <bool LOW_WORDS, class T, class F>
void fill(T* out, const int64_t* run, int64_t runs, int64_t first, int64_t components, int64_t quarters, int64_t step, int64_t seed,
          int64_t purpose, F work) {
    alignas(64) Block high, low;
    for (int64_t w = first; w < first + components; ++w)
        for (int64_t r = 0; r < runs; ++r, out += 4 * quarters)
            for (int64_t q = 0; q < quarters; q += BLOCK) {
                const int n = static_cast<int>(quarters - q < BLOCK ? quarters - q : BLOCK);
                const auto draw = [&](word component, Block& to) {
                    words(static_cast<word>(q), component, static_cast<word>(step), static_cast<word>(run[r]), static_cast<word>(seed),
                          static_cast<word>(purpose), n, to);
                };
                draw(static_cast<word>(w), high);
                if (LOW_WORDS) draw(static_cast<word>(w) + generator::LOW, low);
                work(high, low, n, out + q);
            }
}

template <class T>
void normals(T* out, const int64_t* run, int64_t runs, int64_t first, int64_t components, int64_t quarters, int64_t step, int64_t seed,
             int64_t purpose) {
    fill<sizeof(T) == 8>(out, run, runs, first, components, quarters, step, seed, purpose, [&](const Block& high, const Block& low, int n, T* to) {
        pairs(high, low, 0, n, to, to + quarters);
        pairs(high, low, 2, n, to + 2 * quarters, to + 3 * quarters);
    });
}
}  // namespace

extern "C" void normals_float(float* out, const int64_t* run, int64_t runs, int64_t first, int64_t components, int64_t quarters,
                              int64_t step, int64_t seed, int64_t purpose) {
    normals(out, run, runs, first, components, quarters, step, seed, purpose);
}

extern "C" void normals_double(double* out, const int64_t* run, int64_t runs, int64_t first, int64_t components, int64_t quarters,
                               int64_t step, int64_t seed, int64_t purpose) {
    normals(out, run, runs, first, components, quarters, step, seed, purpose);
}

// On (0, 1): odd multiples of 2^-53.
extern "C" void uniforms(double* out, const int64_t* run, int64_t runs, int64_t components, int64_t quarters, int64_t step, int64_t seed,
                         int64_t purpose) {
    fill<true>(out, run, runs, 0, components, quarters, step, seed, purpose, [&](const Block& high, const Block& low, int n, double* to) {
        for (int k = 0; k < 4; ++k)
            for (int i = 0; i < n; ++i) to[k * quarters + i] = generator::unit(high[k][i], low[k][i]);
    });
}
