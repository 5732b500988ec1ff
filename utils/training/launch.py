"""From command-line options to a running trainer."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch

from devo.checkpoint import read_state_dict
from devo.data_readers.base import ClipSource, TrainingClips
from devo.enet import eVONet
from devo.errors import DevoError, InputError
from utils.atomic import atomic_path
from utils.training.ahead import BatchesAhead
from utils.training.settings import TrainSettings
from utils.training.simulated import simulated_source, validation_clips
from utils.training.trainer import RunSettings, Trainer, check_dimensions, training_state


def launch(options: argparse.Namespace) -> int:
    """Run the training that the options of `train.py` describe; returns the exit code.

    Raises:
        DevoError: unusable options, folders or checkpoints, out of memory.
    """
    settings = settings_from_options(options)
    rank, world, device = _join_processes(options)
    if options.threads:
        torch.set_num_threads(options.threads)
    folder = Path(options.runs) / options.name
    run = RunSettings(folder, options.log_every, options.save_every, options.validate_every, options.minutes)
    if rank == 0:
        _write_description(folder, settings, options)
    torch.manual_seed(settings.seed)
    network = eVONet(**settings.network_arguments()).to(device)
    resume = _resume_path(options, folder)
    if options.init and resume is None:
        weights = read_state_dict(options.init)
        check_dimensions(Path(options.init), {"model_state_dict": weights}, settings)
        network.load_state_dict(weights)
    start = int(training_state(resume).get("steps", 0)) if resume else 0
    source, validation = _data(options, settings, start, rank)
    if device.type == "cuda":
        source = BatchesAhead(source, world)
    trainer = Trainer(network, settings, run, source, validation, report=_reporter(rank), rank=rank, world=world)
    try:
        if resume:
            trainer.resume(resume)
        elif options.init:
            trainer.validate_and_keep()
        reason = trainer.train()
        _reporter(rank)(f"stopped at step {trainer.step}: {reason}; {folder / 'last.pth'} and {folder / 'best.pth'}")
    except torch.OutOfMemoryError as error:
        raise DevoError("out of memory: use fewer --clips, --patches or --frames, or smaller --size") from error
    except KeyboardInterrupt:
        trainer.save(folder / "last.pth")
        _reporter(rank)(f"interrupted at step {trainer.step}; go on with --resume {folder / 'last.pth'}")
        return 130
    finally:
        source.close()
        if world > 1:
            torch.distributed.destroy_process_group()
    return 0


def settings_from_options(options: argparse.Namespace) -> TrainSettings:
    """Preset plus the options that were given.

    Raises:
        InputError: unknown preset, loss or augmentation name, a size that is not HxW in multiples of 4, or nothing that
            simulates.
    """
    names = {item.name for item in fields(TrainSettings)} - {"loss", "augment", "preset", "shard_size"}
    changes = {name: value for name, value in vars(options).items() if name in names and value is not None}
    if options.size:
        changes["sizes"] = tuple(size_of(text) for text in options.size)
    if options.shard_size:
        changes["shard_size"] = size_of(options.shard_size)
    settings = TrainSettings.from_preset(options.preset, **changes)
    settings = replace(
        settings,
        loss=_changed(settings.loss, options.loss, "--loss"),
        augment=_changed(settings.augment, options.augment, "--augment"),
    )
    if options.data != "sim":
        return settings
    if options.simulators < 1:
        raise InputError(f"--simulators {options.simulators}: expected at least 1, or --no-background for none")
    height, width = settings.shard_size
    if any(h > height or w > width for h, w in settings.sizes):
        raise InputError(
            f"--size {settings.sizes} does not fit into the simulated {height}x{width}; raise --shard-size"
        )
    if settings.frames > settings.shard_frames:
        raise InputError(f"--frames {settings.frames} exceeds --shard-frames {settings.shard_frames}")
    return settings


def size_of(text: str) -> tuple[int, int]:
    """Height and width of `HxW`.

    Raises:
        InputError: not of that form, or no multiples of 4.
    """
    try:
        height, width = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise InputError(f"size {text!r} is not of the form HxW, for example 128x160") from None
    if height % 4 or width % 4 or min(height, width) < 32:
        raise InputError(f"size {text!r}: height and width must be multiples of 4 and at least 32")
    return height, width


def _changed(settings: Any, assignments: list[str], flag: str) -> Any:
    known = {item.name: item.type for item in fields(settings)}
    changes: dict[str, float] = {}
    for assignment in assignments:
        name, _, text = assignment.partition("=")
        if name not in known:
            raise InputError(f"{flag} {assignment!r}: unknown name {name!r}; expected one of {', '.join(known)}")
        try:
            changes[name] = int(text) if known[name] == "int" else float(text)
        except ValueError:
            raise InputError(f"{flag} {assignment!r}: {text!r} is not a number") from None
    return replace(settings, **changes)


def _data(
    options: argparse.Namespace, settings: TrainSettings, start: int, rank: int
) -> tuple[ClipSource, TrainingClips | None]:
    if options.data != "sim":
        from utils.training.tartan_source import tartan_source

        return tartan_source(settings), None
    cache = Path(options.cache) if options.cache else Path(options.runs) / "cache"
    producer = "elsewhere" if rank else "inline" if options.no_background else "background"
    source = simulated_source(
        settings,
        cache,
        producer=producer,
        start_step=start * int(os.environ.get("WORLD_SIZE", "1")),
        processes=options.simulators,
    )
    validation = validation_clips(cache, options.validation_clips) if rank == 0 and options.validation_clips else None
    return source, validation


def _join_processes(options: argparse.Namespace) -> tuple[int, int, torch.device]:
    """Rank, number of processes and device; joins the group that torchrun announces in the environment."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    rank = int(os.environ.get("RANK", "0"))
    name = options.device or ("cuda" if torch.cuda.is_available() else "cpu")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("--device cuda: no usable CUDA device was found; use --device cpu")
    device = torch.device(name)
    if world > 1:
        if device.type == "cuda":
            device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
            torch.cuda.set_device(device)
        torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return rank, world, device


def _resume_path(options: argparse.Namespace, folder: Path) -> Path | None:
    if options.resume is None:
        return None
    if options.resume == "auto":
        path = folder / "last.pth"
        return path if path.is_file() else None
    return Path(options.resume)


def _reporter(rank: int) -> Any:
    def report(text: str) -> None:
        if rank == 0:
            sys.stdout.write(f"{time.strftime('%H:%M:%S')} {text}\n")
            sys.stdout.flush()

    return report


def _write_description(folder: Path, settings: TrainSettings, options: argparse.Namespace) -> None:
    """`run.json`: command line, settings, versions."""
    description = {
        "command": sys.argv,
        "settings": settings.as_dict(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "machine": platform.processor() or platform.machine(),
        "options": {name: value for name, value in vars(options).items() if value is not None},
    }
    with atomic_path(folder / "run.json") as temporary:
        temporary.write_text(json.dumps(description, indent=2) + "\n")
