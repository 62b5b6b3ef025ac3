"""A figure over many scenes and how sure it is: 95% percentile bootstrap intervals over scenes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

RESAMPLES = 1000


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95% bootstrap interval over scenes; extremes (deepest, closest) have none."""

    value: float
    low: float | None
    high: float | None
    unit: str

    def __str__(self) -> str:
        scale, unit = (100, "%") if self.unit == "share" else (1, self.unit)
        if self.low is None or self.high is None:
            return f"{self.value * scale:.3g} {unit}".strip()
        return f"{self.value * scale:.3g} [{self.low * scale:.3g}, {self.high * scale:.3g}] {unit}".strip()


class Bootstrap:
    """Percentile bootstrap over scenes, the same resamples for every figure; they depend on `seed` alone."""

    def __init__(self, scenes: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.weights: Int[np.ndarray, "B S"] = rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=RESAMPLES)

    def ratio(self, top: Shaped[np.ndarray, " S"], bottom: Shaped[np.ndarray, " S"], unit: str) -> Estimate:
        """Sum of `top` over sum of `bottom`, both per scene; NaN when there is nothing to divide by."""
        top, bottom = np.asarray(top, float), np.asarray(bottom, float)
        if not bottom.sum():
            return Estimate(float("nan"), None, None, unit)
        below = self.weights @ bottom
        samples = (self.weights @ top)[below > 0] / below[below > 0]
        low, high = np.quantile(samples, [0.025, 0.975])
        return Estimate(float(top.sum() / bottom.sum()), float(low), float(high), unit)

    def mean(self, values: Float[np.ndarray, " S"], unit: str) -> Estimate:
        """Mean over the scenes in which the value is defined (not NaN); NaN when it is in none."""
        defined: Bool[np.ndarray, " S"] = ~np.isnan(values)
        return self.ratio(np.where(defined, values, 0), defined, unit)
