// As much of CUDA as particles.cu needs, for a C++ compiler: blocks one after the other, of one thread each.
#include <cmath>
#include <cstring>
#include <utility>

#define __global__ static
#define __device__
#define __shared__ static
#define __launch_bounds__(...)
#define LANES 1

struct Index { int x, y; };
static const Index threadIdx{0, 0}, blockDim{1, 1};
static Index blockIdx, gridDim;
static int own_memory[1 << 16];  // of a block

static void __syncthreads() {}
template <typename T> static T __shfl_xor_sync(unsigned, T value, int) { return value; }
template <typename T> static T __shfl_up_sync(unsigned, T value, int) { return value; }
template <typename T> static T __shfl_sync(unsigned, T value, int) { return value; }
static int __popc(unsigned value) { return __builtin_popcount(value); }
static unsigned __float_as_uint(float value) { unsigned bits; std::memcpy(&bits, &value, 4); return bits; }
static float __int_as_float(unsigned bits) { float value; std::memcpy(&value, &bits, 4); return value; }
template <typename T> static T min(T a, T b) { return b < a ? b : a; }
template <typename T> static T max(T a, T b) { return a < b ? b : a; }

// what the driver does with a kernel and the addresses of its arguments
template <typename... A, std::size_t... I>
static void blocks(void (*kernel)(A...), int x, int y, void** given, std::index_sequence<I...>) {
    gridDim = {x, y};
    for (blockIdx.y = 0; blockIdx.y < y; ++blockIdx.y)
        for (blockIdx.x = 0; blockIdx.x < x; ++blockIdx.x) kernel(*(A*)given[I]...);
}
template <typename... A> static void launch(void (*kernel)(A...), int x, int y, void** given) {
    blocks(kernel, x, y, given, std::index_sequence_for<A...>());
}
