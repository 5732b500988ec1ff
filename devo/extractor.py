"""Residual convolutional encoder: voxel grids or images to feature maps at quarter resolution."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from devo.errors import InputError


def channels_last_frames(images: Tensor) -> Tensor:
    """Copy clips `(B, n, C, H, W)` to frames `(B*n, C, H, W)` that are channels last in memory."""
    # clone, not contiguous(): views of single frames pass for channels last while the convolutions do not see it
    return images.flatten(0, 1).clone(memory_format=torch.channels_last)


class FrameNorm(nn.InstanceNorm2d):
    """Instance normalisation (no parameters) that keeps the channels-last layout of its input.

    On CPUs the framework's kernel rearranges channels-last maps first, which costs more than the convolution before it;
    batch statistics of a single frame are the same thing and need no rearrangement. On GPUs one call per frame would
    cost more.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Map `(N, C, H, W)` to the same shape with zero mean and unit (biased) variance per frame and channel."""
        if x.is_cuda or x.is_contiguous() or not x.is_contiguous(memory_format=torch.channels_last):
            return super().forward(x)
        frames = [functional.batch_norm(frame, None, None, training=True, eps=self.eps) for frame in x.split(1)]
        return frames[0] if len(frames) == 1 else torch.cat(frames)


def _normaliser(kind: str, channels: int) -> nn.Module:
    if kind == "instance":
        return FrameNorm(channels)
    if kind == "none":
        return nn.Sequential()
    raise InputError(f"unknown encoder norm {kind!r}; expected 'instance' or 'none'")


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a skip connection; ReLU is applied before and after the addition."""

    def __init__(self, in_planes: int, planes: int, norm_fn: str, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_planes, planes, kernel_size=3, padding=1, stride=stride)
        self.conv2 = nn.Conv2d(planes, planes, kernel_size=3, padding=1)
        self.norm1 = _normaliser(norm_fn, planes)
        self.norm2 = _normaliser(norm_fn, planes)
        self.downsample: nn.Sequential | None = None
        if stride != 1:
            self.downsample = nn.Sequential(
                nn.Conv2d(in_planes, planes, kernel_size=1, stride=stride), _normaliser(norm_fn, planes)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map `(N, in_planes, H, W)` to `(N, planes, ceil(H/stride), ceil(W/stride))`."""
        y = functional.relu(self.norm1(self.conv1(x)), inplace=True)
        y = functional.relu(self.norm2(self.conv2(y)), inplace=True)
        if self.downsample is not None:
            x = self.downsample(x)
        return functional.relu(x + y, inplace=True)


class BasicEncoder4(nn.Module):
    """Encoder with stride 4; feature pixel k is centred on full-resolution pixel 4k.

    It works on the channels-last layout, which is the fastest for these convolutions in float32 and bfloat16 alike, and
    follows `torch.autocast`.

    Args:
        channels: input channels, 5 voxel bins or 3 colours.
        output_dim: channels of the feature map.
        dim: width of the first stage (the second has twice as many channels).
        norm_fn: `instance` (no parameters) or `none`.
    """

    def __init__(self, channels: int = 5, output_dim: int = 128, dim: int = 32, norm_fn: str = "instance") -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, dim, kernel_size=7, stride=2, padding=3)
        self.norm1 = _normaliser(norm_fn, dim)
        self.layer1 = nn.Sequential(ResidualBlock(dim, dim, norm_fn), ResidualBlock(dim, dim, norm_fn))
        self.layer2 = nn.Sequential(
            ResidualBlock(dim, 2 * dim, norm_fn, stride=2), ResidualBlock(2 * dim, 2 * dim, norm_fn)
        )
        self.conv2 = nn.Conv2d(2 * dim, output_dim, kernel_size=1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images: Tensor) -> Tensor:
        """Map `(B, n, channels, H, W)` to `(B, n, output_dim, ceil(H/4), ceil(W/4))`."""
        return self.encode(channels_last_frames(images)).unflatten(0, images.shape[:2])

    def encode(self, frames: Tensor) -> Tensor:
        """Map frames `(N, channels, H, W)`, channels last in memory, to `(N, output_dim, ceil(H/4), ceil(W/4))`."""
        return self.conv2(self.trunk(frames))

    def trunk(self, frames: Tensor) -> Tensor:
        """Everything but the last, pointwise convolution: `(N, 2*dim, ceil(H/4), ceil(W/4))`."""
        x = functional.relu(self.norm1(self.conv1(frames)), inplace=True)
        return self.layer2(self.layer1(x))
