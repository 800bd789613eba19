// The generator, for C++ and CUDA: Philox4x32-10 and the transform of Box and Muller. pfbench/kernels/philox.py is the same in torch.
//
// All engines draw the same bits: each operation rounds once, in the order written here, and none is joined with another (no fused
// multiply-add, which not every processor has). So compile with -ffp-contract=off and without -ffast-math. A change of a result
// is a new generator: raise GENERATOR_VERSION in pfbench/kernels/generator_version.py.
//
// A counter is (quarter, component, step, run), a key (seed, purpose). A block of four words a, b, c, d makes four numbers of single
// precision: (a, b) are radius and angle of the numbers at quarter k and k + q, (c, d) those at k + 2 q and k + 3 q. In double
// precision the block of component + 2^31 adds 20 bits to each word, so that a number of single precision is about the rounded one.
#pragma once
#ifndef __CUDACC__
#include <cmath>
#include <cstdint>
#include <cstring>
#define ON_DEVICE inline
#else
#define ON_DEVICE __device__ __forceinline__
#endif

namespace generator {
typedef unsigned int word;
typedef unsigned long long wide;

constexpr word M0 = 0xD2511F53u, M1 = 0xCD9E8D57u, W0 = 0x9E3779B9u, W1 = 0xBB67AE85u, LOW = 0x80000000u;

struct Words {
    word a, b, c, d;
};

ON_DEVICE Words philox(word c0, word c1, word c2, word c3, word k0, word k1) {
    for (int turn = 0; turn < 10; ++turn) {
        const wide p0 = (wide)c0 * M0, p1 = (wide)c2 * M1;
        c0 = (word)(p1 >> 32) ^ c1 ^ k0;
        c2 = (word)(p0 >> 32) ^ c3 ^ k1;
        c1 = (word)p1;
        c3 = (word)p0;
        k0 += W0;
        k1 += W1;
    }
    return {c0, c1, c2, c3};
}

#ifdef __CUDACC__
ON_DEVICE float add(float a, float b) { return __fadd_rn(a, b); }
ON_DEVICE float mul(float a, float b) { return __fmul_rn(a, b); }
// Quotient and root are those of __fdiv_rn and __fsqrt_rn, without their branch for arguments that never come here: the branches keep
// the two numbers of a pair, and the pairs, from being made at the same time.
ON_DEVICE float div(float a, float b) {  // b from 1.7 to 2.5, and a is 0 or at least 2^-24 times as large
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(b));
    r = __fmaf_rn(r, __fmaf_rn(-b, r, 1.0f), r);
    const float q = __fmul_rn(a, r);
    return __fmaf_rn(r, __fmaf_rn(-b, q, a), q);
}
ON_DEVICE float root(float a) {  // a is 0 or from 2^-24 to 2^6
    float r;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(a));
    r = fminf(r, 0x1p60f);  // of 0 it is infinite
    const float s = __fmul_rn(a, r);
    return __fmaf_rn(__fmaf_rn(-s, s, a), __fmul_rn(r, 0.5f), s);
}
ON_DEVICE double add(double a, double b) { return __dadd_rn(a, b); }
ON_DEVICE double mul(double a, double b) { return __dmul_rn(a, b); }
ON_DEVICE double div(double a, double b) { return __ddiv_rn(a, b); }
ON_DEVICE double root(double a) { return __dsqrt_rn(a); }
ON_DEVICE word bits(float a) { return __float_as_uint(a); }
ON_DEVICE wide bits(double a) { return (wide)__double_as_longlong(a); }
ON_DEVICE float number(word a) { return __uint_as_float(a); }
ON_DEVICE double number(wide a) { return __longlong_as_double((long long)a); }
#else
template <class T> ON_DEVICE T add(T a, T b) { return a + b; }
template <class T> ON_DEVICE T mul(T a, T b) { return a * b; }
template <class T> ON_DEVICE T div(T a, T b) { return a / b; }
template <class T> ON_DEVICE T root(T a) { return std::sqrt(a); }
template <class To, class From>
ON_DEVICE To same_bits(From a) {
    To b;
    std::memcpy(&b, &a, sizeof b);
    return b;
}
ON_DEVICE word bits(float a) { return same_bits<word>(a); }
ON_DEVICE wide bits(double a) { return same_bits<wide>(a); }
ON_DEVICE float number(word a) { return same_bits<float>(a); }
ON_DEVICE double number(wide a) { return same_bits<double>(a); }
#endif

// A non-negative integer below 2^52, without an instruction that older processors lack.
ON_DEVICE double real(wide a) { return add(number(a | 0x4330000000000000ull), -0x1p52); }

// A word, or two, as a number in (0, 1]; the second form is exact and never 1.
ON_DEVICE float unit(word high) { return mul(add((float)high, 0.5f), 0x1p-32f); }
ON_DEVICE double unit(word high, word low) {
    return mul(add(real((wide)high << 20 | low >> 12), 0.5), 0x1p-52);
}

// A word, or two, as an angle in [-1, 1] half turns.
ON_DEVICE float half_turns(word high) { return mul((float)(int)high, 0x1p-31f); }
ON_DEVICE double half_turns(word high, word low) {
    return add(mul(unit(high ^ 0x80000000u, low), 2.0), -1.0);  // exact: an odd multiple of 2^-52
}

// Coefficients of powers of the square, fitted by Remez' algorithm: -2 log((1 + s) / (1 - s)) / s for s^2 up to (3 - 2 sqrt 2)^2,
// sin(pi t) / t and cos(pi t) for t up to 1/2. Errors 2^-30, 2^-27, 2^-32 in single and 2^-59, 2^-61, 2^-57 in double precision.
template <class T> struct Series;
template <> struct Series<float> {
    ON_DEVICE static float log(float z) {
        return add(mul(add(mul(add(mul(-0.5985158085823059f, z), -0.7994958162307739f), z), -1.333336353302002f), z), -4.0f);
    }
    ON_DEVICE static float sine(float z) {
        float p = add(mul(0.07756039500236511f, z), -0.5982421040534973f);
        p = add(mul(p, z), 2.550069808959961f);
        p = add(mul(p, z), -5.167709827423096f);
        return add(mul(p, z), 3.1415927410125732f);
    }
    ON_DEVICE static float cosine(float z) {
        float p = add(mul(-0.024396715685725212f, z), 0.23493756353855133f);
        p = add(mul(p, z), -1.3352121114730835f);
        p = add(mul(p, z), 4.058709144592285f);
        p = add(mul(p, z), -4.934802055358887f);
        return add(mul(p, z), 1.0f);
    }
};
template <> struct Series<double> {
    ON_DEVICE static double log(double z) {
        double p = add(mul(-0x1.2f52a7e4021abp-2, z), -0x1.399939e94c893p-2);
        p = add(mul(p, z), -0x1.74669ea53e8f9p-2);
        p = add(mul(p, z), -0x1.c71c4fe53c39fp-2);
        p = add(mul(p, z), -0x1.2492494537380p-1);
        p = add(mul(p, z), -0x1.999999997abefp-1);
        p = add(mul(p, z), -0x1.55555555555aep+0);
        return add(mul(p, z), -4.0);
    }
    ON_DEVICE static double sine(double z) {
        double p = add(mul(0x1.9d1b86f1b22d8p-21, z), -0x1.6f79770e35db1p-16);
        p = add(mul(p, z), 0x1.e8f35e9d59d7cp-12);
        p = add(mul(p, z), -0x1.e3074ddd1d2c4p-8);
        p = add(mul(p, z), 0x1.50783485190b6p-4);
        p = add(mul(p, z), -0x1.32d2cce627542p-1);
        p = add(mul(p, z), 0x1.466bc6775aa6ep+1);
        p = add(mul(p, z), -0x1.4abbce625be52p+2);
        return add(mul(p, z), 0x1.921fb54442d18p+1);
    }
    ON_DEVICE static double cosine(double z) {
        double p = add(mul(0x1.167972088fcdep-18, z), -0x1.b69582e2f780ap-14);
        p = add(mul(p, z), 0x1.f9d2548937763p-10);
        p = add(mul(p, z), -0x1.a6d1efc969530p-6);
        p = add(mul(p, z), 0x1.e1f506813c9ebp-3);
        p = add(mul(p, z), -0x1.55d3c7e3bfc44p+0);
        p = add(mul(p, z), 0x1.03c1f081b5993p+2);
        p = add(mul(p, z), -0x1.3bd3cc9be45dbp+2);
        return add(mul(p, z), 1.0);
    }
};

// u = m 2^-k with m in [sqrt(1/2), sqrt(2)) and k from 0 on
ON_DEVICE float split(float u, float& k) {
    const int down = (int)(0x3F3504F3u + 0x7FFFFFu - bits(u)) >> 23;  // rounds up
    k = (float)down;
    return number(bits(u) + ((word)down << 23));
}
ON_DEVICE double split(double u, double& k) {
    const wide down = (0x3FE6A09E667F3BCDull + 0xFFFFFFFFFFFFFull - bits(u)) >> 52;
    k = real(down);
    return number(bits(u) + (down << 52));
}

// -2 log u
ON_DEVICE float squared_radius(float u) {
    float k;
    const float m = split(u, k), s = div(add(m, -1.0f), add(m, 1.0f));
    return add(mul(s, Series<float>::log(mul(s, s))), mul(k, 1.3862943649291992f));
}
ON_DEVICE double squared_radius(double u) {
    double k;
    const double m = split(u, k), s = div(add(m, -1.0), add(m, 1.0));
    return add(mul(s, Series<double>::log(mul(s, s))), mul(k, 0x1.62e42fefa39efp+0));
}

// Two independent standard normal numbers: radius by cosine and by sine of the angle v, in half turns.
template <class T>
ON_DEVICE void normal_pair(T u, T v, T& first, T& second) {
    const T radius = root(squared_radius(u)), size = v < T(0) ? -v : v;
    const T t = add(size, T(-0.5)), z = mul(t, t);
    const T sine = mul(t, Series<T>::sine(z)), cosine = Series<T>::cosine(z);  // cos v = -sin t, sin |v| = cos t
    first = mul(radius, -sine);
    second = mul(radius, v < T(0) ? -cosine : cosine);
}
}  // namespace generator
