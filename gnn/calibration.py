"""Process noise for a sampler and one factor that makes its bands honest, both from held-out scenes; then the study."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from envs.trajectories import Trajectories, TrajectoryError
from gnn.checkpoint import Model
from gnn.process_noise import fit_noise, with_memory
from gnn.scores import Scores
from gnn.uncertainty import Sampler, make_sampler, one_step_residuals, score_futures

FACTORS = (0.5, 2.0)
"""Calibration factors that are searched, ends included."""
BISECTIONS = 6
"""On a log scale: the factor is found to 2%."""
TARGET = (0.85, 0.95)
"""Where the coverage of the central 90% band shall be at every horizon."""


def with_noise(
    sampler: Sampler,
    held_out: Trajectories,
    *,
    horizon: int = 40,
    samples: int = 50,
    starts: int = 2,
    seed: int = 0,
    fit_steps: int = 800,
) -> Sampler:
    """The sampler with process noise fitted to the even scenes and its factor calibrated on the odd ones.

    The factor is the one at which the 90% band covers as much too little at its worst horizon as too much at another;
    both grow with it, so it is bisected, with the same random numbers each time. The network of the noise overfits few
    scenes: give several hundred. Raises TrajectoryError for fewer than 2 scenes.
    """
    if len(held_out) < 2:
        raise TrajectoryError(f"process noise needs at least 2 held-out scenes, {len(held_out)} given")
    fitted = held_out.take(slice(0, None, 2))
    residuals = one_step_residuals(sampler, fitted, seed=seed)
    noise = with_memory(fit_noise(residuals, sampler.scales, steps=fit_steps, seed=seed), residuals, len(fitted))
    judged = held_out.take(slice(1, None, 2))

    def covers_less(factor: float) -> bool:
        tried = replace(sampler, noise=noise.scaled(factor))
        scores = score_futures(tried, judged, horizon=horizon, samples=samples, starts=starts, seed=seed)
        return float(np.nanmin(scores.coverage_90) + np.nanmax(scores.coverage_90)) / 2 < 0.9

    low, high = map(math.log, FACTORS)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if covers_less(math.exp(middle)) else (low, middle)
    return replace(sampler, noise=noise.scaled(math.exp((low + high) / 2)))


@dataclass(frozen=True)
class Method:
    """A way to draw futures and how it did on the test scenes."""

    name: str
    sampler: Sampler
    scores: Scores

    @property
    def factor(self) -> float | None:
        """Calibration factor of its process noise; None without."""
        return None if self.sampler.noise is None else float(self.sampler.noise.factor)

    @property
    def covers(self) -> bool:
        """Whether the 90% band covers 85-95% at every horizon."""
        coverage = self.scores.coverage_90
        return bool((coverage >= TARGET[0]).all() and (coverage <= TARGET[1]).all())


@dataclass(frozen=True)
class Study:
    """Every method on the same test windows."""

    methods: tuple[Method, ...]
    dt: float
    """[s]"""

    def rows(self) -> list[dict]:
        """One plain row per method and horizon, for a table or JSON."""
        names = ("coverage_50", "coverage_90", "width_50", "width_90", "energy", "nll", "rmse")
        return [
            {"method": m.name, "steps": h + 1, "time": self.dt * (h + 1), "factor": m.factor}
            | {name: float(getattr(m.scores, name)[h]) for name in names}
            for m in self.methods
            for h in range(len(m.scores.energy))
        ]

    def best(self) -> str:
        """One sentence: the calibrated method with the best mean energy score, and with the best mean NLL."""
        judged = [m for m in self.methods if m.factor is not None]
        parts = []
        for name, unit in (("energy", "m"), ("nll", "nats")):
            ranked = sorted(judged, key=lambda m: float(np.nanmean(getattr(m.scores, name))))
            values = ", ".join(f"{m.name} {np.nanmean(getattr(m.scores, name)):.3f}" for m in ranked)
            label = {"energy": "energy score", "nll": "NLL"}[name]
            parts.append(f"{label}, mean over horizons: {values} {unit}, so {ranked[0].name} is better")
        return "; ".join(parts) + "."


def uncertainty_study(
    dropout: Model,
    ensemble: Sequence[Model],
    validation: Trajectories,
    test: Trajectories,
    *,
    horizon: int = 40,
    samples: int = 100,
    starts: int = 2,
    seed: int = 0,
    fit_steps: int = 800,
) -> Study:
    """Dropout and ensemble, each with calibrated process noise and, for comparison, without, scored on `test`.

    `validation`: scenes that no model was trained on; noise and factor come from these alone.
    """
    methods = []
    for name, models in (("dropout", [dropout]), ("ensemble", list(ensemble))):
        bare = make_sampler(models)
        full = with_noise(bare, validation, horizon=horizon, seed=seed, fit_steps=fit_steps)
        for label, sampler in ((name, full), (f"{name} without noise", bare)):
            scores = score_futures(sampler, test, horizon=horizon, samples=samples, starts=starts, seed=seed + 1)
            methods.append(Method(label, sampler, scores))
    return Study(tuple(methods), test.dt)
