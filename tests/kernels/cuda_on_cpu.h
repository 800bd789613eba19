// As much of CUDA as particles.cu needs, for a C++ compiler: blocks one after the other. Threads of a block take turns: each runs
// until it waits for the others, in warps of 32. Every other block runs its threads from the last one, so that a missing barrier shows.
#include <ucontext.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <utility>

#define __global__ static
#define __device__
#define __forceinline__ inline
#define __shared__ static
#define __launch_bounds__(...)
#define LANES 32

struct Index { int x, y; };
static Index threadIdx, blockDim, blockIdx, gridDim;
static int own_memory[1 << 16];  // of a block

enum State { READY, AT_BLOCK, AT_WARP, DONE };
struct Thread {
    ucontext_t context;
    std::unique_ptr<char[]> stack;
    State state;
    int turn;  // shuffles so far
};
static constexpr int MOST = 512;
static constexpr std::size_t STACK = 1 << 16;
static Thread threads[MOST];
static unsigned long long passed[2][MOST];  // by threads to others of their warp, at even and odd shuffles
static ucontext_t scheduler;
static void (*work)(void**);
static void** work_arguments;

static void wait_for(State where) {
    Thread& own = threads[threadIdx.x];
    own.state = where;
    swapcontext(&own.context, &scheduler);
}
static void run_thread() {
    work(work_arguments);
    threads[threadIdx.x].state = DONE;
}
// lets threads go that all wait at the same place
static bool release(int first, int last, State where) {
    for (int i = first; i < last; ++i)
        if (threads[i].state != where && threads[i].state != DONE) return false;
    bool some = false;
    for (int i = first; i < last; ++i)
        if (threads[i].state == where) threads[i].state = READY, some = true;
    return some;
}
static void run_block(bool from_last) {
    int size = blockDim.x;
    for (int i = 0; i < size; ++i) {
        Thread& thread = threads[i];
        if (!thread.stack) thread.stack.reset(new char[STACK]);
        getcontext(&thread.context);
        thread.context.uc_stack.ss_sp = thread.stack.get();
        thread.context.uc_stack.ss_size = STACK;
        thread.context.uc_link = &scheduler;
        makecontext(&thread.context, run_thread, 0);
        thread.state = READY;
        thread.turn = 0;
    }
    for (bool some = true; some;) {
        some = false;
        for (int warp = 0; warp < size; warp += LANES) {
            int first = from_last ? size - LANES - warp : warp;
            do {
                for (int k = 0; k < LANES; ++k) {
                    int i = first + (from_last ? LANES - 1 - k : k);
                    if (threads[i].state != READY) continue;
                    threadIdx.x = i;
                    some = true;
                    swapcontext(&scheduler, &threads[i].context);
                }
            } while (release(first, first + LANES, AT_WARP));
        }
        some = release(0, size, AT_BLOCK) || some;
    }
    for (int i = 0; i < size; ++i)
        if (threads[i].state != DONE) std::fprintf(stderr, "thread %d waits for ever\n", i), std::abort();
}

static void __syncthreads() { wait_for(AT_BLOCK); }
template <typename T> static T pass(T value, int from) {
    int lane = threadIdx.x, first = lane / LANES * LANES;
    unsigned long long* place = passed[threads[lane].turn++ % 2];
    std::memcpy(place + lane, &value, sizeof value);
    wait_for(AT_WARP);
    std::memcpy(&value, place + first + from, sizeof value);
    return value;
}
template <typename T> static T __shfl_xor_sync(unsigned, T value, int off) { return pass(value, threadIdx.x % LANES ^ off); }
template <typename T> static T __shfl_up_sync(unsigned, T value, int off) {
    int lane = threadIdx.x % LANES;
    return pass(value, lane < off ? lane : lane - off);
}
template <typename T> static T __shfl_sync(unsigned, T value, int from) { return pass(value, from % LANES); }
static int __popc(unsigned value) { return __builtin_popcount(value); }
static unsigned __float_as_uint(float value) { unsigned bits; std::memcpy(&bits, &value, 4); return bits; }
static float __int_as_float(unsigned bits) { float value; std::memcpy(&value, &bits, 4); return value; }
template <typename T> static T min(T a, T b) { return b < a ? b : a; }
template <typename T> static T max(T a, T b) { return a < b ? b : a; }
using std::exp;
using std::log;

// what the driver does with a kernel and the addresses of its arguments
template <auto kernel, typename... A, std::size_t... I>
static void call(void (*)(A...), void** given, std::index_sequence<I...>) {
    kernel(*(A*)given[I]...);
}
template <auto kernel, typename... A> static void call(void (*which)(A...), void** given) {
    call<kernel>(which, given, std::index_sequence_for<A...>());
}
template <auto kernel> static void launch(int x, int y, int size, void** given) {
    gridDim = {x, y};
    blockDim = {size, 1};
    work = [](void** given) { call<kernel>(kernel, given); };
    work_arguments = given;
    for (blockIdx.y = 0; blockIdx.y < y; ++blockIdx.y)
        for (blockIdx.x = 0; blockIdx.x < x; ++blockIdx.x) run_block((blockIdx.x + blockIdx.y) % 2);
}
