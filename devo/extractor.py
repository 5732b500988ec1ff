"""Residual convolutional encoder: voxel grids or images to feature maps at quarter resolution."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from devo.errors import InputError


def _normaliser(kind: str, channels: int) -> nn.Module:
    if kind == "instance":
        return nn.InstanceNorm2d(channels)
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
        batch, frames = images.shape[:2]
        x = images.flatten(0, 1)
        x = functional.relu(self.norm1(self.conv1(x)), inplace=True)
        x = self.conv2(self.layer2(self.layer1(x)))
        return x.unflatten(0, (batch, frames))
