"""What training minimises: the Gaussian negative log-likelihood, in forms to compare, and what helps it on its way."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional

from shortfinal.errors import InputError
from shortfinal.train.model import Prediction

Likelihood = Literal["half", "published", "beta", "robust"]

_BETA = 0.5  # Seitzer et al. 2022, arXiv 2203.09168
_TARGET_CELLS = 1.0  # standard deviation of the attention's target, in cells of its map


def gaussian_nll(
    error_px: Tensor,
    sigma_px: Tensor,
    factor: Tensor | None = None,
    visible: Tensor | None = None,
    likelihood: Likelihood = "half",
) -> Tensor:
    """The loss (B,) of errors (B, K, 2): the sum over the visible keypoints of each picture.

    "half", the negative log-likelihood, without its constant: e' S^-1 e / 2 + ln|S| / 2. "published"
    (arXiv 2508.09732, the loss as printed): ln|S| without its half; the best S is then half the
    errors' covariance, overconfident by the square root of two. "beta" (arXiv 2203.09168): each
    coordinate's "half" times its sigma^(2 * 0.5), not differentiated, so that what is uncertain
    still learns. "robust": "half" with Huber's function of a picture's e' S^-1 e, linear in its root beyond
    n + 2 sqrt(2 n) for n coordinates, so that S is that of the bulk of the errors and not of a few
    pictures that are far off; of normal errors the sigma is then 1 to 2 % too small. S: from `sigma_px`
    (B, K, 2) and the `factor` (B, 2K, 2K) of its correlation. Keypoints that are not `visible` (B, K)
    are marginalised out. Raises InputError for another likelihood, or "beta" with correlations.
    """
    if likelihood not in get_args(Likelihood):
        raise InputError(f"likelihood: {likelihood!r}; expected one of {', '.join(get_args(Likelihood))}")
    seen = (torch.ones_like(error_px[..., 0]) if visible is None else visible.to(error_px))[..., None]
    seen = seen.expand_as(error_px).flatten(1)
    scaled, log_variance = (error_px / sigma_px).flatten(1) * seen, 2 * sigma_px.log().flatten(1) * seen
    log_weight = 1.0 if likelihood == "published" else 0.5
    if factor is None and likelihood != "robust":
        each = 0.5 * scaled.square() + log_weight * log_variance
        if likelihood == "beta":
            each = each * sigma_px.detach().flatten(1) ** (2 * _BETA)
        return each.sum(dim=1)
    if likelihood == "beta":
        raise InputError("likelihood: beta weighs coordinates one by one; it needs a diagonal covariance")
    log_det = log_variance.sum(dim=1)
    white = scaled
    if factor is not None:
        rows = factor if visible is None else _of_the_seen(factor, seen)
        white = torch.linalg.solve_triangular(rows, scaled[..., None], upper=False)[..., 0]
        log_det = log_det + 2 * rows.diagonal(dim1=1, dim2=2).abs().log().sum(dim=1)
    squared = white.square().sum(dim=1)
    if likelihood == "robust":
        squared = _huber(squared, seen.sum(dim=1))
    return 0.5 * squared + log_weight * log_det


def _huber(squared: Tensor, count: Tensor) -> Tensor:
    """Huber's function of squared distances (B,) of `count` (B,) coordinates each."""
    bound = count + 2 * (2 * count).sqrt()
    beyond = 2 * (bound * squared.clamp_min(1e-12)).sqrt() - bound
    return torch.where(squared > bound, beyond, squared)


def _of_the_seen(factor: Tensor, seen: Tensor) -> Tensor:
    """A lower triangular factor (B, n, n) of the correlation in which what is not `seen` (B, n) is a unit normal apart.

    By QR of the factor's own rows: forming the correlation would square its condition number, and a
    Cholesky factorisation of it fail where coordinates are nearly the same.
    """
    rows = torch.cat([factor * seen[:, :, None], torch.diag_embed(1.0 - seen)], dim=2)
    upper: Tensor = torch.linalg.qr(rows.transpose(1, 2)).R
    return upper.transpose(1, 2)


def attention_loss(attention: Tensor, corners_px: Tensor, visible: Tensor, size: int) -> Tensor:
    """The loss (B,): cross-entropy of log-attention (B, K, H, W) and a Gaussian one cell wide at the truth.

    Attention is where the network looks for a keypoint; told so directly it learns in a fraction of
    the steps that the soft argmax alone, which only knows the mean, needs (cf. Nibali et al. 2018,
    arXiv 1801.07372, who regularise the same way).
    """
    height, width = attention.shape[-2:]
    target = (
        _bump(corners_px[..., 0], size, width)[..., None, :] * _bump(corners_px[..., 1], size, height)[..., :, None]
    )
    return -(target * attention).sum(dim=(2, 3)).mul(visible).sum(dim=1)


def _bump(place_px: Tensor, size: int, cells: int) -> Tensor:
    """Weights (B, K, cells) that sum to one, a Gaussian around each place (B, K)."""
    centre = (torch.arange(cells, device=place_px.device) + 0.5) * (size / cells) - 0.5
    offset = (place_px[..., None] - centre) / (_TARGET_CELLS * size / cells)
    return torch.softmax(-0.5 * offset.square(), dim=-1)


def where_loss(where: Tensor, box_px: Tensor, visible: Tensor, size: int) -> Tensor:
    """The loss (B,) of `Prediction.where` (B, 2, H, W): in which cell is the centre of a runway's box, how long is it?

    `box_px` (B, 4): left, top, right, bottom of the runway, also beyond the picture; NaN: none, or not known, if
    keypoints are `visible` (B, K) all the same: such pictures count nothing. The loss of centres is the focal one of
    Zhou et al. 2019 (arXiv 1904.07850, eq. 1), with a Gaussian of an eighth of the box around each; of lengths, the
    absolute error of the logarithm.
    """
    height, width = where.shape[-2:]
    cell = size / width
    centre, side = (box_px[:, :2] + box_px[:, 2:]) / 2 + 0.5, (box_px[:, 2:] - box_px[:, :2]).amax(dim=1)
    u, v = ((torch.arange(n, device=where.device) + 0.5) * cell for n in (width, height))
    across, down = u - centre[:, :1], v - centre[:, 1:]  # (B, W), (B, H)
    spread = (side / 8).clamp(cell / 2, 2 * cell)[:, None, None]
    near = torch.exp(-(across.square()[:, None, :] + down.square()[:, :, None]) / (2 * spread.square())).nan_to_num(0.0)
    here = (across.abs()[:, None, :] <= cell / 2) & (down.abs()[:, :, None] <= cell / 2)
    logit, length = where.unbind(dim=1)
    share = logit.sigmoid()
    found = functional.logsigmoid(logit) * (1 - share).square() * here
    spared = functional.logsigmoid(-logit) * share.square() * (1 - near) ** 4 * ~here
    off = (length - side.nan_to_num(1.0).log()[:, None, None]).abs() * here
    told = box_px.isfinite().all(dim=1) | ~visible.any(dim=1)
    return (0.3 * off - found - spared).sum(dim=(1, 2)) * told


def scope_loss(prediction: Prediction, visible: Tensor) -> Tensor:
    """The loss (B,): is each keypoint in the picture, and is a runway?"""
    present = visible.any(dim=1).to(prediction.present)
    each = functional.binary_cross_entropy_with_logits(
        prediction.visible, visible.to(prediction.visible), reduction="none"
    )
    whole = functional.binary_cross_entropy_with_logits(prediction.present, present, reduction="none")
    return each.mean(dim=1) + whole
