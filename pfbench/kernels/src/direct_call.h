// Calls of operators by the code that torch's compiler makes of a step. To look an operator up would take longer than a small one.
#pragma once
#include <initializer_list>

#include "torch_interface.h"

#define DIRECT_CALL extern "C" __attribute__((visibility("default"))) AOTITorchError

namespace {
// The caller keeps its tensors: a handle of our own is made.
inline pfbench::Tensor borrow(AtenTensorHandle a) { return pfbench::Tensor(pfbench::make_handle(a)); }
inline int64_t borrow(int64_t a) { return a; }

inline void hand_over(std::initializer_list<AtenTensorHandle*> to, const pfbench::Tensor& result) {
    **to.begin() = pfbench::make_handle(result.get());
}
template <class... R>
void hand_over(std::initializer_list<AtenTensorHandle*> to, const std::tuple<R...>& results) {
    auto next = to.begin();
    std::apply([&](const auto&... result) { ((**next++ = pfbench::make_handle(result.get())), ...); }, results);
}

// The code of 1 is a failure, which the caller raises.
template <auto F, class... A>
AOTITorchError call_directly(std::initializer_list<AtenTensorHandle*> results, A... arguments) {
    try {
        hand_over(results, F(borrow(arguments)...));
        return 0;
    } catch (...) {
        return 1;
    }
}
}  // namespace
