// Systematic resampling, which decides on the same numbers in every engine.
//
// Weights are cut to multiples of 2^-52. Sums of them are exact in double precision, so that their order does not matter, and the
// few operations after them round once each: compile with -ffp-contract=off.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>

namespace {
// One uniform u for all slots, positions (j + u) / n: slot j goes to the first particle whose sum of weights lies beyond its position.
template <class T>
void systematic(int64_t* ancestor, const T* weight, const double* wanted, const double* uniform, int64_t runs, int64_t slots) {
    constexpr int64_t PARTS = 4;  // are summed side by side: one sum alone would wait for itself
    const int64_t part = slots / PARTS;
    const std::unique_ptr<double[]> sums(new double[slots]);
    const std::unique_ptr<int32_t[]> ends(new int32_t[slots]), first(new int32_t[slots + 1]);
    for (int64_t r = 0; r < runs; ++r, weight += slots, ancestor += slots) {
        for (int64_t i = 0; i < slots; ++i) sums[i] = std::trunc(static_cast<double>(weight[i]) * 0x1p52);
        double sum[PARTS] = {};
        for (int64_t i = 0; i < part; ++i)
            for (int64_t k = 0; k < PARTS; ++k) sums[k * part + i] = sum[k] += sums[k * part + i];
        for (int64_t i = PARTS * part; i < slots; ++i) sums[i] = sum[PARTS - 1] += sums[i];
        for (int64_t k = 1; k < PARTS; ++k) sum[k] += sum[k - 1];
        const double whole = sum[PARTS - 1], n = wanted[r], u = uniform[r], scale = n / whole;
        for (int64_t k = 0; k < PARTS; ++k) {
            const double before = k ? sum[k - 1] : 0.0;
            for (int64_t i = k * part; i < (k < PARTS - 1 ? (k + 1) * part : slots); ++i) {
                const double reach = before + sums[i];
                // not simply ceil, since the last sum times scale may round below n; NaN is not below the whole
                const double end = reach < whole ? std::min(std::ceil(reach * scale - u), n) : n;
                ends[i] = static_cast<int32_t>(end < 0 ? 0 : end);
            }
        }
        // a particle's slots begin where its predecessor's end; of several that begin at a slot, the last one has it
        std::fill(first.get(), first.get() + slots + 1, 0);
        for (int64_t i = 1; i < slots; ++i) first[ends[i - 1]] = static_cast<int32_t>(i);
        int32_t latest = 0;
        for (int64_t j = 0; j < slots; ++j) ancestor[j] = latest = std::max(latest, first[j]);
    }
}
}  // namespace

extern "C" void systematic_float(int64_t* ancestor, const float* weight, const double* n, const double* u, int64_t runs, int64_t slots) {
    systematic(ancestor, weight, n, u, runs, slots);
}

extern "C" void systematic_double(int64_t* ancestor, const double* weight, const double* n, const double* u, int64_t runs, int64_t slots) {
    systematic(ancestor, weight, n, u, runs, slots);
}
