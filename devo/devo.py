"""The online tracker: frames in, keyframe poses and patch depths out.

One call per frame: normalise, extract patches, predict the pose, connect the frame with its neighbours, let the
update operator revise the flow of every edge, and solve for poses and inverse depths. Teed, Lipson and Deng, "Deep
Patch Visual Odometry" (2023) for the method; Klenk et al., "Deep Event Visual Odometry" (3DV 2024) for events.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator
from os import PathLike
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from devo import fastba
from devo import projective_ops as pops
from devo.altcorr import corr_features
from devo.checkpoint import load_network
from devo.device import autocast, fast_dtype, resolve_device
from devo.errors import InputError
from devo.features import FeatureRing
from devo.initialization import initialize
from devo.lietorch import SE3
from devo.normalize import normalize_voxel
from devo.observables import build_observables
from devo.patchgraph import PatchGraph
from devo.result import INITIAL_KEYFRAMES, LOST_AFTER, MIN_EVENT_SHARE, TrackingResult, TrackingStatus, explain
from devo.trajectory import FrameRecorder, accumulated_map, full_trajectory

FINAL_UPDATES = 12
MIN_IMAGE_SIDE = 32
EXPLAINED_PX = 4.0  # a measurement closer to its reprojection than this (quarter-resolution px) counts as explained
_DAMPING = 1e-4


class DEVO(PatchGraph):
    """Visual odometry over keyframes, patches and edges; call it once per frame, then `terminate()`.

    Args:
        cfg: settings (`devo.config.Config`); copied attributes are read, never written.
        network: an `eVONet` or `VONet`, or what `devo.checkpoint.load_network` accepts.
        evs: True for event voxel grids `(bins,H,W)`, False for BGR images `(3,H,W)` in 0..255.
        ht, wd: height and width of the frames [px].
        viz: there is no live viewer in this package; True only warns.
        viz_flow: keep edges, reprojections and images per frame in `flow_data`.
        dim_inet, dim_fnet, dim: accepted for old callers; the network knows its dimensions.
        save_per_frame_cloud, save_per_frame_cloud_path: the drivers in `utils.eval_utils` write these files.
        record_frame_observables: keep what `return_frame_observables` needs.
        accumulate_map: keep removed keyframes for the accumulated map.
        device: where to run; default is where the network is.

    Sizes that are no multiple of 4 are cropped evenly (the odd pixel from the right and the bottom) and the
    principal point moves along. Not thread-safe; one object per run.
    """

    def __init__(self, cfg: Any, network: nn.Module | str | PathLike[str], evs: bool = False, ht: int = 480,
                 wd: int = 640, viz: bool = False, viz_flow: bool = False, dim_inet: int = 384, dim_fnet: int = 128,
                 dim: int = 32, save_per_frame_cloud: bool = False,
                 save_per_frame_cloud_path: str | PathLike[str] = "results/clouds",
                 record_frame_observables: bool = False, debug_viewer: bool = False, accumulate_map: bool = False,
                 device: str | torch.device | None = None) -> None:
        if save_per_frame_cloud:
            raise InputError(f"the tracker writes no files, nothing would appear in {save_per_frame_cloud_path}; call "
                             "utils.eval_utils.run_voxel(..., save_per_frame_cloud=True) instead")
        if viz or debug_viewer:
            warnings.warn("there is no live viewer; look at the result with scripts/view_pointcloud.py", stacklevel=2)
        self.cfg, self.evs, self.ht, self.wd = cfg, evs, ht, wd
        self.load_weights(network, device)
        self.RES = float(self.network.RES)
        self.dtype = fast_dtype(self.device, cfg.MIXED_PRECISION)
        super().__init__(cfg.PATCHES_PER_FRAME, self.network.P, cfg.BUFFER_SIZE, self.dim_inet, self.device,
                         keep_dropped_frames=record_frame_observables or accumulate_map)
        self.crop_left, self.crop_top, height, width = self._cropped_size(ht, wd)
        self.mem = getattr(cfg, "RING_SIZE", 0) or max(32, cfg.REMOVAL_WINDOW + cfg.PATCH_LIFETIME)
        self.ring = FeatureRing(self.mem, self.M, self.P, self.dim_inet, self.dim_fnet, height // 4, width // 4,
                                self.device, self.dtype)
        self.counter = 0  # accepted frames, keyframe or not
        self.is_initialized = False
        self.tlist: list[float] = []
        self.still_frames: list[int] = []  # passed over before initialisation
        self.viz_flow = viz_flow
        self.flow_data: dict[int, dict[str, Any]] = {}
        self.frames = FrameRecorder(self) if record_frame_observables else None
        self.counters: dict[str, int] = defaultdict(int)
        self.last_solve: fastba.BAResult
        self.timings: dict[str, float] = defaultdict(float)
        self.tracked: list[bool] = []

    def load_weights(self, network: nn.Module | str | PathLike[str], device: str | torch.device | None) -> None:
        """Take a network object or load one, move it to the device and switch it to evaluation."""
        if isinstance(network, nn.Module):
            first = next(network.parameters(), None)
            home = first.device if first is not None else torch.device("cpu")
            self.device = resolve_device(device) if device is not None else home
            self.network: Any = network.to(self.device)
        else:
            self.device = resolve_device(device or "auto")
            self.network = load_network(network, patch_selector=self.cfg.PATCH_SELECTOR, device=self.device)
        self.network.eval()
        self.dim_inet, self.dim_fnet = self.network.dim_inet, self.network.dim_fnet
        self.dim = self.network.dim

    def _cropped_size(self, height: int, width: int) -> tuple[int, int, int, int]:
        if min(height, width) < MIN_IMAGE_SIDE:
            raise InputError(f"the image size is {width}x{height} px; expected at least {MIN_IMAGE_SIDE} px a side, "
                             "check --image_size")
        return (width % 4) // 2, (height % 4) // 2, height - height % 4, width - width % 4

    # published names of the feature buffers
    @property
    def imap_(self) -> Tensor:
        """Context features of the ring, `(mem,M,dim_inet)`."""
        return self.ring.imap_

    @property
    def gmap_(self) -> Tensor:
        """Matching patches of the ring, `(mem,M,dim_fnet,P,P)`."""
        return self.ring.gmap_

    @property
    def fmap1_(self) -> Tensor:
        """Matching maps of the ring, `(1,mem,dim_fnet,h,w)`."""
        return self.ring.fmap1_

    @property
    def fmap2_(self) -> Tensor:
        """Pooled matching maps of the ring, `(1,mem,dim_fnet,h//4,w//4)`."""
        return self.ring.fmap2_

    @property
    def points_(self) -> Tensor:
        """World points of all patches with the current poses and depths, `(m,3)`; computed when asked for."""
        return self.world_points()

    @contextlib.contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.timings[stage] += time.perf_counter() - start

    @torch.no_grad()
    def __call__(self, tstamp: float, image: Tensor, intrinsics: Tensor, scale: float = 1.0) -> bool:
        """Track one frame.

        Args:
            tstamp: time stamp [us]; kept as it is.
            image: float voxel grid `(bins,H,W)` or BGR image `(3,H,W)`, 0..255.
            intrinsics: `(4,)` full-resolution `fx fy cx cy` [px].
            scale: input rescaling factor of the caller; only lowers the motion threshold before initialisation.

        Returns:
            True if the frame counts (it gets a pose and a time stamp), False if it was too empty.

        Raises:
            InputError: wrong shape, or values that are not finite.
        """
        self.counters["frames_read"] += 1
        with self._timed("normalize"):
            prepared = self._prepare(image)
        if prepared is None:
            return False
        self.reserve(self.n + 2)
        with self._timed("encoder"), autocast(self.device, self.dtype):
            fmap, gmap, imap, patches, _, colors = self.network.patchify(
                prepared[None, None], patches_per_image=self.M, return_color=True,
                scorer_eval_mode=self.cfg.SCORER_EVAL_MODE, scorer_eval_use_grid=self.cfg.SCORER_EVAL_USE_GRID,
                scorer_eval_pixel=self.cfg.SCORER_EVAL_PIXEL)
        self._write_frame(tstamp, intrinsics, patches, colors)
        self.ring.store(self.n, fmap, gmap, imap)
        self.counter += 1
        if self.n > 0 and not self.is_initialized:
            threshold = getattr(self.cfg, "PROBE_FLOW", 2.0) if scale == 1.0 else scale * scale
            if self.motion_probe() < threshold:
                self.delta[self.counter - 1] = (self.counter - 2, _identity_pose(self.device))
                self.still_frames.append(self.counter - 1)
                self.counters["frames_without_motion"] += 1
                return True
        self.n += 1
        self.m += self.M
        self.append_factors(*self.forward_edges(self.cfg.PATCH_LIFETIME))
        self.append_factors(*self.backward_edges(self.cfg.PATCH_LIFETIME))
        self._optimize()
        if self.viz_flow:
            self._record_flow(image)
        if self.frames is not None and self.is_initialized:
            self.frames.record(tstamp)
        return True

    def _prepare(self, image: Tensor) -> Tensor | None:
        """Check, normalise and crop a frame; None if it is too empty to be used."""
        bins = getattr(self.network.patchify, "channels", None)  # stand-ins take anything
        if image.ndim != 3 or image.shape[1:] != (self.ht, self.wd) or (bins and image.shape[0] != bins):
            raise InputError(f"frame {self.counters['frames_read']} has shape {tuple(image.shape)}; expected "
                             f"({bins or 'C'}, {self.ht}, {self.wd}), check the image size and whether the weights are "
                             "for events (5 channels) or images (3 channels)")
        image = image.to(self.device, torch.float32)
        if not bool(torch.isfinite(image).all()):
            raise InputError(f"frame {self.counters['frames_read']} holds NaN or infinite values")
        if self.evs:
            nonzero = int(torch.count_nonzero(image))
            if nonzero == 0 or (self.n == 0 and nonzero < MIN_EVENT_SHARE * image.numel()):
                self.counters["frames_too_empty"] += 1
                return None
            image = normalize_voxel(image, self.cfg.NORM)
        else:
            image = 2.0 * (image / 255.0) - 0.5
        height, width = self.ht - self.ht % 4, self.wd - self.wd % 4
        return image[:, self.crop_top:self.crop_top + height, self.crop_left:self.crop_left + width]

    def _write_frame(self, tstamp: float, intrinsics: Tensor, patches: Tensor, colors: Tensor) -> None:
        """Fill keyframe slot `n` with pose prediction, intrinsics, patches and colours."""
        n = self.n
        self.tlist.append(tstamp)
        self.tstamps_[n] = self.counter
        cropped = intrinsics.to(self.device, torch.float32).clone()
        if not getattr(self.cfg, "LEGACY_PRINCIPAL_POINT", False):
            cropped[2] -= self.crop_left
            cropped[3] -= self.crop_top
        self.intrinsics_[n] = cropped / self.RES
        color = colors[0].expand(-1, 3) if self.evs else colors[0][:, [2, 1, 0]] if colors.shape[2] == 3 else colors[0]
        self.colors_[n] = ((color.float() + 0.5) * 127.5).clamp(0, 255).to(torch.uint8)
        if n > 0:
            self.poses_[n] = self._predict_pose()
        patches = patches[0].float().clone()
        patches[:, 2] = self._initial_inv_depths()
        self.patches_[n] = patches

    def _initial_inv_depths(self) -> Tensor:
        """Inverse depths of a new frame's patches, `(M,1,1)`: the median of the last three keyframes if possible."""
        start = self.patches_[0, :, 2, :1, :1]
        if self.is_initialized:
            return torch.full_like(start, float(self.patches_[self.n - 3:self.n, :, 2].median()))
        constant = getattr(self.cfg, "INITIAL_INV_DEPTH", 0.0)
        return torch.full_like(start, constant) if constant > 0 else torch.rand(start.shape).to(start)

    def _predict_pose(self) -> Tensor:
        previous = SE3(self.poses_[self.n - 1])
        if self.n < 2 or self.cfg.MOTION_MODEL != "DAMPED_LINEAR":
            return previous.data
        motion = (previous * SE3(self.poses_[self.n - 2]).inv()).log()
        return (SE3.exp(self.cfg.MOTION_DAMPING * motion) * previous).data

    def reproject(self, indicies: tuple[Tensor, Tensor, Tensor] | None = None) -> Tensor:
        """Where patches are seen now: `(1,E,2,P,P)` quarter-resolution pixels of edges `(ii,jj,kk)` (default: all)."""
        ii, jj, kk = indicies if indicies is not None else (self.ii, self.jj, self.kk)
        return pops.reproject_edges(self.poses_[None], self.patches, self.intrinsics, ii, jj, kk)

    def _revise(self, net: Tensor, coords: Tensor, ii: Tensor, jj: Tensor, kk: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One application of the update operator: hidden state, flow revision `(1,E,2)` and weight `(1,E,2)`."""
        with autocast(self.device, self.dtype):
            with self._timed("corr"):
                features = corr_features(self.ring.matching_patches(), self.ring.pyramid, coords,
                                         kk % (self.M * self.mem), jj % self.mem)
            with self._timed("update"):
                net, (delta, weight, _) = self.network.update(net, self.ring.context(kk), features, None, ii, jj, kk)
        return net, delta.float(), weight.float()

    @torch.no_grad()
    def motion_probe(self) -> float:
        """Median flow of the last keyframe's patches into the new frame [quarter-resolution px], from one update."""
        kk = torch.arange(self.m - self.M, self.m, device=self.device)
        ii, jj = self.ix[kk], torch.full_like(kk, self.n)
        net = self.net.new_zeros(1, len(kk), self.dim_inet)
        _, delta, _ = self._revise(net, self.reproject((ii, jj, kk)), ii, jj, kk)
        return float(torch.quantile(delta.norm(dim=-1), 0.5))

    def _optimize(self) -> None:
        if self.is_initialized:
            self.update()
            self._note_health()
            self.keyframe()
        elif self.n == INITIAL_KEYFRAMES:
            initialize(self)
            self._note_health()

    @torch.no_grad()
    def update(self) -> None:
        """Revise all edges once and solve for the newest poses and all inverse depths that have edges.

        Without edges nothing happens. A failed factorisation keeps the geometry and is counted.
        """
        if len(self.kk) == 0:
            return
        with self._timed("reproject"):
            coords = self.reproject()
        self.net, delta, self.weight_ = self._revise(self.net, coords, self.ii, self.jj, self.kk)
        centre = self.P // 2
        self.target_ = coords[:, :, :, centre, centre] + delta
        height, width = self.fmap1_.shape[-2:]
        first_free = max(self.n - self.cfg.OPTIMIZATION_WINDOW, 1) if self.is_initialized else 1
        with self._timed("ba"):
            solved = fastba.BA(self.poses_[None], self.patches, self.intrinsics, self.target_, self.weight_,
                               torch.tensor([_DAMPING], device=self.device), self.ii, self.jj, self.kk,
                               first_free, self.n, 2, image_size=(height, width), accurate=True)
        self.counters["updates"] += 1
        self.counters["ba_failures"] += not solved.success
        self.last_solve = solved

    def _note_health(self) -> None:
        """Note whether the geometry explains the measurements of the newest keyframes."""
        recent = self.jj >= self.n - 2
        residual = self.last_solve.residual.norm(dim=-1)
        explained = self.last_solve.valid.bool() & (residual < EXPLAINED_PX)
        share = explained[recent].float().mean() if bool(recent.any()) else torch.zeros(())
        self.tracked.append(self.last_solve.success and float(share) > 0.5)

    def motionmag(self, i: int, j: int) -> float:
        """Mean flow of the edges from keyframe `i` to `j` [quarter-resolution px]; NaN if there are none."""
        edges = torch.nonzero((self.ii == i) & (self.jj == j))[:, 0]
        if len(edges) == 0:
            return float("nan")
        ii, jj, kk = self.ii[edges], self.jj[edges], self.kk[edges]
        return float(pops.flow_mag(self.poses, self.patches, self.intrinsics, ii, jj, kk, beta=0.5).mean())

    @torch.no_grad()
    def keyframe(self) -> None:
        """Remove the keyframe `KEYFRAME_INDEX` places back if its surroundings hardly moved; retire old edges."""
        with self._timed("keyframe"):
            k = self.n - self.cfg.KEYFRAME_INDEX
            flow = 0.5 * (self.motionmag(k - 1, k + 1) + self.motionmag(k + 1, k - 1)) if k > 0 else float("nan")
            if flow < self.cfg.KEYFRAME_THRESH:  # false for NaN: without edges nothing is known, so keep
                n = self.n
                self.drop_keyframe(k)
                self.ring.drop_keyframe(k, n)
                self.counters["keyframes_dropped"] += 1
            self.remove_factors(self.ix[self.kk] < self.n - self.cfg.REMOVAL_WINDOW, retire=True)

    def _record_flow(self, image: Tensor) -> None:
        self.flow_data[self.counter - 1] = {
            "ii": self.ii.cpu(), "jj": self.jj.cpu(), "kk": self.kk.cpu(), "coords_est": self.reproject().cpu(),
            "img": image.permute(1, 2, 0).cpu(), "n": self.n}

    @torch.no_grad()
    def world_points(self) -> Tensor:
        """World points of all `m` patches, `(m,3)` float32, in trajectory units."""
        points = pops.point_cloud(self.poses, self.patches[:, :self.m], self.intrinsics, self.ix[:self.m])
        centre = self.P // 2
        homogeneous = points[0, :, centre, centre]
        return homogeneous[:, :3] / homogeneous[:, 3:]

    def get_accumulated_map(self, include_colors: bool = False) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """All structure the run ever had, `(K,3)` world points, and on request colours `(K,3)` uint8.

        Raises:
            InputError: the tracker was constructed without `accumulate_map`.
        """
        points, colors = accumulated_map(self)
        return (points, colors) if include_colors else points

    def refine(self, updates: int = FINAL_UPDATES) -> None:
        """The extra updates at the end of a run; nothing happens before initialisation."""
        if self.is_initialized:
            for _ in range(updates):
                self.update()

    def status(self) -> TrackingStatus:
        """How the run stands, judged from what was seen so far."""
        if self.counter == 0:
            return TrackingStatus.EMPTY_STREAM
        if not self.is_initialized:
            return TrackingStatus.NOT_INITIALIZED
        recent = self.tracked[-LOST_AFTER:]
        finite = bool(torch.isfinite(self.poses_[:self.n]).all())
        return TrackingStatus.TRACKED if finite and 2 * sum(recent) > len(recent) else TrackingStatus.LOST

    @torch.no_grad()
    def result(self, *, observables: bool = False, include_colors: bool = False,
               frame_mode: str | None = None) -> TrackingResult:
        """Collect poses and, on request, the sparse structure; may be called at any time.

        Args:
            observables: compute `Observables` from the final poses and depths.
            include_colors: fill the colours of the observables.
            frame_mode: `final` or `online` frame observables, None for none; needs `record_frame_observables`.
        """
        status = self.status()
        if frame_mode is not None and self.frames is None:
            raise InputError("frame observables were asked for, but not recorded; pass record_frame_observables=True")
        poses = full_trajectory(self) if self.is_initialized else np.full((self.counter, 7), np.nan, np.float32)
        self.counters["frames_accepted"], self.counters["keyframes"] = self.counter, self.n
        return TrackingResult(
            poses=poses, tstamps=np.array(self.tlist, dtype=np.float64), status=status,
            message=explain(status, self.counters, self.n),
            observables=build_observables(self, include_colors) if observables else None,
            frame_data=self.frames.collect(frame_mode) if self.frames is not None and frame_mode else None,
            flowdata=self.flow_data if self.viz_flow else None,
            counters=dict(self.counters), timings=dict(self.timings),
            tracked_share=sum(self.tracked) / len(self.tracked) if self.tracked else 0.0)

    def terminate(self, return_observables: bool = False, return_frame_observables: bool = False,
                  include_colors: bool = False, frame_mode: str = "final") -> tuple[Any, ...]:
        """End the run: `(poses, tstamps[, point_cloud, depths[, colors]][, frame_data])`.

        `poses (T,7)` are `world_T_cam`, `tstamps (T,)` microseconds, `point_cloud (K,3)` world points, `depths (K,)`
        z-depths in the host camera, `colors (K,3)` in [0,1]. Poses are NaN (and a warning is given) if the run was
        never initialised. Call `refine()` first, as the drivers do.

        Raises:
            ValueError: colours without observables.
        """
        if include_colors and not return_observables:
            raise ValueError("include_colors needs return_observables=True")
        result = self.result(observables=return_observables, include_colors=include_colors,
                             frame_mode=frame_mode if return_frame_observables else None)
        if not result.ok:
            warnings.warn(result.message, stacklevel=2)
        values: tuple[Any, ...] = (result.poses, result.tstamps)
        if result.observables is not None:
            values += (result.observables.points, result.observables.depths)
            values += (result.observables.colors,) if include_colors else ()
        return values + ((result.frame_data,) if return_frame_observables else ())


def _identity_pose(device: torch.device) -> Tensor:
    return torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], device=device)
