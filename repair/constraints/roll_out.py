"""Distance over a horizon: whoever keeps the action that it takes now stays clear for some steps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from envs.record import Array
from repair.constraints.constraint import HalfPlanes, Motion
from repair.encounters import Encounters, length
from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class RollOut(Motion):
    """|p_t| >= R + margin for t = 1..T control steps of the same action, the other going on as it moves.

        p_t = p + t dt v + c_t u,   c_t = dt^2 (t (t - 1) / 2 + t (k + 1) / (2 k))

    Conditions are T for each body, steps first within a body. Slack is |p_t| - R - margin, in m. Not convex:
    `half_planes` gives the tangents at p_t.
    """

    horizon: int = 5
    """T."""

    name = "roll-out"
    unit = "m"

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise SpecError("horizon", self.horizon, "at least 1 control step")

    def _pushes(self) -> Float[np.ndarray, " T"]:
        t, k = np.arange(1, self.horizon + 1), self.kinematics.substeps
        return self.kinematics.dt**2 * (t * (t - 1) / 2 + t * (k + 1) / (2 * k))

    def _drifts(self, e: Encounters) -> Float[Array, "R J T 2"]:
        xp = e.relative.__array_namespace__()
        times = xp.asarray(self.kinematics.dt * np.arange(1, self.horizon + 1), dtype=e.relative.dtype)
        return e.relative[:, :, None] + e.velocity[:, :, None] * times[:, None]

    def _after(self, e: Encounters, action: Float[Array, "R 2"]) -> Float[Array, "R J T 2"]:
        xp = e.relative.__array_namespace__()
        pushes = xp.asarray(self._pushes(), dtype=e.relative.dtype)
        return self._drifts(e) + pushes[:, None] * action[:, None, None]

    def slack(self, e: Encounters, action: Float[Array, "R 2"]) -> Float[Array, "R JT"]:
        """|p_t| - R - margin [m]."""
        xp = e.relative.__array_namespace__()
        clear = length(self._after(e, action)) - (e.reach + self.margin)[..., None]
        return xp.where(e.present[..., None], clear, np.inf).reshape(len(action), -1)

    def half_planes(self, e: Encounters, action: Float[Array, "R 2"]) -> HalfPlanes:
        """n_t . p_t >= R + margin with n_t = p_t / |p_t|."""
        after, drift = self._after(e, action), self._drifts(e)
        xp = after.__array_namespace__()
        normal = after / length(after)[..., None]
        pushes = xp.asarray(self._pushes(), dtype=after.dtype)
        offset = ((e.reach + self.margin)[..., None] - xp.sum(normal * drift, axis=-1)) / pushes
        offset = xp.where(e.present[..., None], offset, -np.inf)
        return HalfPlanes(normal=normal.reshape(len(action), -1, 2), offset=offset.reshape(len(action), -1))

    def sides(self, e: Encounters) -> None:
        """Infinitely many."""
