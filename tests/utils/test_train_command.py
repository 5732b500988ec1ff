"""The command line of the trainer: options to settings, a short run, going on, and refusals."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import train
from devo.checkpoint import load_network, read_checkpoint, save_checkpoint
from devo.data_readers.base import TrainingClips
from devo.enet import eVONet
from devo.errors import InputError
from tests.utils.test_training import moving_plane
from utils.training.average import main as average_main
from utils.training.export import main as export_main
from utils.training.launch import settings_from_options
from utils.training.log import read_log
from utils.training.pool import ShardSettings

SHORT = [
    *(
        "--no-background",
        "--device",
        "cpu",
        "--threads",
        "1",
        "--clips",
        "2",
        "--patches",
        "8",
        "--validation-clips",
        "8",
    ),
    *("--frames", "3", "--shard-frames", "3", "--initial-frames", "3", "--updates", "2", "--shard-clips", "2"),
    *("--size", "48x64", "--shard-size", "48x64", "--log-every", "1", "--validate-every", "2", "--save-every", "2"),
]


def plane_shard(settings: ShardSettings, number: int) -> TrainingClips:
    return moving_plane(settings.clips, settings.frames, settings.height, settings.width, seed=number)


@pytest.fixture(autouse=True)
def _fast(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A moving plane instead of the simulator, which needs seconds for its textures; one thread."""
    monkeypatch.setattr("utils.training.simulated.simulate_shard", plane_shard)
    monkeypatch.setattr("utils.training.simulated.VALIDATION_FRAMES", 3)
    monkeypatch.setattr("utils.training.simulated.VALIDATION_SIZE", (48, 64))
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_short_run_then_resume_then_export(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = [*SHORT, "--runs", str(tmp_path), "--name", "short"]
    assert train.main([*common, "--steps", "2"]) == 0
    run = tmp_path / "short"
    assert {path.name for path in run.iterdir()} >= {
        "run.json",
        "train.csv",
        "validation.csv",
        "curves.png",
        "best.pth",
        "last.pth",
    }
    assert read_checkpoint(run / "last.pth")["steps"] == 2
    assert train.main([*common, "--steps", "4", "--resume", "auto"]) == 0
    assert read_log(run / "train.csv")["step"] == [1, 2, 3, 4]
    assert "VALIDATION" in capsys.readouterr().out

    target = tmp_path / "weights" / "devo-short.pth"
    assert export_main([str(run / "best.pth"), str(target)]) == 0
    assert set(read_checkpoint(target)) == {"model_state_dict"}
    assert target.stat().st_size <= 4 * 2**20
    assert load_network(str(target)).dim_inet == 128
    card = target.with_suffix(".md").read_text()
    assert "516869 parameters" in card
    assert "{" not in card
    assert export_main([str(run / "best.pth"), str(target)]) == 0
    assert "kept" in capsys.readouterr().out


def test_start_from_weights_of_other_dimensions_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_checkpoint(tmp_path / "other.pth", eVONet(dim_inet=16, dim_fnet=8, dim=8))
    code = train.main([*SHORT, "--runs", str(tmp_path), "--init", str(tmp_path / "other.pth")])
    assert code == 2
    assert "other dimensions" in capsys.readouterr().err


def test_unwritable_folders_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("in the way")
    assert train.main([*SHORT, "--runs", str(tmp_path / "file")]) == 1
    assert "cannot write" in capsys.readouterr().err
    assert train.main([*SHORT, "--runs", str(tmp_path), "--cache", str(tmp_path / "file")]) == 1
    assert "choose another folder with --cache" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--preset", "huge"], "unknown preset 'huge'"),
        (["--size", "100"], "not of the form HxW"),
        (["--size", "50x64"], "multiples of 4"),
        (["--size", "480x640"], "raise --shard-size"),
        (["--frames", "40"], "exceeds --shard-frames"),
        (["--loss", "speed=1"], "unknown name 'speed'"),
        (["--loss", "pose=much"], "'much' is not a number"),
        (["--augment", "noise"], "'' is not a number"),
        (["--simulators", "0"], "expected at least 1, or --no-background"),
    ],
)
def test_unusable_options_say_what_was_expected(arguments: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        settings_from_options(train.parse_arguments(arguments))


def test_options_reach_the_settings() -> None:
    options = train.parse_arguments(
        ["--lr", "0.1", "--clip", "3", "--loss", "pose=2", "--augment", "noise=1", "--size", "64x64"]
    )
    settings = settings_from_options(options)
    assert (settings.learning_rate, settings.clip_gradient, settings.loss.pose, settings.augment.noise) == (
        0.1,
        3.0,
        2.0,
        1.0,
    )
    assert settings.sizes == ((64, 64),)


def test_tartan_without_data_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train.main(["--data", "tartan", "--datapath", str(tmp_path), "--runs", str(tmp_path)]) == 2
    assert "no converted TartanAir scenes" in capsys.readouterr().err


def test_help_does_not_import_torch(repository: Path) -> None:
    code = "import sys, train\ntry: train.main(['--help'])\nexcept SystemExit: pass\nassert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=repository, check=True, capture_output=True)


def test_average_of_runs_is_the_mean_of_their_weights(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    networks = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        networks.append(eVONet(dim_inet=24, dim_fnet=16, dim=8, norm="std"))
        save_checkpoint(tmp_path / f"{seed}.pth", networks[-1])
    moving = {"values": {name: torch.zeros_like(value) for name, value in networks[1].state_dict().items()}}
    save_checkpoint(tmp_path / "last.pth", networks[1], average=moving)
    out = tmp_path / "mean.pth"
    for second, expected in (("1.pth", networks[1].state_dict()), ("last.pth", moving["values"])):
        assert average_main([str(tmp_path / "0.pth"), str(tmp_path / second), "--out", str(out), "--cache",
                             str(tmp_path), "--validation-clips", "8"]) == 0
        assert math.isfinite(read_checkpoint(out)["validation"]["flow"])
        for name, value in load_network(out).state_dict().items():
            torch.testing.assert_close(value, (networks[0].state_dict()[name] + expected[name]) / 2)
    save_checkpoint(tmp_path / "other.pth", eVONet(dim_inet=24, dim_fnet=8, dim=8, norm="std"))
    capsys.readouterr()
    assert average_main([str(tmp_path / "0.pth"), str(tmp_path / "other.pth"), "--out", str(out)]) == 2
    assert "equal dimensions" in capsys.readouterr().err


def test_only_the_scorer_from_given_weights(tmp_path: Path) -> None:
    torch.manual_seed(0)
    start = eVONet(**settings_from_options(train.parse_arguments([])).network_arguments())
    save_checkpoint(tmp_path / "start.pth", start)
    arguments = [*SHORT, "--runs", str(tmp_path), "--name", "scorer", "--only", "scorer", "--steps", "2"]
    assert train.main([*arguments, "--init", str(tmp_path / "start.pth")]) == 0
    trained = load_network(tmp_path / "scorer" / "best.pth").state_dict()
    same = {name: torch.equal(value, trained[name]) for name, value in start.state_dict().items()}
    assert all(equal != name.startswith("patchify.scorer.") for name, equal in same.items())
