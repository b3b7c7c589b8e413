"""CLoD-GS's rule (arXiv 2510.09997, Sec. 3.2): opacity decays with distance, splat by splat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...splats.levels import MAX_LEVELS, Bundle, Level
from ...splats.portable_levels import DISTANCE, DISTANCE_RULE
from ..rule import (
    MIN_SPLATS,
    NO_TABLES,
    OPACITY,
    THINNING,
    Control,
    Rule,
    Values,
    collect_facts,
    distances,
)

SIGMA = "sigma_d"
"""Column of each splat's decay rate, the paper's σ_d."""
EPSILON = 1e-8
"""The paper's ε."""
LIMIT_MARGIN = 1e-5
"""Relative margin on the virtual scale of a budget, so that rounding does not exceed the budget."""
MIN_TAU = 1e-9
"""Smallest threshold; that of a damaged file may be 0."""
NEWTON_STEPS = 6
"""Newton steps of :func:`max_visible_scale`; each doubles the number of correct digits."""


def attenuation(normalized, sigma, s_v: float):
    """Return the opacity factor exp(−(d′ s_v)² / (2 ReLU(σ_d)² + ε)), (N,) (Eq. 2).

    Args:
        normalized: (N,) d′, distances divided by the reference distance, numpy or torch.
        sigma: (N,) σ_d.
        s_v: virtual distance scale.
    """
    exponent = -((normalized * s_v) ** 2) / (2 * sigma.clip(0) ** 2 + EPSILON)
    return exponent.exp() if hasattr(exponent, "exp") else np.exp(exponent)


def max_visible_scale(
    normalized: np.ndarray, sigma: np.ndarray, opacity: np.ndarray, tau: float
) -> np.ndarray:
    """Return the virtual scale (N,) where each splat's attenuated opacity equals the threshold τ s_v.

    α exp(−a s² / 2) = τ s with a = 2 d′² / (2 ReLU(σ_d)² + ε) has the solution s = (α / τ) exp(−W / 2),
    W exp(W) = a (α / τ)². Lambert's W is computed by Newton's method on ln W + W.
    """
    ratio = opacity / np.float32(tau)
    product = 2 * normalized**2 / (2 * sigma.clip(0) ** 2 + np.float32(EPSILON)) * ratio**2
    product = product.clip(np.float32(1e-12), np.float32(1e30))
    w = np.log1p(product)
    for _ in range(NEWTON_STEPS):
        w = w / (1 + w) * (1 + np.log(product / w))
    return ratio * np.exp(-w / 2)


class Decay(Rule):
    """The attenuation where α·attenuation > τ s_v, else 0 (Sec. 3.2).

    The rule needs no levels: of several complete levels, only the finest is drawn.

    d′ is the distance divided by ``reference``, or if that is 0 by the distance of the farthest splat (in the
    paper: of the splats in view). ``at_most`` raises the virtual scale above ``s_v`` until no more splats
    than that remain.
    """

    name = "decay"
    scene_facts = ("reference", "tau")
    lengths = ("reference",)  # σ_d is relative to it
    columns = (SIGMA, OPACITY)
    controls = (
        Control(
            "s_v", 1.0, 1.0, 100.0, "Distance Scale",
            "Factor on camera distances (CLoD-GS: s_v). Larger shows fewer splats", soft=(1.0, 10.0),
        ),
        Control(
            "at_most", 0, 0, 2**30, "Splat Limit",
            "Maximum number of splats. Raises the distance scale as needed. 0 disables",
            integer=True, step=1000,
        ),
    )  # fmt: skip
    independent = False
    sweep = ("s_v", (1.0, 1.5, 2.0, 3.0, 5.0))

    def normalized(self, means: np.ndarray, position: np.ndarray, facts: Mapping[str, float]) -> np.ndarray:
        """Return d′ (N,) of splats at means (N, 3)."""
        distance = distances(means, position)
        reference = facts["reference"] or float(distance.max(initial=0))
        return distance / np.float32(max(reference, 1e-20))

    def virtual_scale(
        self, normalized, columns: Mapping[str, np.ndarray], tau: float, values: Values
    ) -> float:
        """Return ``s_v``, raised as far as the budget requires."""
        s_v, at_most = values["s_v"], int(values["at_most"])
        if not 0 < at_most < len(normalized):
            return s_v
        limits = max_visible_scale(normalized, columns[SIGMA], columns[OPACITY], tau)
        first_excluded = np.partition(limits, len(limits) - at_most - 1)[len(limits) - at_most - 1]
        return max(s_v, float(first_excluded) * (1 + LIMIT_MARGIN))

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        if facts["level"] < facts["levels"]:
            return np.zeros(len(means), np.float32)
        tau = max(facts["tau"], MIN_TAU)
        normalized = self.normalized(means, position, facts)
        s_v = self.virtual_scale(normalized, columns, tau, values)
        weight = attenuation(normalized, columns[SIGMA], s_v).astype(np.float32)
        return np.where(columns[OPACITY] * weight > tau * s_v, weight, np.float32(0))

    def nested_levels(self, bundle: Bundle) -> Bundle:
        """Return the splats with the longest reach as levels of the rule ``chunks``.

        Each coarser level has 1 / THINNING of the finer one's splats, down to MIN_SPLATS, with the opacities
        at the distance from which on no other splats are visible.
        """
        rows = bundle.levels[-1].rows
        splats = rows.select(slice(0, len(rows)))
        facts = collect_facts(self, bundle.facts, [(1, {})], 1)
        s_v = self.resolve_controls({}, [1], bundle.controls)["s_v"]
        sigma = splats.extras.get(SIGMA, np.zeros(len(splats), np.float32))
        opacity = splats.opacities
        reference = facts["reference"] or float(
            distances(splats.means, np.median(splats.means, axis=0)).max(initial=1e-20)
        )
        # α·attenuation = τ s_v, solved for the normalised distance d′
        logarithm = np.log(np.maximum(opacity / (max(facts["tau"], MIN_TAU) * s_v), 1))
        reach = np.sqrt((2 * sigma.clip(0) ** 2 + EPSILON) * logarithm) / s_v
        order = np.argsort(-reach, kind="stable")
        splats.extras = {name: x for name, x in splats.extras.items() if name != SIGMA}
        levels, count = [splats], len(splats) // THINNING
        places = [0.0]
        while count >= MIN_SPLATS and len(levels) < MAX_LEVELS:
            part, distance = np.sort(order[:count]), float(reach[order[count]])
            alphas = opacity[part] * attenuation(np.float32(distance), sigma[part], s_v)
            alphas = alphas.astype(np.float64).clip(1e-7, 1 - 1e-7)
            logits = np.log(alphas / (1 - alphas)).astype(np.float32)
            levels.append(replace(splats.select(part), opacity_logits=logits))
            places.append(max(distance * reference, places[-1]))
            count //= THINNING
        coarse_to_fine = list(enumerate(zip(reversed(levels), reversed(places), strict=True), 1))
        return replace(
            bundle,
            levels=[Level(n, part, {DISTANCE: place}) for n, (part, place) in coarse_to_fine],
            rule=DISTANCE_RULE, facts={}, controls={},
        )  # fmt: skip

    def full_detail_values(self, levels: Sequence[int], recorded: Values | None = None) -> Values | None:
        return self.resolve_controls({}, levels, recorded)

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        return self.raise_control(values, "s_v")


RULE = Decay()
