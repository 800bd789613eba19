// Checks of an operator's arguments: device, type and shape, O(number of axes), and ranges of values.
#pragma once
#include <algorithm>
#include <cctype>
#include <cstdint>
#include <string>

#include "tensors.h"

namespace {
class ArgumentCheck {
    const char* operator_name;
    int64_t sizes[26];  // of the axes A to Z; -1 as long as no argument has one
    int32_t real_type = -1;

    [[noreturn]] void fail(const char* argument, const std::string& requirement, const std::string& value) const {
        throw std::runtime_error(std::string(operator_name) + ": " + argument + " must " + requirement + ", got " + value + ".");
    }

    static std::string shape_of(const Tensor& a) {
        std::string text = "[";
        for (int64_t k = 0; k < a.dim(); ++k) text += (k ? ", " : "") + std::to_string(a.size(k));
        return text + "]";
    }

    static std::string axes_of(const char* axes) {
        std::string text = "[";
        for (const char* axis = axes; *axis; ++axis) {
            text += axis == axes ? "" : ", ";
            text += static_cast<char>(std::toupper(*axis));
            if (std::islower(*axis)) text += " or 1";
        }
        return text + "]";
    }

    void shape(const char* argument, const Tensor& a, const char* axes, const char* positive) {
        if (a.device_type() != aoti_torch_device_type_cpu()) fail(argument, "be on the CPU", "a tensor on another device");
        const int64_t count = static_cast<int64_t>(std::char_traits<char>::length(axes));
        bool valid = a.dim() == count;
        for (int64_t k = 0; valid && k < count; ++k) {
            const int64_t size = a.size(k);
            if (size >= MAX_SIZE) fail(argument, "have less than 2^30 entries along each axis", shape_of(a));
            if (axes[k] == '1') {
                valid = size == 1;
                continue;
            }
            if (std::islower(axes[k]) && size == 1) continue;
            int64_t& wanted = sizes[std::toupper(axes[k]) - 'A'];
            if (wanted < 0) wanted = size;
            valid = size == wanted && (size > 0 || std::string(positive).find(axes[k]) == std::string::npos);
        }
        if (valid) return;
        std::string known;
        for (char axis = 'A'; axis <= 'Z'; ++axis)
            if (const int64_t size = sizes[axis - 'A']; size >= 0)
                known += (known.empty() ? " with " : ", ") + std::string(1, axis) + " = " + std::to_string(size);
        fail(argument, "have shape " + axes_of(axes), shape_of(a) + known);
    }

  public:
    explicit ArgumentCheck(const char* name) : operator_name(name) {
        for (int64_t& size : sizes) size = -1;
    }

    // float32 or float64, the same type for all real arguments
    void real(const char* argument, const Tensor& a, const char* axes, const char* positive = "") {
        const int32_t type = kind(a);
        if (real_type < 0) real_type = type;
        if (type != real_type || (type != kind<float>() && type != kind<double>()))
            fail(argument, "be float32 or float64 as the other real arguments", "another type");
        shape(argument, a, axes, positive);
    }

    void number(const char* argument, const Tensor& a, const char* axes, const char* positive = "") {
        const int32_t type = kind(a);
        if (type != kind<float>() && type != kind<double>() && type != kind<int64_t>())
            fail(argument, "be float32, float64 or int64", "another type");
        shape(argument, a, axes, positive);
    }

    void int64(const char* argument, const Tensor& a, const char* axes, const char* positive = "") {
        if (kind(a) != kind<int64_t>()) fail(argument, "be int64", "another type");
        shape(argument, a, axes, positive);
    }

    void integer(const char* argument, int64_t value) {
        if (value < 0 || value >= MAX_SIZE * 4) fail(argument, "be a whole number from 0 to 2^32 - 1", std::to_string(value));
    }

    // Values from 0 to factor times the size of an axis, for indices minus 1.
    void range(const char* argument, const Tensor& a, int64_t factor, char axis, bool is_index) {
        const int64_t size = factor * (axis == '1' ? 1 : sizes[axis - 'A']);
        bool valid = true;
        if (kind(a) == kind<int64_t>()) {  // without a branch, so that many are compared at a time
            const Packed<int64_t> values(a);
            const int64_t count = a.numel();
            const uint64_t largest = static_cast<uint64_t>(size) - is_index;
            uint64_t outside = 0;  // its highest bit is that of a value below 0 or of a difference below 0
            for (int64_t i = 0; i < count; ++i) {
                const uint64_t value = static_cast<uint64_t>(values.data[i]);
                outside |= value | (largest - value);
            }
            valid = count == 0 || outside >> 63 == 0;
        } else {
            for (const double value : few<double>(a, a.size(0), a.size(1)))
                valid &= value >= 0 && value <= static_cast<double>(size);  // a comparison with NaN is false
        }
        if (valid) return;
        std::string text = axis == '1' ? std::to_string(factor) : (factor == 1 ? "" : std::to_string(factor) + " ") + axis;
        fail(argument, "be from 0 to " + text + (is_index ? " - 1" : ""), "a value outside");
    }
};
}  // namespace
