// Normalisation of log weights: one exponential per particle and three passes over the particles of a run. Mixtures of Gaussian kernels.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <tuple>
#include <vector>

#include "elementary.h"
#include "operators.h"

namespace {
using elementary::exponential;

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

// The mixture of the kernels of a run, with its centres component by component. A few points share what they read of a centre.
template <class T>
class Mixture {
    typedef T Lanes __attribute__((vector_size(REGISTER), aligned(sizeof(T)), may_alias));
    static constexpr int64_t WIDE = REGISTER / sizeof(T), FEW = 4;
    const int64_t components, count, padded;
    std::vector<T> centre, log_weight, term;

  public:
    Mixture(int64_t components, int64_t count)
        : components(components), count(count), padded((count + WIDE - 1) / WIDE * WIDE), centre(components * padded),
          log_weight(padded, -std::numeric_limits<T>::infinity()), term(FEW * padded) {}

    void set(const T* centres, int64_t plane, const T* log_w) {
        for (int64_t k = 0; k < components; ++k) std::copy_n(centres + k * plane, count, centre.data() + k * padded);
        std::copy_n(log_w, count, log_weight.data());
    }

    void evaluate(T* out, const T* a, int64_t plane, int64_t points) {
        for (int64_t first = 0; first < points; first += FEW) {
            const int64_t here = std::min(FEW, points - first);
            const T* point[FEW];
            for (int64_t f = 0; f < FEW; ++f) point[f] = a + first + std::min(f, here - 1);
            for (int64_t j = 0; j < padded; j += WIDE) {
                Lanes square[FEW] = {};
                for (int64_t k = 0; k < components; ++k) {
                    const Lanes at = *reinterpret_cast<const Lanes*>(centre.data() + k * padded + j);
                    for (int64_t f = 0; f < FEW; ++f) {
                        const Lanes apart = at - point[f][k * plane];
                        square[f] += apart * apart;
                    }
                }
                const Lanes weight = *reinterpret_cast<const Lanes*>(log_weight.data() + j);
                for (int64_t f = 0; f < FEW; ++f) *reinterpret_cast<Lanes*>(term.data() + f * padded + j) = weight - T(0.5) * square[f];
            }
            for (int64_t f = 0; f < here; ++f) out[first + f] = log_sum(term.data() + f * padded);
        }
    }

  private:
    T log_sum(T* terms) const {
        constexpr T INFINITE = std::numeric_limits<T>::infinity();
        T top = -INFINITE;
        int32_t wrong = 0;
#pragma omp simd reduction(max : top) reduction(| : wrong)
        for (int64_t i = 0; i < padded; ++i) {
            top = terms[i] > top ? terms[i] : top;
            wrong |= terms[i] != terms[i];
        }
        if (wrong) return std::numeric_limits<T>::quiet_NaN();
        if (!std::isfinite(top)) return top;
#pragma omp simd
        for (int64_t i = 0; i < padded; ++i) terms[i] = exponential(terms[i] - top);
        return top + std::log(totals(terms, padded).first);
    }
};

// A column [R, 1] that holds for all slots, or numbers [R, N], in rows.
template <class T>
struct Rows {
    const Packed<T> packed;
    const int64_t across, down;
    explicit Rows(const Tensor& a) : packed(a), across(a.size(1) == 1 ? 0 : 1), down(a.size(1)) {}
    const T* row(int64_t r) const { return packed.data + r * down; }
};

template <class T, int FIRST, int SECOND>  // strides, so that the compiler makes vector code of each case
void add_row(T* out, const T* terms, const T* first, const T* second, int64_t slots) {
    for (int64_t i = 0; i < slots; ++i) {
        const T sum = terms[i] + first[i * FIRST] + second[i * SECOND];
        out[i] = sum == sum ? sum : -std::numeric_limits<T>::infinity();
    }
}
}  // namespace

// for tape.cpp
extern "C" void normalise_double(double* log_w, double* log_total, double* w, double* ess, const double* from, int64_t slots) {
    normalise(log_w, log_total, w, ess, from, slots);
}

Tensor operators::sum_log_weights(const Tensor& log_likelihood, const Tensor& log_w, const Tensor& log_ratio) {
    const int64_t runs = log_likelihood.size(0), slots = log_likelihood.size(1);
    return by_type(log_likelihood, [&](auto like) {
        using T = decltype(like);
        const Tensor out = fresh<T>({runs, slots});
        const Packed<T> terms(log_likelihood);
        const Rows<T> first(log_w), second(log_ratio);
        const auto add = first.across ? second.across ? add_row<T, 1, 1> : add_row<T, 1, 0> : second.across ? add_row<T, 0, 1> : add_row<T, 0, 0>;
        for (int64_t r = 0; r < runs; ++r)
            add(numbers<T>(out) + r * slots, terms.data + r * slots, first.row(r), second.row(r), slots);
        return out;
    });
}

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

Tensor operators::log_mixture(const Tensor& a, const Tensor& centres, const Tensor& log_w) {
    const int64_t runs = a.size(0), points = a.size(1), components = a.size(2), count = centres.size(1);
    return by_type(a, [&](auto like) {
        using T = decltype(like);
        const Tensor out = fresh<T>({runs, points});
        const Packed<T> at(a, COMPONENTS_FIRST), centre(centres, COMPONENTS_FIRST), weight(log_w);
        Mixture<T> mixture(components, count);
        for (int64_t r = 0; r < runs; ++r) {
            mixture.set(centre.data + r * count, runs * count, weight.data + r * count);
            mixture.evaluate(numbers<T>(out) + r * points, at.data + r * points, runs * points, points);
        }
        return out;
    });
}
