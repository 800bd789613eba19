// Linear algebra of small matrices, those of many runs side by side: they are too small to be worked on one by one.
//
// Compiled as particles.cpp: NaN and infinity keep their meaning, and a run that has no result does no harm to its neighbours.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <tuple>
#include <vector>

#include "operators.h"

namespace {
// Numbers of as many runs as fill a register.
template <class T>
struct Side {
    typedef T Lanes __attribute__((vector_size(REGISTER), aligned(sizeof(T)), may_alias));
    static constexpr int64_t WIDE = REGISTER / sizeof(T);
    std::vector<T> own;

    explicit Side(int64_t count) : own(count * WIDE) {}
    Lanes* data() { return reinterpret_cast<Lanes*>(own.data()); }
};
template <class T>
using Lanes = typename Side<T>::Lanes;

template <class T>
Lanes<T> root(const Lanes<T>& a) {
    Lanes<T> found;
    const T* const from = reinterpret_cast<const T*>(&a);
    T* const to = reinterpret_cast<T*>(&found);
    for (int64_t lane = 0; lane < Side<T>::WIDE; ++lane) to[lane] = std::sqrt(from[lane]);
    return found;
}

// Matrices [R, rows, columns], or vectors [R, rows], that lie as their strides say.
template <class T>
struct View {
    const T* data;
    int64_t runs, rows, columns, step[3];

    explicit View(const Tensor& a) : data(numbers<T>(a)), runs(a.size(0)), rows(a.size(1)) {
        const bool flat = a.dim() < 3;
        columns = flat ? 1 : a.size(2);
        step[0] = a.stride(0), step[1] = a.stride(1), step[2] = flat ? 0 : a.stride(2);
    }

    // Those of the runs from `first` on, side by side; lanes without a run repeat the last one. Rows are `width` apart.
    void load(Lanes<T>* to, int64_t first, int64_t width) const {
        T* const out = reinterpret_cast<T*>(to);
        for (int64_t lane = 0; lane < Side<T>::WIDE; ++lane) {
            const T* from = data + std::min(first + lane, runs - 1) * step[0];
            for (int64_t i = 0; i < rows; ++i)
                for (int64_t j = 0; j < columns; ++j)
                    out[(i * width + j) * Side<T>::WIDE + lane] = from[i * step[1] + j * step[2]];
        }
    }
};

// `count` numbers of each run from `first` on, run after run.
template <class T>
void store(T* out, const Lanes<T>* from, int64_t first, int64_t runs, int64_t count) {
    const T* const one = reinterpret_cast<const T*>(from);
    for (int64_t lane = 0; lane < std::min(Side<T>::WIDE, runs - first); ++lane)
        for (int64_t i = 0; i < count; ++i) out[(first + lane) * count + i] = one[i * Side<T>::WIDE + lane];
}

// Lower triangular A of A A' = covariance [d, d], by the correlations, and 1 where there is one, as covariance.factor has it: where
// it fails, and by rounding alone, with a little more on the diagonal.
template <class T>
Lanes<T> rooted(Lanes<T>* low, const Lanes<T>* covariance, int64_t d, Lanes<T>* scratch) {  // of d + d * d
    Lanes<T>* const sd = scratch;
    Lanes<T>* const trial = sd + d;
    for (int64_t i = 0; i < d; ++i) {
        const Lanes<T> variance = covariance[i * d + i];
        sd[i] = root<T>(variance > 0 ? variance : Lanes<T>{} + 1);
    }
    const auto attempt = [&](Lanes<T>* a, T jitter) {
        Lanes<T> good = Lanes<T>{} + 1;
        for (int64_t j = 0; j < d; ++j) {
            for (int64_t i = j; i < d; ++i) {
                Lanes<T> sum = covariance[i * d + j] / (sd[i] * sd[j]) + (i == j ? jitter : T(0));
                for (int64_t k = 0; k < j; ++k) sum -= a[i * d + k] * a[j * d + k];
                if (i == j) {
                    good = sum > 0 ? good : Lanes<T>{};
                    a[i * d + i] = root<T>(sum > 0 ? sum : Lanes<T>{} + 1);
                } else {
                    a[i * d + j] = sum / a[j * d + j];
                }
            }
        }
        return good;
    };
    Lanes<T> good = attempt(low, 0);
    bool all = true;
    for (int64_t lane = 0; lane < Side<T>::WIDE; ++lane) all &= good[lane] > 0;
    if (!all) {
        const Lanes<T> healed = attempt(trial, std::is_same_v<T, float> ? T(1e-6) : T(1e-12));
        for (int64_t i = 0; i < d; ++i)
            for (int64_t j = 0; j <= i; ++j) low[i * d + j] = good > 0 ? low[i * d + j] : trial[i * d + j];
        good = good > 0 ? good : healed;
    }
    for (int64_t i = 0; i < d; ++i) {
        const Lanes<T> variance = covariance[i * d + i], scale = variance > 0 ? sd[i] : Lanes<T>{};
        good = variance >= 0 ? good : Lanes<T>{};
        for (int64_t j = 0; j < d; ++j) low[i * d + j] = j <= i ? low[i * d + j] * scale : Lanes<T>{};
    }
    return good;
}

// [A b] = low [rows, d + 1] taken up by Householder's reflections into high [d, d + 1], which is [I 0] before and then the triangle
// T'T = I + A'A, its diagonal positive, with T'^-1 A'b beside it. What is left of b stays in `low`: its square is the minimum of
// |A x - b|^2 + |x|^2.
template <class T>
Lanes<T> triangle(Lanes<T>* high, Lanes<T>* low, int64_t rows, int64_t d) {
    const int64_t width = d + 1;
    for (int64_t i = 0; i < d; ++i)
        for (int64_t c = 0; c < width; ++c) high[i * width + c] = Lanes<T>{} + T(i == c);
    for (int64_t j = 0; j < d; ++j) {
        Lanes<T> square = {};
        for (int64_t k = 0; k < rows; ++k) square += low[k * width + j] * low[k * width + j];
        const Lanes<T> pivot = high[j * width + j], norm = root<T>(pivot * pivot + square);
        // v = (pivot - norm, column) is reflected to its negative; v'v = -2 norm (pivot - norm), and 0 where the column is
        const Lanes<T> head = -square / (pivot + norm), once = 1 / norm;
        const Lanes<T> share = square > 0 ? -(pivot + norm) / (norm * square) : Lanes<T>{};
        high[j * width + j] = norm;
        for (int64_t c = j + 1; c < width; ++c) {
            Lanes<T> along = head * high[j * width + c];
            for (int64_t k = 0; k < rows; ++k) along += low[k * width + j] * low[k * width + c];
            high[j * width + c] += along * once;
            along *= share;
            for (int64_t k = 0; k < rows; ++k) low[k * width + c] += along * low[k * width + j];
        }
    }
    Lanes<T> left = {};
    for (int64_t k = 0; k < rows; ++k) left += low[k * width + d] * low[k * width + d];
    return left;
}

// A coefficient that is not zero, and its column.
template <class T>
struct Term {
    int64_t column;
    T by;
};

constexpr int64_t FEW = 4;  // sums at a time, so that none waits for itself

// Row and column a of sum w r r' [k, k] over points, from the diagonal on.
template <class T, int64_t S>
void squares(Lanes<T>* omega, const Lanes<T>* r, const T* weight, int64_t points, int64_t k, int64_t a) {
    for (int64_t next = a; next < k; next += S) {
        const int64_t b = std::min(next, k - S);  // the last ones overlap
        Lanes<T> sum[S] = {};
        for (int64_t p = 0; p < points; ++p) {
            const Lanes<T> own = weight[p] * r[p * k + a];
            for (int64_t c = 0; c < S; ++c) sum[c] += own * r[p * k + b + c];
        }
        for (int64_t c = 0; c < S; ++c) omega[a * k + b + c] = omega[(b + c) * k + a] = sum[c];
    }
}

// M [k, d] = sum w r xi' and what it leaves, sum w (r - M xi) (r - M xi)' [k, k], over points: r [points, k], which becomes what is
// left, and xi by its coefficients, up to last[p] those of point p. Most rules have points on the axes, one coefficient each.
template <class T>
void fitted(Lanes<T>* m, Lanes<T>* omega, Lanes<T>* r, const std::vector<Term<T>>& terms, const std::vector<int64_t>& last,
            const T* weight, int64_t k, int64_t d) {
    const int64_t points = static_cast<int64_t>(last.size());
    std::fill(reinterpret_cast<T*>(m), reinterpret_cast<T*>(m + k * d), T(0));
    for (int64_t p = 0, t = 0; p < points; ++p)
        for (; t < last[p]; ++t)
            for (int64_t a = 0; a < k; ++a) m[a * d + terms[t].column] += weight[p] * terms[t].by * r[p * k + a];
    for (int64_t p = 0, t = 0; p < points; ++p)
        for (; t < last[p]; ++t)
            for (int64_t a = 0; a < k; ++a) r[p * k + a] -= terms[t].by * m[a * d + terms[t].column];
    for (int64_t a = 0; a < k; ++a)
        if (k < FEW) squares<T, 1>(omega, r, weight, points, k, a);
        else squares<T, FEW>(omega, r, weight, points, k, a);
}

// e' covariance^-1 e by elimination on the lower triangle, which is lost: a sum of squares over pivots, infinite or NaN where one is 0.
template <class T>
Lanes<T> squared_length(Lanes<T>* e, Lanes<T>* covariance, int64_t d) {
    Lanes<T> sum = {};
    for (int64_t j = 0; j < d; ++j) {
        sum += e[j] * e[j] / covariance[j * d + j];
        for (int64_t i = j + 1; i < d; ++i) {
            const Lanes<T> by = covariance[i * d + j] / covariance[j * d + j];
            e[i] -= by * e[j];
            for (int64_t k = j + 1; k <= i; ++k) covariance[i * d + k] -= by * covariance[k * d + j];
        }
    }
    return sum;
}
}  // namespace

Tensor operators::squared_mahalanobis(const Tensor& e, const Tensor& covariance) {
    const int64_t systems = e.size(0), d = e.size(1);
    return by_type(e, [&](auto one) {
        using T = decltype(one);
        const Tensor out = fresh<T>({systems});
        const View<T> of_e(e), of_covariance(covariance);
        Side<T> left(d), whole(d * d);
        for (int64_t first = 0; first < systems; first += Side<T>::WIDE) {
            of_e.load(left.data(), first, 1);
            of_covariance.load(whole.data(), first, d);
            const Lanes<T> sum = squared_length<T>(left.data(), whole.data(), d);
            store(numbers<T>(out), &sum, first, systems, 1);
        }
        return out;
    });
}

std::tuple<Tensor, Tensor> operators::cholesky_factor(const Tensor& covariance) {
    const int64_t runs = covariance.size(0), d = covariance.size(1);
    return by_type(covariance, [&](auto one) {
        using T = decltype(one);
        const Tensor lower = fresh<T>({runs, d, d}), fine = fresh<bool>({runs});
        const View<T> from(covariance);
        Side<T> whole(d * d), low(d * d), scratch(d + d * d);
        for (int64_t first = 0; first < runs; first += Side<T>::WIDE) {
            from.load(whole.data(), first, d);
            const Lanes<T> good = rooted<T>(low.data(), whole.data(), d, scratch.data());
            store(numbers<T>(lower), low.data(), first, runs, d * d);
            for (int64_t lane = 0; lane < std::min(Side<T>::WIDE, runs - first); ++lane) numbers<bool>(fine)[first + lane] = good[lane] > 0;
        }
        return std::make_tuple(lower, fine);
    });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> operators::kalman_update(const Tensor& m, const Tensor& r, const Tensor& omega) {
    const int64_t runs = m.size(0), k = m.size(1), d = m.size(2), width = d + 1;
    return by_type(m, [&](auto one) {
        using T = decltype(one);
        const Tensor shift = fresh<T>({runs, d}), back = fresh<T>({runs, d, d}), least = fresh<T>({runs});
        const Tensor scales = fresh<T>({runs, k + d}), fine = fresh<bool>({runs});
        const View<T> of_m(m), of_r(r), of_omega(omega);
        Side<T> held(2 * k * k + k * width + 2 * d * width + k + d), scratch(k + k * k);
        Lanes<T>* const noise = held.data();
        Lanes<T>* const half = noise + k * k;
        Lanes<T>* const white = half + k * k;
        Lanes<T>* const high = white + k * width;
        Lanes<T>* const found = high + d * width;  // the shift, and then the root
        Lanes<T>* const scale = found + d * width;
        for (int64_t first = 0; first < runs; first += Side<T>::WIDE) {
            of_omega.load(noise, first, k);
            of_m.load(white, first, width);
            of_r.load(white + d, first, width);
            const Lanes<T> good = rooted<T>(half, noise, k, scratch.data());
            for (int64_t i = 0; i < k; ++i) {
                scale[i] = half[i * k + i];
                for (int64_t j = 0; j < i; ++j)
                    for (int64_t c = 0; c < width; ++c) white[i * width + c] -= half[i * k + j] * white[j * width + c];
                for (int64_t c = 0; c < width; ++c) white[i * width + c] /= scale[i];
            }
            const Lanes<T> left = triangle<T>(high, white, k, d);
            Lanes<T>* const inverse = found + d;
            for (int64_t i = d - 1; i >= 0; --i) {
                const Lanes<T> once = 1 / (scale[k + i] = high[i * width + i]);
                found[i] = high[i * width + d];
                for (int64_t c = 0; c < d; ++c) inverse[i * d + c] = Lanes<T>{} + T(i == c);
                for (int64_t j = i + 1; j < d; ++j) {
                    found[i] -= high[i * width + j] * found[j];
                    for (int64_t c = j; c < d; ++c) inverse[i * d + c] -= high[i * width + j] * inverse[j * d + c];
                }
                found[i] *= once;
                for (int64_t c = i; c < d; ++c) inverse[i * d + c] *= once;
            }
            store(numbers<T>(shift), found, first, runs, d);
            store(numbers<T>(back), inverse, first, runs, d * d);
            store(numbers<T>(least), &left, first, runs, 1);
            store(numbers<T>(scales), scale, first, runs, k + d);
            for (int64_t lane = 0; lane < std::min(Side<T>::WIDE, runs - first); ++lane) numbers<bool>(fine)[first + lane] = good[lane] > 0;
        }
        return std::make_tuple(shift, back, least, scales, fine);
    });
}

std::tuple<Tensor, Tensor> operators::fit_affine(const Tensor& r, const Tensor& xi, const Tensor& w) {
    const int64_t runs = r.size(0), points = r.size(1), k = r.size(2), d = xi.size(1);
    return by_type(r, [&](auto one) {
        using T = decltype(one);
        const Tensor m = fresh<T>({runs, k, d}), omega = fresh<T>({runs, k, k});
        std::vector<Term<T>> terms;
        std::vector<int64_t> last(points);
        const Packed<T> places(xi), weight(w);
        for (int64_t p = 0; p < points; ++p) {
            for (int64_t c = 0; c < d; ++c)
                if (const T by = places.data[p * d + c]; by != 0) terms.push_back({c, by});
            last[p] = static_cast<int64_t>(terms.size());
        }
        const View<T> from(r);
        Side<T> held(points * k + k * d + k * k);
        Lanes<T>* const off = held.data();
        Lanes<T>* const slope = off + points * k;
        Lanes<T>* const left = slope + k * d;
        for (int64_t first = 0; first < runs; first += Side<T>::WIDE) {
            from.load(off, first, k);
            fitted<T>(slope, left, off, terms, last, weight.data, k, d);
            store(numbers<T>(m), slope, first, runs, k * d);
            store(numbers<T>(omega), left, first, runs, k * k);
        }
        return std::make_tuple(m, omega);
    });
}
