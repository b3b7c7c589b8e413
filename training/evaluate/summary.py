"""What a finished run is worth, in the few numbers that people judge it by."""

from __future__ import annotations

import torch

from ..scenes.cameras import pick_evenly
from ..splats.levels import Bundle
from .metrics import fit_exposure, psnr
from .offset_views import count_oversized, measure_veil
from .views import MAX_TRAINING_VIEWS, Evaluation, full_detail_selector


def summarize(evaluation: Evaluation, bundle: Bundle) -> dict:
    """Measures of a bundle's finest level, as its cameras are shown it.

    Returns:
        ``train_psnr``: dB, mean over training views, ``MOST_TRAINING_VIEWS`` at most; ``veil`` and
        ``oversized``, see ``evaluate.offset_views``; where views are held out ``worst``, the ``view`` of the lowest
        ``psnr``, and ``fitted_psnr``, the mean over them where each picture has its photograph's exposure.
    """
    data, shown = evaluation.data, full_detail_selector(bundle, bundle.levels[-1])
    train = evaluation.compare_views(pick_evenly(data.train, MAX_TRAINING_VIEWS), shown)
    found = {
        "train_psnr": round(float(train.mean()), 3),
        "veil": measure_veil(evaluation, shown),
        "oversized": count_oversized(data, shown),
    }
    if data.test:
        quality, fitted = evaluation.compare_views(data.test, shown, _as_it_is_and_exposed).T
        found["fitted_psnr"] = round(float(fitted.mean()), 3)
        worst = int(quality.argmin())
        found["worst"] = {"view": data.test[worst].name, "psnr": round(float(quality[worst]), 3)}
    return found


def _as_it_is_and_exposed(
    image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None
) -> tuple[float, float]:
    """The PSNR of a picture, and of the same with its photograph's exposure."""
    return psnr(image, target, mask), psnr(fit_exposure(image, target, mask), target, mask)
