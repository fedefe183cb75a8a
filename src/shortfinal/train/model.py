"""The network: backbone, keypoint head, predicted covariance; after Valentin et al. 2025 (arXiv 2508.09732).

Where this departs from the paper: docs/paper.md. What was tried: docs/log.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from shortfinal.errors import InputError
from shortfinal.train import timm

Head = Literal["sam", "fc"]
Covariance = Literal["diagonal", "keypoint", "full"]

MIN_SIGMA_PX = 0.03  # keeps the likelihood finite on a picture seen too often
_FIRST_LOG_VARIANCE = 6.0  # a sigma of 20 px: an untrained network knows nothing
_DIM = 0.1  # of RGB as normalised: what less contrast is taken as
_HIDDEN = 64  # of the layers that turn pooled features into sigmas, correlations and logits


class Prediction(NamedTuple):
    """What the network says of B pictures and K keypoints, in pixels of its input."""

    mean_px: Tensor  # (B, K, 2)
    sigma_px: Tensor  # (B, K, 2)
    factor: Tensor | None  # (B, 2K, 2K) lower, of the correlation; None: the identity
    visible: Tensor  # (B, K) logits: this keypoint is in the picture
    present: Tensor  # (B,) logits: a runway is in the picture
    attention: Tensor | None  # (B, K, H, W) logarithm of where each keypoint is looked for; None: the head has none
    # (B, 2, H, W): logit that the centre of a runway's box is in the cell, and the logarithm of the box's longer side
    where: Tensor | None = None

    @property
    def cov_px(self) -> Tensor:
        """Covariances (B, 2K, 2K)."""
        sigma = self.sigma_px.flatten(1)
        if self.factor is None:
            return torch.diag_embed(sigma.square())
        root = sigma[:, :, None] * self.factor
        return root @ root.transpose(1, 2)


class KeypointNet(nn.Module):
    """Pictures (B, 3, S, S) to a `Prediction`.

    `backbone`: any timm model with `features_only`, convolutional or transformer. `head`: "sam", the
    paper's 1x1 convolution and spatial soft argmax, or "fc", its baseline: pool, hidden layer,
    coordinates. `features`: strides of the feature maps; one, (32,) as published, is used as it is,
    several are fused from deep to shallow with `width` channels, so that the deep ones say which
    corner and the shallow ones say where. `covariance`: sigmas only, or also how the two coordinates
    of a keypoint correlate, or how all 2K do (by the Cholesky factor of the correlation matrix).
    `where`: also say where in the picture runways are, however small, for the search in whole frames;
    it looks at the fused map. `corners`: also look at patches (B, 4, 3, P, P) of one corner each (`Corners`).

    Raises InputError for a backbone timm does not have, or without such feature maps, and for `where` without
    a fused map.
    """

    linked: Tensor

    def __init__(
        self,
        backbone: str = "mobilenetv4_conv_small",
        keypoints: int = 4,
        head: Head = "sam",
        covariance: Covariance = "diagonal",
        features: Sequence[int] = (4, 8, 16, 32),
        width: int = 48,
        pretrained: bool = False,
        where: bool = False,
        corners: bool = False,
    ) -> None:
        super().__init__()
        for name, value, known in (("head", head, Head), ("covariance", covariance, Covariance)):
            if value not in get_args(known):
                raise InputError(f"{name}: {value!r}; expected one of {', '.join(get_args(known))}")
        self.keypoints, self.head, self.covariance = keypoints, head, covariance
        self.backbone, channels = _backbone(backbone, features, pretrained)
        self.neck = Neck(channels, width) if len(channels) > 1 else nn.Identity()
        inner, deep = (width if len(channels) > 1 else channels[0]), channels[-1]
        self.score = nn.Conv2d(inner, keypoints, 1) if head == "sam" else None
        self.fc = None if head == "sam" else _layers(deep, 256, 2 * keypoints)
        # Of each keypoint: the features where it is looked for, those of the whole picture, and how
        # widely it is looked for.
        told = deep + (inner + 2 if head == "sam" else 0)
        self.spread = nn.ModuleList([_layers(told, _HIDDEN, 3) for _ in range(keypoints)])  # two variances, visible
        for layers in self.spread:
            nn.init.constant_(layers[-1].bias[:2], _FIRST_LOG_VARIANCE)  # type: ignore[index]
        self.present = _layers(deep, _HIDDEN, 1)
        linked = _linked(keypoints, covariance)
        self.register_buffer("linked", torch.eye(linked.numel())[linked.flatten()], persistent=False)  # (links, 4K²)
        if where and (head != "sam" or len(channels) == 1):
            raise InputError("where: looks at the fused map; it needs the head sam and several features")
        self.where = Where(width) if where else None
        self.corners = Corners(covariance) if corners else None
        self.correlation = _layers(told * keypoints, _HIDDEN, int(linked.sum())) if linked.any() else None

    def forward(self, image: Tensor) -> Prediction:
        """See the class."""
        if image.dim() == 5:
            assert self.corners is not None
            told: Prediction = self.corners(image)
            return told
        maps = self.backbone(image)
        fused = None if self.score is None else self.neck(maps if len(maps) > 1 else maps[0])
        with _single_precision(image.device.type):
            return self._answer(maps[-1].float(), None if fused is None else fused.float(), image.shape[-1])

    def _answer(self, deepest: Tensor, fused: Tensor | None, size: int) -> Prediction:
        whole = deepest.mean(dim=(2, 3))
        everywhere = whole[:, None].expand(-1, self.keypoints, -1)
        if self.score is not None and fused is not None:
            attention = functional.log_softmax(self.score(fused).flatten(2), dim=-1)  # (B, K, H W)
            weight = attention.exp()
            mean, variance = soft_argmax(weight, *fused.shape[-2:])
            local = weight @ fused.flatten(2).transpose(1, 2)  # (B, K, C)
            told = torch.cat([local, everywhere, variance.clamp_min(1e-6).log()], dim=-1)
            looked = attention.unflatten(2, fused.shape[-2:])
        else:
            assert self.fc is not None
            mean = self.fc(whole).unflatten(1, (self.keypoints, 2)) + 0.5
            told, looked = everywhere, None
        # Not all in one product: where there is no picture, ONNX Runtime dies of it.
        spread = torch.stack([layers(told[:, k]) for k, layers in enumerate(self.spread)], dim=1)
        sigma = (spread[..., :2].exp() + MIN_SIGMA_PX**2).sqrt()
        where = None if self.where is None or fused is None else self.where(fused)
        return Prediction(
            mean * size - 0.5,
            sigma,
            _factor(self.correlation, self.linked, told),
            spread[..., 2],
            self.present(whole)[:, 0],
            looked,
            where,
        )

    @property
    def means(self) -> list[nn.Module]:
        """The parts that the means come from; the others say how sure they are, and whether there is a runway."""
        return [part for part in (self.backbone, self.neck, self.score, self.fc) if part is not None]


class Corners(nn.Module):
    """Patches (B, 4, 3, P, P), one for each corner in its own frame (`crops.corner_patches`), to a `Prediction` in
    pixels of those patches.

    All corners look alike there, so that one small network knows them all. Together they give the covariance.
    `visible`: the corner is in its patch; `present`: the likeliest of them.
    """

    linked: Tensor

    def __init__(self, covariance: Covariance, width: int = 32) -> None:
        super().__init__()
        deep = 2 * width
        self.shallow = nn.Sequential(_convolution(3, width // 2), _convolution(width // 2, width, 4, 2))
        self.end = nn.Parameter(torch.randn(1, 2, 1, deep, 1, 1))  # of the near end's two, of the far one's
        self.down = _convolution(width, deep, 4, 2)
        self.deep = nn.ModuleList([
            nn.Sequential(_convolution(deep, deep), nn.Conv2d(deep, deep, 3, padding=1, bias=False),
                          nn.BatchNorm2d(deep))
            for _ in range(3)
        ])  # fmt: skip
        # What the other corners of the same end and of the same edge show there: they share a line, and the first
        # look's error across it. Nothing at first.
        self.shared = nn.Conv2d(2 * deep, deep, 1, bias=False)
        nn.init.zeros_(self.shared.weight)
        self.lateral, self.skip = nn.Conv2d(deep, width, 1), _convolution(width, width)
        self.fused = nn.Sequential(_convolution(width, width), _convolution(width, width))
        self.score = nn.Conv2d(width, 1, 1)
        told = width + deep + 2  # the features where the corner is looked for, of the whole patch, how widely it is
        self.spread = _layers(told, _HIDDEN, 3)
        nn.init.constant_(self.spread[-1].bias[:2], _FIRST_LOG_VARIANCE / 2)  # type: ignore[index]
        linked = _linked(4, covariance)
        self.register_buffer("linked", torch.eye(linked.numel())[linked.flatten()], persistent=False)
        self.correlation = _layers(4 * told, _HIDDEN, int(linked.sum())) if linked.any() else None

    def forward(self, patches: Tensor) -> Prediction:
        """See the class."""
        size = patches.shape[-1]
        image = patches.flatten(0, 1)
        # A dark or a hazy corner is a corner: each patch by its own contrast.
        level = image.mean(dim=(1, 2, 3), keepdim=True)
        contrast = (image - level).square().mean(dim=(1, 2, 3), keepdim=True).add(_DIM**2).sqrt()
        shallow = self.shallow(((image - level) / contrast).contiguous(memory_format=torch.channels_last))
        deep = (self.down(shallow).unflatten(0, (-1, 2, 2)) + self.end).flatten(0, 2)
        for number, layers in enumerate(self.deep):
            if number == len(self.deep) - 1:
                deep = deep + self.shared(_others(deep))
            deep = functional.relu(deep + layers(deep))
        up = functional.interpolate(self.lateral(deep), scale_factor=2.0, mode="bilinear", align_corners=False)
        fused = self.fused(self.skip(shallow) + up)
        with _single_precision(image.device.type):
            return self._answer(deep.float(), fused.float(), size)

    def _answer(self, deep: Tensor, fused: Tensor, size: int) -> Prediction:
        attention = functional.log_softmax(self.score(fused).flatten(2), dim=-1)  # (4B, 1, H W)
        weight = attention.exp()
        mean, variance = soft_argmax(weight, *fused.shape[-2:])
        local = weight @ fused.flatten(2).transpose(1, 2)
        told = torch.cat([local[:, 0], deep.mean(dim=(2, 3)), variance[:, 0].clamp_min(1e-6).log()], dim=-1)
        spread = self.spread(told).unflatten(0, (-1, 4))
        factor = _factor(self.correlation, self.linked, told.unflatten(0, (-1, 4)))
        visible = spread[..., 2]
        return Prediction(
            mean.unflatten(0, (-1, 4))[:, :, 0] * size - 0.5, (spread[..., :2].exp() + MIN_SIGMA_PX**2).sqrt(), factor,
            visible, visible.amax(dim=1), attention.unflatten(2, fused.shape[-2:]).unflatten(0, (-1, 4))[:, :, 0],
        )  # fmt: skip


def _others(maps: Tensor) -> Tensor:
    """Beside each corner's map (4B, C, H, W), those of the other corner of its end and of its edge (4B, 2C, H, W)."""
    four = maps.unflatten(0, (-1, 4))
    end, edge = four[:, [1, 0, 3, 2]], four[:, [3, 2, 1, 0]]
    return torch.cat([end, edge], dim=2).flatten(0, 1)


def _factor(correlation: nn.Module | None, linked: Tensor, told: Tensor) -> Tensor | None:
    """The correlation's Cholesky factor (B, n, n): a unit lower triangle, its rows scaled to length one; `linked` (n²
    wide) are the entries that the layers fill from what is `told` of each keypoint (B, K, C).
    """
    if correlation is None:
        return None
    below = correlation(told.flatten(1)) @ linked
    n = math.isqrt(below.shape[1])
    lower = below.unflatten(1, (n, n)) + torch.eye(n, device=below.device)
    factor: Tensor = lower / lower.norm(dim=2, keepdim=True)
    return factor


def _convolution(inner: int, outer: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inner, outer, kernel, stride, (kernel - 1) // 2, bias=False), nn.BatchNorm2d(outer),
        nn.ReLU(inplace=True),
    )  # fmt: skip


class Neck(nn.Module):
    """Feature maps (shallow to deep) to one of the shallowest's size, `width` channels: from deep to
    shallow, each is added to what came from below and smoothed.
    """

    def __init__(self, channels: Sequence[int], width: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList([nn.Conv2d(c, width, 1, bias=False) for c in channels])
        self.smooth = nn.ModuleList([
            nn.Sequential(
                nn.BatchNorm2d(width), nn.Hardswish(),
                nn.Conv2d(width, width, 3, padding=1, groups=width, bias=False), nn.BatchNorm2d(width),
                nn.Conv2d(width, width, 1, bias=False), nn.BatchNorm2d(width), nn.Hardswish(),
            )
            for _ in channels
        ])  # fmt: skip

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """The fused map (B, width, H, W)."""
        fused: Tensor | None = None
        for lateral, smooth, feature in zip(
            reversed(list(self.lateral)), reversed(list(self.smooth)), reversed(maps), strict=True
        ):
            here = lateral(feature)
            if fused is not None:
                here = here + functional.interpolate(fused, size=here.shape[-2:], mode="bilinear", align_corners=False)
            fused = smooth(here)
        assert fused is not None
        return fused


class Where(nn.Module):
    """The fused map (B, C, H, W) to `Prediction.where` (B, 2, H/2, W/2)."""

    def __init__(self, width: int, hidden: int = 64) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(2 * width, hidden, 1), nn.Hardswish()]
        for _ in range(2):  # to see more than a runway's own size around it
            layers += [
                nn.Conv2d(hidden, hidden, 5, padding=2, groups=hidden), nn.Conv2d(hidden, hidden, 1), nn.Hardswish()
            ]  # fmt: skip
        last = nn.Conv2d(hidden, 2, 1)
        nn.init.constant_(last.bias[:1], -4.0)  # type: ignore[index]  # most cells hold none
        self.layers = nn.Sequential(*layers, last)

    def forward(self, fused: Tensor) -> Tensor:
        """See the class."""
        # The mean forgets what is two pixels wide, the maximum how much of it there is.
        told: Tensor = self.layers(torch.cat([functional.max_pool2d(fused, 2), functional.avg_pool2d(fused, 2)], dim=1))
        return told


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


def _backbone(name: str, features: Sequence[int], pretrained: bool) -> tuple[nn.Module, list[int]]:
    """timm's model giving the last map of each stride, and the maps' channels; shallow to deep."""
    wanted = sorted(set(features))
    try:
        probe: Any = timm.create_model(name, features_only=True, pretrained=False)
    except (RuntimeError, AttributeError) as error:  # timm's: no such model, or one without feature maps
        raise InputError(f"backbone: {name!r}: {str(error).strip().splitlines()[0]}") from error
    every: list[int] = probe.feature_info.reduction()
    if not wanted or not set(wanted) <= set(every):
        raise InputError(
            f"features: {name!r} has the strides {', '.join(map(str, sorted(set(every))))}; "
            f"{', '.join(map(str, wanted)) or 'at least one'} wanted"
        )
    taken = [len(every) - 1 - every[::-1].index(stride) for stride in wanted]
    model: Any = timm.create_model(name, features_only=True, pretrained=pretrained, out_indices=taken)
    return model, model.feature_info.channels()


def _single_precision(device: str) -> AbstractContextManager[Any]:
    """Where mixed precision ends: bfloat16's 8 bits would round a mean to half a pixel at 64, to one at 128."""
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()


def _layers(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.Hardswish(), nn.Linear(hidden, outputs))


def _linked(keypoints: int, covariance: Covariance) -> Tensor:
    """Which entries below the diagonal of the (2K, 2K) correlation factor are predicted."""
    below = torch.ones(2 * keypoints, 2 * keypoints).tril(-1).bool()
    if covariance == "full":
        return below
    if covariance == "diagonal":
        return torch.zeros_like(below)
    same: Tensor = torch.block_diag(*[torch.ones(2, 2)] * keypoints).bool()
    return below & same
