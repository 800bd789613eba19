"""Derivatives of maps of states: backward and forward, against those written down."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pfbench.core import linear_algebra as jacobian_module
from pfbench.core.linear_algebra import jacobian

R, D = 3, 4
AT = torch.linspace(0.3, 1.7, R * D, dtype=torch.float64).view(R, 1, D)


def bent(xi: Tensor) -> Tensor:
    """Two values of four numbers, a constant among what they are made of."""
    a = AT + xi
    return torch.stack([torch.sin(a[..., 0]) * a[..., 1] + 2.0, a[..., 2] / (1.0 + a[..., 3])], -1)


def written() -> Tensor:
    a, b, c, d = AT[:, 0].unbind(-1)
    zero = torch.zeros_like(a)
    numbers = [torch.cos(a) * b, torch.sin(a), zero, zero, zero, zero, 1.0 / (1.0 + d), -c / (1.0 + d) ** 2]  # fmt: skip
    return torch.stack(numbers, -1).unflatten(-1, (2, 4))


def at_zero(f: jacobian_module.Map) -> Tensor:
    return f(torch.zeros(R, 1, D, dtype=torch.float64))


def of_no_use(*_: object) -> Tensor:
    raise AssertionError("the other way was asked for")


def test_backward_and_forward_give_what_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forward only where a gradient is required: it takes several times as long."""
    by = torch.ones((), dtype=torch.float64, requires_grad=True)
    for mode in (torch.no_grad, torch.enable_grad):
        with mode(), monkeypatch.context() as patched:
            patched.setattr(jacobian_module, "_forward", of_no_use)
            assert torch.allclose(jacobian(bent, at_zero(bent), D), written(), rtol=1e-14)
    monkeypatch.setattr(jacobian_module, "_backward", of_no_use)
    found = jacobian(lambda xi: by * bent(xi), by * at_zero(bent), D)
    assert found.requires_grad
    assert torch.allclose(found, written(), rtol=1e-14)


def test_a_gradient_goes_through() -> None:
    by = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(jacobian(lambda xi: by**2 * bent(xi), by**2 * at_zero(bent), D).sum(), by)  # fmt: skip
    assert torch.allclose(gradient, 2.0 * by * written().sum(), rtol=1e-13)


def test_a_branch_not_taken_spoils_nothing() -> None:
    """The length of a difference is 0 at 0, where its root has no derivative; runs that have no value stay out of it."""

    def guarded(xi: Tensor) -> Tensor:
        square = xi.square().sum(-1, keepdim=True)
        return torch.where(square > 0.0, torch.sqrt(square), 0.0) + bent(xi)

    with torch.no_grad():
        assert jacobian_module._backward(guarded, at_zero(guarded), D, torch.subtract) is None
        assert torch.allclose(jacobian(guarded, at_zero(guarded), D), written(), rtol=1e-14)

        def lost(xi: Tensor) -> Tensor:
            return bent(xi) * torch.tensor([1.0, torch.nan, 1.0], dtype=torch.float64).view(R, 1, 1)

        found = jacobian(lost, at_zero(lost), D)
    assert torch.allclose(found[[0, 2]], written()[[0, 2]], rtol=1e-14)
    assert not bool(torch.isfinite(found[1].sum()))


def test_values_that_wrap_and_values_that_stand_still() -> None:
    def turned(a: Tensor, b: Tensor) -> Tensor:
        return torch.remainder(a - b + torch.pi, 2.0 * torch.pi) - torch.pi

    def wrapped(xi: Tensor) -> Tensor:
        return turned(3.0 * (AT + xi)[..., :1], torch.zeros(1, dtype=torch.float64))

    for mode in (torch.no_grad, torch.enable_grad):
        with mode():
            assert torch.allclose(
                jacobian(wrapped, at_zero(wrapped), D, turned)[:, 0, 0], torch.tensor(3.0).double()
            )
            assert torch.equal(
                jacobian(lambda xi: AT[..., :2].expand(-1, xi.shape[1], -1), AT[..., :2], D),
                torch.zeros(R, 2, D).double(),
            )
