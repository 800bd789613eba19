// Torch's tensors and operators through the C functions of its stable interface.
//
// Torch keeps these functions in all versions from 2.10 on. They are declared here, so that building needs a compiler and no torch,
// and one library serves all versions. A test compares the declarations with torch's own headers.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

extern "C" {
using AOTITorchError = int32_t;
using StableIValue = uint64_t;
struct AtenTensorOpaque;
using AtenTensorHandle = AtenTensorOpaque*;
class TorchLibraryOpaque;
using TorchLibraryHandle = TorchLibraryOpaque*;
struct StableListOpaque;
using StableListHandle = StableListOpaque*;

int32_t aoti_torch_device_type_cpu();
int32_t aoti_torch_dtype_int64();
int32_t aoti_torch_dtype_float32();
int32_t aoti_torch_dtype_float64();
int32_t aoti_torch_dtype_bool();
AOTITorchError aoti_torch_delete_tensor_object(AtenTensorHandle tensor);
AOTITorchError aoti_torch_new_tensor_handle(AtenTensorHandle from, AtenTensorHandle* made);
AOTITorchError aoti_torch_get_data_ptr(AtenTensorHandle tensor, void** data);
AOTITorchError aoti_torch_get_dim(AtenTensorHandle tensor, int64_t* dim);
AOTITorchError aoti_torch_get_numel(AtenTensorHandle tensor, int64_t* numel);
AOTITorchError aoti_torch_get_sizes(AtenTensorHandle tensor, int64_t** sizes);
AOTITorchError aoti_torch_get_strides(AtenTensorHandle tensor, int64_t** strides);
AOTITorchError aoti_torch_get_dtype(AtenTensorHandle tensor, int32_t* dtype);
AOTITorchError aoti_torch_get_device_type(AtenTensorHandle tensor, int32_t* type);
AOTITorchError aoti_torch_empty_strided(int64_t ndim, const int64_t* sizes, const int64_t* strides, int32_t dtype, int32_t device_type,
                                        int32_t device_index, AtenTensorHandle* made);
AOTITorchError aoti_torch_library_init_impl(const char* space, const char* key, const char* file, uint32_t line,
                                            TorchLibraryHandle* made);
AOTITorchError torch_library_impl(TorchLibraryHandle self, const char* name, void (*function)(StableIValue*, uint64_t, uint64_t),
                                  uint64_t version);
AOTITorchError torch_new_list_reserve_size(size_t size, StableListHandle* made);
AOTITorchError torch_list_size(StableListHandle list, size_t* size);
AOTITorchError torch_list_get_item(StableListHandle list, size_t index, StableIValue* item);
AOTITorchError torch_list_push_back(StableListHandle list, StableIValue item);
AOTITorchError torch_delete_list(StableListHandle list);
}

namespace pfbench {
constexpr uint64_t INTERFACE_VERSION = (uint64_t{2} << 56) | (uint64_t{10} << 48);  // of torch, by which values are passed

inline void require_success(AOTITorchError code, const char* call) {
    if (code != 0) throw std::runtime_error(std::string("torch refused ") + call + ".");
}
#define TORCH_CALL(function, ...) ::pfbench::require_success(function(__VA_ARGS__), #function)

// A tensor that shares its memory with those of torch.
class Tensor {
    std::shared_ptr<AtenTensorOpaque> handle;

    template <class T>
    T value_of(AOTITorchError (*function)(AtenTensorHandle, T*)) const {
        T value;
        require_success(function(get(), &value), "a property of a tensor");
        return value;
    }

  public:
    // It owns the handle.
    explicit Tensor(AtenTensorHandle own) : handle(own, [](AtenTensorHandle a) { aoti_torch_delete_tensor_object(a); }) {}

    AtenTensorHandle get() const { return handle.get(); }
    void* data_ptr() const { return value_of(aoti_torch_get_data_ptr); }
    int64_t dim() const { return value_of(aoti_torch_get_dim); }
    int64_t numel() const { return value_of(aoti_torch_get_numel); }
    const int64_t* sizes() const { return value_of(aoti_torch_get_sizes); }
    const int64_t* strides() const { return value_of(aoti_torch_get_strides); }
    int64_t size(int64_t axis) const { return sizes()[axis]; }
    int64_t stride(int64_t axis) const { return strides()[axis]; }
    int32_t dtype() const { return value_of(aoti_torch_get_dtype); }
    int32_t device_type() const { return value_of(aoti_torch_get_device_type); }
};

// Another handle of the same tensor.
inline AtenTensorHandle make_handle(AtenTensorHandle a) {
    AtenTensorHandle made;
    TORCH_CALL(aoti_torch_new_tensor_handle, a, &made);
    return made;
}

// Values on torch's stack: 64 bits, of a list or a tensor its handle. An argument is taken over, a result is handed over.
inline StableIValue from_handle(const void* handle) { return reinterpret_cast<uintptr_t>(handle); }

template <class T>
struct Value;
template <>
struct Value<int64_t> {
    static int64_t take(StableIValue value) { return static_cast<int64_t>(value); }
    static StableIValue give(int64_t value) { return static_cast<StableIValue>(value); }
};
template <>
struct Value<Tensor> {
    static Tensor take(StableIValue value) { return Tensor(reinterpret_cast<AtenTensorHandle>(static_cast<uintptr_t>(value))); }
    static StableIValue give(const Tensor& a) { return from_handle(make_handle(a.get())); }
};
template <>
struct Value<std::vector<Tensor>> {
    struct Delete {
        void operator()(StableListHandle list) const { torch_delete_list(list); }
    };
    using List = std::unique_ptr<StableListOpaque, Delete>;

    static std::vector<Tensor> take(StableIValue value) {
        const List list(reinterpret_cast<StableListHandle>(static_cast<uintptr_t>(value)));
        size_t count;
        TORCH_CALL(torch_list_size, list.get(), &count);
        std::vector<Tensor> all;
        all.reserve(count);
        for (size_t k = 0; k < count; ++k) {
            StableIValue item;
            TORCH_CALL(torch_list_get_item, list.get(), k, &item);
            all.push_back(Value<Tensor>::take(item));
        }
        return all;
    }
    static StableIValue give(const std::vector<Tensor>& all) {
        StableListHandle made;
        TORCH_CALL(torch_new_list_reserve_size, all.size(), &made);
        List list(made);
        for (const Tensor& a : all) TORCH_CALL(torch_list_push_back, made, Value<Tensor>::give(a));
        return from_handle(list.release());
    }
};

template <class R>
void give_results(StableIValue* stack, const R& result) {
    stack[0] = Value<R>::give(result);
}
template <class... R>
void give_results(StableIValue* stack, const std::tuple<R...>& results) {
    std::apply([&](const auto&... result) { ((*stack++ = Value<R>::give(result)), ...); }, results);
}

// A function as torch calls it: it takes its arguments from the stack and leaves its results there.
template <auto F>
struct Boxed;
template <class R, class... A, R (*F)(A...)>
struct Boxed<F> {
    static void call(StableIValue* stack, uint64_t, uint64_t) { run(stack, std::index_sequence_for<A...>{}); }

  private:
    template <size_t... I>
    static void run(StableIValue* stack, std::index_sequence<I...>) {
        std::tuple<std::decay_t<A>...> arguments{Value<std::decay_t<A>>::take(stack[I])...};
        give_results(stack, F(std::move(std::get<I>(arguments))...));
    }
};

// Registers operators of the namespace pfbench for tensors on the CPU. Torch keeps them as long as the process runs.
struct Registration {
    template <class... Entry>
    explicit Registration(const Entry&... entries) {
        TorchLibraryHandle library;
        TORCH_CALL(aoti_torch_library_init_impl, "pfbench", "CPU", __FILE__, __LINE__, &library);
        (require_success(torch_library_impl(library, entries.first, entries.second, INTERFACE_VERSION), entries.first), ...);
    }
};
template <auto F>
auto entry(const char* name) {
    return std::make_pair(name, &Boxed<F>::call);
}
}  // namespace pfbench
