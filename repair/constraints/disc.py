"""The true disc: the next position lies outside every body."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from envs.record import Array
from repair.constraints.constraint import HalfPlanes, Motion, absent, drifted
from repair.encounters import Encounters, length


@dataclass(frozen=True, kw_only=True)
class Disc(Motion):
    """|p'| >= R + margin with p' = p + v dt + dt^2 (k + 1) / (2 k) u, the relative position after the step (eq. 6.13).

    Others are taken to go on as they move. Slack is |p'| - R - margin, in m. Not convex: `half_planes` gives the
    tangent at the point of the circle nearest to p' (the convex-concave step), which holds only what is allowed.
    """

    name = "disc"
    unit = "m"

    def slack(self, e: Encounters, action: Float[Array, "R 2"]) -> Float[Array, "R J"]:
        """|p'| - R - margin [m]."""
        after = drifted(e, self) + self.push * action[:, None]
        return absent(e, length(after) - e.reach - self.margin, np.inf)

    def half_planes(self, e: Encounters, action: Float[Array, "R 2"]) -> HalfPlanes:
        """n . (p + v dt + c u) >= R + margin with n = p' / |p'|."""
        drift = drifted(e, self)
        after = drift + self.push * action[:, None]
        normal = after / length(after)[..., None]
        xp = drift.__array_namespace__()
        offset = (e.reach + self.margin - xp.sum(normal * drift, axis=-1)) / self.push
        return HalfPlanes(normal=normal, offset=absent(e, offset, -np.inf))

    def sides(self, e: Encounters) -> None:
        """Infinitely many."""
