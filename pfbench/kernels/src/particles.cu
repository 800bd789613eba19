// What a step does to all particles, on a CUDA device. Each kernel computes what the torch function of its place does; they are
// compiled by NVRTC, for the types and sizes at hand. Arrays are contiguous, particles last.
//
// A thread has the four particles that share a counter of the generator: k, k + q, k + 2 q, k + 3 q, where q is a quarter of them.
// Sums over the particles of a run are made by one block, so that the result does not hang on other runs.

#ifndef LANES  // a test on the CPU has one
#define LANES 32  // threads of a warp
#endif

typedef unsigned int word;
typedef unsigned long long wide;

struct Words { word a, b, c, d; };

// Philox4x32-10: counter, key
__device__ inline Words philox(word c0, word c1, word c2, word c3, word k0, word k1) {
#pragma unroll
    for (int turn = 0; turn < 10; ++turn) {
        wide p0 = (wide)c0 * 0xD2511F53u, p1 = (wide)c2 * 0xCD9E8D57u;
        c0 = (word)(p1 >> 32) ^ c1 ^ k0;
        c2 = (word)(p0 >> 32) ^ c3 ^ k1;
        c1 = (word)p1;
        c3 = (word)p0;
        k0 += 0x9E3779B9u;
        k1 += 0xBB67AE85u;
    }
    return {c0, c1, c2, c3};
}

// By Box and Muller, with the device's own approximations, each to some 3e-7: normals to 3e-6. That of the logarithm would do
// badly where the radius is small, so there it is a series. The angle is taken from -pi to pi, where sine and cosine are best.
__device__ inline void normal(word radial, word angular, float& one, float& other) {
    float u = (__uint2float_rn(radial) + 0.5f) * 0x1p-32f, left = 1.0f - u, radius;
    float series = left * (1.0f + left * (0.5f + left * (0.33333334f + left * 0.25f)));
    float square = 2.0f * (left < 0.03125f ? series : -__logf(u));
    radius = square * rsqrtf(fmaxf(square, 1e-30f));
    float angle = __int2float_rn((int)angular) * 1.4629180792671596e-9f;  // 2 pi / 2^32
    one = radius * __cosf(angle);
    other = radius * __sinf(angle);
}

__device__ inline void four_normals(Words of, float* n) {
    normal(of.a, of.b, n[0], n[1]);
    normal(of.c, of.d, n[2], n[3]);
}

// [components, runs, 4 q]
__global__ void normals(float* out, const long long* runs, word seed, word purpose, word step, int components, int R, int q) {
    int k = blockIdx.x * blockDim.x + threadIdx.x;
    if (k >= q) return;
    for (int row = blockIdx.y; row < components * R; row += gridDim.y) {
        float n[4];
        four_normals(philox(k, row / R, step, (word)runs[row % R], seed, purpose), n);
        float* to = out + (size_t)row * 4 * q + k;
#pragma unroll
        for (int m = 0; m < 4; ++m) to[(size_t)m * q] = n[m];
    }
}

__global__ void uniforms(double* out, const long long* runs, word seed, word purpose, word step, int components, int R, int q) {
    int k = blockIdx.x * blockDim.x + threadIdx.x;
    if (k >= q) return;
    for (int row = blockIdx.y; row < components * R; row += gridDim.y) {
        Words of = philox(k, row / R, step, (word)runs[row % R], seed, purpose);
        double* to = out + (size_t)row * 4 * q + k;
        to[0] = (of.a + 0.5) * 0x1p-32;
        to[q] = (of.b + 0.5) * 0x1p-32;
        to[2 * (size_t)q] = (of.c + 0.5) * 0x1p-32;
        to[3 * (size_t)q] = (of.d + 0.5) * 0x1p-32;
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
                    float n[4];
                    four_normals(philox(k, j, step, run, seed, purpose), n);
#pragma unroll
                    for (int m = 0; m < 4; ++m) noise[m] = n[m];
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

// Ancestors [R, N] by the positions (j + u) / n. Marks where each particle's slots begin, and fills up from there, so that what
// rounding leaves at the end goes to the last particle that weighs anything. `marks` are [R, N] in global memory, where those of a
// run do not fit into the block's own (`inside`).
template <typename T>
__global__ void systematic(
    long long* out, const T* a, const T* n, int n_stride, const double* u, int* marks, int inside, int R, int N) {
    extern __shared__ int own[];
    __shared__ T parts[32];
    __shared__ int whole[32];
    int* mark = inside ? own : marks + (size_t)blockIdx.x * N;
    bool aligned = N % 4 == 0;
    for (int r = blockIdx.x; r < R; r += gridDim.x) {
        const T* weight = a + (size_t)r * N;
        T total = 0, wanted = n[(size_t)r * n_stride], offset = (T)u[r];
#pragma unroll 4
        for (int i = 4 * threadIdx.x; i < N; i += 4 * blockDim.x) {
            Rows<T> value = four(weight + i, N - i, aligned);
            total += (value.v[0] + value.v[1]) + (value.v[2] + value.v[3]);
        }
        for (int i = threadIdx.x; i < N; i += blockDim.x) mark[i] = 0;
        total = over_block(total, Sum(), parts);
        T carried = 0, scale = wanted / total;
        int last = 0, end = (int)wanted;
        for (int first = 0; first < N; first += 4 * blockDim.x) {
            int i = first + 4 * threadIdx.x;
            Rows<T> value = four(weight + i, N - i, aligned);
            T all, sum = (value.v[0] + value.v[1]) + (value.v[2] + value.v[3]);
            T reach = carried + before(sum, Sum(), T(0), parts, all);
            int ends[4], most = 0, every;
#pragma unroll
            for (int v = 0; v < 4; ++v) {
                reach += value.v[v];
                ends[v] = value.v[v] > T(0) ? min((int)ceil(reach * scale - offset), end) : 0;
                most = max(most, ends[v]);
            }
            int begun = max(last, before(most, Most(), 0, whole, every));
#pragma unroll
            for (int v = 0; v < 4; ++v) {  // sums that are not made in one order may fall by a rounding
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
