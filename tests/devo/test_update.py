"""Update operator and its building blocks: reference values, laws, gradients, both regimes and number formats."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from devo.blocks import GatedResidual, GradientClip, SoftAgg, segment_softmax_sum
from devo.edges import EdgeGroups, Segments
from devo.errors import InputError
from devo.fastba import neighbors
from devo.update import Update
from devo.update_inference import update_in_chunks
from tests.tolerances import NETWORK_PARITY, UPDATE_BFLOAT16, UPDATE_CHUNKS

DIM = 48


def make_graph(edges: int, frames: int = 9, per_frame: int = 7, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Random edges in random order; some occur twice, some patches not at all."""
    generator = torch.Generator().manual_seed(seed)
    kk = torch.randint(0, frames * per_frame, (edges,), generator=generator)
    return kk // per_frame, torch.randint(0, frames, (edges,), generator=generator), kk


def make_inputs(edges: int, dim: int = DIM, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return tuple(torch.randn(1, edges, size, generator=generator) for size in (dim, dim, 882))  # type: ignore[return-value]


def make_update(dim: int = DIM, seed: int = 0) -> Update:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Update(3, dim).eval()


def largest(first: Tensor, second: Tensor) -> float:
    return float((first.detach().float() - second.detach().float()).abs().max())


@pytest.fixture
def reference(fixture_npz: Callable[[str], dict[str, np.ndarray]]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(value) for name, value in fixture_npz("network_small").items()}


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("prepared", [True, False])
def test_two_updates_equal_reference(reference: dict[str, Tensor], gradients: bool, prepared: bool) -> None:
    update = Update(3, 48).eval()
    start = "sd/update."
    update.load_state_dict({name[len(start) :]: value for name, value in reference.items() if name.startswith(start)})
    ii, jj, kk = reference["ii"], reference["jj"], reference["kk"]
    groups = EdgeGroups.build(ii, jj, kk) if prepared else None
    net, context = reference["net0"], reference["imap"][:, kk, :, 0, 0]
    with torch.set_grad_enabled(gradients):
        for step in ("1", "2"):
            net, (delta, weight, nothing) = update(net, context, reference["corr"], None, ii, jj, kk, groups=groups)
            assert nothing is None
            assert net.requires_grad == gradients
            for name, value in (("net", net), ("delta", delta), ("weight", weight)):
                assert value.shape == reference[name + step].shape
                assert largest(value, reference[name + step]) < NETWORK_PARITY


@settings(max_examples=25, deadline=None)
@given(edges=st.integers(1, 300), chunk=st.integers(1, 400), seed=st.integers(0, 99))
def test_both_regimes_agree_for_any_chunk_size(edges: int, chunk: int, seed: int) -> None:
    update, graph, inputs = make_update(), make_graph(edges, seed=seed), make_inputs(edges, seed=seed)
    groups = EdgeGroups.build(*graph)
    net, (delta, weight, _) = update(*inputs, None, *graph)
    state, revision, confidence = update_in_chunks(update, *(value[0] for value in inputs), groups, chunk)
    assert largest(net[0], state) < UPDATE_CHUNKS
    assert largest(delta[0], revision) < UPDATE_CHUNKS
    assert largest(weight[0], confidence) < UPDATE_CHUNKS


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("edges", [1, 127, 1000, 5000])
def test_edge_order_does_not_matter(gradients: bool, edges: int) -> None:
    update, inputs = make_update(), make_inputs(edges)
    # every (patch, frame) once: with duplicates, position decides who is whose neighbour
    kk, jj = torch.arange(7 * 1000) // 10, torch.arange(7 * 1000) % 10
    graph = (kk[:edges] // 7, jj[:edges], kk[:edges])
    shuffle = torch.randperm(edges, generator=torch.Generator().manual_seed(1))
    with torch.set_grad_enabled(gradients):
        net, (delta, weight, _) = update(*inputs, None, *graph)
        moved, (moved_delta, moved_weight, _) = update(
            *(value[:, shuffle] for value in inputs), None, *(index[shuffle] for index in graph)
        )
    assert largest(net[:, shuffle], moved) < UPDATE_CHUNKS
    assert largest(delta[:, shuffle], moved_delta) < UPDATE_CHUNKS
    assert largest(weight[:, shuffle], moved_weight) < UPDATE_CHUNKS


def test_inference_is_byte_equal_on_repetition_and_keeps_its_inputs() -> None:
    update, graph, inputs = make_update(), make_graph(900), make_inputs(900)
    copies = [value.clone() for value in inputs]
    with torch.no_grad():
        first, (delta, weight, _) = update(*inputs, None, *graph)
        second, (delta2, weight2, _) = update(*inputs, None, *graph)
    assert torch.equal(first, second) and torch.equal(delta, delta2) and torch.equal(weight, weight2)
    assert all(torch.equal(value, copy) for value, copy in zip(inputs, copies))


@pytest.mark.parametrize("gradients", [True, False])
def test_bfloat16_is_close_and_keeps_float32_state(gradients: bool) -> None:
    update, graph, (net, inp, corr) = make_update(128), make_graph(700), make_inputs(700, 128)
    with torch.no_grad():
        exact, (delta, weight, _) = update(net, inp, corr, None, *graph)
    with torch.set_grad_enabled(gradients), torch.autocast("cpu", dtype=torch.bfloat16):
        lower, (delta16, weight16, _) = update(net, inp.bfloat16(), corr.bfloat16(), None, *graph)
    assert lower.dtype == delta16.dtype == weight16.dtype == torch.float32
    assert 0 < largest(exact, lower) < UPDATE_BFLOAT16, "bfloat16 was not used, or is far off"
    assert largest(delta, delta16) < UPDATE_BFLOAT16
    assert largest(weight, weight16) < UPDATE_BFLOAT16


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_inputs_without_autocast(gradients: bool, dtype: torch.dtype) -> None:
    update, graph, (net, inp, corr) = make_update(), make_graph(90), make_inputs(90)
    inp, corr = inp.to(dtype), corr.to(dtype)
    with torch.set_grad_enabled(gradients):
        expected = update(net, inp.float(), corr.float(), None, *graph)[0]
        assert largest(update(net, inp, corr, None, *graph)[0], expected) < UPDATE_CHUNKS


def test_no_edges() -> None:
    update, graph, inputs = make_update(), make_graph(0), make_inputs(0)
    with torch.no_grad():
        net, (delta, weight, _) = update(*inputs, None, *graph)
    assert net.shape == (1, 0, DIM) and delta.shape == weight.shape == (1, 0, 2)


def test_every_parameter_and_input_gets_a_gradient() -> None:
    update, graph, inputs = make_update(), make_graph(200), [value.requires_grad_() for value in make_inputs(200)]
    net, (delta, weight, _) = update(*inputs, None, *graph)
    (net.square().mean() + delta.square().mean() + weight.mean()).backward()
    for name, value in [*update.named_parameters(), *zip(("net", "inp", "corr"), inputs)]:
        assert value.grad is not None and bool(torch.isfinite(value.grad).all()), name
        # the softmax over a group is unchanged by the bias of its scores
        assert (float(value.grad.abs().max()) > 1e-9) != name.endswith("g.bias"), name


def test_missing_neighbours_pass_the_bias_of_the_exchange() -> None:
    """An edge without predecessor receives c1(0), which is not zero."""
    update, (net, inp, corr) = make_update(), make_inputs(1)
    graph = tuple(torch.zeros(1, dtype=torch.int64) for _ in range(3))
    with torch.no_grad():
        before = update(net, inp, corr, None, *graph)[0]
        update.c1[2].bias += 1.0
        assert largest(before, update(net, inp, corr, None, *graph)[0]) > 1e-3


def test_update_in_float64_matches_numeric_gradient() -> None:
    update = Update(3, 4).double()
    graph = make_graph(6, frames=3, per_frame=2)
    generator = torch.Generator().manual_seed(0)
    net, inp = (torch.randn(1, 6, 4, generator=generator, dtype=torch.float64, requires_grad=True) for _ in range(2))
    corr = torch.randn(1, 6, 882, generator=generator, dtype=torch.float64)

    def state(net: Tensor, inp: Tensor) -> Tensor:
        return update(net, inp, corr, None, *graph)[0]

    assert torch.autograd.gradcheck(state, (net, inp))


# --- building blocks ----------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(edges=st.integers(0, 200), frames=st.integers(1, 12), seed=st.integers(0, 99))
def test_edge_groups(edges: int, frames: int, seed: int) -> None:
    ii, jj, kk = make_graph(edges, frames, seed=seed)
    groups = EdgeGroups.build(ii, jj, kk)
    pairs = torch.unique(torch.stack([ii, jj]), dim=1, return_inverse=True)[1] if edges else kk
    for segments, labels in ((groups.patch, kk), (groups.frame_pair, pairs)):
        values, label = torch.unique(labels, return_inverse=True)
        assert torch.equal(segments.label, label) and segments.count == len(values)
        assert sorted(segments.order.tolist()) == list(range(edges))
        for group in range(segments.count):
            members = segments.order[segments.start[group] : segments.start[group + 1]]
            assert bool((label[members] == group).all())
        for rows in (1, 5, 1000):
            pieces = segments.chunks(rows)
            assert [piece[0] for piece in pieces] + [edges] == [0] + [piece[1] for piece in pieces]
            assert all(
                last - first <= rows or groups_in == 1
                for first, last, groups_in in ((a, b, d - c) for a, b, c, d in pieces)
            )
    previous, following = groups.neighbours
    expected = neighbors(kk, jj)
    assert torch.equal(previous, expected[0]) and torch.equal(following, expected[1])
    # inside a patch, the sorted order is the order of the neighbours: the chunked regime relies on it
    order = groups.patch.order
    linked = kk[order][1:] == kk[order][:-1]
    assert torch.equal(previous[order][1:], torch.where(linked, order[:-1], -1))
    assert torch.equal(following[order][:-1], torch.where(linked, order[1:], -1))


def test_frame_pairs_stay_apart_in_long_recordings() -> None:
    """The published label ii*12345+jj maps (0, 12345) and (1, 0) to the same group."""
    ii, jj = torch.tensor([0, 1]), torch.tensor([12345, 0])
    assert EdgeGroups.build(ii, jj, ii).frame_pair.count == 2


def test_unequal_edge_lists_are_refused() -> None:
    with pytest.raises(InputError, match=r"\(3,\), \(2,\), \(3,\)"):
        EdgeGroups.build(torch.zeros(3, dtype=torch.int64), torch.zeros(2, dtype=torch.int64), torch.zeros(3).long())


def labels_to_segments(labels: list[int]) -> Segments:
    kk = torch.tensor(labels)
    return EdgeGroups.build(kk, torch.zeros_like(kk), kk).patch


def test_soft_aggregation_equals_a_loop_over_groups() -> None:
    torch.manual_seed(0)
    module, x = SoftAgg(6).double(), torch.randn(1, 9, 6, dtype=torch.float64) * 30  # exp would overflow unshifted
    labels = [5, 2, 5, 9, 2, 5, 5, 7, 9]
    result = module(x, labels_to_segments(labels))
    for label in set(labels):
        rows = [row for row, value in enumerate(labels) if value == label]
        f, g = module.f(x[0, rows]), module.g(x[0, rows])
        expected = module.h((f * torch.softmax(g, dim=0)).sum(0))
        assert torch.allclose(result[0, rows], expected.expand(len(rows), 6), rtol=1e-12, atol=1e-12)


def test_soft_aggregation_gradients() -> None:
    torch.manual_seed(0)
    segments = labels_to_segments([3, 1, 3, 0, 1, 3, 4])
    value, score = (torch.randn(7, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    assert torch.autograd.gradcheck(lambda f, g: segment_softmax_sum(f, g, segments), (value, score))
    module = SoftAgg(3).double()
    assert torch.autograd.gradcheck(lambda x: module(x, segments), (value[None].detach().requires_grad_(),))


def test_gradient_clip_is_identity_with_small_gradients() -> None:
    x = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.equal(GradientClip()(x), x)
    assert torch.autograd.gradcheck(lambda x: 0.009 * GradientClip()(x.sin()), (x,), eps=1e-5, atol=1e-9)


def test_gradient_clip_limits_and_removes_nan() -> None:
    x = torch.zeros(6, requires_grad=True)
    GradientClip()(x).backward(torch.tensor([float("nan"), float("inf"), -float("inf"), 0.5, -0.02, 0.004]))
    assert x.grad is not None and torch.equal(x.grad, torch.tensor([0.0, 0.01, -0.01, 0.01, -0.01, 0.004]))


def test_gated_residual_is_what_it_says() -> None:
    torch.manual_seed(0)
    module, x = GatedResidual(5), torch.randn(2, 4, 5)
    gate = torch.sigmoid(x @ module.gate[0].weight.T + module.gate[0].bias)
    hidden = (x @ module.res[0].weight.T + module.res[0].bias).clamp(min=0)
    assert torch.allclose(module(x), x + gate * (hidden @ module.res[2].weight.T + module.res[2].bias), atol=1e-6)
