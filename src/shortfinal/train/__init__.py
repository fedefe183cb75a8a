"""Training: the only part of the package that imports torch (extra "train").

Import timm from here, not directly: `from shortfinal.train import timm`.
"""

from __future__ import annotations

from shortfinal.errors import InputError

try:
    import torch
except ModuleNotFoundError as error:
    raise InputError("training needs torch: pip install 'shortfinal[train]'") from error

# PyPI's torchvision is built against CUDA. Beside a CPU build of torch its compiled operators do not
# load, and its import, which timm's needs, fails where it registers shapes for two that do not exist
# ("operator torchvision::nms does not exist"). Declaring them is enough: nothing here calls them.
_declared = torch.library.Library("torchvision", "FRAGMENT")
for _name in ("nms", "qnms"):
    if not hasattr(torch.ops.torchvision, _name):
        _declared.define(f"{_name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

import timm  # noqa: E402

__all__ = ["timm"]
