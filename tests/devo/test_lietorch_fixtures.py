"""Parity of the Lie groups with the reference arrays, values and gradients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from devo.lietorch import SE3, SO3, LieGroup, Sim3
from devo.lietorch.formulas import small_adj_transposed
from tests.tolerances import LIE_PARITY

GROUPS = [SO3, SE3, Sim3]
Arrays = dict[str, Tensor]


@pytest.fixture(scope="module")
def arrays(fixture_npz: Callable[[str], dict[str, np.ndarray]]) -> Arrays:
    return {key: torch.from_numpy(value) for key, value in fixture_npz("lie_groups").items()}


def _close(found: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=LIE_PARITY)


VALUES = {
    "exp_a": lambda x, y, get: x.data,
    "exp_b": lambda x, y, get: y.data,
    "log_of_exp_a": lambda x, y, get: x.log(),
    "inv_a": lambda x, y, get: x.inv().data,
    "mul_ab": lambda x, y, get: (x * y).data,
    "matrix": lambda x, y, get: x.matrix(),
    "act3": lambda x, y, get: x * get("p3"),
    "act4": lambda x, y, get: x.act(get("p4")),
    "adj": lambda x, y, get: x.adj(get("v")),
    "adjT": lambda x, y, get: x.adjT(get("v")),
    "retr": lambda x, y, get: x.retr(0.1 * get("v")).data,
}


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("name", VALUES)
def test_values(group: type[LieGroup], name: str, arrays: Arrays) -> None:
    def get(key: str) -> Tensor:
        return arrays[f"{group.__name__}_{key}"]

    _close(VALUES[name](group.exp(get("a")), group.exp(get("b")), get), get(name))


def _small_adj(group: type[LieGroup], tangent: Tensor) -> Tensor:
    k = group.manifold_dim
    return small_adj_transposed(
        group.layout, tangent.unsqueeze(-2), torch.eye(k, dtype=tangent.dtype).expand(len(tangent), k, k)
    )


def _act4_gradient(group: type[LieGroup], a: Tensor, p: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the tangent and of the element exp(a)."""
    a = a.clone().requires_grad_()
    x = group.exp(a)
    x.data.retain_grad()
    ((x * p) * w).sum().backward()
    return a.grad, x.data.grad[..., : group.manifold_dim]


def _log_gradient(group: type[LieGroup], a: Tensor, b: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient of the tangent, and the logarithm."""
    a = a.clone().requires_grad_()
    log = (group.exp(a) * group.exp(b)).log()
    (log * w).sum().backward()
    return a.grad, log.detach()


@pytest.mark.parametrize("group", [SO3, SE3])
def test_gradients(group: type[LieGroup], arrays: Arrays) -> None:
    def get(key: str) -> Tensor:
        return arrays[f"{group.__name__}_{key}"]

    found, _ = _act4_gradient(group, get("a")[5:], get("p4")[5:], get("grad_act4_w"))
    _close(found, get("grad_act4"))
    found, _ = _log_gradient(group, 0.5 * get("a")[5:], 0.3 * get("b")[5:], get("grad_log_w"))
    _close(found, get("grad_log"))


def test_sim3_gradients_up_to_the_cut_series_of_the_reference(arrays: Arrays) -> None:
    """The reference cuts both Jacobian series of Sim3; with the same cut on top of our element gradients we agree."""

    def get(key: str) -> Tensor:
        return arrays[f"Sim3_{key}"]

    identity = torch.eye(7, dtype=torch.float64)

    def cut(tangent: Tensor) -> Tensor:
        x = _small_adj(Sim3, tangent)
        return identity + x / 2 + x @ x / 6 + x @ x @ x / 24 + x @ x @ x @ x / 120

    def cut_inverse(tangent: Tensor) -> Tensor:
        x = _small_adj(Sim3, tangent)
        return identity - x / 2 + x @ x / 12 - x @ x @ x @ x / 720

    a = get("a")[5:]
    _, element = _act4_gradient(Sim3, a, get("p4")[5:], get("grad_act4_w"))
    _close((element.unsqueeze(-2) @ cut(a)).squeeze(-2), get("grad_act4"))

    _, log = _log_gradient(Sim3, 0.5 * a, 0.3 * get("b")[5:], get("grad_log_w"))
    chained = get("grad_log_w").unsqueeze(-2) @ cut_inverse(log) @ cut(0.5 * a)
    _close(chained.squeeze(-2), get("grad_log"))
