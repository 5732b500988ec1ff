"""Tools around training runs: batches made ahead, a wider network that computes the same."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from devo.checkpoint import load_network
from devo.enet import eVONet
from devo.errors import DevoError, InputError
from tests.tolerances import WIDENED
from utils.training.ahead import BatchesAhead
from utils.training.widen import main, widened

NARROW = {"dim_inet": 16, "dim_fnet": 8, "dim": 8}
WIDE = {"dim_inet": 48, "dim_fnet": 16, "dim": 16}


def outputs(network: eVONet) -> list[torch.Tensor]:
    """Correlations of all features with those of a patch, and what an update makes of them, twice in a row."""
    generator = torch.Generator().manual_seed(1)
    images = torch.randn(1, 2, 5, 48, 64, generator=generator)
    coords = torch.randint(1, 11, (2, 4, 2), generator=generator)
    fmap, gmap, imap, *_ = network.eval().patchify(images, 4, coords=coords)
    kk, jj = torch.arange(8).repeat_interleave(2), torch.arange(2).repeat(8)
    corr = torch.randn(1, 16, 882, generator=generator)
    net = torch.zeros(1, 16, network.dim_inet)
    updates = []
    for _ in range(2):
        net, (delta, weight, _) = network.update(net, imap[0, kk].flatten(1)[None], corr, None, kk // 4, jj, kk)
        updates += [delta, weight]
    return [torch.einsum("fchw,kcyx->kfhwyx", fmap[0], gmap[0]), *updates]


def networks() -> tuple[eVONet, eVONet]:
    torch.manual_seed(0)
    return eVONet(**NARROW), eVONet(**WIDE)


def test_a_wider_network_computes_the_same_and_its_copies_differ() -> None:
    narrow, wide = networks()
    wide.load_state_dict(widened(narrow.state_dict(), wide))
    with torch.no_grad():
        for found, expected in zip(outputs(wide), outputs(narrow), strict=True):
            assert (found - expected).abs().max() <= WIDENED * expected.abs().max()
    loss = sum((value**2).sum() for value in outputs(wide.train()))
    loss.backward()
    gradient = wide.update.c1[0].weight.grad
    assert gradient is not None
    first, second = gradient[:16, :16], gradient[16:32, :16]
    assert (first - second).norm() > 0.05 * first.norm(), "copies with equal gradients would stay copies"


def test_widths_that_are_no_multiples_are_refused() -> None:
    narrow, _ = networks()
    with pytest.raises(InputError, match="expected multiples of all widths"):
        widened(narrow.state_dict(), eVONet(dim_inet=40, dim_fnet=16, dim=16))


def test_as_a_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devo-tiny", "--preset", "base", "--out", str(tmp_path / "wide.pth")]) == 0
    assert "3397061 parameters" in capsys.readouterr().out
    assert load_network(tmp_path / "wide.pth").dim_inet == 384
    assert main([str(tmp_path / "absent.pth"), "--out", str(tmp_path / "x.pth")]) == 2
    assert capsys.readouterr().err.startswith("widen: ")


def test_batches_made_ahead_are_those_asked_for() -> None:
    asked, closed = [], []

    class Source:
        waited_seconds = 2.5

        def batch(self, step: int) -> int:
            asked.append(step)
            if step == 9:
                raise DevoError("no such batch")
            return 10 * step

        def close(self) -> None:
            closed.append(True)

    ahead = BatchesAhead(Source(), stride=2)  # type: ignore[arg-type]
    assert [ahead.batch(step) for step in (0, 2, 4, 1, 3)] == [0, 20, 40, 10, 30]
    assert ahead.waited_seconds == 2.5
    ahead.batch(7)
    with pytest.raises(DevoError, match="no such batch"):
        ahead.batch(9)
    ahead.close()
    assert closed == [True] and asked[:3] == [0, 2, 4] and asked.count(2) == 1
