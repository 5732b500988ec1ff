"""Losses of training: optical flow, relative poses, patch scores, and the direct supervision of the update operator."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

MAX_SCALE = 10.0
STRUCTURE_AT = 4.0  # times the mean event gradient of a frame: more does not count for more
LEAST_SCORE = 0.2  # so that about every second patch is drawn evenly: all on the strongest edges, they see one surface
PEAK_SHARPNESS = 3.0  # logits per unit of correlation


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of `values` where `mask` holds; 0 (with zero gradient) where it holds nowhere.

    Args:
        values: any shape; entries outside the mask may be infinite or NaN, they take no part.
        mask: same shape, bool or 0/1.
    """
    mask = mask.bool()
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


def flow_errors(coords: Tensor, coords_gt: Tensor) -> Tensor:
    """Distance to the true position, minimum over the pixels of a patch.

    Args:
        coords, coords_gt: (1,E,P,P,2) float, quarter-resolution pixels (x,y).

    Returns:
        (1,E) pixels.
    """
    return (coords - coords_gt).norm(dim=-1).flatten(2).amin(dim=-1)


def flow_loss(coords: Tensor, coords_gt: Tensor, valid: Tensor) -> Tensor:
    """Mean over valid edges of `flow_errors`, in quarter-resolution pixels.

    Args:
        coords, coords_gt: (1,E,P,P,2).
        valid: (1,E) bool or 0/1.
    """
    return masked_mean(flow_errors(coords, coords_gt), valid)


def direct_loss(predicted: Tensor, coords_gt: Tensor, valid: Tensor, limit: float = 20.0) -> Tensor:
    """Error of the revised patch centres before bundle adjustment, each edge clamped at `limit` pixels.

    Supervises the update operator without the detour through the solver, which gives useful gradients only
    once the revisions are roughly right. Clamped edges (far off or hopeless) have no gradient.

    Args:
        predicted: (1,E,2) reprojected centre + revision, quarter-resolution pixels.
        coords_gt: (1,E,2) true centres.
        valid: (1,E) bool.
        limit: pixels.
    """
    return masked_mean((predicted - coords_gt).norm(dim=-1).clamp(max=limit), valid)


def fine_loss(predicted: Tensor, coords_gt: Tensor, valid: Tensor, scale: float = 0.2) -> Tensor:
    """Mean of ln(1 + error/scale): rewards precision, where `direct_loss` is dominated by the edges that are far off.

    Args:
        predicted, coords_gt: (1,E,2) quarter-resolution pixels.
        valid: (1,E) bool.
        scale: pixels.
    """
    return masked_mean(torch.log1p((predicted - coords_gt).norm(dim=-1) / scale), valid)


def confidence_loss(
    weights: Tensor, predicted: Tensor, coords_gt: Tensor, valid: Tensor, scale: float = 0.2, limit: float = 2.0
) -> Tensor:
    """Gaussian negative log likelihood of the errors, per axis, with variance scale^2 / weight.

    Makes the confidence what bundle adjustment takes it for, an inverse variance: smallest at scale^2 / error^2. Errors
    get no gradient; they are limited to `limit` pixels, which is also the error of edges that are not valid (hidden).

    Args:
        weights: (1,E,2) in (0,1).
        predicted, coords_gt: (1,E,2) quarter-resolution pixels.
        valid: (1,E) bool.
    """
    error = torch.where(valid[..., None], (predicted.detach() - coords_gt).abs().clamp(max=limit), limit)
    return 0.5 * (weights * (error / scale).square() - weights.clamp(min=1e-6).log()).mean()


def structure_loss(logits: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Teach the scorer where events have structure: its scores follow the event gradient, relative to the frame's mean.

    Cross entropy with t = min(1, gradient / (`STRUCTURE_AT` * mean)), raised to `LEAST_SCORE` + (1 - `LEAST_SCORE`) t.
    Patches drawn with these scores prefer edges without leaving the rest of the image empty. The published loss
    (`score_loss`) compares errors with one pixel: once they are well below, all scores go to 1 and patches are drawn
    evenly; how well a single patch will be matched can hardly be foreseen from its few pixels.

    Args:
        logits: (N,rows,columns) of `devo.selector.Scorer`; cell s stands for quarter-resolution pixel s+1.
        gradient: (N,h,w) of `devo.selector.event_gradient` of the same frames; cell s stands for pixel s.

    Returns:
        the loss, and the correlation between scores and their targets (over all cells), a figure to watch.
    """
    rows, columns = logits.shape[-2:]
    mean = gradient.mean(dim=(1, 2), keepdim=True).clamp(min=1e-6)
    target = (gradient / (STRUCTURE_AT * mean)).clamp(max=1.0)[:, 1 : rows + 1, 1 : columns + 1]
    target = LEAST_SCORE + (1.0 - LEAST_SCORE) * target
    loss = F.binary_cross_entropy_with_logits(logits, target)
    pairs = torch.stack([torch.sigmoid(logits.detach()).flatten(), target.flatten()])
    return loss, torch.corrcoef(pairs)[0, 1]


def peak_loss(correlation: Tensor, centre: Tensor, coords_gt: Tensor, valid: Tensor) -> Tensor:
    """Cross entropy between the softmax of a correlation window and the true position in it (bilinear weights).

    Trains the features themselves: the correlation has to be largest where the patch really is. Edges whose true
    position lies outside the window take no part.

    Args:
        correlation: (1,E,S,S) at shifts (x, y) of -r..r pixels, S = 2r+1.
        centre: (1,E,2) position of the shift (0,0), quarter-resolution pixels.
        coords_gt: (1,E,2) true position.
        valid: (1,E) bool.
    """
    side = correlation.shape[-1]
    place = coords_gt - centre + side // 2
    inside = valid & ((place >= 0) & (place <= side - 1)).all(dim=-1)
    cells = torch.arange(side, device=place.device, dtype=place.dtype)
    near = (1.0 - (place[..., None] - cells).abs()).clamp(min=0)  # (1,E,2,S)
    target = near[..., 0, :, None] * near[..., 1, None, :]
    logits = PEAK_SHARPNESS * correlation.flatten(2)
    return masked_mean(-(target.flatten(2) * logits.log_softmax(dim=-1)).sum(dim=-1), inside)


def alignment_scale(centres_gt: Tensor, centres: Tensor, limit: float = MAX_SCALE) -> Tensor:
    """Scale that brings predicted camera centres to the size of the true ones (Umeyama 1991, without sign correction).

    s = Var(x_gt) / trace(D), D the singular values of cov(x_gt, x); at most `limit`. A predicted path
    without motion gets `limit`, a true path without motion gets 1. No gradient flows through it.

    Args:
        centres_gt, centres: (B,N,3) world frame, any unit.

    Returns:
        (B,) scale.
    """
    with torch.no_grad():
        gt = centres_gt - centres_gt.mean(dim=1, keepdim=True)
        est = centres - centres.mean(dim=1, keepdim=True)
        covariance = gt.transpose(1, 2) @ est / gt.shape[1]
        trace = torch.linalg.svdvals(covariance).sum(dim=-1)
        variance = gt.square().sum(dim=-1).mean(dim=1)
        scale = (variance / trace.clamp(min=torch.finfo(trace.dtype).tiny)).clamp(max=limit)
        return torch.where(variance > 0, scale, torch.ones_like(scale))


def pose_errors(cam_T_world: Tensor, cam_T_world_gt: Tensor) -> tuple[Tensor, Tensor]:
    """Errors of all relative poses of each clip after scaling the predicted translations.

    e_ij = log((P_i^-1 P_j) (Q_i^-1 Q_j)^-1) with P true and Q predicted camera-to-world poses, i != j.

    Args:
        cam_T_world, cam_T_world_gt: (B,N,7) world -> camera, `tx ty tz qx qy qz qw`.

    Returns:
        translation part and rotation part (radians) of e, norms, each (B, N*(N-1)).
    """
    from devo.lietorch import SE3

    world_T_cam = SE3(cam_T_world).inv()
    world_T_cam_gt = SE3(cam_T_world_gt).inv()
    centres, centres_gt = world_T_cam.data[..., :3], world_T_cam_gt.data[..., :3]
    world_T_cam = world_T_cam.scale(alignment_scale(centres_gt, centres)[:, None])
    frames = cam_T_world.shape[1]
    first, second = torch.meshgrid(torch.arange(frames), torch.arange(frames), indexing="ij")
    different = first != second
    first, second = first[different].to(cam_T_world.device), second[different].to(cam_T_world.device)
    relative_gt = world_T_cam_gt[:, first].inv() * world_T_cam_gt[:, second]
    relative = world_T_cam[:, first].inv() * world_T_cam[:, second]
    error = (relative_gt * relative.inv()).log()
    return error[..., :3].norm(dim=-1), error[..., 3:].norm(dim=-1)


def same_direction(cam_T_world: Tensor, cam_T_world_gt: Tensor) -> Tensor:
    """Clips (B,) bool whose predicted camera path does not run against the true one.

    Scenes with little relief have a second solution with depth and motion inverted. A clip that sits there cannot learn
    from its poses: small changes do not bring it back.
    """
    from devo.lietorch import SE3

    with torch.no_grad():
        paths = [SE3(poses).inv().data[..., :3] for poses in (cam_T_world, cam_T_world_gt)]
        est, gt = (path - path[:, :1] for path in paths)
        return (est * gt).sum(dim=(1, 2)) >= 0


def pose_loss(cam_T_world: Tensor, cam_T_world_gt: Tensor, used: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Mean translation error plus mean rotation error of all ordered frame pairs, see `pose_errors`.

    Args:
        cam_T_world, cam_T_world_gt: (B,N,7) world -> camera.
        used: (B,) bool, clips that count; default all.

    Returns:
        (sum, translation part, rotation part), scalars.
    """
    translation, rotation = pose_errors(cam_T_world, cam_T_world_gt)
    if used is not None:
        mask = used[:, None].expand_as(translation)
        translation, rotation = masked_mean(translation, mask), masked_mean(rotation, mask)
    return translation.mean() + rotation.mean(), translation.mean(), rotation.mean()


def score_loss(scores: Tensor, errors: Tensor, weights: Tensor, valid: Tensor, kk: Tensor) -> Tensor:
    """Teach the scorer which patches are tracked well; only `scores` receives a gradient.

    mean over valid edges of (1 - ln(mean weight) / 2) * score * error, plus mean of -ln(score) over all
    patches, which keeps the scores from collapsing to zero.

    Args:
        scores: (frames, M) in (0,1), patch-major order as in `kk`.
        errors: (1,E) flow error after bundle adjustment, quarter-resolution pixels.
        weights: (1,E,2) confidence in (0,1).
        valid: (1,E).
        kk: (E,) patch of each edge.
    """
    confidence = weights.detach().mean(dim=-1).clamp(min=1e-6)
    difficulty = (1.0 - 0.5 * confidence.log()) * errors.detach()
    flat = scores.reshape(-1)
    tracked = masked_mean(difficulty * flat[kk][None], valid)
    return tracked - flat.clamp(min=1e-6).log().mean()
