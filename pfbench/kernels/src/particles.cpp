// The loops over particles of a bootstrap filter's step, one run at a time, so that a run's particles stay in the first-level cache.
//
// Particles lie component by component: x [D, R, N]. Compiled without -ffinite-math-only: NaN and infinity keep their meaning.
// At the end are the operators, see operators.toml.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <numeric>
#include <tuple>
#include <vector>

#include "operators.h"

// of random_normal.cpp
extern "C" void normals_float(float*, const int64_t*, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t);
extern "C" void normals_double(double*, const int64_t*, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t);
extern "C" void uniforms(double*, const int64_t*, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t);
// of resampling.cpp
extern "C" void systematic_float(int64_t*, const float*, const double*, const double*, int64_t, int64_t);
extern "C" void systematic_double(int64_t*, const double*, const double*, const double*, int64_t, int64_t);

namespace {
inline void systematic(int64_t* ancestor, const float* w, const double* n, const double* u, int64_t runs, int64_t slots) { systematic_float(ancestor, w, n, u, runs, slots); }
inline void systematic(int64_t* ancestor, const double* w, const double* n, const double* u, int64_t runs, int64_t slots) { systematic_double(ancestor, w, n, u, runs, slots); }

// Copies parents: out [D, R, M] of x [D, R, N].
template <class T>
void copied(T* out, const T* x, const int64_t* ancestor, int64_t components, int64_t runs, int64_t slots, int64_t wanted) {
    std::vector<int32_t> from(wanted);
    for (int64_t r = 0; r < runs; ++r, ancestor += wanted) {
        for (int64_t j = 0; j < wanted; ++j) from[j] = static_cast<int32_t>(ancestor[j]);  // half as long
        for (int64_t d = 0; d < components; ++d) {
            const T* row = x + (d * runs + r) * slots;
            T* to = out + (d * runs + r) * wanted;
            for (int64_t j = 0; j < wanted; ++j) to[j] = row[from[j]];
        }
    }
}

// -1/2 sum ((y - mean) scale)^2 - constant; y, scale and constant are of a run, mean [R, N, K] lies as its strides say.
template <class T>
void log_normal(T* out, const T* y, const T* mean, const T* scale, const T* constant, const int64_t* stride, int64_t runs,
                int64_t particles, int64_t components) {
    for (int64_t r = 0; r < runs; ++r, out += particles) {
        for (int64_t i = 0; i < particles; ++i) out[i] = -constant[r];
        for (int64_t k = 0; k < components; ++k) {
            const T* at = mean + r * stride[0] + k * stride[2];
            const T centre = y[r * components + k], by = scale[r * components + k];
            if (stride[1] == 1)  // known to the compiler
                for (int64_t i = 0; i < particles; ++i) {
                    const T z = (centre - at[i]) * by;
                    out[i] -= T(0.5) * z * z;
                }
            else
                for (int64_t i = 0; i < particles; ++i) {
                    const T z = (centre - at[i * stride[1]]) * by;
                    out[i] -= T(0.5) * z * z;
                }
        }
    }
}

// Rows of sums of terms, the ends of which are in `last`, for particles that fill S registers or more.
template <class T, int S>
void summed(T* const* out, const Product<T>* terms, const std::vector<int64_t>& last, int64_t particles) {
    typedef T Lanes __attribute__((vector_size(REGISTER), aligned(sizeof(T)), may_alias));
    constexpr int64_t WIDE = S * REGISTER / sizeof(T);
    for (int64_t next = 0; next < particles; next += WIDE) {
        const int64_t at = std::min(next, particles - WIDE);  // the last ones overlap
        for (int64_t d = 0, t = 0; d < static_cast<int64_t>(last.size()); ++d) {
            Lanes sum[S] = {};
            for (; t < last[d]; ++t) {
                const Lanes* from = reinterpret_cast<const Lanes*>(terms[t].from + at);
                for (int k = 0; k < S; ++k) sum[k] += terms[t].by * from[k];
            }
            for (int k = 0; k < S; ++k) reinterpret_cast<Lanes*>(out[d] + at)[k] = sum[k];
        }
    }
}

template <class T>
void sums(T* const* out, const Product<T>* terms, const std::vector<int64_t>& last, int64_t particles) {
    constexpr int64_t WIDE = REGISTER / sizeof(T);
    if (particles >= 8 * WIDE) return summed<T, 8>(out, terms, last, particles);
    if (particles >= 4 * WIDE) return summed<T, 4>(out, terms, last, particles);
    if (particles >= WIDE) return summed<T, 1>(out, terms, last, particles);
    for (int64_t d = 0, t = 0; d < static_cast<int64_t>(last.size()); ++d) {
        std::fill_n(out[d], particles, T(0));
        for (; t < last[d]; ++t)
            for (int64_t at = 0; at < particles; ++at) out[d][at] += terms[t].by * terms[t].from[at];
    }
}

// out = phi x + gain w of each particle, by the coefficients that are not zero: in error models of an INS three in four are.
template <class T>
void affine(T* out, const T* phi, const T* x, const T* gain, const T* w, int64_t one_phi, int64_t one_gain, int64_t runs,
            int64_t particles, int64_t rows, int64_t states, int64_t noises) {
    std::vector<Product<T>> terms(rows * (states + noises));
    std::vector<int64_t> last(rows);
    std::vector<T*> to(rows);
    const int64_t plane = runs * particles;
    for (int64_t r = 0; r < runs; ++r, x += particles, w += particles, out += particles) {
        int64_t count = 0;
        const auto add = [&](const T* row, const T* from, int64_t many) {
            for (int64_t k = 0; k < many; ++k)
                if (row[k] != 0) terms[count++] = {from + k * plane, row[k]};
        };
        for (int64_t d = 0; d < rows; ++d) {
            add(phi + ((one_phi ? 0 : r * rows) + d) * states, x, states);
            add(gain + ((one_gain ? 0 : r * rows) + d) * noises, w, noises);
            last[d] = count, to[d] = out + d * plane;
        }
        sums(to.data(), terms.data(), last, particles);
    }
}

// How many of the values 0 to 2 N - 1 occur at slots that hold a particle. Where values do not fall from slot to slot, as after
// systematic resampling, each new one begins where it differs from the one before.
template <class T>
void distinct(int64_t* count, const int64_t* value, const T* log_weight, int64_t runs, int64_t slots) {
    std::vector<uint8_t> there;
    for (int64_t r = 0; r < runs; ++r, value += slots, log_weight += slots) {
        int64_t falls = 0, holes = 0, begun = 1;
        for (int64_t i = 1; i < slots; ++i) falls |= value[i] < value[i - 1];
        for (int64_t i = 0; i < slots; ++i) holes |= !(log_weight[i] > -HUGE_VAL);
        for (int64_t i = 1; i < slots; ++i) begun += value[i] != value[i - 1];
        if (!falls && !holes) {
            count[r] = begun;
            continue;
        }
        there.assign(2 * slots, 0);
        for (int64_t i = 0; i < slots; ++i) there[value[i]] |= log_weight[i] > -HUGE_VAL;
        count[r] = 0;
        for (const uint8_t one : there) count[r] += one;
    }
}

// Adds the products of A rows with B others, lane by lane, to A x B sums; rows of both lie `chunk` numbers apart. Nine sums and what
// goes into them fit where there are sixteen registers.
template <class T, int A, int B>
void products(T* sums, int64_t down, const T* some, const T* others, int64_t chunk, int64_t particles) {
    typedef T Lanes __attribute__((vector_size(REGISTER), aligned(sizeof(T)), may_alias));
    constexpr int64_t WIDE = REGISTER / sizeof(T);
    Lanes sum[A][B];
    for (int a = 0; a < A; ++a)
        for (int b = 0; b < B; ++b) sum[a][b] = *reinterpret_cast<const Lanes*>(sums + a * down + b * WIDE);
    for (int64_t i = 0; i < particles; i += WIDE) {
        Lanes left[A];
        for (int a = 0; a < A; ++a) left[a] = *reinterpret_cast<const Lanes*>(some + a * chunk + i);
        for (int b = 0; b < B; ++b) {
            const Lanes right = *reinterpret_cast<const Lanes*>(others + b * chunk + i);
            for (int a = 0; a < A; ++a) sum[a][b] += left[a] * right;
        }
    }
    for (int a = 0; a < A; ++a)
        for (int b = 0; b < B; ++b) *reinterpret_cast<Lanes*>(sums + a * down + b * WIDE) = sum[a][b];
}

// Covariances of the pairs of each group of components; x [R, N, K] lies as its strides say. Particles are taken by chunks that stay
// in the first-level cache, and pairs by threes with threes, so that a number that is loaded goes into three sums.
template <class T>
void spread(T* out, const T* x, const T* mean, const T* weight, const int64_t* component, const int64_t* stride, int64_t groups,
            int64_t size, int64_t runs, int64_t particles, int64_t components) {
    constexpr int64_t WIDE = REGISTER / sizeof(T), CHUNK = 1024 / sizeof(T);
    typedef void (*Tile)(T*, int64_t, const T*, const T*, int64_t, int64_t);
    constexpr Tile TILES[3][3] = {{products<T, 1, 1>, products<T, 1, 2>, products<T, 1, 3>},
                                  {products<T, 2, 1>, products<T, 2, 2>, products<T, 2, 3>},
                                  {products<T, 3, 1>, products<T, 3, 2>, products<T, 3, 3>}};
    const int64_t down = size * WIDE;
    std::vector<T> off(size * CHUNK), weighed(size * CHUNK), sums(groups * size * down);
    for (int64_t r = 0; r < runs; ++r, weight += particles) {
        std::fill(sums.begin(), sums.end(), T(0));
        for (int64_t first = 0; first < particles; first += CHUNK) {
            const int64_t many = std::min(CHUNK, particles - first), whole = (many + WIDE - 1) / WIDE * WIDE;
            for (int64_t g = 0; g < groups; ++g) {
                for (int64_t a = 0; a < size; ++a) {
                    const int64_t k = component[g * size + a];
                    const T* from = x + r * stride[0] + first * stride[1] + k * stride[2];
                    const T centre = mean[r * components + k];
                    T *const __restrict plain = off.data() + a * CHUNK, *const __restrict heavy = weighed.data() + a * CHUNK;
                    if (stride[1] == 1)  // known to the compiler
                        for (int64_t i = 0; i < many; ++i) heavy[i] = weight[first + i] * (plain[i] = from[i] - centre);
                    else
                        for (int64_t i = 0; i < many; ++i)
                            heavy[i] = weight[first + i] * (plain[i] = from[i * stride[1]] - centre);
                    for (int64_t i = many; i < whole; ++i) plain[i] = heavy[i] = 0;
                }
                for (int64_t a = 0; a < size; a += 3)
                    for (int64_t b = a; b < size; b += 3)
                        TILES[std::min<int64_t>(size - a, 3) - 1][std::min<int64_t>(size - b, 3) - 1](
                            sums.data() + (g * size + a) * down + b * WIDE, down, weighed.data() + a * CHUNK,
                            off.data() + b * CHUNK, CHUNK, whole);
            }
        }
        for (int64_t g = 0; g < groups; ++g, out += size * size)
            for (int64_t a = 0; a < size; ++a)
                for (int64_t b = a; b < size; ++b) {
                    const T* lanes = sums.data() + (g * size + a) * down + b * WIDE;
                    T all = 0;
                    for (int64_t lane = 0; lane < WIDE; ++lane) all += lanes[lane];
                    out[a * size + b] = out[b * size + a] = all;
                }
    }
}

// Sum of weight (x - centre), or of weight times its square, by four sums at a time: one alone would wait for itself.
template <class T, bool SQUARE>
T weighed(const T* x, T centre, const T* weight, int64_t particles) {
    typedef T Lanes __attribute__((vector_size(REGISTER), aligned(sizeof(T)), may_alias));
    constexpr int64_t WIDE = REGISTER / sizeof(T);
    Lanes sum[4] = {};
    int64_t i = 0;
    for (; i + 4 * WIDE <= particles; i += 4 * WIDE)
        for (int k = 0; k < 4; ++k) {
            const Lanes off = *reinterpret_cast<const Lanes*>(x + i + k * WIDE) - centre;
            const Lanes w = *reinterpret_cast<const Lanes*>(weight + i + k * WIDE);
            sum[k] += SQUARE ? w * off * off : w * off;
        }
    const Lanes all = (sum[0] + sum[1]) + (sum[2] + sum[3]);
    T whole = 0;
    for (int64_t lane = 0; lane < WIDE; ++lane) whole += all[lane];
    for (; i < particles; ++i) whole += weight[i] * (x[i] - centre) * (SQUARE ? x[i] - centre : T(1));
    return whole;
}

// Sums of parts [R, N] and of their squares, likewise.
template <class T>
void totals(T* whole, T* square, const T* part, int64_t runs, int64_t particles) {
    typedef T Lanes __attribute__((vector_size(REGISTER), aligned(sizeof(T)), may_alias));
    constexpr int64_t WIDE = REGISTER / sizeof(T);
    for (int64_t r = 0; r < runs; ++r, part += particles) {
        Lanes sum[4] = {}, squares[4] = {};
        int64_t i = 0;
        for (; i + 4 * WIDE <= particles; i += 4 * WIDE)
            for (int k = 0; k < 4; ++k) {
                const Lanes own = *reinterpret_cast<const Lanes*>(part + i + k * WIDE);
                sum[k] += own;
                squares[k] += own * own;
            }
        const Lanes all = (sum[0] + sum[1]) + (sum[2] + sum[3]), each = (squares[0] + squares[1]) + (squares[2] + squares[3]);
        whole[r] = square[r] = 0;
        for (int64_t lane = 0; lane < WIDE; ++lane) whole[r] += all[lane], square[r] += each[lane];
        for (; i < particles; ++i) whole[r] += part[i], square[r] += part[i] * part[i];
    }
}

template <class T>
void moments(T* mean, T* variance, const T* x, const T* weight, int64_t components, int64_t runs, int64_t particles) {
    for (int64_t r = 0; r < runs; ++r)
        for (int64_t d = 0; d < components; ++d) {
            const T* row = x + (d * runs + r) * particles;
            const T* w = weight + r * particles;
            const T centre = weighed<T, false>(row, 0, w, particles);
            mean[r * components + d] = centre;
            variance[r * components + d] = weighed<T, true>(row, centre, w, particles);
        }
}

// Ancestors of a run and their log weights: resampled if the effective sample size of its weights is below a limit times `wanted`.
template <class T>
bool choose(int64_t* ancestor, T* log_w, const T* w, const T* log_w_before, double wanted, double uniform, T limit, int64_t slots) {
    T whole, square;
    totals(&whole, &square, w, 1, slots);
    const bool resampled = limit >= 1 || 1 / square < limit * static_cast<T>(wanted);
    if (resampled) {
        systematic(ancestor, w, &wanted, &uniform, 1, slots);
        const int64_t many = static_cast<int64_t>(std::ceil(wanted));  // slots below n
        std::fill(log_w, log_w + many, -std::log(static_cast<T>(wanted)));
        std::fill(log_w + many, log_w + slots, -std::numeric_limits<T>::infinity());
    } else {
        std::iota(ancestor, ancestor + slots, 0);
        std::copy_n(log_w_before, slots, log_w);
    }
    return resampled;
}

template <class T>
Tensor drawn(void (*draw)(T*, const int64_t*, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t), const Tensor& seed,
             int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    require(components * runs.size(0) < MAX_SIZE && quarters < MAX_SIZE, "philox: more than 2^30 numbers of a kind");
    const Tensor out = fresh<T>({components, runs.size(0), 4 * quarters});
    const Packed<int64_t> run(runs);
    draw(numbers<T>(out), run.data, runs.size(0), 0, components, quarters, *numbers<int64_t>(step), *numbers<int64_t>(seed), purpose);
    return out;
}
}  // namespace

// for tape.cpp, of one run
extern "C" bool choose_double(int64_t* ancestor, double* log_w, const double* w, const double* before, double uniform, double limit, int64_t slots) {
    return choose(ancestor, log_w, w, before, static_cast<double>(slots), uniform, limit, slots);
}
extern "C" int64_t distinct_double(const int64_t* ancestor, const double* log_w, int64_t slots) {
    int64_t count;
    distinct(&count, ancestor, log_w, 1, slots);
    return count;
}
extern "C" void sums_double(double* const* out, const Product<double>* terms, const std::vector<int64_t>* last, int64_t particles) {
    sums(out, terms, *last, particles);
}
extern "C" void moments_double(double* mean, double* variance, const double* x, const double* w, int64_t slots) {
    moments(mean, variance, x, w, 1, 1, slots);
}

Tensor operators::philox_normals(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    return drawn(normals_float, seed, purpose, step, runs, components, quarters);
}

Tensor operators::philox_normals_float64(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    return drawn(normals_double, seed, purpose, step, runs, components, quarters);
}

Tensor operators::philox_uniforms(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    return drawn<double>([](double* out, const int64_t* run, int64_t many, int64_t, int64_t wanted, int64_t each, int64_t at, int64_t by,
                            int64_t kind) { uniforms(out, run, many, wanted, each, at, by, kind); },
                         seed, purpose, step, runs, components, quarters);
}

Tensor operators::resample_systematic(const Tensor& a, const Tensor& n, const Tensor& u) {
    const int64_t runs = a.size(0), slots = a.size(1);
    const Tensor out = fresh<int64_t>({runs, slots});
    const auto wanted = few<double>(n, runs), uniform = few<double>(u, runs);
    by_type(a, [&](auto one) {
        systematic(numbers<int64_t>(out), Packed<decltype(one)>(a).data, wanted.data(), uniform.data(), runs, slots);
    });
    return out;
}

std::tuple<Tensor, Tensor, Tensor, Tensor> operators::resample_particles(const Tensor& x, const Tensor& log_w, const Tensor& w, const Tensor& n,
                                                                         const Tensor& u, const Tensor& threshold) {
    const int64_t components = x.size(0), runs = x.size(1), slots = x.size(2);
    const Tensor ancestors = fresh<int64_t>({runs, slots}), mask = fresh<bool>({runs});
    const auto wanted = few<double>(n, runs), uniform = few<double>(u, runs);
    return by_type(x, [&](auto one) {
        using T = decltype(one);
        const Tensor out = fresh<T>({components, runs, slots}), log_out = fresh<T>({runs, slots});
        const Packed<T> weight(w), before(log_w);
        const T limit = few<T>(threshold, 1)[0];
        for (int64_t r = 0; r < runs; ++r)
            numbers<bool>(mask)[r] = choose(numbers<int64_t>(ancestors) + r * slots, numbers<T>(log_out) + r * slots, weight.data + r * slots,
                                            before.data + r * slots, wanted[r], uniform[r], limit, slots);
        copied(numbers<T>(out), Packed<T>(x).data, numbers<int64_t>(ancestors), components, runs, slots, slots);
        return std::make_tuple(out, log_out, ancestors, mask);
    });
}

Tensor operators::gather_particles(const Tensor& x, const Tensor& ancestors) {
    const int64_t components = x.size(0), runs = x.size(1), wanted = ancestors.size(1);
    const Packed<int64_t> from(ancestors);
    return by_type(x, [&](auto one) {
        using T = decltype(one);
        const Tensor out = fresh<T>({components, runs, wanted});
        copied(numbers<T>(out), Packed<T>(x).data, from.data, components, runs, x.size(2), wanted);
        return out;
    });
}

Tensor operators::log_normal(const Tensor& y, const Tensor& mean, const Tensor& scale, const Tensor& constant) {
    const int64_t runs = mean.size(0), particles = mean.size(1), components = mean.size(2);
    return by_type(mean, [&](auto one) {
        using T = decltype(one);
        const Tensor out = fresh<T>({runs, particles});
        ::log_normal(numbers<T>(out), few<T>(y, runs, components).data(), numbers<T>(mean), few<T>(scale, runs, components).data(),
                   few<T>(constant, runs).data(), mean.strides(), runs, particles, components);
        return out;
    });
}

Tensor operators::log_observed_normal(const Tensor& y, const Tensor& mean, const Tensor& sd) {
    const int64_t runs = mean.size(0), particles = mean.size(1), components = mean.size(2);
    return by_type(mean, [&](auto one) {
        using T = decltype(one);
        const Tensor out = fresh<T>({runs, particles});
        auto seen = few<T>(y, runs, components), scale = few<T>(sd, runs, components);
        std::vector<T> constant(runs);
        for (int64_t i = 0; i < runs * components; ++i) {
            const bool missing = seen[i] != seen[i];
            constant[i / components] += missing ? T(0) : std::log(scale[i]) + T(0.91893853320467274178);  // log sqrt(2 pi)
            scale[i] = missing ? T(0) : 1 / scale[i];
            seen[i] = missing ? T(0) : seen[i];
        }
        ::log_normal(numbers<T>(out), seen.data(), numbers<T>(mean), scale.data(), constant.data(), mean.strides(), runs, particles,
                     components);
        return out;
    });
}

namespace {
// Whether all particles share one noise, of zeros: a prediction without noise.
template <class T>
bool quiet(const Tensor& w) {
    if (w.size(0) * w.size(1) == 0 || w.stride(0) != 0 || w.stride(1) != 0) return false;
    for (int64_t k = 0; k < w.size(2); ++k)
        if (numbers<T>(w)[k * w.stride(2)] != 0) return false;
    return true;
}
}  // namespace

Tensor operators::propagate_affine(const Tensor& phi, const Tensor& x, const Tensor& gain, const Tensor& w) {
    const int64_t runs = x.size(0), particles = x.size(1), rows = phi.size(1);
    const bool one = phi.size(0) == 1 && gain.size(0) == 1;  // runs then lie side by side as particles of one run do
    return by_type(x, [&](auto like) {
        using T = decltype(like);
        const Tensor out = fresh<T>({rows, runs, particles});
        const auto work = [&](const T* by, const T* noise, int64_t noises) {
            affine(numbers<T>(out), Packed<T>(phi).data, Packed<T>(x, COMPONENTS_FIRST).data, by, noise, phi.size(0) == 1,
                   gain.size(0) == 1, one ? 1 : runs, one ? runs * particles : particles, rows, phi.size(2), noises);
        };
        if (quiet<T>(w)) work(nullptr, nullptr, 0);
        else work(Packed<T>(gain).data, Packed<T>(w, COMPONENTS_FIRST).data, gain.size(2));
        return out;
    });
}

Tensor operators::count_unique(const Tensor& ancestors, const Tensor& log_w) {
    const int64_t runs = ancestors.size(0);
    const Tensor out = fresh<int64_t>({runs});
    const Packed<int64_t> ancestor(ancestors);
    by_type(log_w, [&](auto one) {
        distinct(numbers<int64_t>(out), ancestor.data, Packed<decltype(one)>(log_w).data, runs, ancestors.size(1));
    });
    return out;
}

std::tuple<Tensor, Tensor> operators::sum_and_squares(const Tensor& terms) {
    const int64_t runs = terms.size(0);
    return by_type(terms, [&](auto one) {
        using T = decltype(one);
        const Tensor whole = fresh<T>({runs, 1}), square = fresh<T>({runs, 1});
        totals(numbers<T>(whole), numbers<T>(square), Packed<T>(terms).data, runs, terms.size(1));
        return std::make_tuple(whole, square);
    });
}

std::tuple<Tensor, Tensor> operators::weighted_moments(const Tensor& x, const Tensor& w) {
    const int64_t runs = x.size(0), components = x.size(2);
    return by_type(x, [&](auto one) {
        using T = decltype(one);
        const Tensor mean = fresh<T>({runs, components}), variance = fresh<T>({runs, components});
        moments(numbers<T>(mean), numbers<T>(variance), Packed<T>(x, COMPONENTS_FIRST).data, Packed<T>(w).data, components, runs,
                x.size(1));
        return std::make_tuple(mean, variance);
    });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> operators::weigh_particles(const Tensor& x, const Tensor& log_w) {
    const auto weights = operators::normalise_weights(log_w);
    return std::tuple_cat(weights, operators::weighted_moments(x, std::get<2>(weights)));
}

Tensor operators::group_covariance(const Tensor& x, const Tensor& mean, const Tensor& w, const Tensor& groups) {
    const int64_t runs = x.size(0), many = groups.size(0), size = groups.size(1);
    const Packed<int64_t> components(groups);
    return by_type(x, [&](auto one) {
        using T = decltype(one);
        const Tensor out = fresh<T>({runs, many, size, size});
        spread(numbers<T>(out), numbers<T>(x), Packed<T>(mean).data, Packed<T>(w).data, components.data, x.strides(), many,
               size, runs, x.size(1), x.size(2));
        return out;
    });
}
