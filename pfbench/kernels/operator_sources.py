"""C++ of the operators that is made from the manifest: declarations, checks and registration.

`python -m pfbench.kernels.operator_sources` writes `src/operators.h` and `src/operators.cpp`.
"""

from __future__ import annotations

from pfbench.kernels.manifest import KERNELS_FOLDER, Argument, Operator, read_operators

_HEAD = "// Written by `python -m pfbench.kernels.operator_sources` from operators.toml."
_DECLARATIONS = """\
// Operators on the CPU. Their arguments have been checked.
#pragma once
#include "tensors.h"

namespace operators {"""
_CHECKS = """\
// The operators as torch calls them: checks of the arguments, registration.
#include "argument_check.h"
#include "operators.h"

namespace {"""


def make_sources() -> dict[str, str]:
    """Make the generated files of the C++ operators."""
    operators = [operator for operator in read_operators().values() if operator.is_on_cpu]
    names = ",\n    ".join(
        f'pfbench::entry<&{operator.name}>("{operator.name}")' for operator in operators
    )
    declarations = [_HEAD, _DECLARATIONS, *(f"{_signature(operator)};" for operator in operators)]
    definitions = [_HEAD, _CHECKS, *(_checked(operator) for operator in operators)]
    definitions += [f"const pfbench::Registration registration(\n    {names});"]
    return {
        "operators.h": "\n".join([*declarations, "}  // namespace operators", ""]),
        "operators.cpp": "\n".join([*definitions, "}  // namespace", ""]),
    }


def _signature(operator: Operator) -> str:
    types = ("int64_t " if a.kind == "int" else "const Tensor& " for a in operator.arguments)
    parameters = ", ".join(f"{t}{a.name}" for t, a in zip(types, operator.arguments, strict=True))
    result_types = ", ".join(["Tensor"] * len(operator.results))
    if len(operator.results) > 1:
        result_types = f"std::tuple<{result_types}>"
    return f"{result_types} {operator.name}({parameters})"


def _checked(operator: Operator) -> str:
    """Return the function that checks the arguments of an operator and calls it."""
    lines = [f"{_signature(operator)} {{", f'    ArgumentCheck check("{operator.name}");']
    lines += [f"    check.{_check(a)};" for a in operator.arguments]
    for name, *_, limit, _ in operator.arguments:
        if limit is not None:
            largest = f"{limit.factor}, '{limit.axis}', {int(limit.is_index)}"
            lines.append(f'    check.range("{name}", {name}, {largest});')
    parameters = ", ".join(a.name for a in operator.arguments)
    return "\n".join([*lines, f"    return operators::{operator.name}({parameters});", "}", ""])


def _check(argument: Argument) -> str:
    """Return the check of type and shape of an argument."""
    name, kind, axes, positive, *_ = argument
    if kind == "int":
        return f'integer("{name}", {name})'
    more = f', "{positive}"' if positive else ""
    return f'{kind}("{name}", {name}, "{axes}"{more})'


if __name__ == "__main__":
    for name, text in make_sources().items():
        (KERNELS_FOLDER / "src" / name).write_text(text)
