"""The network: backbone, one 1x1 convolution, spatial soft argmax; and its Gaussian likelihood.

Valentin et al. 2025 (arXiv 2508.09732). Where this departs from it: docs/paper.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from shortfinal.errors import InputError
from shortfinal.train import timm

MIN_SIGMA_PX = 0.03  # keeps the likelihood finite on a picture seen too often


class KeypointNet(nn.Module):
    """Images (B, 3, S, S) to means (B, K, 2) in [0, 1] and log-variances (B, K, 2) in px² of the input.

    Features of several strides are brought to the finest by bilinear interpolation and summed, so
    that the deep ones say which corner and the shallow ones say where.
    """

    def __init__(
        self,
        backbone: str = "mobilenetv3_small_100",
        keypoints: int = 4,
        width: int = 96,
        strides: Sequence[int] = (8, 16, 32),
        pretrained: bool = False,
    ) -> None:
        super().__init__()
        try:
            probe: Any = timm.create_model(backbone, features_only=True, pretrained=False)
        except (RuntimeError, AttributeError) as error:  # timm's: no such model, or one without feature maps
            raise InputError(f"backbone: {backbone!r}: {str(error).strip().splitlines()[0]}") from error
        every: list[int] = probe.feature_info.reduction()
        if not set(strides) <= set(every):
            raise InputError(
                f"backbone: {backbone!r} has the strides {', '.join(map(str, sorted(set(every))))}; "
                f"{', '.join(map(str, strides))} are needed"
            )
        taken = [len(every) - 1 - every[::-1].index(stride) for stride in strides]
        features: Any = timm.create_model(backbone, features_only=True, pretrained=pretrained, out_indices=taken)
        self.backbone = features
        channels: list[int] = features.feature_info.channels()
        self.lateral = nn.ModuleList([nn.Conv2d(c, width, 1, bias=False) for c in channels])
        self.fuse = nn.Sequential(
            nn.BatchNorm2d(width), nn.Hardswish(),
            nn.Conv2d(width, width, 3, padding=1, groups=width, bias=False), nn.BatchNorm2d(width), nn.Hardswish(),
            nn.Conv2d(width, width, 1, bias=False), nn.BatchNorm2d(width), nn.Hardswish(),
        )  # fmt: skip
        self.score = nn.Conv2d(width, keypoints, 1)
        self.log_variance = nn.ModuleList([nn.Linear(2 * width + 2, 2) for _ in range(keypoints)])

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Means in [0, 1] and log-variances in px²."""
        maps = self.backbone(image)
        size = maps[0].shape[-2:]
        fused = self.lateral[0](maps[0])
        for layer, feature in zip(list(self.lateral)[1:], maps[1:], strict=True):
            fused = fused + functional.interpolate(layer(feature), size=size, mode="bilinear", align_corners=False)
        fused = self.fuse(fused)
        attention = self.score(fused).flatten(2).softmax(dim=-1)  # (B, K, H W)
        mean, spread = soft_argmax(attention, size[0], size[1])
        return mean, self._variances(fused.flatten(2), attention, spread)

    def _variances(self, fused: Tensor, attention: Tensor, spread: Tensor) -> Tensor:
        """Pool, linear (the exponential follows in the loss): pooled over the image and, for each
        keypoint, where its attention lies, with the attention's own spread.
        """
        local = attention @ fused.transpose(1, 2)  # (B, K, C)
        everywhere = fused.mean(dim=-1, keepdim=True).transpose(1, 2).expand_as(local)
        pooled = torch.cat([local, everywhere, spread.clamp_min(1e-6).log()], dim=-1)
        return torch.stack([layer(pooled[:, k]) for k, layer in enumerate(self.log_variance)], dim=1)


def soft_argmax(attention: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Mean and variance (B, K, 2), as (x, y) in units of the image's side, of attention (B, K, H W).

    A cell stands for its centre, (i + 1/2) / W: the paper's equations for the soft argmax, with the
    pixel centre of docs/architecture.md.
    """
    x = (torch.arange(width, device=attention.device, dtype=attention.dtype) + 0.5) / width
    y = (torch.arange(height, device=attention.device, dtype=attention.dtype) + 0.5) / height
    grid = torch.stack([x.repeat(height), y.repeat_interleave(width)], dim=-1)  # (H W, 2)
    mean = attention @ grid
    return mean, attention @ grid.square() - mean.square()


def to_pixels(mean: Tensor, size: int) -> Tensor:
    """Means in [0, 1] to pixels of a square image of side `size`: the left edge is at -1/2."""
    return mean * size - 0.5


def variance_px(log_variance: Tensor) -> Tensor:
    """px², bounded away from zero."""
    return log_variance.exp() + MIN_SIGMA_PX**2


def gaussian_nll(error_px: Tensor, log_variance: Tensor) -> Tensor:
    """Mean over coordinates of e²/(2 s²) + ln(s²)/2.

    With the half on both terms; as printed in the paper (none on the logarithm) the optimum is
    s² = e²/2, which is overconfident by the square root of two.
    """
    variance = variance_px(log_variance)
    return 0.5 * (error_px.square() / variance + variance.log()).mean()
