"""What imported samples are like: the echo that shows a wrong unit, what a model will have seen, and outliers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from envs.importers.config import ImportConfig
from envs.importers.samples import Samples

LISTED = 1000
"""Outliers that the card lists; all are counted."""
OUTLYING = 10.0
"""Times the median, where no threshold is declared."""
_ROWS = 300
"""Rows at which spacing is measured, evenly over all runs."""
_SHARES = (0.01, 0.5, 0.99)


@dataclass(frozen=True)
class Outlier:
    """A speed or acceleration beyond its threshold."""

    run: str
    id: str
    time: float
    """[s]"""
    what: str
    """speed [m/s] or acceleration [m/s^2]."""
    value: float


@dataclass(frozen=True)
class Survey:
    """Figures over agents; triples are the 1% quantile, the median and the 99% quantile."""

    speed: tuple[float, float, float]
    """[m/s]"""
    acceleration: tuple[float, float, float]
    """Of one row to the next [m/s^2]."""
    spacing: tuple[float, float, float] | None
    """Distance to the nearest other agent [m]; None where nobody ever has company."""
    present: tuple[float, float, float]
    """Agents at a time."""
    largest: float
    """Largest coordinate [m]."""
    thresholds: dict[str, float]
    outliers: tuple[Outlier, ...]
    """The most extreme `LISTED`, worst first by kind."""
    outlying: int
    """How many there are."""


def survey(runs: Sequence[Samples], dt: float, config: ImportConfig) -> Survey:
    """Measures runs on their grid of rows `dt` [s] apart."""
    speeds = [np.linalg.norm(run.velocity, axis=1) for run in runs]
    turns = [_accelerations(run, dt) for run in runs]
    speed = np.concatenate([s[run.agents] for s, run in zip(speeds, runs, strict=True)])
    turn = np.concatenate([a[run.agents] for a, run in zip(turns, runs, strict=True)])
    turn = turn[np.isfinite(turn)]
    thresholds = {
        "speed [m/s]": _threshold(config.outlier_speed, config.max_speed, speed),
        "acceleration [m/s^2]": _threshold(config.outlier_acceleration, config.max_acceleration, turn),
    }
    outliers = []
    for what, values in zip(thresholds, (speeds, turns), strict=True):
        found = [
            Outlier(
                run.tracks.name,
                run.tracks.labels[run.person[at]],
                round(run.start + float(run.row[at]) * dt, 6),
                what,
                float(value[at]),
            )
            for run, value in zip(runs, values, strict=True)
            for at in np.flatnonzero((value > thresholds[what]) & run.agents)
        ]
        outliers += sorted(found, key=lambda outlier: -outlier.value)
    present, near = _company(runs)
    return Survey(
        speed=_quantiles(speed),
        acceleration=_quantiles(turn) if len(turn) else (0.0, 0.0, 0.0),
        spacing=_quantiles(near) if len(near) else None,
        present=_quantiles(present),
        largest=float(max(np.abs(run.position).max() for run in runs)),
        thresholds=thresholds,
        outliers=tuple(outliers[:LISTED]),
        outlying=len(outliers),
    )


def _accelerations(run: Samples, dt: float) -> np.ndarray:
    """Change of velocity since the row before [m/s^2]; NaN for the first row of a stay."""
    change = np.full(len(run.row), np.nan)
    follows = (np.diff(run.person) == 0) & (np.diff(run.row) == 1)
    change[1:][follows] = np.linalg.norm(np.diff(run.velocity, axis=0)[follows], axis=1) / dt
    return change


def _threshold(declared: float | None, limit: float, values: np.ndarray) -> float:
    if declared is not None:
        return declared
    if np.isfinite(limit):
        return limit * (1 + 1e-4)  # what moves at its limit is no outlier
    median = float(np.median(values)) if len(values) else 0.0
    return OUTLYING * median if median else float("inf")


def _company(runs: Sequence[Samples]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of agents at every row with any, and distances to the nearest one at some of them."""
    counts = [np.bincount(run.row[run.agents], minlength=run.rows) for run in runs]
    crowded = [(run, int(row)) for run, count in zip(runs, counts, strict=True) for row in np.flatnonzero(count > 1)]
    chosen = crowded[:: max(1, len(crowded) // _ROWS)]
    near, grouped = [], {}
    for run, row in chosen:
        grouped.setdefault(id(run), (run, []))[1].append(row)
    for run, rows in grouped.values():
        at = np.flatnonzero(np.isin(run.row, rows) & run.agents)
        at = at[np.argsort(run.row[at], kind="stable")]
        for part in np.split(at, np.flatnonzero(np.diff(run.row[at])) + 1):
            near.append(KDTree(run.position[part]).query(run.position[part], k=2)[0][:, 1])
    present = np.concatenate(counts)
    return present[present > 0], np.concatenate(near) if near else np.zeros(0)


def _quantiles(values: np.ndarray) -> tuple[float, float, float]:
    low, middle, high = np.quantile(values, _SHARES)
    return float(low), float(middle), float(high)
