"""The focus-refined edge cloud of a whole recording, with a progress bar and a word on whether it can work."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from tqdm import tqdm

from utils.clouds.cloud import PointCloud
from utils.edge_clouds.focus import refine_edges
from utils.edge_clouds.settings import FocusSettings
from utils.eval_utils import Frame
from utils.frame_bundle import FrameBundle
from utils.messages import say

LEAST_TRAVEL_PX = 3.0
"""A peak cannot be told from its surroundings if the tried band spans fewer pooled pixels than this."""


def collect_focus_cloud(frames: Iterable[Frame], bundle: FrameBundle, settings: FocusSettings,
                        device: torch.device | str = "cpu", *, image_dtype: torch.dtype = torch.float16,
                        progress_every: int = 1) -> PointCloud:
    """All refined edge points, see `utils.edge_clouds.focus.refine_edges`.

    The metadata `band_travel_px` is the median over the frames. If it is too small a line on stderr says so and what
    to change.

    Args:
        progress_every: frames from one update of the progress bar to the next, 0 for no bar.

    Raises:
        InputError: the recording and the bundle share no time stamp.
    """
    total = -(-len(bundle) // settings.keyframe_stride)
    total = min(total, settings.max_keyframes) if settings.max_keyframes else total
    clouds = list(tqdm(refine_edges(frames, bundle, settings, device, image_dtype=image_dtype), total=total,
                       unit="frame", desc="focus", disable=progress_every == 0, miniters=progress_every))
    travel = float(np.median([float(cloud.metadata["band_travel_px"]) for cloud in clouds] or [0.0]))
    if travel < LEAST_TRAVEL_PX:
        say(f"focus: the tried depths are only {travel:.1f} pixels apart in the farthest event image, so most of them "
            "cannot be told apart; raise --focus_support_stride or --focus_support, or lower --focus_downsample")
    joined = PointCloud.concat(clouds)
    return PointCloud(joined.points, None, joined.scalars, {"band_travel_px": f"{travel:.3f}"})
