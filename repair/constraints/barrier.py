"""The braking barrier: never closer or faster than the brakes can undo."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from envs.record import Array
from repair.constraints.constraint import HalfPlanes, Motion, Sides, absent
from repair.encounters import Encounters, gap, outward
from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class Barrier(Motion):
    """After the coming control step the agent can still stop along the line of centres before it touches.

    With the gap h [m] between surfaces less `margin`, the outward normal n, the radial velocity s = n . v (opening is
    positive), and the outward acceleration w = n . u over a control step of dt:

        s' = s + dt w,   h' = h + dt s + dt^2 (k + 1) / (2 k) w,   s' >= -sqrt(2 b h')   (while s' <= 0)
        w >= s^2 / (2 h)   (where s' > 0: it stops on the way)

    which is `w >= w_min` with the least w_min that satisfies it, linear in the action. For k -> infinity the set of
    states from which w_min <= b is left by no action that obeys it, along one line of centres. An agent brakes with
    `share` of its largest acceleration; two agents brake together, with 2 b, and each owes half of w_min. Inside the
    margin the agent has to open, with a speed of -h / dt at the end of the step: that takes one which stood still out
    of it in one step more. Slack is n . u - w_min, in m/s^2.
    """

    share: float = 0.7
    """Part of the largest acceleration that is counted on for braking; the rest is left for turning."""

    name = "barrier"
    unit = "m/s^2"

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise SpecError("share", self.share, "above 0, at most 1")
        if not np.isfinite(self.kinematics.max_acceleration):
            raise SpecError("max_acceleration", self.kinematics.max_acceleration, "finite: agents brake with it")

    def least(self, e: Encounters) -> Float[Array, "R J"]:
        """w_min, an agent's own part of it [m/s^2]; above the limit of the acceleration where it is too late."""
        xp = e.relative.__array_namespace__()
        dt, c = self.kinematics.dt, self.push
        both = xp.where(e.steers, 2.0, 1.0)
        b = both * (self.share * self.kinematics.max_acceleration)
        h = xp.where(e.present, gap(e), 1e6) - self.margin
        s = xp.sum(outward(e) * e.velocity, axis=-1)
        inside = h <= 1e-6
        room = xp.where(inside, 1.0, h)
        # s'^2 <= 2 b h' is a quadratic in w; its lower root is where braking with b has to begin.
        half, rest = dt * s - b * c, s * s - 2 * b * (room + dt * s)
        root = xp.sqrt(xp.maximum(half * half - dt * dt * rest, 0))
        braking = -(half + root) / (dt * dt)
        stops_in_time = room + dt * s - c * s / dt >= 0  # where it would stand if it stopped just at the step's end
        least = xp.where((s >= 0) | stops_in_time, braking, s * s / (2 * room))
        least = xp.where(inside, (-h / dt - s) / dt, least)
        return absent(e, least / both, -np.inf)

    def slack(self, e: Encounters, action: Float[Array, "R 2"]) -> Float[Array, "R J"]:
        """n . u - w_min [m/s^2]."""
        xp = e.relative.__array_namespace__()
        return xp.sum(outward(e) * action[:, None], axis=-1) - self.least(e)

    def half_planes(self, e: Encounters, action: Float[Array, "R 2"]) -> HalfPlanes:
        """The condition itself, whatever the action."""
        return HalfPlanes(normal=outward(e), offset=self.least(e))

    def sides(self, e: Encounters) -> Sides:
        """One side each."""
        return Sides(normal=outward(e)[:, :, None], offset=self.least(e)[:, :, None])
