"""Random calls of the C++ operators, valid and wrong: `random_calls.py CALLS SEED`. A wrong call must raise.

With an argument `sanitize` the operators are built with AddressSanitizer and UndefinedBehaviorSanitizer. Their
runtimes must be preloaded, see sanitized.py.
"""

import random
import sys
from typing import Any

import torch
from torch import Tensor

from pfbench.kernels import dispatch
from pfbench.kernels.manifest import Argument, check_arguments, read_operators

OPERATORS = {name: operator.arguments for name, operator in read_operators().items()}
ON_CPU = [name for name, operator in read_operators().items() if operator.is_on_cpu]
REALS = (torch.float32, torch.float64)


def make_tensor(
    argument: Argument, shape: list[int], real: torch.dtype, rng: random.Random
) -> Tensor:
    """A tensor of an argument's kind whose memory is contiguous, permuted, a slice or expanded."""
    dtype = {"real": real, "int64": torch.int64}.get(argument.kind) or rng.choice(
        (*REALS, torch.int64)
    )
    layout = rng.randrange(4)
    if layout == 1 and len(shape) > 1:
        x = torch.rand(shape[::-1]).permute(*reversed(range(len(shape))))
    elif layout == 2 and shape:
        x = torch.rand(*shape[:-1], 2 * shape[-1] + 3)[..., 1 : 2 * shape[-1] + 1 : 2]
    elif layout == 3 and shape:
        x = torch.rand(1, *shape[1:]).expand(shape)
    else:
        x = torch.rand(shape)
    if dtype == torch.int64:
        return (4 * x).long()
    if layout == 0 and rng.random() < 0.3 and x.numel():
        x.view(-1)[rng.randrange(x.numel())] = rng.choice((torch.nan, torch.inf, -torch.inf, 1e38))
    return x.to(dtype) if layout != 3 or not shape else x[:1].to(dtype).expand(shape)


def make_call(name: str, rng: random.Random, given: dict[str, int] | None = None) -> list[Any]:
    """Valid arguments of random or given sizes."""
    sizes = dict(given or {})
    real, arguments = rng.choice(REALS), []
    for argument in OPERATORS[name]:
        if argument.kind == "int":
            arguments.append(rng.choice((0, 1, 2, 5)))
            continue
        shape = []
        for axis in argument.axes:
            longest = 70 if axis.upper() in "NM" else 9
            least = int(axis in argument.positive)
            size = sizes.setdefault(
                axis.upper(), rng.choice((least, 1, 2, rng.randint(1, longest)))
            )
            shape.append(1 if axis == "1" or (axis.islower() and rng.random() < 0.4) else size)
        arguments.append(make_tensor(argument, shape, real, rng))
    return fix_values(name, arguments, sizes)


def fix_values(name: str, arguments: list[Any], sizes: dict[str, int]) -> list[Any]:
    """Put values into the ranges of the manifest."""
    for place, argument in enumerate(OPERATORS[name]):
        if argument.limit is None:
            continue
        shape, largest = arguments[place].shape, max(0, argument.limit.largest(sizes))
        is_uniform = argument.limit.axis == "1"
        arguments[place] = torch.rand(shape) if is_uniform else torch.randint(0, largest + 1, shape)
    return arguments


def spoil(name: str, arguments: list[Any], rng: random.Random) -> list[Any]:
    """Change one argument of a valid call in its shape, type or values."""
    place = rng.randrange(len(arguments))
    argument, value = OPERATORS[name][place], arguments[place]
    spoiled = list(arguments)
    if argument.kind == "int":
        spoiled[place] = rng.choice((-1, -(2**40), 2**40, 2**62))
        return spoiled
    kind = rng.randrange(4)
    if kind == 0 and value.dim():
        axis = rng.randrange(int(argument.has_batch), value.dim())
        spoiled[place] = torch.cat(
            [value] + [value.narrow(axis, 0, min(1, value.shape[axis]))] * 2, axis
        )
    elif kind == 1 and argument.has_batch:
        spoiled[place] = value.reshape(-1)[:1].sum()  # any number of axes more would be valid
    elif kind == 1:
        spoiled[place] = (
            value.unsqueeze(0) if value.dim() < 3 or rng.random() < 0.5 else value[0:0].sum(0)
        )
    elif kind == 2:
        spoiled[place] = value.to(
            rng.choice((torch.int32, torch.float16, torch.bool, torch.complex64))
        )
    elif places := [k for k, other in enumerate(OPERATORS[name]) if other.limit is not None]:
        index = rng.choice(places)
        spoiled[index] = arguments[index] + rng.choice((-(2**40), 2**40, 1000, -1000))
    else:
        spoiled[place] = value.to(torch.int16)
    return spoiled


def wrong_values(argument: Argument, value: Any) -> list[Any]:
    """Values that an argument must not have: of a wrong kind, type, shape or range."""
    if argument.kind == "int":
        return [-1, 2**32, 1.5, None]
    wrong = [3, None, value.to(torch.int32), value.to(torch.float16), value.unsqueeze(0)]
    if argument.has_batch:
        wrong[-1] = value.reshape(-1)[0]
    if argument.limit is not None:
        wrong += [value - 1000, value + 1000]
    return wrong


def is_valid(name: str, arguments: list[Any]) -> bool:
    """Whether the Python check accepts a call."""
    try:
        check_arguments(name, arguments)
    except ValueError:
        return False
    return True


def run(calls: int, seed: int) -> dict[str, int]:
    """Make random calls and count what became of them."""
    dispatch.sum_and_squares(torch.rand(1, 1))  # loads the operators
    rng = random.Random(seed)
    torch.manual_seed(seed)
    counts = dict.fromkeys(("computed", "refused", "wrong but computed", "valid but refused"), 0)
    for _ in range(calls):
        name = rng.choice(ON_CPU)
        arguments = make_call(name, rng)
        if rng.random() < 0.5:
            arguments = spoil(name, arguments, rng)
        valid = is_valid(name, arguments)
        try:
            getattr(dispatch, name)(*arguments)  # its check is that in C++
            counts["computed" if valid else "wrong but computed"] += 1
        except (RuntimeError, ValueError, TypeError) as error:
            is_too_large = "more than" in str(error)  # the only check outside of the manifest
            counts["refused" if not valid or is_too_large else "valid but refused"] += 1
    return counts


if __name__ == "__main__":
    torch.set_num_threads(1)
    if "sanitize" not in sys.argv:
        print(run(int(sys.argv[1]), int(sys.argv[2])))
    else:
        import sanitized

        outcomes = run(int(sys.argv[1]), int(sys.argv[2]))
        sanitized.check_library()
        print(outcomes)
