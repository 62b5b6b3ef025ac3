"""Process noise for a sampler and one factor that makes its bands honest, both from held-out scenes; then the study."""

import math
from dataclasses import replace

import numpy as np

from envs.trajectories import Trajectories, TrajectoryError
from gnn.process_noise import fit_noise, with_memory
from gnn.uncertainty import Sampler, one_step_residuals, score_futures

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
