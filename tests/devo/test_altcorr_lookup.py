"""Fast correlation features and the training block: both must equal `corr`, level by level."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from devo.altcorr import CorrBlock, block, corr, corr_features
from devo.errors import InputError
from tests.tolerances import CORRELATION_BLOCK, CORRELATION_FEATURES, CORRELATION_HALF, CORRELATION_PARITY

Arrays = Callable[[str], dict[str, np.ndarray]]
KINDS = ("translated", "scaled", "rotated", "sheared", "scattered", "mixed")


def by_level(gmap: Tensor, pyramid: Sequence[Tensor], coords: Tensor, kk: Tensor, jj: Tensor, radius: int) -> Tensor:
    """What the features are defined to be."""
    levels = [corr(gmap, level, coords / 4**number, kk, jj, radius) for number, level in enumerate(pyramid)]
    return torch.stack(levels, dim=-1).flatten(2)


def patch_positions(kind: str, edges: int, size: tuple[int, int], source: torch.Generator) -> Tensor:
    """(1, E, 2, 3, 3) positions of 3x3 patches under different deformations, many leaving the map."""
    extent = torch.tensor([size[1], size[0]]).float()
    centre = torch.rand(edges, 2, generator=source) * (extent + 16) - 8
    offset = torch.stack(torch.meshgrid(torch.arange(-1.0, 2), torch.arange(-1.0, 2), indexing="xy"))
    linear = torch.eye(2).repeat(edges, 1, 1)
    noise = torch.randn(edges, 2, 2, generator=source)
    if kind == "scaled":
        linear = linear * (1 + 0.4 * noise[:, :1, :1])
    elif kind == "rotated":
        angle = noise[:, 0, 0]
        linear = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).view(-1, 2, 2)
    elif kind == "sheared":
        linear = linear + 0.3 * noise
    elif kind == "mixed":
        linear = linear + noise * torch.logspace(-2, 1.5, edges)[:, None, None]
    positions = centre[:, :, None, None] + torch.einsum("eab,bij->eaij", linear, offset)
    if kind == "scattered":
        positions = positions + 20 * torch.randn(edges, 2, 3, 3, generator=source)
    return positions[None]


def tracking_problem(
    kind: str, edges: int = 150, channels: int = 16, size: tuple[int, int] = (21, 30), seed: int = 0
) -> tuple[Tensor, tuple[Tensor, Tensor], Tensor, Tensor, Tensor]:
    """Patches, channels-last pyramid, positions, patch and frame of each edge."""
    source = torch.Generator().manual_seed(seed)
    fmap = torch.randn(5, *size, channels, generator=source).permute(0, 3, 1, 2)[None]
    pooled = torch.nn.functional.avg_pool2d(fmap[0], 4)[None].contiguous()
    gmap = torch.randn(1, 40, channels, 3, 3, generator=source)
    kk, jj = (torch.randint(0, count, (edges,), generator=source) for count in (40, 5))
    return gmap, (fmap, pooled), patch_positions(kind, edges, size, source), kk, jj


# --- features for inference ---------------------------------------------------------------------------------


def test_features_equal_the_reference_network(fixture_npz: Arrays) -> None:
    data = {key: torch.from_numpy(value) for key, value in fixture_npz("network_small").items() if "/" not in key}
    pyramid = (data["fmap"], data["pyramid1"])
    out = corr_features(data["gmap"], pyramid, data["reprojected"], data["kk"], data["jj"])
    assert (out - data["corr"]).abs().max() <= CORRELATION_PARITY
    block_out = CorrBlock(data["fmap"], data["gmap"])(data["kk"], data["jj"], data["reprojected"])
    assert (block_out - data["corr"]).abs().max() <= CORRELATION_PARITY


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("edges", [1, 31, 150])
def test_features_equal_corr(kind: str, seed: int, edges: int) -> None:
    problem = tracking_problem(kind, edges, seed=seed)
    ours, wanted = corr_features(*problem), by_level(*problem, 3)
    assert ours.shape == (1, edges, 882) and wanted.abs().max() > 1
    assert (ours - wanted).abs().max() <= CORRELATION_FEATURES


@pytest.mark.parametrize("radius", [0, 1, 2, 4])
@pytest.mark.parametrize("channels", [1, 7, 24])
def test_features_for_other_radii_and_channels(radius: int, channels: int) -> None:
    problem = tracking_problem("mixed", 60, channels)
    assert (corr_features(*problem, radius) - by_level(*problem, radius)).abs().max() <= CORRELATION_FEATURES


@pytest.mark.parametrize("size", [(4, 4), (5, 40), (64, 7)])
def test_features_on_small_maps(size: tuple[int, int]) -> None:
    problem = tracking_problem("scaled", 80, size=size)
    assert (corr_features(*problem) - by_level(*problem, 3)).abs().max() <= CORRELATION_FEATURES


def test_features_of_one_and_of_three_levels() -> None:
    gmap, (fmap, pooled), coords, kk, jj = tracking_problem("sheared")
    third = torch.nn.functional.avg_pool2d(pooled[0], 4)[None]
    for pyramid in ((fmap,), (fmap, pooled, third)):
        ours = corr_features(gmap, pyramid, coords, kk, jj)
        assert ours.shape[2] == 441 * len(pyramid)
        assert (ours - by_level(gmap, pyramid, coords, kk, jj, 3)).abs().max() <= CORRELATION_FEATURES


@pytest.mark.parametrize("order", ["by_frame", "by_patch", "shuffled"])
def test_features_do_not_depend_on_the_order_of_edges(order: str) -> None:
    gmap, pyramid, coords, kk, jj = tracking_problem("mixed", 300)
    keys = {"by_frame": jj * 1000 + kk, "by_patch": kk * 1000 + jj, "shuffled": (kk * 7919 + jj * 104729) % 1009}
    moved = keys[order].argsort()
    ours = corr_features(gmap, pyramid, coords[:, moved], kk[moved], jj[moved])
    assert torch.equal(ours, corr_features(gmap, pyramid, coords, kk, jj)[:, moved])


@pytest.mark.parametrize("chunk_bytes", [1, 1 << 18, 1 << 26])
def test_features_do_not_depend_on_the_step_size(monkeypatch: pytest.MonkeyPatch, chunk_bytes: int) -> None:
    problem = tracking_problem("mixed", 400)
    expected = corr_features(*problem)
    monkeypatch.setattr("devo.altcorr.lookup.CHUNK_BYTES", chunk_bytes)
    assert torch.equal(corr_features(*problem), expected)


def test_features_of_no_edges() -> None:
    gmap, pyramid, _, _, _ = tracking_problem("translated")
    none = torch.zeros(0, dtype=torch.long)
    assert corr_features(gmap, pyramid, torch.zeros(1, 0, 2, 3, 3), none, none).shape == (1, 0, 882)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_features_in_other_precisions(dtype: torch.dtype) -> None:
    gmap, pyramid, coords, kk, jj = tracking_problem("mixed")
    gmap, pyramid = gmap.to(dtype), tuple(level.to(dtype) for level in pyramid)
    ours = corr_features(gmap, pyramid, coords, kk, jj)
    precise = by_level(gmap.double(), [level.double() for level in pyramid], coords.double(), kk, jj, 3)
    assert ours.dtype == dtype
    tolerance = CORRELATION_FEATURES if dtype == torch.float64 else CORRELATION_HALF
    assert (ours.double() - precise).abs().max() <= tolerance * precise.abs().max()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e20, -3e9])
@pytest.mark.parametrize("whole", [True, False])
def test_features_at_odd_positions(value: float, whole: bool) -> None:
    gmap, pyramid, coords, kk, jj = tracking_problem("translated")
    coords[0, 5] = value if whole else coords[0, 5]
    coords[0, 5, 1, 2, 0] = value
    ours, wanted = corr_features(gmap, pyramid, coords, kk, jj), by_level(gmap, pyramid, coords, kk, jj, 3)
    assert torch.equal(ours.isnan(), wanted.isnan())
    assert wanted.isnan().any() == (not np.isfinite(value))
    assert (ours - wanted).nan_to_num().abs().max() <= CORRELATION_FEATURES


def test_a_broken_frame_or_patch_spoils_only_its_edges() -> None:
    gmap, pyramid, coords, kk, jj = tracking_problem("translated")
    expected = corr_features(gmap, pyramid, coords, kk, jj)
    gmap, pyramid = gmap.clone(), tuple(level.clone() for level in pyramid)
    gmap[0, 3] = float("nan")
    for level in pyramid:
        level[0, 2] = float("inf")
    untouched = (kk != 3) & (jj != 2)
    assert torch.equal(corr_features(gmap, pyramid, coords, kk, jj)[0, untouched], expected[0, untouched])


@pytest.mark.parametrize("layout", ["channels_first", "channels_last", "ring"])
def test_features_do_not_depend_on_the_memory_layout(layout: str) -> None:
    gmap, pyramid, coords, kk, jj = tracking_problem("scaled")
    if layout == "channels_first":
        stored = tuple(level.contiguous() for level in pyramid)
    elif layout == "channels_last":
        stored = tuple(level[0].contiguous(memory_format=torch.channels_last)[None] for level in pyramid)
    else:
        stored = tuple(torch.cat([level, level], dim=1)[:, :5] for level in pyramid)
    assert torch.equal(corr_features(gmap, stored, coords, kk, jj), corr_features(gmap, pyramid, coords, kk, jj))


def test_features_repeat_bit_by_bit_and_ignore_autocast() -> None:
    problem = tracking_problem("mixed", 500)
    first = corr_features(*problem)
    assert torch.equal(corr_features(*problem), first)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(corr_features(*problem), first)


def test_insisting_on_the_extension_fails_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVO_KERNELS", "cuda")
    with pytest.raises(InputError, match="DEVO_KERNELS"):
        corr_features(*tracking_problem("translated"))
    with pytest.raises(InputError, match="DEVO_KERNELS"):
        CorrBlock(*training_problem()[:2])


def test_features_refuse_unequal_inputs() -> None:
    gmap, pyramid, coords, kk, jj = tracking_problem("translated")
    with pytest.raises(InputError, match="corr_features got the pyramid nothing"):
        corr_features(gmap, (), coords, kk, jj)
    with pytest.raises(InputError, match="corr_features got the pyramid"):
        corr_features(gmap.half(), pyramid, coords, kk, jj)
    with pytest.raises(InputError, match="corr_features got the pyramid"):
        corr_features(gmap, (pyramid[0], pyramid[1][:, :4]), coords, kk, jj)
    with pytest.raises(InputError, match="expected levels"):
        corr_features(gmap[:, :, :8], pyramid, coords, kk, jj)
    with pytest.raises(InputError, match="corr_features got coords"):
        corr_features(gmap, pyramid, coords[:, 1:], kk, jj)


# --- training block -----------------------------------------------------------------------------------------


def training_problem(
    clips: int = 2, dtype: torch.dtype = torch.float32, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor, Tensor, list[Tensor]]:
    """Maps, patches, edges of joined clips (clip-major, within clips) and positions of three iterations."""
    source = torch.Generator().manual_seed(seed)
    frames, patches, channels, size = 3, 6, 8, (12, 17)
    fmap = torch.randn(1, clips * frames, channels, *size, generator=source, dtype=dtype).requires_grad_()
    gmap = torch.randn(1, clips * patches, channels, 3, 3, generator=source, dtype=dtype).requires_grad_()
    kk = torch.arange(clips * patches).repeat_interleave(frames)
    jj = torch.arange(clips * frames).view(clips, 1, frames).expand(-1, patches, -1).reshape(-1)
    coords = [patch_positions(kind, len(kk), size, source).to(dtype) for kind in ("translated", "mixed", "scattered")]
    return fmap, gmap, kk, jj, coords


@pytest.mark.parametrize("clips", [1, 2, 3])
@pytest.mark.parametrize("limit", [1 << 30, 0])
def test_block_equals_corr_with_gradients(monkeypatch: pytest.MonkeyPatch, clips: int, limit: int) -> None:
    monkeypatch.setattr(block, "MAX_VOLUME_BYTES", limit)
    fmap, gmap, kk, jj, positions = training_problem(clips)
    look_up = CorrBlock(fmap, gmap, dropout=1.0, clips=clips)
    assert (look_up.volumes is None) == (limit == 0)
    pooled = torch.nn.functional.avg_pool2d(fmap[0], 4)[None]
    results = []
    for features in (
        [look_up(kk, jj, coords) for coords in positions],
        [by_level(gmap, (fmap, pooled), coords, kk, jj, 3) for coords in positions],
    ):
        loss = sum((feature * (number + feature.detach().cos())).sum() for number, feature in enumerate(features))
        gradients = torch.autograd.grad(loss, (fmap, gmap), retain_graph=True)
        results.append((torch.cat(features), *gradients))
    for ours, wanted in zip(*results):
        assert (ours - wanted).abs().max() <= CORRELATION_BLOCK * wanted.abs().max()


@pytest.mark.parametrize("levels", [(1,), (1, 4), (2, 3)])
def test_gradcheck_block(levels: tuple[int, ...]) -> None:
    fmap, gmap, kk, jj, positions = training_problem(2, torch.float64)
    maps = (fmap[:, :, :2, :8, :8].detach().requires_grad_(), gmap[:, :, :2, :1, :1].detach().requires_grad_())

    def two_lookups(fmap: Tensor, gmap: Tensor) -> Tensor:
        look_up = CorrBlock(fmap, gmap, 1, 1.0, levels, clips=2)
        return look_up(kk, jj, positions[0][..., :1, :1]) + look_up(kk, jj, positions[2][..., :1, :1]).square()

    assert torch.autograd.gradcheck(two_lookups, maps, fast_mode=True)


def test_block_survives_repeated_partial_and_interleaved_backward_passes() -> None:
    fmap, gmap, kk, jj, positions = training_problem()

    def alone(coords: Tensor) -> Tensor:
        return torch.autograd.grad(CorrBlock(fmap, gmap, dropout=1.0, clips=2)(kk, jj, coords).square().sum(), fmap)[0]

    look_up = CorrBlock(fmap, gmap, dropout=1.0, clips=2)
    first, second = (look_up(kk, jj, coords) for coords in positions[:2])
    for _ in range(2):
        gradient = torch.autograd.grad(first.square().sum(), fmap, retain_graph=True)[0]
        assert torch.equal(gradient, alone(positions[0]))
    third = look_up(kk, jj, positions[2])  # after the memory of the products was given to gradients
    assert torch.equal(third, CorrBlock(fmap, gmap, clips=2)(kk, jj, positions[2]))
    gradient = torch.autograd.grad(second.square().sum() + third.square().sum(), fmap)[0]
    expected = alone(positions[1]) + alone(positions[2])
    assert (gradient - expected).abs().max() <= CORRELATION_BLOCK * expected.abs().max()


def test_block_works_under_checkpointing() -> None:
    fmap, gmap, kk, jj, positions = training_problem()
    gradients = []
    for wrapped in (True, False):
        look_up = CorrBlock(fmap, gmap, dropout=1.0, clips=2)
        loss = torch.zeros(())
        for coords in positions:
            features = (
                torch.utils.checkpoint.checkpoint(look_up, kk, jj, coords, use_reentrant=False)
                if wrapped
                else look_up(kk, jj, coords)
            )
            loss = loss + features.square().sum()
        gradients.append(torch.autograd.grad(loss, (fmap, gmap)))
    for ours, wanted in zip(*gradients):
        assert (ours - wanted).abs().max() <= CORRELATION_BLOCK * wanted.abs().max()


@pytest.mark.parametrize("limit", [1 << 30, 0])
def test_block_dropout_thins_the_backward_pass_only(monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    monkeypatch.setattr(block, "MAX_VOLUME_BYTES", limit)
    fmap, _, _, _, positions = training_problem(1)
    edges = 300
    source = torch.Generator().manual_seed(3)
    gmap = torch.randn(1, edges, 8, 3, 3, generator=source).requires_grad_()
    kk, jj = torch.arange(edges), torch.arange(edges) % 3
    coords = patch_positions("translated", edges, (12, 17), source).clamp(0, 11)

    def run(dropout: float) -> tuple[Tensor, Tensor]:
        generator = torch.Generator().manual_seed(4)
        features = CorrBlock(fmap, gmap, 3, dropout, levels=(1,), generator=generator)(kk, jj, coords)
        return features, torch.autograd.grad(features.sum(), gmap)[0][0]

    (full, complete), (features, gradient) = run(1.0), run(0.2)
    assert torch.equal(features, full)
    kept = gradient.flatten(1).any(1)
    assert 30 <= int(kept.sum()) <= 90
    assert (gradient[kept] - complete[kept]).abs().max() <= CORRELATION_BLOCK * complete.abs().max()
    assert torch.equal(run(0.2)[1], gradient)
    assert not run(0.0)[1].any()


@pytest.mark.parametrize("maps_dtype", [torch.float32, torch.bfloat16])
def test_block_computing_in_bfloat16(maps_dtype: torch.dtype) -> None:
    fmap, gmap, kk, jj, positions = training_problem()
    precise = CorrBlock(fmap, gmap, dropout=1.0, clips=2)(kk, jj, positions[1])
    wanted = torch.autograd.grad(precise.sum(), (fmap, gmap))
    maps = [tensor.detach().to(maps_dtype).requires_grad_() for tensor in (fmap, gmap)]
    ours = CorrBlock(*maps, dropout=1.0, clips=2, compute_dtype=torch.bfloat16)(kk, jj, positions[1])
    assert ours.dtype == torch.bfloat16
    assert (ours.float() - precise).abs().max() <= CORRELATION_HALF * precise.abs().max()
    for gradient, expected in zip(torch.autograd.grad(ours.float().sum(), maps), wanted):
        assert gradient.dtype == maps_dtype
        assert (gradient.float() - expected).abs().max() <= CORRELATION_HALF * expected.abs().max()


def test_block_without_gradients_and_without_edges() -> None:
    fmap, gmap, kk, jj, positions = training_problem()
    none = kk[:0]
    empty = CorrBlock(fmap, gmap, clips=2)(none, none, positions[0][:, :0])
    assert empty.shape == (1, 0, 882)
    assert not any(gradient.any() for gradient in torch.autograd.grad(empty.sum(), (fmap, gmap)))
    before = torch.get_rng_state()
    with torch.no_grad():
        assert not CorrBlock(fmap, gmap, clips=2)(kk, jj, positions[0]).requires_grad
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e20, -3e9])
def test_block_at_odd_positions(value: float) -> None:
    fmap, gmap, kk, jj, positions = training_problem()
    coords = positions[0].clone()
    coords[0, 4, 0, 1, 1] = value
    pooled = torch.nn.functional.avg_pool2d(fmap[0], 4)[None]
    ours = CorrBlock(fmap, gmap, dropout=1.0, clips=2)(kk, jj, coords)
    wanted = by_level(gmap, (fmap, pooled), coords, kk, jj, 3)
    assert torch.equal(ours.isnan(), wanted.isnan()) and wanted.isnan().any() == (not np.isfinite(value))
    assert (ours - wanted).nan_to_num().abs().max() <= CORRELATION_BLOCK * wanted.nan_to_num().abs().max()
    gradient = torch.autograd.grad(ours.nan_to_num().sum(), fmap)[0]
    assert gradient[0, jj[torch.arange(len(jj)) != 4].unique()].isfinite().any()


def test_block_refuses_edges_between_clips_and_odd_shapes() -> None:
    fmap, gmap, kk, jj, positions = training_problem()
    look_up = CorrBlock(fmap, gmap, clips=2)
    for wrong in (jj.roll(3), jj + 6, jj - 3):
        with pytest.raises(InputError, match="between clips or out of range"):
            look_up(kk, wrong, positions[0])
    with pytest.raises(InputError, match="CorrBlock got coords"):
        look_up(kk, jj[1:], positions[0])
    with pytest.raises(InputError, match="multiples of clips"):
        CorrBlock(fmap, gmap, clips=4)
    with pytest.raises(InputError, match="CorrBlock got maps"):
        CorrBlock(fmap, gmap[:, :, :4])
