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

// out[D, R, M] = phi x + gain w. GATHER: x by ancestors [R, M], else M = N and they are not looked at. DRAW: w is drawn here, as
// `normals` does; else it is w[W, R, M]. phi and gain [1 or R, D, D or W]: `own` says which of them are of each run (1, 2).
// Rows of coefficients that are zero, four at a time, are left out.
template <typename T, int D, int W, bool GATHER, bool DRAW>
__global__ void __launch_bounds__(128) affine(
    T* out, const T* x, const long long* ancestors, const T* w, const T* phi, const T* gain, int own, const long long* runs,
    word seed, word purpose, word step, int R, int N, int M) {
    constexpr int GROUPS = (D + 3) / 4, COLUMNS = D + W;
    __shared__ Rows<T> coefficients[COLUMNS][GROUPS];
    __shared__ word there[COLUMNS];
    int q = (M + 3) / 4, k = blockIdx.x * blockDim.x + threadIdx.x;
    for (int r = blockIdx.y; r < R; r += gridDim.y) {
        const T *f = phi + (own & 1 ? (size_t)r * D * D : 0), *g = gain + (own & 2 ? (size_t)r * D * W : 0);
        __syncthreads();
        for (int i = threadIdx.x; i < COLUMNS * GROUPS * 4; i += blockDim.x) {
            int column = i / (GROUPS * 4), row = i % (GROUPS * 4);
            T value = 0;
            if (row < D) value = column < D ? f[row * D + column] : g[row * W + column - D];
            coefficients[column][row / 4].v[row % 4] = value;
        }
        __syncthreads();
        for (int column = threadIdx.x; column < COLUMNS; column += blockDim.x) {
            word mask = 0;
            for (int b = 0; b < GROUPS; ++b)
                for (int v = 0; v < 4; ++v) mask |= (coefficients[column][b].v[v] != T(0)) << b;
            there[column] = mask;
        }
        __syncthreads();
        if (k >= q) continue;
        const T* from[4];
#pragma unroll
        for (int m = 0; m < 4; ++m) {
            int p = min(k + m * q, M - 1);
            long long parent = p;
            if (GATHER) parent = ancestors[(size_t)r * M + p];
            from[m] = x + (size_t)r * N + parent;
        }
        T sum[GROUPS * 4][4] = {};
        auto add = [&](int column, const T* value) {
            word mask = there[column];
#pragma unroll
            for (int b = 0; b < GROUPS; ++b)
                if (mask >> b & 1) {
                    Rows<T> c = coefficients[column][b];
#pragma unroll
                    for (int v = 0; v < 4; ++v)
#pragma unroll
                        for (int m = 0; m < 4; ++m) sum[4 * b + v][m] += c.v[v] * value[m];
                }
        };
        size_t stride = (size_t)R * N;
        word run = DRAW ? (word)runs[r] : 0;
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
                    Counters<T>(k, j, step, run, seed, purpose).normals(noise);
                } else {
#pragma unroll
                    for (int m = 0; m < 4; ++m) noise[m] = w[((size_t)j * R + r) * M + min(k + m * q, M - 1)];
                }
                add(D + j, noise);
            }
            if (j < D) add(j, value);
        }
#pragma unroll
        for (int m = 0; m < 4; ++m)
            if (k + m * q < M) {
                T* to = out + (size_t)r * M + k + m * q;
#pragma unroll
                for (int i = 0; i < D; ++i) to[(size_t)i * R * M] = sum[i][m];
            }
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

// Ancestors [R, N] by the positions (j + u) / n. Marks where each particle's slots begin, and fills up from there. A particle of
// weight 0 marks nothing. `marks` are [R, N] in global memory, where those of a run do not fit into the block's own (`inside`).
template <typename T>
__global__ void systematic(
    long long* out, const T* a, const double* n, int n_stride, const double* u, int* marks, int inside, int R, int N) {
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
        int last = 0, end = (int)wanted;
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
                if (ends[v] > begun) mark[begun] = i + v;
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
            Rows<long long> found;
#pragma unroll
            for (int v = 0; v < 4; ++v) found.v[v] = i + v < end ? max(ahead, most.v[v]) : N - 1;
            long long* to = out + (size_t)r * N + i;
            if (aligned && i < N)
                *(Rows<long long>*)to = found;
            else
                for (int v = 0; v < 4; ++v)
                    if (i + v < N) to[v] = found.v[v];
            latest = max(latest, every);
        }
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
