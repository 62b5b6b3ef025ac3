"""Collective motion over time: how aligned, how rotating, how close a group is. Formulas: `docs/definitions.md`.

Every measure is taken over the agents present at that row, in float64; it is NaN where it has no meaning, and never a
warning. None depends on the order of the agents, on absent agents, or on where the group is and how it is turned.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from envs.estimates import Bootstrap, Estimate
from envs.trajectories import AGENT, Trajectories

STILL = 1e-3
"""An agent slower than this [m/s] has no heading: what is left of its velocity is rounding."""
UNITS = {
    "polarisation": "",
    "milling": "",
    "angular_momentum": "",
    "spread": "m",
    "spread_rms": "m",
    "nearest_neighbour_mean": "m",
    "nearest_neighbour_min": "m",
}
"""The measures in the order of a report, with their units; those without one lie in 0..1."""
_POINTS = 1 << 18
"""Agents per search tree: bounds the memory, whatever the data."""


def collective_measures(trajectories: Trajectories) -> dict[str, Float[np.ndarray, "S T"]]:
    """Every measure of `UNITS` at every row of every scene, by name."""
    t = trajectories
    present = t.mask & (t.kind == AGENT)[:, None]
    nearest = nearest_neighbour(t.position, present)
    return {
        "polarisation": polarisation(t.velocity, present),
        "milling": milling(t.position, t.velocity, present),
        "angular_momentum": angular_momentum(t.position, t.velocity, present),
        "spread": spread(t.position, present),
        "spread_rms": spread_rms(t.position, present),
        "nearest_neighbour_mean": _mean(nearest, ~np.isnan(nearest)),
        "nearest_neighbour_min": _least(nearest),
    }


def collective_report(measures: dict[str, Float[np.ndarray, "S T"]], *, seed: int = 0) -> dict[str, Estimate]:
    """`NAME_mean`: mean over the rows of each scene, then over scenes. `NAME_final`: mean over scenes at the last row.

    Rows and scenes in which a measure is undefined (NaN) are left out. Intervals: 95% bootstrap over scenes.
    """
    report: dict[str, Estimate] = {}
    for name, values in measures.items():
        bootstrap = Bootstrap(len(values), seed)
        report[f"{name}_mean"] = bootstrap.mean(_mean(values, ~np.isnan(values)), UNITS[name])
        report[f"{name}_final"] = bootstrap.mean(values[:, -1], UNITS[name])
    return report


def polarisation(velocity: Float[np.ndarray, "*n V 2"], present: Bool[np.ndarray, "*n V"]) -> Float[np.ndarray, "*n"]:
    """|mean unit velocity|: 1 when all fly one way, 0 when headings cancel (Vicsek et al. 1995, their v_a).

    Over agents that move (faster than `STILL`); NaN when none does. A single agent has 1. `velocity` [m/s].
    """
    heading, moving = _units(velocity, present, STILL)
    return _length(_mean(heading, moving[..., None], axis=-2))


def milling(
    position: Float[np.ndarray, "*n V 2"], velocity: Float[np.ndarray, "*n V 2"], present: Bool[np.ndarray, "*n V"]
) -> Float[np.ndarray, "*n"]:
    """|mean of (unit vector from the centroid) x (unit velocity)|: 1 on a circle that all run around one way, 0 when
    as many turn left as right (rotation order of Tunstrøm et al. 2013; Couzin et al. 2002).

    Over agents that move and are not at the centroid itself; NaN without one. Positions [m], velocities [m/s].
    """
    outward, away = _units(_from_centroid(position, present), present, 1e-9)
    heading, moving = _units(velocity, present, STILL)
    return np.asarray(np.abs(_mean(_cross(outward, heading), away & moving)))


def angular_momentum(
    position: Float[np.ndarray, "*n V 2"], velocity: Float[np.ndarray, "*n V 2"], present: Bool[np.ndarray, "*n V"]
) -> Float[np.ndarray, "*n"]:
    """|sum r x v| / sum |r| |v| about the centroid (Chuang et al. 2007): `milling` weighted by distance and speed.

    1 for a mill of any shape, 0 for any group that moves as one. NaN when nobody moves (faster than `STILL`) away from
    the centroid. Positions [m], velocities [m/s].
    """
    arm = _from_centroid(position, present)
    moving = present & (_length(velocity) > STILL)
    swept = np.where(moving, _cross(arm, velocity.astype(np.float64)), 0).sum(axis=-1)
    most = np.where(moving, _length(arm) * _length(velocity), 0).sum(axis=-1)
    return np.divide(np.abs(swept), most, out=np.full(most.shape, np.nan), where=most > 1e-9 * STILL)


def spread(position: Float[np.ndarray, "*n V 2"], present: Bool[np.ndarray, "*n V"]) -> Float[np.ndarray, "*n"]:
    """Mean distance to the centroid [m]: small is cohesive. 0 for a single agent, NaN for none. Positions [m]."""
    return _mean(_length(_from_centroid(position, present)), present)


def spread_rms(position: Float[np.ndarray, "*n V 2"], present: Bool[np.ndarray, "*n V"]) -> Float[np.ndarray, "*n"]:
    """Root mean square distance to the centroid [m], the radius of gyration. 0 for a single agent, NaN for none."""
    return np.asarray(np.sqrt(_mean((_from_centroid(position, present) ** 2).sum(axis=-1), present)))


def nearest_neighbour(
    position: Float[np.ndarray, "*n V 2"], present: Bool[np.ndarray, "*n V"]
) -> Float[np.ndarray, "*n V"]:
    """Distance [m] from each agent's centre to the nearest other agent's; NaN for absent agents and for one alone.

    One tree for many rows: a third coordinate keeps rows farther apart than any two agents of a row, so time grows with
    the number of agents and not with its square.
    """
    rows, agents = present.reshape(-1, present.shape[-1]), present.shape[-1]
    places = position.reshape(-1, agents, 2)
    found = np.full(rows.shape, np.nan)
    step = max(1, _POINTS // max(agents, 1))
    for first in range(0, len(rows), step):
        row, agent = np.nonzero(rows[first : first + step])
        if not len(row):
            continue
        points = places[first + row, agent].astype(np.float64)
        apart = 2 * float(_length(np.ptp(points, axis=0))) + 1
        tree = KDTree(np.column_stack([points, apart * row]))
        distance = tree.query(tree.data, k=2, distance_upper_bound=apart / 1.5)[0][:, 1]
        found[first + row, agent] = np.where(np.isfinite(distance), distance, np.nan)
    return found.reshape(present.shape)


def _from_centroid(position: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Vectors from the mean place of the present agents, 0 for absent ones."""
    centroid = _mean(position.astype(np.float64), present[..., None], axis=-2)
    return np.where(present[..., None], position - centroid[..., None, :], 0)


def _units(vectors: np.ndarray, present: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors, and which of them there are: of present agents whose vector is longer than `least`."""
    vectors = vectors.astype(np.float64)
    length = _length(vectors)
    defined = present & (length > least)
    return vectors / np.where(defined, length, 1)[..., None], defined


def _mean(values: np.ndarray, where: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the values that `where` names; NaN where it names none."""
    count = np.broadcast_to(where, values.shape).sum(axis=axis)
    total = np.where(where, values, 0).sum(axis=axis)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def _least(values: np.ndarray) -> np.ndarray:
    """Smallest of the values that are not NaN; NaN where all are."""
    least = np.where(np.isnan(values), np.inf, values).min(axis=-1, initial=np.inf)
    return np.asarray(np.where(np.isinf(least), np.nan, least))


def _length(vectors: np.ndarray) -> np.ndarray:
    vectors = np.asarray(vectors, np.float64)
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1]))


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The z component of the cross product of vectors in the plane."""
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
