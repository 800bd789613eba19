// The loop over the steps of a filter, when torch's compiler has made one function of a step (see pfbench/filter/compiled.py).
//
// A small step takes a fraction of what Python takes to call it.
#include <dlfcn.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

#include "torch_interface.h"

#ifdef __SSE2__
#include <immintrin.h>
#endif

extern "C" int PyGILState_Ensure();
extern "C" void PyGILState_Release(int);

namespace {
using pfbench::Tensor;

typedef void (*Step)(AtenTensorHandle*, AtenTensorHandle*);  // takes its inputs over, leaves its outputs

// The interpreter's lock: a step lets go of it while it works, and so wants to be called by one who has it.
struct Lock {
    const int before = PyGILState_Ensure();
    ~Lock() { PyGILState_Release(before); }
};

// Numbers below the smallest normal one (1e-38 in single precision) count as 0: a processor takes a hundred times as long for one
// of them, and the weights of a peaked likelihood have many.
struct Flush {
#ifdef __SSE2__
    const unsigned before = _mm_getcsr();
    Flush() { _mm_setcsr(before | 0x8040); }  // results, and operands
    ~Flush() { _mm_setcsr(before); }
#endif
};

// What a compiled step takes as given: type, sizes and strides of each argument, and the number of its results. Its code was made
// for these alone and does not look at them again.
struct Signature {
    Step step;
    int64_t outputs;
    std::vector<std::vector<int64_t>> layouts;
};
std::vector<Signature> signatures;  // a step's number is its index plus one: Python never holds an address
std::mutex signatures_lock;

// The function that torch's compiler writes into the library of a step.
constexpr const char* ENTRY = "_Z19inductor_entry_implPP16AtenTensorOpaqueS1_";

// Type, sizes and strides of a tensor from an axis on. The stride of an axis of one entry has no meaning.
std::vector<int64_t> layout(const Tensor& a, int64_t first = 0) {
    std::vector<int64_t> numbers{a.dtype()};
    for (int64_t k = first; k < a.dim(); ++k) {
        numbers.push_back(a.size(k));
        numbers.push_back(a.size(k) > 1 ? a.stride(k) : 0);
    }
    return numbers;
}

// Loads the library of a step; its path is given as bytes.
int64_t register_step(Tensor library, int64_t outputs, std::vector<Tensor> arguments) {
    if (library.dtype() != aoti_torch_dtype_uint8() || library.dim() != 1 || (library.size(0) > 1 && library.stride(0) != 1))
        throw std::runtime_error("register_step: library must be a path as bytes, uint8 [n].");
    if (outputs < 0 || outputs > 1000000) throw std::runtime_error("register_step: outputs must be from 0 to 1000000.");
    const std::string path(static_cast<const char*>(library.data_ptr()), static_cast<size_t>(library.size(0)));
    void* const handle = path.empty() ? nullptr : dlopen(path.c_str(), RTLD_NOW);
    void* const entry = handle ? dlsym(handle, ENTRY) : nullptr;
    if (!entry) throw std::runtime_error("register_step: library must be a step of torch's compiler, got " + path + ".");
    Signature signature{reinterpret_cast<Step>(entry), outputs, {}};
    for (const Tensor& a : arguments) signature.layouts.push_back(layout(a));
    const std::lock_guard<std::mutex> guard(signatures_lock);
    signatures.push_back(signature);
    return static_cast<int64_t>(signatures.size());
}

// Raises unless a step has this number and its first call gets what it was compiled for.
Signature check_step(int64_t step, const std::vector<Tensor>& constants, const std::vector<Tensor>& state,
                     const std::vector<Tensor>& seen, const std::vector<Tensor>& shared) {
    const std::lock_guard<std::mutex> guard(signatures_lock);
    if (step < 1 || step > static_cast<int64_t>(signatures.size()))
        throw std::runtime_error("run_steps: step must be the number of a registered step, got " + std::to_string(step) + ".");
    const Signature& found = signatures[step - 1];
    if (found.outputs < static_cast<int64_t>(state.size()))
        throw std::runtime_error("run_steps: state must have at most " + std::to_string(found.outputs) + " tensors, as the step returns.");
    if (seen.empty()) throw std::runtime_error("run_steps: inputs must have at least one tensor.");
    std::vector<std::vector<int64_t>> layouts;
    for (const Tensor& a : constants) layouts.push_back(layout(a));
    for (const Tensor& a : state) layouts.push_back(layout(a));
    for (const Tensor& a : seen) {
        if (a.dim() < 1 || a.size(0) != seen[0].size(0))
            throw std::runtime_error("run_steps: inputs must have one row for each step.");
        layouts.push_back(layout(a, 1));
    }
    for (const Tensor& a : shared) layouts.push_back(layout(a));
    if (layouts.size() != found.layouts.size())
        throw std::runtime_error("run_steps: the step must have " + std::to_string(found.layouts.size()) + " arguments, got " +
                                 std::to_string(layouts.size()) + ".");
    for (size_t k = 0; k < layouts.size(); ++k)
        if (layouts[k] != found.layouts[k])
            throw std::runtime_error("run_steps: argument " + std::to_string(k) +
                                     " must have the type, shape and strides that the step was compiled for.");
    return found;
}

AtenTensorHandle again(const Tensor& a) { return pfbench::make_handle(a.get()); }

// a[t], which shares its memory.
AtenTensorHandle at(const Tensor& a, int64_t t) {
    const int64_t *const size = a.sizes(), *const stride = a.strides();
    AtenTensorHandle made;  // it begins beyond where `a` itself begins
    TORCH_CALL(aoti_torch__reinterpret_tensor, a.get(), a.dim() - 1, size + 1, stride + 1, t * stride[0], &made);
    return made;
}

// [..., R, N] as [R, N, ...], which shares its memory.
AtenTensorHandle particles_first(const Tensor& a) {
    const int64_t axes = a.dim();
    std::vector<int64_t> size, stride;
    for (int64_t k = 0; k < axes; ++k) {
        const int64_t from = k < 2 ? axes - 2 + k : k - 2;
        size.push_back(a.size(from));
        stride.push_back(a.stride(from));
    }
    AtenTensorHandle made;
    TORCH_CALL(aoti_torch__reinterpret_tensor, a.get(), axes, size.data(), stride.data(), 0, &made);
    return made;
}

// Entries of an int64 tensor [n].
std::vector<int64_t> read_indices(const Tensor& a, const char* name) {
    if (a.dtype() != aoti_torch_dtype_int64() || a.dim() != 1 || (a.size(0) > 1 && a.stride(0) != 1))
        throw std::runtime_error(std::string("run_steps: ") + name + " must be int64 [n].");
    const auto* const first = static_cast<const int64_t*>(a.data_ptr());
    return {first, first + a.size(0)};
}

size_t bytes_of(const Tensor& a) {
    const int32_t type = a.dtype();
    const int64_t size = type == aoti_torch_dtype_float64() || type == aoti_torch_dtype_int64() ? 8 : type == aoti_torch_dtype_float32() ? 4
                         : type == aoti_torch_dtype_bool()                                      ? 1
                                                                                                : 0;
    if (size == 0) throw std::runtime_error("run_steps: joined results must be float64, float32, int64 or bool.");
    return static_cast<size_t>(size * a.numel());
}

bool is_finite(const Tensor& a) {
    const auto all_finite = [n = a.numel()](const auto* value) {
        return std::all_of(value, value + n, [](auto number) { return std::isfinite(number); });
    };
    if (a.dtype() == aoti_torch_dtype_float64()) return all_finite(static_cast<const double*>(a.data_ptr()));
    if (a.dtype() == aoti_torch_dtype_float32()) return all_finite(static_cast<const float*>(a.data_ptr()));
    return true;
}

// Memory for a result of all steps, one row for each step, each like `row`.
Tensor make_rows(const Tensor& row, int64_t steps) {
    std::vector<int64_t> size{steps}, stride{row.numel()};
    int64_t expected = row.numel();
    for (int64_t k = 0; k < row.dim(); ++k) {
        size.push_back(row.size(k));
        expected /= row.size(k) > 0 ? row.size(k) : 1;
        if (row.size(k) > 1 && row.numel() > 0 && row.stride(k) != expected)
            throw std::runtime_error("run_steps: joined results must be contiguous.");
        stride.push_back(expected);
    }
    AtenTensorHandle made;
    TORCH_CALL(aoti_torch_empty_strided, static_cast<int64_t>(size.size()), size.data(), stride.data(), row.dtype(),
               aoti_torch_device_type_cpu(), 0, &made);
    return Tensor(made);
}

struct Block {
    Tensor rows;
    size_t bytes;  // of a row

    Block(const Tensor& row, int64_t steps) : rows(make_rows(row, steps)), bytes(bytes_of(row)) {}

    void store(int64_t t, const Tensor& row) { std::memcpy(static_cast<char*>(rows.data_ptr()) + t * bytes, row.data_ptr(), bytes); }

    // The first rows, which share the memory.
    Tensor head(int64_t steps) const {
        std::vector<int64_t> size(rows.sizes(), rows.sizes() + rows.dim());
        size[0] = steps;
        AtenTensorHandle made;
        TORCH_CALL(aoti_torch__reinterpret_tensor, rows.get(), rows.dim(), size.data(), rows.strides(), 0, &made);
        return Tensor(made);
    }
};

// The steps until the first of which joined result 0 is not finite. A step is given `constants`, `state` (which is what the one
// before left first), its part of `seen` [T, ...] and `shared`. First come the results that `joined` numbers, of all steps, [S, ...].
// Then come the other results of the steps in `kept`, which ascends, and of the last one, with the axes of particles first.
std::vector<Tensor> follow(int64_t number, std::vector<Tensor> constants, std::vector<Tensor> state, std::vector<Tensor> seen,
                           std::vector<Tensor> shared, Tensor joined_numbers, Tensor kept_steps) {
    const auto [step, outputs, layouts] = check_step(number, constants, state, seen, shared);
    const std::vector<int64_t> joined = read_indices(joined_numbers, "joined"), kept = read_indices(kept_steps, "kept");
    std::vector<bool> is_joined(outputs, false);
    for (const int64_t k : joined) {
        if (k < 0 || k >= outputs) throw std::runtime_error("run_steps: joined must be numbers of results.");
        is_joined[k] = true;
    }
    const Lock held;
    const Flush flushed;
    const int64_t steps = seen[0].size(0);
    std::vector<AtenTensorHandle> given, left(outputs);
    std::vector<Block> blocks;
    std::vector<Tensor> others, last;
    const auto keep = [&] {
        for (size_t k = 0; k < last.size(); ++k)
            if (!is_joined[k]) others.push_back(last[k].dim() > 2 ? Tensor(particles_first(last[k])) : last[k]);
        last.clear();
    };
    auto next_kept = kept.begin();
    int64_t t = 0;
    for (; t < steps; ++t) {
        given.clear();
        for (const Tensor& a : constants) given.push_back(again(a));
        for (const Tensor& a : state) given.push_back(again(a));
        for (const Tensor& a : seen) given.push_back(at(a, t));
        for (const Tensor& a : shared) given.push_back(again(a));
        step(given.data(), left.data());
        std::vector<Tensor> now;
        now.reserve(left.size());
        for (AtenTensorHandle a : left) now.emplace_back(a);
        // a step always leaves the same layouts, so the first one is enough
        for (size_t k = 0; t == 0 && steps > 1 && k < state.size(); ++k)
            if (layout(now[k]) != layouts[constants.size() + k])
                throw std::runtime_error("run_steps: result " + std::to_string(k) + " must have the layout that the next step takes.");
        if (t == 0)
            for (const int64_t k : joined) blocks.emplace_back(now[k], steps);
        if (!joined.empty() && !is_finite(now[joined[0]])) break;
        for (size_t j = 0; j < joined.size(); ++j) blocks[j].store(t, now[joined[j]]);
        std::copy_n(now.begin(), state.size(), state.begin());
        last = std::move(now);
        next_kept = std::find_if(next_kept, kept.end(), [t](int64_t k) { return k >= t; });
        if (next_kept != kept.end() && *next_kept == t) keep();
    }
    keep();
    std::vector<Tensor> all;
    for (const Block& block : blocks) all.push_back(block.head(t));
    all.insert(all.end(), others.begin(), others.end());
    return all;
}

const pfbench::Registration registration(pfbench::entry<&follow>("run_steps"), pfbench::entry<&register_step>("register_step"));
}  // namespace
