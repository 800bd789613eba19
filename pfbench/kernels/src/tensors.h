// Torch's tensors as the loops want them: plain numbers.
#pragma once
#include <array>
#include <cstdint>
#include <type_traits>
#include <vector>

#include "torch_interface.h"

namespace {
using pfbench::Tensor;

constexpr int64_t MAX_SIZE = int64_t{1} << 30;  // of an axis: counters of particles have 32 bits

// Raises where a condition on the values of an argument does not hold.
inline void require(bool condition, const char* message) {
    if (!condition) throw std::runtime_error(message);
}

// A product of a sum: numbers of particles, and their coefficient.
template <class T>
struct Product {
    const T* from;
    T by;
};

// Of the processor: a compiler takes longer vectors apart badly.
#if defined(__AVX512F__)
constexpr int REGISTER = 64;  // bytes
#elif defined(__AVX__)
constexpr int REGISTER = 32;
#else
constexpr int REGISTER = 16;
#endif

template <class T>
int32_t kind() {
    if (std::is_same_v<T, float>) return aoti_torch_dtype_float32();
    if (std::is_same_v<T, double>) return aoti_torch_dtype_float64();
    return std::is_same_v<T, bool> ? aoti_torch_dtype_bool() : aoti_torch_dtype_int64();
}

inline int32_t kind(const Tensor& a) { return a.dtype(); }

template <class T>
T* numbers(const Tensor& a) {
    require(kind(a) == kind<T>(), "pfbench: a loop's tensors are of different types");
    return static_cast<T*>(a.data_ptr());
}

// A new tensor, contiguous.
template <class T>
Tensor fresh(const std::vector<int64_t>& size) {
    std::vector<int64_t> stride(size.size(), 1);
    for (size_t k = size.size() - 1; k > 0; --k) stride[k - 1] = stride[k] * size[k];
    AtenTensorHandle made;
    TORCH_CALL(aoti_torch_empty_strided, static_cast<int64_t>(size.size()), size.data(), stride.data(), kind<T>(),
               aoti_torch_device_type_cpu(), 0, &made);
    return Tensor(made);
}

// A tensor's numbers one after the other, its axes in the order given, outermost first; copied only where they lie otherwise.
template <class T>
class Packed {
    std::vector<T> own;

  public:
    const T* data;

    explicit Packed(const Tensor& a, std::array<int64_t, 3> order = {0, 1, 2}) : data(numbers<T>(a)) {
        std::array<int64_t, 3> size, step;
        const int64_t *const sizes = a.sizes(), *const strides = a.strides(), axes = a.dim();
        int64_t count = 1;
        bool apart = false;
        for (int k = 2; k >= 0; --k) {
            const bool there = order[k] < axes;
            size[k] = there ? sizes[order[k]] : 1;
            step[k] = there ? strides[order[k]] : 0;
            apart |= size[k] != 1 && step[k] != count;
            count *= size[k];
        }
        if (!apart) return;
        own.resize(count);
        T* to = own.data();
        for (int64_t i = 0; i < size[0]; ++i)
            for (int64_t j = 0; j < size[1]; ++j, to += size[2])
                for (int64_t k = 0; k < size[2]; ++k) to[k] = data[i * step[0] + j * step[1] + k * step[2]];
        data = own.data();
    }
    Packed(const Packed&) = delete;
};

constexpr std::array<int64_t, 3> COMPONENTS_FIRST = {2, 0, 1};

// A few numbers of any type, [R or 1, K or 1] or [R or 1], as [R, K] of another.
template <class T>
std::vector<T> few(const Tensor& a, int64_t rows, int64_t columns = 1) {
    const int64_t down = a.size(0) == 1 ? 0 : a.stride(0), across = a.dim() < 2 || a.size(1) == 1 ? 0 : a.stride(1);
    std::vector<T> all;
    all.reserve(rows * columns);
    const auto fill = [&](const auto* from) {
        for (int64_t r = 0; r < rows; ++r)
            for (int64_t k = 0; k < columns; ++k) all.push_back(static_cast<T>(from[r * down + k * across]));
    };
    if (kind(a) == kind<float>()) fill(numbers<float>(a));
    else if (kind(a) == kind<double>()) fill(numbers<double>(a));
    else fill(numbers<int64_t>(a));
    return all;
}

template <class F>
auto by_type(const Tensor& like, F work) {
    return kind(like) == kind<float>() ? work(float{}) : work(double{});
}
}  // namespace
