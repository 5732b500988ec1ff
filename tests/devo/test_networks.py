"""Networks: published layout of the weights, reference feature maps and patches, modes of the Patchifier."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from devo.altcorr import corr_features
from devo.checkpoint import load_encoders
from devo.enet import eVONet
from devo.errors import CheckpointError, InputError
from devo.extractor import BasicEncoder4
from devo.net import VONet
from devo.normalize import normalize_frames
from devo.patchifier import Patchifier
from devo.projective_ops import reproject_edges
from tests.tolerances import ENCODER_BFLOAT16, NETWORK_PARITY, REPROJECT_EDGES

DIMS = {"dim_inet": 48, "dim_fnet": 32, "dim": 8}


def largest(first: Tensor, second: Tensor) -> float:
    return float((first.detach().float() - second.detach().float()).abs().max())


def small_network(selector: str = "scorer", kind: type[nn.Module] = eVONet, seed: int = 0) -> nn.Module:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return kind(patch_selector=selector, **DIMS)


def voxels(clips: int = 1, frames: int = 2, channels: int = 5, height: int = 52, width: int = 68) -> Tensor:
    return torch.randn(clips, frames, channels, height, width, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def reference(fixture_npz: Callable[[str], dict[str, np.ndarray]]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(value) for name, value in fixture_npz("network_small").items()}


@pytest.fixture
def network(reference: dict[str, Tensor]) -> eVONet:
    result = eVONet(**DIMS).eval()
    state = {name[3:]: value for name, value in reference.items() if name.startswith("sd/")}
    result.load_state_dict(state, strict=True)
    return result


# --- layout -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, build, parameters",
    [
        ("eVONet_scorer", lambda: eVONet(), 3_397_061),
        ("eVONet_gradient", lambda: eVONet(patch_selector="Gradient"), 3_390_596),
        ("VONet", lambda: VONet(), 3_384_324),
    ],
)
def test_state_dict_layout(fixture_folder: Path, name: str, build: Callable[[], nn.Module], parameters: int) -> None:
    expected = json.loads((fixture_folder / f"state_dict_{name}.json").read_text())
    network = build()
    found = [(key, list(value.shape)) for key, value in network.state_dict().items()]
    assert found == list(expected.items()), "names, shapes or order differ"
    assert [key for key, _ in network.named_parameters()] == list(expected), "the optimiser would see another order"
    assert not list(network.buffers())
    assert all(value.dtype == torch.float32 for value in network.parameters())
    assert sum(value.numel() for value in network.parameters()) == parameters


def test_other_dimensions(reference: dict[str, Tensor]) -> None:
    shapes = {key: value.shape for key, value in small_network().state_dict().items()}
    assert shapes == {key[3:]: value.shape for key, value in reference.items() if key.startswith("sd/")}
    assert eVONet(P=5, **DIMS).update.corr[0].weight.shape == (48, 98 * 25)


def test_attributes() -> None:
    events = eVONet(dim_inet=64, dim_fnet=24, dim=16, norm="STD2")
    assert (events.P, events.RES, events.bins, events.norm, events.randaug) == (3, 4.0, 5, "std2", False)
    assert (events.dim_inet, events.dim_fnet, events.dim, events.patch_selector) == (64, 24, 16, "scorer")
    frames = VONet(dim_inet=64, patch_selector="Gradient")
    assert (frames.P, frames.RES, frames.bins, frames.DIM, frames.dim_inet) == (3, 4, 3, 64, 64)
    assert frames.patch_selector == "gradient"


def test_wrong_options_are_refused() -> None:
    with pytest.raises(InputError, match="'corner'.*scorer, gradient, random"):
        eVONet(patch_selector="corner")
    with pytest.raises(InputError, match="no scorer"):
        VONet(patch_selector="scorer")
    with pytest.raises(InputError, match="'std3'.*std2"):
        eVONet(norm="std3")
    with pytest.raises(InputError, match="'batch'"):
        BasicEncoder4(norm_fn="batch")


def test_initialisation_is_kaiming_fan_out() -> None:
    torch.manual_seed(0)
    weight = BasicEncoder4(5, 128, 32).layer2[0].conv1.weight
    assert float(weight.detach().std()) == pytest.approx((2 / (64 * 9)) ** 0.5, rel=0.03)


# --- reference values ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("gradients", [True, False])
def test_patchifier_equals_reference(network: eVONet, reference: dict[str, Tensor], gradients: bool) -> None:
    with torch.set_grad_enabled(gradients):
        fmap, gmap, imap, patches, index, colors = network.patchify(
            reference["voxels"], 10, return_color=True, coords=reference["coords"]
        )
        scores = network.patchify.scorer(reference["voxels"])
        context = network.patchify.inet(reference["voxels"]) / 4
    found = {"fmap": fmap, "gmap": gmap, "imap": imap, "patches": patches, "colors": colors, "scores": scores}
    found["imap_full"] = context
    found["pyramid1"] = functional.avg_pool2d(fmap[0], 4, 4)[None]
    for name, value in found.items():
        assert value.shape == reference[name].shape, name
        assert largest(value, reference[name]) < NETWORK_PARITY, name
    assert index.tolist() == [0] * 10 + [1] * 10 and index.dtype == torch.int64


@pytest.mark.parametrize(("pixel", "offset"), [("best", 1), ("drawn", 1), ("shifted", 2)])
def test_patches_lie_where_the_scores_are(monkeypatch: pytest.MonkeyPatch, pixel: str, offset: int) -> None:
    """Score cell s is feature pixel s + 1; the published rule lands one further."""
    network = small_network().eval()
    scores = torch.full((2, 11, 15), -20.0)
    scores[:, 5, 6] = 20.0  # not in the last row or column of its 4x4 cell
    monkeypatch.setattr(network.patchify.scorer, "rate", lambda frames: scores)
    with torch.no_grad():
        patches = network.patchify(voxels()[:1], 4, scorer_eval_use_grid=False, scorer_eval_pixel=pixel)[3]
    first = patches[0].unflatten(0, (2, 4))[:, 0, :2, 1, 1]
    assert first.tolist() == [[6.0 + offset, 5.0 + offset]] * 2


def test_one_tracker_step_equals_reference(network: eVONet, reference: dict[str, Tensor]) -> None:
    """From voxel grids to revisions: patchify, reproject, correlate, update."""
    ii, jj, kk = reference["ii"], reference["jj"], reference["kk"]
    with torch.no_grad():
        fmap, gmap, imap, patches, _, _ = network.patchify(reference["voxels"], 10, coords=reference["coords"])
        coords = reproject_edges(reference["poses"], reference["patches"], reference["intrinsics"], ii, jj, kk)
        expected = reference["reprojected"]
        assert float(((coords - expected).abs() / (1 + expected.abs())).max()) < REPROJECT_EDGES
        pyramid = fmap, functional.avg_pool2d(fmap[0], 4, 4)[None]
        corr = corr_features(gmap, pyramid, expected, kk, jj)
        assert largest(corr, reference["corr"]) < 10 * NETWORK_PARITY  # sums over 32 channels, values up to 40
        net, (delta, weight, _) = network.update(reference["net0"], imap[:, kk, :, 0, 0], corr, None, ii, jj, kk)
    for name, value in (("net1", net), ("delta1", delta), ("weight1", weight)):
        assert largest(value, reference[name]) < NETWORK_PARITY, name


def test_trained_rgb_encoders_load(repository: Path) -> None:
    file = repository.parent / "shared" / "weights" / "dpvo_encoders" / "dpvo_patchify_encoders.npz"
    if not file.is_file():
        pytest.skip(f"trained encoders not found at {file}")
    with np.load(file, allow_pickle=False) as archive:
        arrays = dict(archive)
    network = VONet().eval()
    before = network.update.state_dict()["norm.weight"].clone()
    load_encoders(network, arrays)
    state = network.state_dict()
    assert all(np.array_equal(state[name].numpy(), value) for name, value in arrays.items())
    assert torch.equal(state["update.norm.weight"], before)
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    texture = (127 + 60 * torch.sin(x / 3 + y / 7) + 60 * torch.sin(y / 4 - x / 11)).expand(1, 1, 3, 64, 96)
    with torch.no_grad():
        fmap = network.patchify(normalize_frames(torch.cat([texture, texture.roll(8, -1)], 1)), 8)[0][0]
    # trained features match across a shift of 8 pixels = 2 cells
    left, right = (functional.normalize(fmap[i, :, 4:-4, 6:-6].flatten(1), dim=0) for i in (0, 1))
    wide = fmap.shape[3] - 12
    best = (left.T @ right).argmax(1).view(-1, wide)
    exact = (best == torch.arange(best.numel()).view(-1, wide) + 2)[:, :-2]
    assert float(exact.float().mean()) > 0.5
    del arrays["patchify.inet.conv2.bias"]
    with pytest.raises(CheckpointError, match="missing: patchify.inet.conv2.bias"):
        load_encoders(network, arrays)


# --- behaviour of the Patchifier ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind, channels, colors, selector",
    [(eVONet, 5, 1, name) for name in ("scorer", "gradient", "random")]
    + [(VONet, 3, 3, name) for name in ("gradient", "random")],
)
@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("size", [(52, 68), (50, 87)])
def test_six_outputs_in_every_mode(kind, channels, colors, selector, training, size) -> None:
    network = small_network(selector, kind).train(training)
    height, width = -(-size[0] // 4), -(-size[1] // 4)
    fmap, gmap, imap, patches, index, last = network.patchify(
        voxels(2, 3, channels, *size), patches_per_image=12, return_color=True
    )
    assert fmap.shape == (1, 6, 32, height, width)
    assert gmap.shape == (1, 72, 32, 3, 3)
    assert imap.shape == (1, 72, 48, 1, 1)
    assert patches.shape == (1, 72, 3, 3, 3)
    assert index.tolist() == [frame for frame in range(6) for _ in range(12)]
    x, y = patches[0, :, 0, 1, 1], patches[0, :, 1, 1, 1]
    assert float(x.min()) >= 1 and float(x.max()) <= width - 2
    assert float(y.min()) >= 1 and float(y.max()) <= height - 2
    assert torch.equal(x, x.round()) and bool((patches[0, :, 2] == 1).all())
    assert torch.equal(patches[0, :, 0, 0, 2] - x, torch.ones_like(x))
    if not training:
        assert last.shape == (1, 72, colors)
        assert network.eval().patchify(voxels(1, 1, channels), 12)[5] is None
    elif selector == "scorer":
        assert last.shape == (6, 12) and bool((last.diff(dim=1) >= 0).all()), "best third, ascending"
    else:
        assert last is None


def test_clips_are_joined_frame_by_frame() -> None:
    network = small_network().eval()
    images, coords = voxels(2, 2), torch.randint(1, 11, (4, 5, 2))
    inv_depth = torch.rand(2, 2, 13, 17)
    joined = network.patchify(images, coords=coords, disps=inv_depth)
    for frame in range(4):
        single = network.patchify(
            images.flatten(0, 1)[None, frame : frame + 1], coords=coords[frame : frame + 1],
            disps=inv_depth.flatten(0, 1)[None, frame : frame + 1],
        )  # fmt: skip
        rows = slice(5 * frame, 5 * frame + 5)
        assert largest(joined[0][:, frame : frame + 1], single[0]) < 1e-5
        assert largest(joined[1][:, rows], single[1]) < 1e-5
        assert largest(joined[2][:, rows], single[2]) < 1e-5
        assert torch.equal(joined[3][:, rows], single[3])
        x, y = coords[frame, 0].tolist()
        assert float(joined[3][0, 5 * frame, 2, 1, 1]) == float(inv_depth.flatten(0, 1)[frame, y, x])


def test_patches_are_cut_at_their_coordinates() -> None:
    network = small_network().eval()
    coords = torch.tensor([[[1, 1], [15, 11], [7, 3]]])
    images = voxels(1, 1)
    fmap, gmap, imap, _, _, colors = network.patchify(images, coords=coords, return_color=True)
    context = network.patchify.inet(images)[0, 0] / 4
    for patch, (x, y) in enumerate(coords[0].tolist()):
        assert torch.equal(gmap[0, patch], fmap[0, 0, :, y - 1 : y + 2, x - 1 : x + 2])
        assert largest(imap[0, patch, :, 0, 0], context[:, y, x]) < 1e-5
        brightness = float(images[0, 0, :, 4 * y + 2, 4 * x + 2].abs().sum())
        assert float(colors[0, patch]) == pytest.approx(brightness, rel=1e-5)


def test_seed_decides_positions() -> None:
    for training in (True, False):
        network = small_network().train(training)
        picks = []
        for seed in (1, 1, 2):
            torch.manual_seed(seed)
            picks.append(network.patchify(voxels(), 8)[3])
        own = network.patchify(voxels(), 8, generator=torch.Generator().manual_seed(1))[3]
        assert torch.equal(picks[0], picks[1]) and not torch.equal(picks[0], picks[2])
        assert torch.equal(own, picks[0])


def test_scores_train_the_scorer_only_and_features_the_encoders() -> None:
    network = small_network().train()
    _, gmap, imap, _, _, scores = network.patchify(voxels(), 12)
    scores.sum().backward(retain_graph=True)
    for name, value in network.patchify.named_parameters():
        assert (value.grad is not None) == name.startswith("scorer."), name
    (gmap.square().mean() + imap.square().mean()).backward()
    for name, value in network.patchify.named_parameters():
        assert value.grad is not None and bool(torch.isfinite(value.grad).all()), name
        # a constant added before instance normalisation has no effect
        if not (name.startswith("fnet") and name.endswith("bias") and not name.startswith("fnet.conv2")):
            assert float(value.grad.abs().max()) > 0, name


def test_scores_belong_to_the_patches() -> None:
    network = small_network().train()
    _, _, _, patches, _, scores = network.patchify(voxels(1, 1), 6)
    chosen = patches[0, :, :2, 1, 1].long()
    maps = torch.sigmoid(network.patchify.scorer(voxels(1, 1)))[0, 0]
    assert largest(scores[0], maps[chosen[:, 1] - 1, chosen[:, 0] - 1]) < 1e-5
    again = network.patchify(voxels(1, 1), coords=chosen[None].float())[5]
    assert largest(scores, again) < 1e-5


def test_bfloat16_encoders_are_close() -> None:
    network = small_network().eval()
    coords = torch.randint(1, 11, (1, 6, 2))
    with torch.no_grad():
        exact = network.patchify(voxels(1, 1), coords=coords)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            lower = network.patchify(voxels(1, 1), coords=coords)
    assert lower[0].dtype == torch.bfloat16
    for first, second in zip(exact[:3], lower[:3]):
        assert 0 < largest(first, second) < ENCODER_BFLOAT16 * float(first.abs().max())
    assert torch.equal(exact[3], lower[3]), "coordinates must not be rounded"


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_instance_norm_in_both_layouts(layout: torch.memory_format) -> None:
    x = (torch.randn(3, 8, 12, 10, generator=torch.Generator().manual_seed(0)) * 4 + 7).contiguous(memory_format=layout)
    found = small_network().patchify.fnet.norm1(x)
    mean, variance = x.double().mean((2, 3), keepdim=True), x.double().var((2, 3), correction=0, keepdim=True)
    assert largest(found, (x - mean) / (variance + 1e-5).sqrt()) < 1e-5


@pytest.mark.parametrize(
    "images, options, message",
    [
        (voxels(channels=3), {}, r"\(1, 2, 3, 52, 68\).*\(B, n, 5, H, W\)"),
        (voxels()[0], {}, "expects"),
        (voxels(height=8, width=8), {}, "8x8 pixels are too small"),
        (voxels(), {"coords": torch.ones(1, 4, 2)}, r"expected \(2, M, 2\) inside \[1, 15\] x \[1, 11\]"),
        (voxels(), {"coords": torch.full((2, 4, 2), 12.0)}, r"\[1, 15\] x \[1, 11\]"),
        (voxels(), {"disps": torch.ones(1, 2, 52, 68)}, r"disps .*\(1, 2, 52, 68\); expected \(1, 2, 13, 17\)"),
        (voxels(), {"coords": torch.zeros(2, 4, 2)}, r"\[1, 15\] x \[1, 11\]"),
    ],
)
def test_unusable_images_are_refused(images: Tensor, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        small_network("random").eval().patchify(images, 4, **options)


def test_patchifier_defaults_are_published() -> None:
    module = Patchifier()
    assert module.fnet.conv2.weight.shape[:2] == (128, 64) and module.inet.conv2.weight.shape[:2] == (384, 64)
    assert hasattr(module, "scorer") and not hasattr(Patchifier(patch_selector="random"), "scorer")
