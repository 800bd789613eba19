// Scores of a cloud against the truth, which a report wants at some instants.
//
// Compiled as particles.cpp: NaN and infinity keep their meaning.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <tuple>
#include <vector>

#include "operators.h"

namespace {
template <class T>
struct Weighted {
    T off, weight;
    bool operator<(const Weighted& other) const { return off < other.off; }
};

// Puts particles in order. By twice as many buckets of equal width as there are particles, which leaves little to be put in order:
// a third of the time of comparing alone. Where most share few buckets, those are sorted by comparing.
template <class T>
class Ordered {
    std::vector<int32_t> bucket, end;
    std::vector<Weighted<T>> found;

  public:
    explicit Ordered(int64_t particles) : bucket(particles), end(2 * particles + 1), found(particles) {}

    // None of the values is NaN.
    const std::vector<Weighted<T>>& operator()(const T* off, const T* weight) {
        const int32_t particles = static_cast<int32_t>(found.size()), buckets = 2 * particles;
        T least = off[0], most = off[0];
        for (int32_t i = 0; i < particles; ++i) least = off[i] < least ? off[i] : least;
        for (int32_t i = 0; i < particles; ++i) most = off[i] > most ? off[i] : most;
        const T by = (static_cast<T>(buckets) - 1) / (most - least);
        if (!(by > 0 && by < HUGE_VAL)) {  // all the same, or farther apart than there are numbers for
            for (int32_t i = 0; i < particles; ++i) found[i] = {off[i], weight[i]};
            std::sort(found.begin(), found.end());
            return found;
        }
        for (int32_t i = 0; i < particles; ++i)
            bucket[i] = std::min(static_cast<int32_t>((off[i] - least) * by), buckets - 1);
        std::fill(end.begin(), end.end(), 0);
        for (int32_t i = 0; i < particles; ++i) ++end[bucket[i] + 1];
        for (int32_t b = 0; b < buckets; ++b) end[b + 1] += end[b];  // so far where bucket b begins, at b
        for (int32_t i = 0; i < particles; ++i) found[end[bucket[i]]++] = {off[i], weight[i]};
        for (int32_t b = 0, begin = 0; b < buckets; begin = end[b++])
            if (end[b] - begin > 16) std::sort(found.begin() + begin, found.begin() + end[b]);
        for (int32_t i = 1; i < particles; ++i) {
            const Weighted<T> one = found[i];
            int32_t j = i;
            for (; j > 0 && one < found[j - 1]; --j) found[j] = found[j - 1];
            found[j] = one;
        }
        return found;
    }
};

// Continuous ranked probability score against 0 of each component, by its quantiles, and the probability below 0, of particles that
// lie at error + deviation; deviation [R, N, K] lies as its strides say. With a NaN among them the score is NaN.
template <class T>
void marginal_scores(T* crps, T* below, const T* error, const T* deviation, const T* weight, const int64_t* stride, int64_t runs,
                     int64_t particles, int64_t components) {
    std::vector<T> off(particles);
    Ordered<T> ordered(particles);
    for (int64_t r = 0; r < runs; ++r, weight += particles)
        for (int64_t k = 0; k < components; ++k, ++crps, ++below) {
            const T* from = deviation + r * stride[0] + k * stride[2];
            const T centre = error[r * components + k];
            bool known = true;
            T left = 0;
            for (int64_t i = 0; i < particles; ++i) off[i] = centre + from[i * stride[1]];
            for (int64_t i = 0; i < particles; ++i) known &= off[i] == off[i];
            for (int64_t i = 0; i < particles; ++i) left += weight[i] * (off[i] < 0 ? T(1) : T(0));
            for (int64_t i = 0; i < particles; ++i) left += weight[i] * (off[i] == 0 ? T(0.5) : T(0));
            double sum = 0, score = 0;
            if (known)
                for (const auto& [at, w] : ordered(off.data(), weight)) {
                    score += w * at * ((at > 0) - (sum + 0.5 * w));
                    sum += w;
                }
            *crps = known ? static_cast<T>(2 * score) : static_cast<T>(NAN);
            *below = left;
        }
}

// Energy scores against 0 of equally weighted points [R, S, n], by all pairs.
template <class T>
void energy_score(T* out, const T* points, int64_t runs, int64_t size, int64_t n) {
    std::vector<T> square(n);
    for (int64_t r = 0; r < runs; ++r, points += size * n) {
        double near = 0, apart = 0;
        for (int64_t i = -1; i < n; ++i) {  // from 0, and from each point to those after it
            std::fill(square.begin(), square.end(), T(0));
            for (int64_t k = 0; k < size; ++k) {
                const T *row = points + k * n, from = i < 0 ? T(0) : row[i];
                for (int64_t j = i + 1; j < n; ++j) square[j] += (row[j] - from) * (row[j] - from);
            }
            T sum = 0;
            for (int64_t j = i + 1; j < n; ++j) sum += std::sqrt(square[j]);
            (i < 0 ? near : apart) += sum;
        }
        out[r] = static_cast<T>(near / n - apart / (static_cast<double>(n) * n));
    }
}
}  // namespace

std::tuple<Tensor, Tensor> operators::marginal_scores(const Tensor& error, const Tensor& deviation, const Tensor& w) {
    const int64_t runs = error.size(0), components = error.size(1);
    return by_type(error, [&](auto one) {
        using T = decltype(one);
        const Tensor crps = fresh<T>({runs, components}), below = fresh<T>({runs, components});
        ::marginal_scores(numbers<T>(crps), numbers<T>(below), Packed<T>(error).data, numbers<T>(deviation), Packed<T>(w).data,
                        deviation.strides(), runs, w.size(1), components);
        return std::make_tuple(crps, below);
    });
}

Tensor operators::energy_score(const Tensor& points) {
    return by_type(points, [&](auto one) {
        using T = decltype(one);
        const Tensor out = fresh<T>({points.size(0)});
        ::energy_score(numbers<T>(out), Packed<T>(points, {0, 2, 1}).data, points.size(0), points.size(2), points.size(1));
        return out;
    });
}
