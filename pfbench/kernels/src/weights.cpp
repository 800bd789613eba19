// Normalisation of log weights: one exponential per particle and three passes over the particles of a run.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <tuple>

#include "operators.h"

namespace {
template <class T>
struct Exponential;
template <>
struct Exponential<double> {
    typedef int64_t Integer;
    static constexpr double LEAST = -800, HIGH = 0x1.62e42fefap-1, LOW = 0x1.cf79abc9e3b3ap-40;
    static constexpr int TERMS = 13, FRACTION = 52, BIAS = 1023;
};
template <>
struct Exponential<float> {
    typedef int32_t Integer;
    static constexpr float LEAST = -120, HIGH = 0x1.62ep-1f, LOW = 0x1.0bfbe8p-15f;
    static constexpr int TERMS = 7, FRACTION = 23, BIAS = 127;
};

// 2^k of a k in the range of normal numbers.
template <class T>
inline T power_of_two(int32_t k) {
    typedef typename Exponential<T>::Integer Integer;
    const Integer bits = static_cast<Integer>(k + Exponential<T>::BIAS) << Exponential<T>::FRACTION;
    T value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// e^x of x <= 0, to two units of the last place: x = k log 2 + r, and Taylor's series of e^r for |r| <= log(2) / 2.
template <class T>
inline T exponential(T x) {
    typedef Exponential<T> E;
    x = x > E::LEAST ? x : E::LEAST;  // e^x is 0 there
    const T k = std::rint(x * T(1.4426950408889634));
    const T r = (x - k * E::HIGH) - k * E::LOW;
    T series = 1;
    for (int n = E::TERMS; n > 0; --n) series = 1 + series * r * (T(1) / n);
    const int32_t whole = static_cast<int32_t>(k), half = whole / 2;  // 2^k may be subnormal, its two factors are not
    return series * power_of_two<T>(half) * power_of_two<T>(whole - half);
}

// Sums of numbers and of their squares.
template <class T>
std::pair<T, T> totals(const T* a, int64_t count) {
    constexpr int64_t LANES = 64 / sizeof(T);
    T sum[LANES] = {}, square[LANES] = {};
    int64_t i = 0;
    for (; i + LANES <= count; i += LANES)
        for (int64_t lane = 0; lane < LANES; ++lane) {
            sum[lane] += a[i + lane];
            square[lane] += a[i + lane] * a[i + lane];
        }
    for (int64_t lane = 0; i < count; ++i, ++lane) {
        sum[lane] += a[i];
        square[lane] += a[i] * a[i];
    }
    for (int64_t width = LANES / 2; width > 0; width /= 2)
        for (int64_t lane = 0; lane < width; ++lane) sum[lane] += sum[lane + width], square[lane] += square[lane + width];
    return {sum[0], square[0]};
}

// Log weights, logsumexp, weights and effective sample size of a run. Without resolved weights it gets equal ones.
template <class T>
void normalise(T* log_w, T* log_total, T* w, T* ess, const T* from, int64_t slots) {
    T top = -std::numeric_limits<T>::infinity();
    bool valid = true;
    for (int64_t i = 0; i < slots; ++i) {
        top = from[i] > top ? from[i] : top;
        valid &= from[i] == from[i];
    }
    valid &= std::isfinite(top) && top > -1 / std::numeric_limits<T>::epsilon();
    if (!valid) {
        std::fill(log_w, log_w + slots, -static_cast<T>(std::log(static_cast<double>(slots))));
        std::fill(w, w + slots, static_cast<T>(1.0 / static_cast<double>(slots)));
        *log_total = -std::numeric_limits<T>::infinity(), *ess = static_cast<T>(slots);
        return;
    }
#pragma omp simd
    for (int64_t i = 0; i < slots; ++i) w[i] = exponential(from[i] - top);
    const auto [total, square] = totals(w, slots);
    *log_total = top + std::log(total), *ess = total * total / square;
    const T minus = *log_total, by = 1 / total;
    for (int64_t i = 0; i < slots; ++i) {
        log_w[i] = from[i] - minus;
        w[i] *= by;
    }
}
}  // namespace

std::tuple<Tensor, Tensor, Tensor, Tensor> operators::normalise_weights(const Tensor& log_w) {
    const int64_t runs = log_w.size(0), slots = log_w.size(1);
    return by_type(log_w, [&](auto like) {
        using T = decltype(like);
        const Tensor log_out = fresh<T>({runs, slots}), log_total = fresh<T>({runs}), w = fresh<T>({runs, slots}), ess = fresh<T>({runs});
        const Packed<T> from(log_w);
        for (int64_t r = 0; r < runs; ++r)
            normalise(numbers<T>(log_out) + r * slots, numbers<T>(log_total) + r, numbers<T>(w) + r * slots, numbers<T>(ess) + r,
                      from.data + r * slots, slots);
        return std::make_tuple(log_out, log_total, w, ess);
    });
}
