// What a step does to all particles, on a CUDA device. Each kernel computes what the torch function of its place does; they are
// compiled by NVRTC, for the types and sizes at hand. Arrays are contiguous, particles last.
//
// A thread has the four particles that share a counter of the generator: k, k + q, k + 2 q, k + 3 q, where q is a quarter of them.
// Sums over the particles of a run are made by one block, so that the result does not hang on other runs.

#ifndef LANES  // a test on the CPU has one
#define LANES 32  // threads of a warp
#endif

#include "generator.h"  // put in its place before NVRTC sees it

using generator::word;
using generator::Words;
using generator::wide;

// The words of a counter: with those of low order in double precision
template <typename T> struct Counters;
template <> struct Counters<float> {
    Words high;
    __device__ Counters(word k, word component, word step, word run, word seed, word purpose)
        : high(generator::philox(k, component, step, run, seed, purpose)) {}
    __device__ void normals(float* n) const {
        generator::normal_pair(generator::unit(high.a), generator::half_turns(high.b), n[0], n[1]);
        generator::normal_pair(generator::unit(high.c), generator::half_turns(high.d), n[2], n[3]);
    }
};
template <> struct Counters<double> {
    Words high, low;
    __device__ Counters(word k, word component, word step, word run, word seed, word purpose)
        : high(generator::philox(k, component, step, run, seed, purpose)),
          low(generator::philox(k, component + generator::LOW, step, run, seed, purpose)) {}
    __device__ void normals(double* n) const {
        generator::normal_pair(generator::unit(high.a, low.a), generator::half_turns(high.b, low.b), n[0], n[1]);
        generator::normal_pair(generator::unit(high.c, low.c), generator::half_turns(high.d, low.d), n[2], n[3]);
    }
};

// [components, runs, 4 q]
template <typename T>
__global__ void normals(T* out, const long long* runs, word seed, word purpose, word step, int components, int R, int q) {
    int k = blockIdx.x * blockDim.x + threadIdx.x;
    if (k >= q) return;
    for (int row = blockIdx.y; row < components * R; row += gridDim.y) {
        T n[4];
        Counters<T>(k, row / R, step, (word)runs[row % R], seed, purpose).normals(n);
        T* to = out + (size_t)row * 4 * q + k;
#pragma unroll
        for (int m = 0; m < 4; ++m) to[(size_t)m * q] = n[m];
    }
}

__global__ void uniforms(double* out, const long long* runs, word seed, word purpose, word step, int components, int R, int q) {
    int k = blockIdx.x * blockDim.x + threadIdx.x;
    if (k >= q) return;
    for (int row = blockIdx.y; row < components * R; row += gridDim.y) {
        Counters<double> of(k, row / R, step, (word)runs[row % R], seed, purpose);
        double* to = out + (size_t)row * 4 * q + k;
        to[0] = generator::unit(of.high.a, of.low.a);
        to[q] = generator::unit(of.high.b, of.low.b);
        to[2 * (size_t)q] = generator::unit(of.high.c, of.low.c);
        to[3 * (size_t)q] = generator::unit(of.high.d, of.low.d);
    }
}

// out[D, R, M] = x[D, R, N] by ancestors[R, M]
template <typename T>
__global__ void copied(T* out, const T* x, const long long* ancestors, int D, int R, int N, int M) {
    int p = blockIdx.x * blockDim.x + threadIdx.x;
    if (p >= M) return;
    for (int r = blockIdx.y; r < R; r += gridDim.y) {
        const T* from = x + (size_t)r * N + ancestors[(size_t)r * M + p];
        T* to = out + (size_t)r * M + p;
        for (int d = 0; d < D; ++d) to[(size_t)d * R * M] = from[(size_t)d * R * N];
    }
}

template <typename T> struct alignas(4 * sizeof(T)) Rows { T v[4]; };

// [phi | gain] by columns, in groups of rows of which a thread reads one at a time. States come in threes, and so do coefficients that
// are zero: `there` has a bit for each group of a column with another one.
constexpr int GROUP = 3;
template <typename T, int D, int W> struct Coefficients {
    static constexpr int GROUPS = (D + GROUP - 1) / GROUP, COLUMNS = D + W;
    Rows<T> rows[COLUMNS][GROUPS];
    word there[COLUMNS];

    // all threads of a block come here
    __device__ void read(const T* phi, const T* gain) {
        __syncthreads();
        for (int i = threadIdx.x; i < COLUMNS * GROUPS * GROUP; i += blockDim.x) {
            int column = i / (GROUPS * GROUP), row = i % (GROUPS * GROUP);
            T value = 0;
            if (row < D) value = column < D ? phi[row * D + column] : gain[row * W + column - D];
            rows[column][row / GROUP].v[row % GROUP] = value;
        }
        __syncthreads();
        for (int column = threadIdx.x; column < COLUMNS; column += blockDim.x) {
            word mask = 0;
            for (int b = 0; b < GROUPS; ++b)
                for (int v = 0; v < GROUP; ++v) mask |= (rows[column][b].v[v] != T(0)) << b;
            there[column] = mask;
        }
        __syncthreads();
    }

    __device__ __forceinline__ void add(int column, const T* value, T (*sum)[4]) const {
        word mask = there[column];
#pragma unroll
        for (int b = 0; b < GROUPS; ++b)
            if (mask >> b & 1) {
                Rows<T> c = rows[column][b];
#pragma unroll
                for (int v = 0; v < GROUP; ++v)
                    if (GROUP * b + v < D)
#pragma unroll
                        for (int m = 0; m < 4; ++m) sum[GROUP * b + v][m] += c.v[v] * value[m];
            }
    }
};

struct Key { word seed, purpose, step, run; };

// sum[D][4] = phi x + gain w of particles k + m q of run r. GATHER: x by ancestors [R, M], else M = N and they are not looked at.
// DRAW: w is drawn here, as `normals` does; else it is w[W, R, M].
template <bool GATHER, bool DRAW, typename T, int D, int W, typename A>
__device__ __forceinline__ void move(
    T (*sum)[4], const Coefficients<T, D, W>& coefficients, const T* x, const A* ancestors, const T* w, Key key, int r, int k, int R,
    int N, int M) {
    int q = (M + 3) / 4;
    const T* from[4];
#pragma unroll
    for (int m = 0; m < 4; ++m) {
        int p = min(k + m * q, M - 1);
        long long parent = p;
        if (GATHER) parent = ancestors[(size_t)r * M + p];
        from[m] = x + (size_t)r * N + parent;
    }
    size_t stride = (size_t)R * N;
#pragma unroll 1
    for (int j = 0; j < (D > W ? D : W); ++j) {  // parents are on their way while noise is made
        T value[4], noise[4];
        if (j < D)
#pragma unroll
            for (int m = 0; m < 4; ++m) {
                value[m] = *from[m];
                from[m] += stride;
            }
        if (j < W) {
            if (DRAW) {
                Counters<T>(k, j, key.step, key.run, key.seed, key.purpose).normals(noise);
            } else {
#pragma unroll
                for (int m = 0; m < 4; ++m) noise[m] = w[((size_t)j * R + r) * M + min(k + m * q, M - 1)];
            }
            coefficients.add(D + j, noise, sum);
        }
        if (j < D) coefficients.add(j, value, sum);
    }
}

// out[D, R, M] of the particles of `move`
template <typename T, int D> __device__ __forceinline__ void store(T* out, const T (*sum)[4], int r, int k, int R, int M) {
    int q = (M + 3) / 4;
    size_t stride = (size_t)R * M;
    T* to[4];
    bool there[4];
#pragma unroll
    for (int m = 0; m < 4; ++m) {
        to[m] = out + (size_t)r * M + k + m * q;
        there[m] = k < q && k + m * q < M;
    }
#pragma unroll
    for (int d = 0; d < D; ++d)
#pragma unroll
        for (int m = 0; m < 4; ++m) {
            if (there[m]) *to[m] = sum[d][m];
            to[m] += stride;
        }
}

// a number of each run, or of all runs: `own` has a bit for each argument
template <typename T> __device__ const T* of_run(const T* from, int own, int bit, int r, int size) {
    return from + (own >> bit & 1 ? (size_t)r * size : 0);
}

// out[D, R, M] = phi x + gain w, see `move`; phi and gain [1 or R, D, D or W] (own: 0, 1)
template <typename T, int D, int W, bool GATHER, bool DRAW>
__global__ void __launch_bounds__(128) affine(
    T* out, const T* x, const long long* ancestors, const T* w, const T* phi, const T* gain, int own, const long long* runs,
    word seed, word purpose, word step, int R, int N, int M) {
    __shared__ Coefficients<T, D, W> coefficients;
    int q = (M + 3) / 4, k = blockIdx.x * blockDim.x + threadIdx.x;
    for (int r = blockIdx.y; r < R; r += gridDim.y) {
        if (own || r == blockIdx.y) coefficients.read(of_run(phi, own, 0, r, D * D), of_run(gain, own, 1, r, D * W));
        if (k >= q) continue;
        T sum[D][4] = {};
        Key key{seed, purpose, step, DRAW ? (word)runs[r] : 0};
        move<GATHER, DRAW>(sum, coefficients, x, ancestors, w, key, r, k, R, N, M);
        store<T, D>(out, sum, r, k, R, M);
    }
}

// Sums and maxima over a block, all threads of which come here: a power of two of whole warps; `shared` has place for one number of
// each.

struct Sum { template <typename T> __device__ T operator()(T a, T b) const { return a + b; } };
struct Most { template <typename T> __device__ T operator()(T a, T b) const { return a < b ? b : a; } };

template <typename T, typename F> __device__ T over_block(T value, F join, T* shared) {
    int lane = threadIdx.x % LANES, warp = threadIdx.x / LANES, warps = blockDim.x / LANES;
    for (int off = LANES / 2; off; off >>= 1) value = join(value, __shfl_xor_sync(~0u, value, off));
    __syncthreads();
    if (lane == 0) shared[warp] = value;
    __syncthreads();
    value = shared[lane < warps ? lane : 0];
    for (int off = LANES / 2; off; off >>= 1) {
        T other = __shfl_xor_sync(~0u, value, off);
        if ((lane ^ off) < warps && lane < warps) value = join(value, other);
    }
    return __shfl_sync(~0u, value, 0);
}

// what the threads before this one have together, and all of them
template <typename T, typename F> __device__ T before(T value, F join, T nothing, T* shared, T& all) {
    int lane = threadIdx.x % LANES, warp = threadIdx.x / LANES, warps = blockDim.x / LANES;
    T own = value;
    for (int off = 1; off < LANES; off <<= 1) {
        T other = __shfl_up_sync(~0u, own, off);
        if (lane >= off) own = join(other, own);
    }
    __syncthreads();
    if (lane == LANES - 1) shared[warp] = own;
    __syncthreads();
    T ahead = nothing;
    all = nothing;
    for (int i = 0; i < warps; ++i) {
        if (i == warp) ahead = all;
        all = join(all, shared[i]);
    }
    T left = __shfl_up_sync(~0u, own, 1);
    return lane ? join(ahead, left) : ahead;
}

template <typename T> __device__ Rows<T> four(const T* from, int left, bool aligned) {
    if (aligned && left >= 4) return *(const Rows<T>*)from;
    Rows<T> rows;
#pragma unroll
    for (int v = 0; v < 4; ++v) rows.v[v] = v < left ? from[v] : T(0);
    return rows;
}

// A weight as a multiple of 2^-52: sums of them are exact in double precision, and so the same in any order and in every engine.
template <typename T> __device__ double on_grid(T weight) { return trunc((double)weight * 0x1p52); }

// Ancestors [R, N] by the positions (j + u) / n, and how many are distinct [R]. Marks where each particle's slots begin, and fills up from there. A particle of
// weight 0 marks nothing. `marks` are [R, N] in global memory, where those of a run do not fit into the block's own (`inside`).
template <typename T, typename A>
__global__ void __launch_bounds__(512, 3) systematic(
    A* out, long long* distinct, const T* a, const double* n, int n_stride, const double* u, int* marks, int inside, int R, int N) {
    extern __shared__ int own[];
    __shared__ double parts[32];
    __shared__ int whole[32];
    int* mark = inside ? own : marks + (size_t)blockIdx.x * N;
    bool aligned = N % 4 == 0;
    for (int r = blockIdx.x; r < R; r += gridDim.x) {
        const T* weight = a + (size_t)r * N;
        double total = 0, wanted = n[(size_t)r * n_stride], offset = u[r];
#pragma unroll 4
        for (int i = 4 * threadIdx.x; i < N; i += 4 * blockDim.x) {
            Rows<T> value = four(weight + i, N - i, aligned);
#pragma unroll
            for (int v = 0; v < 4; ++v) total += on_grid(value.v[v]);
        }
        for (int i = threadIdx.x; i < N; i += blockDim.x) mark[i] = 0;
        total = over_block(total, Sum(), parts);
        double carried = 0, scale = generator::div(wanted, total);
        int last = 0, end = (int)wanted, count = 0;
        for (int first = 0; first < N; first += 4 * blockDim.x) {
            int i = first + 4 * threadIdx.x;
            Rows<T> value = four(weight + i, N - i, aligned);
            double all, each[4], sum = 0;
#pragma unroll
            for (int v = 0; v < 4; ++v) sum += each[v] = on_grid(value.v[v]);
            double reach = carried + before(sum, Sum(), 0.0, parts, all);
            int ends[4], most = 0, every;
#pragma unroll
            for (int v = 0; v < 4; ++v) {
                reach += each[v];
                int stop = reach < total ? min((int)ceil(generator::add(generator::mul(reach, scale), -offset)), end) : end;
                ends[v] = each[v] > 0.0 ? stop : 0;
                most = max(most, ends[v]);
            }
            int begun = max(last, before(most, Most(), 0, whole, every));
#pragma unroll
            for (int v = 0; v < 4; ++v) {
                if (ends[v] > begun) mark[begun] = i + v, ++count;
                begun = max(begun, ends[v]);
            }
            carried += all;
            last = max(last, every);
        }
        __syncthreads();
        int latest = 0;
        for (int first = 0; first < N; first += 4 * blockDim.x) {
            int i = first + 4 * threadIdx.x, top = 0, every;
            Rows<int> most = four((const int*)mark + i, N - i, aligned);
#pragma unroll
            for (int v = 0; v < 4; ++v) most.v[v] = top = max(top, most.v[v]);
            int ahead = max(latest, before(top, Most(), 0, whole, every));
            Rows<A> found;
#pragma unroll
            for (int v = 0; v < 4; ++v) found.v[v] = i + v < end ? max(ahead, most.v[v]) : N - 1;
            A* to = out + (size_t)r * N + i;
            if (aligned && i < N)
                *(Rows<A>*)to = found;
            else
                for (int v = 0; v < 4; ++v)
                    if (i + v < N) to[v] = found.v[v];
            latest = max(latest, every);
        }
        count = over_block(count, Sum(), whole);
        if (threadIdx.x == 0) distinct[r] = max(count, 1);
        __syncthreads();
    }
}

// How many values below 2 N there are in copy_of[R, N] at the slots whose log weight is finite
template <typename T> __global__ void distinct(long long* out, const long long* copy_of, const T* log_w, int R, int N) {
    extern __shared__ unsigned char seen[];
    __shared__ int parts[32];
    for (int r = blockIdx.x; r < R; r += gridDim.x) {
        for (int i = threadIdx.x; i < (2 * N + 3) / 4; i += blockDim.x) ((word*)seen)[i] = 0;
        __syncthreads();
        for (int i = threadIdx.x; i < N; i += blockDim.x)
            if (log_w[(size_t)r * N + i] > (T)__int_as_float(0xff800000)) seen[copy_of[(size_t)r * N + i]] = 1;
        __syncthreads();
        int count = 0;
        for (int i = threadIdx.x; i < (2 * N + 3) / 4; i += blockDim.x) count += __popc(((word*)seen)[i]);
        count = over_block(count, Sum(), parts);
        if (threadIdx.x == 0) out[r] = count;
        __syncthreads();
    }
}

// Mean and variance [R, D] of x[D, R, N] by weights [R, N], in one pass: about the particle that weighs most, which is close to
// the mean, so that nothing is lost by taking squares from each other.
template <typename T, int D>
__global__ void __launch_bounds__(256, 2) moments(T* mean, T* variance, const T* x, const T* w, int R, int N) {
    constexpr int SUMS = 2 * D + 1;
    __shared__ wide tops[32];
    __shared__ T parts[32][SUMS];
    size_t stride = (size_t)R * N;
    int lane = threadIdx.x % LANES, warp = threadIdx.x / LANES;
    for (int r = blockIdx.x; r < R; r += gridDim.x) {
        const T *weight = w + (size_t)r * N, *first = x + (size_t)r * N;
        wide top = 0;  // weights are not negative, so that their bits are in their order
#pragma unroll 8
        for (int i = threadIdx.x; i < N; i += blockDim.x)
            top = Most()(top, (wide)__float_as_uint((float)weight[i]) << 32 | (word)i);
        int heaviest = (int)(word)over_block(top, Most(), tops);
        T about[D], sums[SUMS] = {};
#pragma unroll
        for (int d = 0; d < D; ++d) about[d] = first[d * stride + heaviest];
        for (int i = threadIdx.x; i < N; i += blockDim.x) {
            T part = weight[i], value[D];
#pragma unroll
            for (int d = 0; d < D; ++d) value[d] = first[d * stride + i];
            sums[2 * D] += part;
#pragma unroll
            for (int d = 0; d < D; ++d) {
                T off = value[d] - about[d];
                sums[d] += part * off;
                sums[D + d] += part * off * off;
            }
        }
#pragma unroll
        for (int k = 0; k < SUMS; ++k) {
            for (int off = LANES / 2; off; off >>= 1) sums[k] += __shfl_xor_sync(~0u, sums[k], off);
            if (lane == 0) parts[warp][k] = sums[k];
        }
        __syncthreads();
        for (int d = threadIdx.x; d < D; d += blockDim.x) {
            T s = 0, ss = 0, total = 0;
            for (int i = 0; i < blockDim.x / LANES; ++i) {
                s += parts[i][d];
                ss += parts[i][D + d];
                total += parts[i][2 * D];
            }
            s /= total;
            mean[(size_t)r * D + d] = first[d * stride + heaviest] + s;
            variance[(size_t)r * D + d] = Most()(ss / total - s * s, T(0));
        }
        __syncthreads();
    }
}

// Sums over a warp of WIDTH numbers of each lane, a power of two: a lane returns that of number lane / (LANES / WIDTH). At each turn
// a lane passes on half of its numbers.
template <int WIDTH, int OFF = LANES / 2, typename T> __device__ __forceinline__ T over_warp(T* v) {
    if constexpr (OFF == 0) return v[0];
    if constexpr (WIDTH > 1) {
        bool upper = threadIdx.x & OFF;
#pragma unroll
        for (int i = 0; i < WIDTH / 2; ++i) {
            T mine = upper ? v[i + WIDTH / 2] : v[i], other = upper ? v[i] : v[i + WIDTH / 2];
            v[i] = mine + __shfl_xor_sync(~0u, other, OFF);
        }
        return over_warp<WIDTH / 2, OFF / 2>(v);
    } else {
        v[0] += __shfl_xor_sync(~0u, v[0], OFF);
        return over_warp<1, OFF / 2>(v);
    }
}

template <typename T> __device__ T lowest() { return (T)__int_as_float(0xff800000); }

// Moves particles as `affine` does with its ancestors and its noise, and weighs them while their states are at hand:
// log_w[R, M] = -log n - 1/2 sum ((y - x) scale)^2 - constant over the measured components, -inf for NaN and from slot n on. Of those
// of each warp, up to 4 LANES, parts[R, parts of a run, 2 D + 3] has the greatest log weight, the sum of weights over that one, the
// sum of their squares, the mean of each component and the weighted sum of squares about it.
// components [K], all different; phi, gain, y [1 or R, K], scale, constant [1 or R], n [1 or R] (own: 0 to 5)
template <typename T, int D, int W>
__global__ void __launch_bounds__(128, sizeof(T) * D > 64 ? 2 : 5) weighed(
    T* out, T* log_w, T* parts, const T* x, const int* ancestors, const T* phi, const T* gain, const long long* runs,
    const long long* components, const T* y, const T* scale, const T* constant, const T* n, int own, word seed, word purpose,
    word step, int K, int R, int N, int M) {
    constexpr int WIDTH = D < 16 ? 16 : 32, EACH = LANES / WIDTH, RECORD = 2 * D + 3;
    __shared__ Coefficients<T, D, W> coefficients;
    __shared__ T measured[D], scales[D];
    int q = (M + 3) / 4, k = blockIdx.x * blockDim.x + threadIdx.x, lane = threadIdx.x % LANES, warps = (q + LANES - 1) / LANES;
    for (int r = blockIdx.y; r < R; r += gridDim.y) {
        if (own & 3 || r == blockIdx.y) coefficients.read(of_run(phi, own, 0, r, D * D), of_run(gain, own, 1, r, D * W));
        if (r == blockIdx.y)
            for (int d = threadIdx.x; d < D; d += blockDim.x) scales[d] = 0;
        __syncthreads();
        for (int i = threadIdx.x; i < K; i += blockDim.x) {
            measured[components[i]] = of_run(y, own, 2, r, K)[i];
            scales[components[i]] = of_run(scale, own, 3, r, K)[i];
        }
        __syncthreads();
        if (k - lane >= q) continue;  // a whole warp
        T sum[D][4] = {};
        move<true, true>(sum, coefficients, x, ancestors, x, Key{seed, purpose, step, (word)runs[r]}, r, k, R, N, M);
        T count = *of_run(n, own, 5, r, 1), level = -log(count), base = *of_run(constant, own, 4, r, 1), l[4] = {}, top = lowest<T>();
#pragma unroll
        for (int d = 0; d < D; ++d) {
            T s = scales[d];
            if (s != T(0))
#pragma unroll
                for (int m = 0; m < 4; ++m) {
                    T z = (measured[d] - sum[d][m]) * s;
                    l[m] += z * z;
                }
        }
#pragma unroll
        for (int m = 0; m < 4; ++m) {
            int p = k + m * q;
            l[m] = T(-0.5) * l[m] - base + level;
            if (!(l[m] == l[m]) || k >= q || T(p) >= count) l[m] = lowest<T>();
            if (k < q && p < M) log_w[(size_t)r * M + p] = l[m];
            top = Most()(top, l[m]);
        }
        store<T, D>(out, sum, r, k, R, M);
        for (int off = LANES / 2; off; off >>= 1) top = Most()(top, __shfl_xor_sync(~0u, top, off));
        T weight[4], v[WIDTH] = {};
#pragma unroll
        for (int m = 0; m < 4; ++m) weight[m] = exp(l[m] - (top > lowest<T>() ? top : T(0)));
#pragma unroll
        for (int m = 0; m < 4; ++m) {
            v[D] += weight[m];
#pragma unroll
            for (int d = 0; d < D; ++d) v[d] += weight[m] * sum[d][m];
        }
        T total = over_warp<WIDTH>(v), whole = __shfl_sync(~0u, total, D * EACH), mean = total * (whole > T(0) ? T(1) / whole : T(0));
        T u[WIDTH] = {};
#pragma unroll
        for (int d = 0; d < D; ++d) {
            T about = __shfl_sync(~0u, mean, d * EACH);
#pragma unroll
            for (int m = 0; m < 4; ++m) {
                T off = sum[d][m] - about;
                u[d] += weight[m] * off * off;
            }
        }
#pragma unroll
        for (int m = 0; m < 4; ++m) u[D] += weight[m] * weight[m];
        T squares = over_warp<WIDTH>(u);
        int d = lane / EACH;
        T* part = parts + ((size_t)r * warps + k / LANES) * RECORD;
        if (lane % EACH == 0 && d < D) part[3 + d] = mean, part[3 + D + d] = squares;
        if (lane == D * EACH) part[0] = top, part[1] = total, part[2] = squares;
    }
}

// What `weighed` leaves to do: log_w[R, N] in place, w[R, N], logsumexp and effective sample size [R], mean and variance [R, D], by
// `parts` [R, B, 2 D + 3]. A run without a finite weight, or without a resolved one, gets equal weights. Blocks of the
// same run share its particles, in pieces of four times as many as there are threads; the first has the moments.
template <typename T, int D>
__global__ void __launch_bounds__(256, 6) finished(
    T* log_w, T* log_total, T* w, T* ess, T* mean, T* variance, const T* x, const T* parts, int B, int R, int N) {
    constexpr int RECORD = 2 * D + 3;
    constexpr T LEAST = sizeof(T) == 4 ? -0x1p23 : -0x1p52;  // see `is_resolved`
    __shared__ double sums[32];
    int lane = threadIdx.x % LANES, warp = threadIdx.x / LANES, warps = blockDim.x / LANES;
    bool aligned = N % 4 == 0;
    for (int r = blockIdx.y; r < R; r += gridDim.y) {
        const T* part = parts + (size_t)r * B * RECORD;
        double most = lowest<double>(), total = 0, squares = 0;
        for (int b = threadIdx.x; b < B; b += blockDim.x) most = Most()(most, (double)part[(size_t)b * RECORD]);
        T top = (T)over_block(most, Most(), sums);
        bool lost = !(top > LEAST && top < -lowest<T>());
        auto relative = [&](int b) { return lost ? T(0) : exp(part[(size_t)b * RECORD] - top); };
        for (int b = threadIdx.x; b < B; b += blockDim.x) {
            double factor = relative(b);
            total += factor * part[(size_t)b * RECORD + 1];
            squares += factor * factor * part[(size_t)b * RECORD + 2];
        }
        total = over_block(total, Sum(), sums);
        squares = over_block(squares, Sum(), sums);
        T log_sum = top + (T)log(total), inverse = T(1) / (T)total, equal = T(1) / (T)N, log_equal = -log((T)N);
        if (blockIdx.x == 0) {
            if (threadIdx.x == 0) {
                log_total[r] = lost ? lowest<T>() : log_sum;
                ess[r] = lost ? (T)N : (T)(total * total / squares);
            }
            for (int d = warp; d < D; d += warps) {
                const T* value = x + ((size_t)d * R + r) * N;
                double s = 0, ss = 0;
                if (lost)
                    for (int i = lane; i < N; i += LANES) s += value[i];
                else
                    for (int b = lane; b < B; b += LANES)
                        s += (double)relative(b) * part[(size_t)b * RECORD + 1] * part[(size_t)b * RECORD + 3 + d];
                for (int off = LANES / 2; off; off >>= 1) s += __shfl_xor_sync(~0u, s, off);
                s /= lost ? (double)N : total;
                if (lost)
                    for (int i = lane; i < N; i += LANES) ss += (value[i] - s) * (value[i] - s);
                else
                    for (int b = lane; b < B; b += LANES) {
                        double off = part[(size_t)b * RECORD + 3 + d] - s;
                        ss += relative(b) * (part[(size_t)b * RECORD + 3 + D + d] + part[(size_t)b * RECORD + 1] * off * off);
                    }
                for (int off = LANES / 2; off; off >>= 1) ss += __shfl_xor_sync(~0u, ss, off);
                if (lane == 0) {
                    mean[(size_t)r * D + d] = (T)s;
                    variance[(size_t)r * D + d] = (T)(ss / (lost ? (double)N : total));
                }
            }
        }
        for (int i = 4 * (blockIdx.x * blockDim.x + threadIdx.x); i < N; i += 4 * gridDim.x * blockDim.x) {
            T *l = log_w + (size_t)r * N + i, *to = w + (size_t)r * N + i;
            Rows<T> value = four((const T*)l, N - i, aligned), weight;
#pragma unroll
            for (int v = 0; v < 4; ++v) {
                weight.v[v] = lost ? equal : exp(value.v[v] - top) * inverse;
                value.v[v] = lost ? log_equal : value.v[v] - log_sum;
            }
            if (aligned) {
                *(Rows<T>*)l = value;
                *(Rows<T>*)to = weight;
            } else
                for (int v = 0; v < 4; ++v)
                    if (i + v < N) l[v] = value.v[v], to[v] = weight.v[v];
        }
        __syncthreads();
    }
}
