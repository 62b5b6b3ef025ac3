"""What a model has seen: agents at a time, speeds, distances to the nearest other. Plain figures for its checkpoint."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from envs.trajectories import AGENT, Trajectories

Figures = Mapping[str, Sequence[float]]
"""Of each quantity `[1%, median, 99%, largest]`."""
QUANTITIES = {"agents": "", "speed": "m/s", "spacing": "m"}
"""What is measured, with its unit."""
SHARES = (0.01, 0.5, 0.99)
"""Quantiles that a checkpoint stores."""
_CELLS = 200_000
"""Rows times nodes that are looked at, evenly over all scenes and rows."""
_ROWS = 300
"""Rows at which distances are measured, evenly over those."""


def figures_of(trajectories: Trajectories) -> dict[str, list[float]]:
    """`[1%, median, 99%, largest]` of each of `QUANTITIES` that has values: plain JSON, cheap on any amount of data."""
    return {
        name: [float(f"{value:.6g}") for value in (*np.quantile(values, SHARES), values.max())]
        for name, values in samples_of(trajectories).items()
        if len(values)
    }


def joined(ranges: Sequence[Figures]) -> dict[str, list[float]]:
    """What was seen in all of several data sets: the span of their figures. The median is the first's."""
    found = {}
    for name in QUANTITIES:
        if parts := [figures[name] for figures in ranges if name in figures]:
            low, median, high, largest = zip(*parts, strict=True)
            found[name] = [min(low), median[0], max(high), max(largest)]
    return found


def samples_of(trajectories: Trajectories) -> dict[str, Float[np.ndarray, " n"]]:
    """Samples of the `QUANTITIES`: agents present in a row (rows with any), their speeds [m/s], and the distance from
    each to the nearest other agent [m]. No random draw: every so many rows are looked at."""
    scenes, rows, nodes = trajectories.mask.shape
    every = max(1, scenes * rows * nodes // _CELLS)
    while math.gcd(every, rows) > 1:  # or the same rows of all scenes would be looked at
        every += 1
    scene, row = np.divmod(np.arange(0, scenes * rows, every), rows)
    there = trajectories.mask[scene, row] & (trajectories.kind[scene] == AGENT)
    position, velocity = trajectories.position[scene, row], trajectories.velocity[scene, row]
    count = there.sum(axis=1)
    company = np.flatnonzero(count > 1)
    company = company[:: max(1, len(company) // _ROWS)]
    near = [
        KDTree(position[at][there[at]]).query(position[at][there[at]], k=2)[0][:, 1]  # the first is itself
        for at in company
    ]
    return {
        "agents": count[count > 0].astype(np.float64),
        "speed": np.linalg.norm(velocity[there].astype(np.float64), axis=1),
        "spacing": np.concatenate(near) if near else np.zeros(0),
    }
