"""Turn a training checkpoint into a weights file that ships: tensors only, with a card beside it."""

from __future__ import annotations

import argparse
import json
import platform
import sys
from pathlib import Path
from typing import Any

import torch

from devo.checkpoint import network_from_state, read_state_dict, save_checkpoint
from devo.errors import DevoError, OutputError
from utils.atomic import atomic_path
from utils.training.trainer import figure_of_merit, training_state

LIMIT_BYTES = 4 * 2**20

CARD = """# {name}

Event network (published architecture, `dim_inet {dim_inet}, dim_fnet {dim_fnet}, dim {dim}`, {parameters} parameters,
float32), trained from random initialisation on simulated events only. Voxel grids of 5 bins, normalised per grid
(`NORM: std`).

| | |
|---|---|
| data | `utils/simulator`: random scenes, textures, motion and pixel parameters; seed {seed}; no real recordings |
| optimisation | {history} |
| hardware | {machine}, shared with other work |
| loss weights | {losses} |

## Validation
{clips} simulated clips of 10 frames, 160x128, seed outside the training range; identity poses and equal depths at the
start, 12 updates, errors in quarter-resolution pixels:

| figure | value | meaning |
|---|---|---|
{figures}

## Reproduce
Numbers differ slightly between machines and thread counts; the same machine, commands and seeds give the same weights.
```
{commands}
python -m utils.training.export runs/{run}/best.pth devo/weights/{name}.pth
```

## Limits
* Trained on small images (80 to 144 pixels high) of static scenes: moving objects and flicker were never seen.
* Pure rotation gives no parallax; depth is then undefined, as for every monocular odometry.
* Motion above about 12 quarter-resolution pixels between neighbouring frames lies outside the correlation windows.
"""

MEANING = {
    "flow": "median error after bundle adjustment, neighbouring frames",
    "flow90": "90 % quantile of the same",
    "start": "median true displacement before the first update",
    "first": "median error of the first update",
    "last": "median error of the last update before bundle adjustment",
    "probe": "median error of one update on single edges",
    "match": "median error after three updates of edges that start off the truth, each in its own way",
    "probe_ratio": "predicted over true motion there",
    "rotation": "median rotation error of frame pairs, degrees",
    "ate": "median position error over path length of a clip",
    "lost": "share of clips with more than 0.3 of that",
    "score": "scorer loss",
    "confidence": "mean weight",
}


def export_weights(checkpoint: Path, destination: Path, history: str = "", commands: str = "", clips: int = 16) -> bool:
    """Write the weights of `checkpoint` and the card beside them, unless the file there is better already.

    Args:
        checkpoint: `best.pth` of a run.
        destination: weights file; its card is `<name>.md`, its figure of merit `<name>.json` in the run folder.
        history: text about steps and time. commands: the exact command lines. clips: size of the validation set.

    Returns:
        Whether the file was written.

    Raises:
        CheckpointError: `checkpoint` is unusable.
        OutputError: the weights are larger than 4 MB, or cannot be written.
    """
    state = training_state(checkpoint)
    network = network_from_state(read_state_dict(checkpoint))
    merit = figure_of_merit(state["validation"])
    record = checkpoint.parent.parent / f"{destination.stem}.json"
    if record.is_file() and destination.is_file() and json.loads(record.read_text())["merit"] <= merit:
        return False
    size = sum(value.numel() * 4 for value in network.state_dict().values())
    if size > LIMIT_BYTES:
        raise OutputError(
            f"{checkpoint} holds {size / 2**20:.1f} MiB of weights; at most {LIMIT_BYTES / 2**20:.0f} MiB are shipped"
        )
    save_checkpoint(destination, network)
    settings = state["settings"]
    figures = "\n".join(
        f"| {name} | {value:.3f} | {MEANING.get(name, '')} |" for name, value in state["validation"].items()
    )
    losses = ", ".join(f"{name} {value:g}" for name, value in settings["loss"].items())
    card = CARD.format(
        name=destination.stem,
        parameters=size // 4,
        history=history or f"{state['steps']} steps, see the command",
        machine=f"{platform.machine()} CPU, 2 threads, torch {torch.__version__}",
        losses=losses,
        clips=clips,
        figures=figures,
        commands=commands.strip() or "python train.py --data sim --preset tiny",
        run=checkpoint.parent.name,
        **{key: settings[key] for key in ("dim_inet", "dim_fnet", "dim", "seed")},
    )
    with atomic_path(destination.with_suffix(".md")) as temporary:
        temporary.write_text(card)
    with atomic_path(record) as temporary:
        temporary.write_text(
            json.dumps({"merit": merit, "checkpoint": str(checkpoint), "steps": state["steps"]}) + "\n"
        )
    return True


def main(arguments: list[str] | None = None) -> int:
    """Command line: `python -m utils.training.export runs/NAME/best.pth devo/weights/NAME.pth`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("destination", type=Path)
    parser.add_argument("--history", default="", help="text of the card about steps and time")
    parser.add_argument(
        "--commands", type=Path, default=None, help="file with the command lines that reproduce the weights"
    )
    options: Any = parser.parse_args(arguments)
    try:
        commands = options.commands.read_text() if options.commands else ""
        written = export_weights(options.checkpoint, options.destination, options.history, commands)
    except DevoError as error:
        sys.stderr.write(f"export: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{options.destination} {'written' if written else 'kept, it is as good'}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
