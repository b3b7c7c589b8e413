"""What a finished run is worth, in the few numbers that people judge it by."""

from __future__ import annotations

from ..scenes.cameras import evenly
from ..splats.bundle import Bundle
from .aside import oversized, veil
from .views import MOST_TRAINING_VIEWS, Evaluation, shown_at


def summary(evaluation: Evaluation, bundle: Bundle) -> dict:
    """Measures of a bundle's finest level, as its cameras are shown it.

    Returns:
        ``train_psnr``: dB, mean over training views, ``MOST_TRAINING_VIEWS`` at most; ``veil`` and
        ``oversized``, see ``evaluate.aside``; where views are held out ``worst``, the ``view`` of the lowest
        ``psnr``.
    """
    data, shown = evaluation.data, shown_at(bundle, bundle.levels[-1])
    train = evaluation.psnrs(evenly(data.train, MOST_TRAINING_VIEWS), shown)
    found = {
        "train_psnr": round(float(train.mean()), 3),
        "veil": veil(evaluation, shown),
        "oversized": oversized(data, shown),
    }
    if data.test:
        quality = evaluation.psnrs(data.test, shown)
        worst = int(quality.argmin())
        found["worst"] = {"view": data.test[worst].name, "psnr": round(float(quality[worst]), 3)}
    return found
