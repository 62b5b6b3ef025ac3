"""A polygon around the disc: the next position lies beyond one of its K edges."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from envs.record import Array
from repair.constraints.constraint import HalfPlanes, Motion, Sides, absent, drifted
from repair.encounters import Encounters
from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class Polygon(Motion):
    """max_d n_d . p' >= R + margin over the K outward normals n_d of a regular polygon around the disc.

    p' = p + v dt + dt^2 (k + 1) / (2 k) u is the relative position after the step. Slack is that maximum less
    R + margin, in m. Exact in a mixed-integer program, with a binary for each edge. Of the disc's area, a share of
    (K / pi) tan(pi / K) - 1 more is forbidden: 27% for K = 4, 1.3% for K = 16.
    """

    edges: int = 16
    """K."""

    name = "polygon"
    unit = "m"

    def __post_init__(self) -> None:
        if self.edges < 3:
            raise SpecError("edges", self.edges, "at least 3")

    @property
    def normals(self) -> Float[np.ndarray, "K 2"]:
        """Outward unit normals."""
        angles = 2 * np.pi * (np.arange(self.edges) + 0.5) / self.edges
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def _beyond(self, e: Encounters, action: Float[Array, "R 2"]) -> Float[Array, "R J K"]:
        after = drifted(e, self) + self.push * action[:, None]
        xp = after.__array_namespace__()
        return after @ xp.asarray(self.normals.T, dtype=after.dtype) - (e.reach + self.margin)[..., None]

    def slack(self, e: Encounters, action: Float[Array, "R 2"]) -> Float[Array, "R J"]:
        """max_d n_d . p' - R - margin [m]."""
        xp = e.relative.__array_namespace__()
        return absent(e, xp.max(self._beyond(e, action), axis=-1), np.inf)

    def half_planes(self, e: Encounters, action: Float[Array, "R 2"]) -> HalfPlanes:
        """Of the edge that p' is farthest beyond, or nearest to."""
        xp = e.relative.__array_namespace__()
        best = xp.argmax(self._beyond(e, action), axis=-1)
        sides = self.sides(e)
        return HalfPlanes(
            normal=xp.take_along_axis(sides.normal, best[..., None, None], axis=2)[:, :, 0],
            offset=xp.take_along_axis(sides.offset, best[..., None], axis=2)[..., 0],
        )

    def sides(self, e: Encounters) -> Sides:
        """n_d . (p + v dt + c u) >= R + margin for each edge."""
        drift = drifted(e, self)
        xp = drift.__array_namespace__()
        normals = xp.asarray(self.normals, dtype=drift.dtype)
        offset = ((e.reach + self.margin)[..., None] - drift @ normals.T) / self.push
        return Sides(
            normal=xp.broadcast_to(normals, (*drift.shape[:2], *normals.shape)),
            offset=xp.where(e.present[..., None], offset, -np.inf),
        )
