"""Training batches from TartanAir event voxels on disk, `<env>/<level>/evs_left/<env>/<env>/<level>/<P>/h5`."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import torch

from devo.data_readers.base import TrainingClips
from devo.data_readers.tartan import CELL, TartanScene, camera_poses, frame_graph, inverse_depth
from devo.errors import InputError, OutputError
from utils.atomic import atomic_path
from utils.training.augment import AugmentSettings, augment, generator_for
from utils.training.settings import TrainSettings

logger = logging.getLogger(__name__)

GRAPH_FOLDER = "fgraph"


def read_voxel(path: Path) -> np.ndarray:
    """Voxel grid (5,H,W) float16 of one file.

    Raises:
        InputError: unreadable, or without a data set `voxel`.
    """
    try:
        import hdf5plugin  # noqa: F401 - registers the compression of these files

        with h5py.File(path, "r") as file:
            return np.asarray(file["voxel"])
    except (OSError, KeyError) as error:
        raise InputError(
            f"cannot read the voxel grid {path} ({error}); convert this TartanAir trajectory again"
        ) from error


def open_scene(root: Path, folder: Path, cache: Path) -> TartanScene:
    """A scene from its `evs_left/...` folder; its frame graph is computed once and cached below `cache`.

    Raises:
        InputError: numbers of voxels, depths and poses disagree.
    """
    parts = folder.relative_to(root).parts  # env, level, evs_left, env, env, level, P
    images, depth_folder = (root.joinpath(*parts[:2], kind, *parts[3:]) for kind in ("image_left", "depth_left"))
    voxels = sorted((folder / "h5").glob("*.h5"))
    depths = sorted((depth_folder / "depth_left").glob("*.npy"))[1:]
    poses = camera_poses(np.loadtxt(images / "pose_left.txt", ndmin=2)[1:])
    if not len(voxels) == len(depths) == len(poses):
        raise InputError(
            f"{folder}: found {len(voxels)} voxel grids, {len(depths)} depth maps and {len(poses)} poses after the "
            "first frame; expected equal numbers, so download or convert the trajectory again"
        )

    def load(frame: int) -> tuple[np.ndarray, np.ndarray]:
        return read_voxel(voxels[frame]), np.load(depths[frame], allow_pickle=False)

    name = "/".join(parts[3:])
    return TartanScene(name, poses, _cached_graph(cache / f"{name.replace('/', '_')}.npz", poses, depths), load)


def _cached_graph(path: Path, poses: np.ndarray, depths: list[Path]) -> list[tuple[np.ndarray, np.ndarray]]:
    if path.is_file():
        with np.load(path, allow_pickle=False) as archive:
            if np.array_equal(archive["poses"], poses):
                parts = np.split(np.arange(len(archive["frame"])), archive["split"])
                return [(archive["frame"][part], archive["distance"][part]) for part in parts]
    sampled = [
        inverse_depth(np.load(depth, allow_pickle=False))[CELL // 2 :: CELL, CELL // 2 :: CELL] for depth in depths
    ]
    graph = frame_graph(poses, np.stack(sampled))
    frames, distances = (np.concatenate(column) for column in zip(*graph))
    split = np.cumsum([len(frame) for frame, _ in graph])[:-1]
    try:
        with atomic_path(path) as temporary:
            np.savez(temporary, poses=poses, frame=frames, distance=distances, split=split)
    except OutputError as error:
        logger.warning("%s; the frame graph will be computed again next time", error)
    return graph


def find_scenes(root: Path, tokens: Iterable[str] | None = None) -> list[Path]:
    """Converted scenes below a TartanAir root whose path holds one of the tokens of a split (all without tokens).

    Raises:
        InputError: none found.
    """
    wanted = None if tokens is None else [token.strip() for token in tokens if token.strip()]
    found = []
    for folder in sorted(root.glob("*/*/evs_left/*/*/*/*")):
        parts = folder.relative_to(root).parts
        converted = root.joinpath(*parts[:2], "image_left", *parts[3:]) / "converted.txt"
        if converted.is_file() and (wanted is None or any(token in "/".join(parts[3:]) for token in wanted)):
            found.append(folder)
    if not found:
        raise InputError(
            f"no converted TartanAir scenes below {root}; expected <env>/<level>/evs_left/<env>/<env>/<level>/<P>/h5 "
            "and a converted.txt beside the images, so check --datapath and the split file"
        )
    return found


class TartanSource:
    """Deterministic batches of augmented TartanAir clips; see `devo.data_readers.base.ClipSource`."""

    def __init__(
        self,
        scenes: list[TartanScene],
        *,
        clips: int,
        frames: int,
        sizes: tuple[tuple[int, int], ...],
        augment_settings: AugmentSettings,
        seed: int = 0,
    ) -> None:
        self.scenes, self.clips, self.frames, self.sizes = scenes, clips, frames, sizes
        self.augment_settings, self.seed = augment_settings, seed
        self.starts = [(number, int(i)) for number, scene in enumerate(scenes) for i in scene.starts(frames)]
        if not self.starts:
            raise InputError(f"no TartanAir scene has a frame with more than {frames} neighbours; use fewer --frames")

    def batch(self, step: int) -> TrainingClips:
        """Batch of training step `step`."""
        generator = generator_for(self.seed, 4, step)
        rng = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
        parts = []
        for _ in range(self.clips):
            scene, start = self.starts[int(rng.integers(len(self.starts)))]
            parts.append(self.scenes[scene].clip(start, self.frames, rng))
        size = self.sizes[int(rng.integers(len(self.sizes)))]
        return augment(TrainingClips.join(parts), self.frames, size, self.augment_settings, generator)

    def close(self) -> None:
        """Nothing runs in the background."""


def tartan_source(settings: TrainSettings, split: Path | None = None) -> TartanSource:
    """Source of a training run on TartanAir.

    Raises:
        InputError: no scenes below `settings.datapath`.
    """
    root = Path(settings.datapath)
    tokens = split.read_text().split("\n") if split else None
    scenes = [open_scene(root, folder, root / GRAPH_FOLDER) for folder in find_scenes(root, tokens)]
    return TartanSource(
        scenes,
        clips=settings.clips,
        frames=settings.frames,
        sizes=settings.sizes,
        augment_settings=replace(settings.augment, reverse=0.0),  # poses belong to the ends of the windows
        seed=settings.seed,
    )
