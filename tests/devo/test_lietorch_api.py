"""Construction, indexing, shapes, promotion and clear errors of the group classes."""

from __future__ import annotations

import copy

import pytest
import torch

from devo.errors import InputError
from devo.lietorch import SE3, SO3, LieGroup, LieGroupParameter, RxSO3, Sim3, cat, stack

GROUPS = [SO3, RxSO3, SE3, Sim3]
every_group = pytest.mark.parametrize("group", GROUPS)


@every_group
def test_identity(group: type[LieGroup]) -> None:
    x = group.Identity(2, 3, dtype=torch.float64)
    assert x.shape == (2, 3)
    assert x.tangent_shape == (2, 3, group.manifold_dim)
    assert x.dtype == torch.float64
    assert x.device.type == "cpu"
    assert torch.equal(x.matrix(), torch.eye(4, dtype=torch.float64).expand(2, 3, 4, 4))
    assert torch.equal(x.log(), torch.zeros(x.tangent_shape, dtype=torch.float64))
    assert torch.equal(group.Identity((2, 3)).data, group.Identity([2, 3]).data)
    assert group.Identity().shape == ()
    like = group.IdentityLike(group.Random(5, dtype=torch.float64))
    assert torch.equal(like.data, group.Identity(5, dtype=torch.float64).data)


@every_group
def test_dimensions(group: type[LieGroup]) -> None:
    expected = {SO3: (4, 3), RxSO3: (5, 4), SE3: (7, 6), Sim3: (8, 7)}[group]
    assert (group.embedded_dim, group.manifold_dim) == expected


@every_group
def test_random_is_seeded_and_scaled(group: type[LieGroup]) -> None:
    first, second = (group.Random(100, sigma=0.1, generator=torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first.data, second.data)
    assert 0.07 < first.log().std().item() < 0.13
    rates = torch.zeros(group.manifold_dim)
    assert torch.equal(group.Random(4, sigma=rates).data, group.Identity(4).data)


@every_group
def test_vectors_round_trip(group: type[LieGroup]) -> None:
    data = group.Random(3, 2).data
    assert torch.equal(group.InitFromVec(data).vec(), data)
    assert torch.equal(group(data).data, data)
    assert group(group(data)).data is data


@every_group
def test_indexing_touches_batch_dimensions_only(group: type[LieGroup]) -> None:
    x = group.Random(4, 5)
    assert torch.equal(x[1].data, x.data[1])
    assert torch.equal(x[:, 2].data, x.data[:, 2])
    assert torch.equal(x[..., 0].data, x.data[:, 0])
    assert torch.equal(x[1, ...].data, x.data[1])
    assert torch.equal(x[:, None].data, x.data[:, None])
    assert torch.equal(x[torch.tensor([3, 0])].data, x.data[[3, 0]])
    mask = torch.rand(4, 5) > 0.5
    assert torch.equal(x[mask].data, x.data[mask])
    assert len(x) == 4
    with pytest.raises(InputError, match="batch shape is"):
        x[0, 1, 2]


@every_group
def test_writing_by_index(group: type[LieGroup]) -> None:
    x, y = group.Random(4, 5), group.Random(5)
    x[2] = y
    assert torch.equal(x.data[2], y.data)
    x[..., 1] = group.Identity(4)
    assert torch.equal(x.data[:, 1], group.Identity(4).data)
    x[torch.tensor([True, False, False, True])] = group.Identity(1, 1)
    assert torch.equal(x.data[[0, 3]], group.Identity(2, 5).data)
    with pytest.raises(InputError, match="same group"):
        x[0] = (SO3 if group is not SO3 else SE3).Identity(5)


@every_group
def test_shapes(group: type[LieGroup]) -> None:
    x = group.Random(2, 6)
    assert x.view(3, 4).shape == x.view((3, 4)).shape == (3, 4)
    assert torch.equal(x.view(12).data, x.data.view(12, -1))
    assert [part.shape for part in x.unbind(1)] == [(2,)] * 6
    assert torch.equal(x.unbind(-1)[2].data, x.data[:, 2])
    assert torch.equal(cat([x, x[:1]], 0).data, torch.cat([x.data, x.data[:1]], 0))
    assert torch.equal(cat([x, x[:, :1]], -1).data, torch.cat([x.data, x.data[:, :1]], 1))
    assert stack([x, x], 1).shape == (2, 2, 6)
    assert stack([x, x], -1).shape == (2, 6, 2)
    with pytest.raises(InputError, match="batch dimensions"):
        x.unbind(2)
    with pytest.raises(InputError, match="batch dimensions"):
        cat([x, x], 2)
    with pytest.raises(InputError, match="one group"):
        cat([x, (SO3 if group is not SO3 else SE3).Identity(2, 6)])
    with pytest.raises(InputError, match="no group"):
        stack([])


@every_group
def test_empty_batches(group: type[LieGroup]) -> None:
    x = group.Identity(1, 0)
    a = torch.zeros(1, 0, group.manifold_dim, requires_grad=True)
    y = x.retr(a) * x.inv()
    assert y.shape == (1, 0)
    y.log().sum().backward()
    assert a.grad is not None
    assert x.act(torch.zeros(1, 0, 4)).shape == (1, 0, 4)
    assert x[:, :, None, None].act(torch.zeros(1, 0, 3, 3, 4)).shape == (1, 0, 3, 3, 4)


@every_group
def test_dtypes_and_devices(group: type[LieGroup]) -> None:
    x = group.Random(3)
    assert x.double().dtype == torch.float64
    assert x.double().float().dtype == torch.float32
    assert x.to(torch.float64).inv().dtype == torch.float64
    assert x.cpu().device.type == "cpu"
    assert x.to("cpu", torch.float64).log().dtype == torch.float64
    assert not x.requires_grad
    assert group.__name__ in repr(x)
    with pytest.raises(InputError, match="float16"):
        x.to(torch.float16)


@pytest.mark.gpu
@every_group
def test_cuda_equals_cpu(group: type[LieGroup]) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device found")
    x, y = group.Random(10, dtype=torch.float64), group.Random(10, dtype=torch.float64)
    torch.testing.assert_close((x.cuda() * y.cuda()).log().cpu(), (x * y).log(), rtol=0, atol=1e-12)


@every_group
def test_detach_and_clone(group: type[LieGroup]) -> None:
    x = group.exp(torch.zeros(2, group.manifold_dim, requires_grad=True))
    assert x.requires_grad
    assert not x.detach().requires_grad
    copied = x.detach().clone()
    copied[0] = group.Random()
    assert torch.equal(x.data[0], group.Identity().data)


@every_group
def test_no_graph_without_need(group: type[LieGroup]) -> None:
    x = group.exp(torch.zeros(2, group.manifold_dim, requires_grad=True))
    with torch.no_grad():
        assert not (x * x).requires_grad
        assert not x.log().requires_grad
    with torch.inference_mode():
        group.Random(2).log()
    # Constants made inside inference mode must not poison later training.
    group.exp(torch.zeros(2, group.manifold_dim, requires_grad=True)).log().sum().backward()


@every_group
def test_autocast_leaves_poses_alone(group: type[LieGroup]) -> None:
    x, p = group.Random(3, 5), torch.randn(3, 5, 4)
    expected = ((x * x).log(), x * p, x.adj(x.log()), x.Jinv(x.log()))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = ((x * x).log(), x * p, x.adj(x.log()), x.Jinv(x.log()))
    for a, b in zip(found, expected):
        assert torch.equal(a, b)


@every_group
def test_quaternions_are_normalised_when_used(group: type[LieGroup]) -> None:
    x, p = group.Random(5, dtype=torch.float64), torch.randn(5, 3, dtype=torch.float64)
    data = x.data.clone()
    group.layout.quaternion(data).mul_(-2.5)
    raw = group(data)
    for a, b in [
        (raw.log(), x.log()),
        (raw * p, x * p),
        (raw.matrix(), x.matrix()),
        (raw.adjT(x.log()), x.adjT(x.log())),
    ]:
        torch.testing.assert_close(a, b, rtol=0, atol=1e-13)
    for element in (raw.inv(), raw * raw):
        norm = torch.linalg.vector_norm(group.layout.quaternion(element.data), dim=-1)
        torch.testing.assert_close(norm, torch.ones_like(norm), rtol=0, atol=1e-14)


def test_promotion_and_extraction() -> None:
    rotation, motion, similarity = SO3.Random(4), SE3.Random(4), Sim3.Random(4)
    assert torch.equal(SE3(rotation).data, torch.cat((torch.zeros(4, 3), rotation.data), -1))
    assert torch.equal(SO3(motion).data, motion.data[:, 3:])
    assert torch.equal(Sim3(motion).data, torch.cat((motion.data, torch.ones(4, 1)), -1))
    assert torch.equal(Sim3(motion).matrix(), motion.matrix())
    assert torch.equal(Sim3(rotation).matrix(), rotation.matrix())
    assert torch.equal(SO3(similarity).data, similarity.data[:, 3:7])
    assert torch.equal(RxSO3(rotation).matrix(), rotation.matrix())
    with pytest.raises(InputError, match="SE3 cannot hold"):
        SE3(similarity)


def test_scaled_translation() -> None:
    x, factor = SE3.Random(2, 3), torch.rand(2, 3)
    scaled = x.scale(factor)
    assert torch.equal(scaled.data[..., :3], x.data[..., :3] * factor[..., None])
    assert torch.equal(scaled.data[..., 3:], x.data[..., 3:])
    assert torch.equal(x.scale(torch.tensor(2.0)).data[..., :3], 2 * x.data[..., :3])


@every_group
def test_wrong_operands_are_refused(group: type[LieGroup]) -> None:
    x = group.Random(2, 3)
    k, n = group.manifold_dim, group.embedded_dim
    with pytest.raises(InputError, match=r"shape \(2, 9\)"):
        group(torch.zeros(2, 9))
    with pytest.raises(InputError, match="int64"):
        group(torch.zeros(2, n, dtype=torch.int64))
    with pytest.raises(InputError, match="tangent"):
        group.exp(torch.zeros(2, k + 3))
    with pytest.raises(InputError, match="float16"):
        group.exp(torch.zeros(2, k, dtype=torch.float16))
    with pytest.raises(InputError, match="convert one"):
        x * (SO3 if group is not SO3 else SE3).Random(2, 3)
    with pytest.raises(InputError, match="float64"):
        x * x.double()
    with pytest.raises(InputError, match=r"\(\.\.\., 3\) or \(\.\.\., 4\)"):
        x.act(torch.zeros(2, 3, 5))
    for wrong in [(2, 4), (3,), (2, 3, 1), ()]:
        with pytest.raises(InputError, match="batch shapes"):
            x * group.Identity(wrong)
        with pytest.raises(InputError, match="batch shapes"):
            x.act(torch.zeros(*wrong, 3))
        for method in (x.adj, x.adjT, x.Jinv, x.retr):
            with pytest.raises(InputError, match="batch shapes"):
                method(torch.zeros(*wrong, k))


@pytest.mark.parametrize("optimizer", [torch.optim.SGD, torch.optim.Adam])
def test_parameter_descends_to_a_known_pose(optimizer: type[torch.optim.Optimizer]) -> None:
    torch.manual_seed(0)
    target, points = SE3.Random(2, 1, sigma=0.5, dtype=torch.float64), torch.randn(1, 30, 3, dtype=torch.float64)
    parameter = LieGroupParameter(SE3.IdentityLike(target))
    assert isinstance(parameter, torch.nn.Parameter)
    stepper = optimizer([parameter], lr=0.05)
    for _ in range(300):
        stepper.zero_grad()
        (parameter.retr() * points - target * points).square().sum(-1).mean().backward()
        stepper.step()
        parameter.fold_()
    assert torch.equal(parameter.detach(), torch.zeros_like(parameter))
    assert (parameter.retr() * target.inv()).log().abs().max().item() < 1e-3


def test_parameter_registers_and_copies() -> None:
    module = torch.nn.Module()
    module.pose = LieGroupParameter(SE3.Random(3))
    assert [name for name, _ in module.named_parameters()] == ["pose"]
    copied = copy.deepcopy(module.pose)
    assert torch.equal(copied.retr().data, module.pose.retr().data)
