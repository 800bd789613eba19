// Elementary functions of double precision without branches, so that a loop over particles becomes vector code.
//
// Errors against exact values, in units of the last place: exponential 2, logarithm 2, sine and cosine 2 up to LARGEST_ANGLE, arc
// tangent 3. They are not torch's bits, which depend on the processor. Coefficients of sine, cosine and arc tangent are those of
// S. L. Moshier's Cephes library, 1984-1995.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

namespace elementary {
// 1 / 0!, 1 / 1!, ..., 1 / (COUNT - 1)!
template <class T, int COUNT>
struct InverseFactorials {
    T of[COUNT];
    constexpr InverseFactorials() : of() {
        double factorial = 1;  // exact up to 18!
        for (int n = 0; n < COUNT; factorial *= ++n) of[n] = static_cast<T>(1 / factorial);
    }
    constexpr T operator[](int n) const { return of[n]; }
};

template <class T>
struct Exponential;
template <>
struct Exponential<double> {
    typedef int64_t Integer;
    static constexpr double LEAST = -800, MOST = 800, HIGH = 0x1.62e42fefap-1, LOW = 0x1.cf79abc9e3b3ap-40;
    static constexpr int TERMS = 13, FRACTION = 52, BIAS = 1023;
    static constexpr InverseFactorials<double, TERMS + 1> INVERSE_FACTORIAL{};
};
template <>
struct Exponential<float> {
    typedef int32_t Integer;
    static constexpr float LEAST = -120, MOST = 120, HIGH = 0x1.62ep-1f, LOW = 0x1.0bfbe8p-15f;
    static constexpr int TERMS = 7, FRACTION = 23, BIAS = 127;
    static constexpr InverseFactorials<float, TERMS + 1> INVERSE_FACTORIAL{};
};

template <class To, class From>
inline To same_bits(From a) {
    To b;
    static_assert(sizeof a == sizeof b);
    std::memcpy(&b, &a, sizeof b);
    return b;
}

// 2^k of a k in the range of normal numbers.
template <class T>
inline T power_of_two(int32_t k) {
    typedef typename Exponential<T>::Integer Integer;
    return same_bits<T>(static_cast<Integer>(static_cast<Integer>(k + Exponential<T>::BIAS) << Exponential<T>::FRACTION));
}

// x = k log 2 + r, and Taylor's series of e^r for |r| <= log(2) / 2. NaN counts as the least number: see `exponential_or_nan`.
template <class T>
inline T exponential(T x) {
    typedef Exponential<T> E;
    x = x > E::LEAST ? x : E::LEAST;  // e^x is 0 there
    x = x < E::MOST ? x : E::MOST;    // and infinite there
    const T k = std::rint(x * T(1.4426950408889634));
    const T r = (x - k * E::HIGH) - k * E::LOW;
    T series = E::INVERSE_FACTORIAL[E::TERMS];
    for (int n = E::TERMS - 1; n >= 0; --n) series = series * r + E::INVERSE_FACTORIAL[n];
    const int32_t whole = static_cast<int32_t>(k), half = whole / 2;  // 2^k may be subnormal, its two factors are not
    return series * power_of_two<T>(half) * power_of_two<T>(whole - half);
}
inline double exponential_or_nan(double x) { return x == x ? exponential(x) : x; }

// The sum of c[n] z^n.
template <int COUNT>
inline double polynomial(const double (&c)[COUNT], double z) {
    double sum = c[COUNT - 1];
    for (int n = COUNT - 2; n >= 0; --n) sum = sum * z + c[n];
    return sum;
}

// x = m 2^k with m in [sqrt(1/2), sqrt(2)): log m = 2 artanh s for s = (m - 1) / (m + 1), a series in s^2 up to 0.0295.
inline double logarithm(double x) {
    constexpr double SERIES[] = {2.0 / 3, 2.0 / 5, 2.0 / 7, 2.0 / 9, 2.0 / 11, 2.0 / 13, 2.0 / 15, 2.0 / 17, 2.0 / 19, 2.0 / 21};
    const double scaled = x < 0x1p-1022 ? x * 0x1p54 : x;  // a subnormal number has no exponent of its own
    const uint64_t above = same_bits<uint64_t>(scaled) - 0x3FE6A09E667F3BCDull;  // how far above sqrt(1/2)
    // k + 2^10 in the last bits of a number: an instruction from int64 to double is missing in older processors
    const double k = same_bits<double>(((above + (uint64_t{1024} << 52)) >> 52) | 0x4330000000000000ull) - (0x1p52 + 1024) -
                     (x < 0x1p-1022 ? 54.0 : 0.0);
    const double m = same_bits<double>((above & 0xFFFFFFFFFFFFFull) + 0x3FE6A09E667F3BCDull);
    const double f = m - 1, s = f / (m + 1), z = s * s, half = 0.5 * f * f;
    const double small = k * 0x1.a39ef35793c76p-33 + (s * (half + z * polynomial(SERIES, z)) - half);
    const double value = k * 0x1.62e42feep-1 + (f + small);
    return x > 0 ? x < HUGE_VAL ? value : x : x == 0 ? -HUGE_VAL : NAN;
}

constexpr double LARGEST_ANGLE = 1e6;  // rad; beyond it the loops take the functions of the C library

// Sine or cosine: the angle less k quarter turns, in [-pi/4, pi/4], by the series of both.
template <int QUARTERS>
inline double circular(double x) {
    constexpr double SINE[] = {-1.66666666666666307295e-1, 8.33333333332211858878e-3, -1.98412698295895385996e-4,
                               2.75573136213857245213e-6,  -2.50507477628578072866e-8, 1.58962301576546568060e-10};
    constexpr double COSINE[] = {4.16666666666665929218e-2,  -1.38888888888730564116e-3, 2.48015872888517045348e-5,
                                 -2.75573141792967388112e-7, 2.08757008419747316778e-9,  -1.13585365213876817300e-11};
    const double k = std::rint(x * 0x1.45f306dc9c883p-1);
    const double r = ((x - k * 0x1.921fb54400000p+0) - k * 0x1.0b4611a600000p-34) - k * 0x1.3198a2e037073p-69;
    const double z = r * r, sine = r + r * z * polynomial(SINE, z), cosine = (1 - 0.5 * z) + z * z * polynomial(COSINE, z);
    const int32_t turn = static_cast<int32_t>(k) + QUARTERS;
    const double part = turn & 1 ? cosine : sine;
    return turn & 2 ? -part : part;
}

// Angle of (x, y), as std::atan2: an octant, and a rational function below 0.66.
inline double arc_tangent(double y, double x) {
    constexpr double TOP[] = {-6.485021904942025371773e1, -1.228866684490136173410e2, -7.500855792314704667340e1,
                              -1.615753718733365076637e1, -8.750608600031904122785e-1};
    constexpr double BOTTOM[] = {1.945506571482613964425e2, 4.853903996359136964868e2, 4.328810604912902668951e2,
                                 1.650270098316988542046e2, 2.485846490142306297962e1, 1.0};
    const double a = std::fabs(y), b = std::fabs(x), most = a > b ? a : b, least = a > b ? b : a;
    const double t = most == 0 ? 0 : least == most ? 1 : least / most;  // also of infinity by infinity
    const bool wide = t > 0.66;
    const double s = wide ? (t - 1) / (t + 1) : t, z = s * s;
    double angle = s + s * (z * polynomial(TOP, z) / polynomial(BOTTOM, z));
    angle = wide ? 0x1.921fb54442d18p-1 + (angle + 0x1.1a62633145c07p-55) : angle;
    angle = a > b ? 0x1.921fb54442d18p+0 - (angle - 0x1.1a62633145c07p-54) : angle;
    angle = std::signbit(x) ? 0x1.921fb54442d18p+1 - (angle - 0x1.1a62633145c07p-53) : angle;
    return x == x && y == y ? std::copysign(angle, y) : x + y;
}

// Without overflow of the squares.
inline double hypotenuse(double x, double y) {
    const double a = std::fabs(x), b = std::fabs(y), most = a > b ? a : b, least = a > b ? b : a, ratio = least / most;
    const double length = most * std::sqrt(1 + ratio * ratio);
    return most == 0 ? least : std::isinf(most) ? most : length;
}
}  // namespace elementary
