"""Settings of a training run, and the presets."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from devo.errors import InputError
from utils.training.augment import AugmentSettings

PRESETS: dict[str, dict[str, Any]] = {
    "tiny": {"dim_inet": 128, "dim_fnet": 64, "dim": 16, "norm": "std", "patches": 24, "clips": 4},
    "small": {"dim_inet": 192, "dim_fnet": 96, "dim": 24, "norm": "std", "patches": 48, "clips": 4},
    "base": {"dim_inet": 384, "dim_fnet": 128, "dim": 32, "norm": "std", "patches": 80, "clips": 2},
}
PARTS = ("", "scorer")


@dataclass(frozen=True)
class LossSettings:
    """Weights of the losses; the published ones are flow 0.1, pose 10, scores 0.05 and no others.

    Attributes:
        flow, pose: per update, after bundle adjustment. pose applies from the third update on.
        scores: last update only.
        direct: per update, error of the revised centres before bundle adjustment.
        direct_first: factor on `direct` for the first update, which the tracker's start-up depends on.
        probe: error of one update on stand-alone edges from a zero state.
        match: per update of `match_updates`, the direct, fine and confidence losses of edges that start off the truth,
            with their own weights.
        peak: of the same edges, cross entropy between their correlation windows and the true positions; trains the
            features without the detour through the update operator.
        fine: per update, ln(1 + error/0.2 px) of the same revised centres.
        confidence: per update, likelihood of these errors under the predicted confidence; gives the weights a meaning
            before the solver's gradients do.
        published_from: flow and pose losses are left out up to this step and ramped up over as many steps after it.
    """

    flow: float = 0.1
    pose: float = 4.0
    scores: float = 0.05
    direct: float = 0.15
    direct_first: float = 2.0
    probe: float = 0.6
    match: float = 4.0
    peak: float = 0.5
    fine: float = 0.15
    confidence: float = 0.05
    published_from: int = 300


@dataclass(frozen=True)
class TrainSettings:
    """Everything that decides the result of a run (with the code and the machine).

    Attributes:
        dim_inet, dim_fnet, dim, norm: network.
        only: "scorer" trains the scorer alone, to find the structure of the frames, see `devo.losses.structure_loss`;
            "" trains everything.
        patches: patches per frame. frames: frames per clip. updates: updates per step. initial_frames: dense start.
        clips: clips per step. sizes: (height, width) windows, one drawn per step.
        structure_only: probability, per step, that poses stay at the truth.
        perturbed: probability, per clip, to start between identity and truth (else at identity).
        flat_depth: probability, per clip, of equal initial depths, see `devo.unroll_state.UnrollSettings`.
        solver_gradient_every, match_gradient_every, match_updates, depth_noise: see
            `devo.unroll_state.UnrollSettings`.
        unroll_every: the loop with bundle adjustment runs in every k-th step, the others learn matching alone.
        score_every: the scorer runs with gradient in every k-th step.
        steps, learning_rate, warmup, schedule, clip_gradient, weight_decay, ema: optimisation; `warmup` in steps,
            schedule onecycle (published, linear), cosine or constant.
        precision: float32, bfloat16 or float16 (autocast of encoders and update operator).
        pool: see `utils.training.pool.ClipPool`.
        seed: of everything random.
    """

    preset: str = "tiny"
    dim_inet: int = 128
    dim_fnet: int = 64
    dim: int = 16
    norm: str = "std"
    randaug: bool = False
    only: str = ""
    patches: int = 24
    frames: int = 8
    updates: int = 6
    initial_frames: int = 8
    clips: int = 4
    sizes: tuple[tuple[int, int], ...] = ((128, 160), (112, 176), (144, 144))
    structure_only: float = 0.0
    perturbed: float = 0.65
    flat_depth: float = 0.7
    solver_gradient_every: int = 1
    match_gradient_every: int = 2
    match_updates: int = 3
    depth_noise: float = 0.1
    unroll_every: int = 1
    score_every: int = 4
    steps: int = 10000
    learning_rate: float = 7e-4
    warmup: int = 100
    schedule: str = "cosine"
    final_rate: float = 0.02
    clip_gradient: float = 10.0
    weight_decay: float = 1e-6
    ema: float = 0.998
    precision: str = "float32"
    seed: int = 0
    data: str = "sim"
    datapath: str = ""
    pool_shards: int = 24
    shard_clips: int = 8
    shard_frames: int = 12
    shard_size: tuple[int, int] = (144, 176)
    reuse: int = 5
    loss: LossSettings = field(default_factory=LossSettings)
    augment: AugmentSettings = field(default_factory=AugmentSettings)

    @classmethod
    def from_preset(cls, name: str, **changes: Any) -> TrainSettings:
        """Settings of a preset (`tiny`, `small`, `base`) with changes.

        Raises:
            InputError: unknown preset or field.
        """
        if changes.get("only", "") not in PARTS:
            raise InputError(f"unknown part {changes['only']!r} to train; expected one of {', '.join(PARTS[1:])}")
        if name not in PRESETS:
            raise InputError(f"unknown preset {name!r}; expected one of {', '.join(PRESETS)}")
        known = {item.name for item in fields(cls)}
        unknown = set(changes) - known
        if unknown:
            raise InputError(f"unknown training setting {sorted(unknown)[0]!r}; known are {', '.join(sorted(known))}")
        return replace(cls(preset=name, **PRESETS[name]), **changes)

    def as_dict(self) -> dict[str, Any]:
        """Plain nested dictionary of lists, numbers and strings, for checkpoints and logs."""
        return _plain(asdict(self))

    def network_arguments(self) -> dict[str, Any]:
        """Keyword arguments of `eVONet`."""
        return {
            "dim_inet": self.dim_inet,
            "dim_fnet": self.dim_fnet,
            "dim": self.dim,
            "norm": self.norm,
            "randaug": self.randaug,
            "patch_selector": "scorer",
        }


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(entry) for entry in value]
    return value
