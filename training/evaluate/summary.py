"""Summary of a finished run in a few measures."""

from __future__ import annotations

from typing import Any

import torch

from ..scenes.cameras import pick_evenly
from ..splats.levels import Bundle
from .metrics import fit_exposure, psnr
from .offset_views import count_oversized, measure_veil
from .views import MAX_TRAINING_VIEWS, Evaluation, full_detail_source


def summarize(evaluation: Evaluation, bundle: Bundle) -> dict:
    """Measure a bundle's finest level.

    Returns:
        ``train_psnr``: mean over at most ``MAX_TRAINING_VIEWS`` training views in dB.
        ``veil`` and ``oversized``: see ``evaluate.offset_views``.
        ``worst``: ``view`` and ``psnr`` of the worst held-out view, if views are held out.
        ``fitted_psnr``: mean over held-out views after fitting each image's exposure to its photo.
    """
    data = evaluation.data
    source = full_detail_source(bundle, bundle.levels[-1])
    train_psnr = evaluation.compare_views(pick_evenly(data.train, MAX_TRAINING_VIEWS), source)
    measures: dict[str, Any] = {
        "train_psnr": round(float(train_psnr.mean()), 3),
        "veil": measure_veil(evaluation, source),
        "oversized": count_oversized(data, source),
    }
    if data.test:
        quality, fitted = evaluation.compare_views(data.test, source, _psnr_and_fitted_psnr).T
        measures["fitted_psnr"] = round(float(fitted.mean()), 3)
        worst = int(quality.argmin())
        measures["worst"] = {"view": data.test[worst].name, "psnr": round(float(quality[worst]), 3)}
    return measures


def _psnr_and_fitted_psnr(
    image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None
) -> tuple[float, float]:
    """Return the PSNR of an image before and after fitting its exposure."""
    return psnr(image, target, mask), psnr(fit_exposure(image, target, mask), target, mask)
