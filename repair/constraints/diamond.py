"""The thesis's constraint: an L1 diamond around the disc."""

from dataclasses import dataclass

from repair.constraints.polygon import Polygon


@dataclass(frozen=True, kw_only=True)
class Diamond(Polygon):
    """|p'_x| + |p'_y| >= sqrt(2) (R + margin) (eq. 6.14), the polygon of four edges with its corners on the axes.

    p' is the relative position after the step. Slack in m, as of a polygon: (|p'_x| + |p'_y|) / sqrt(2) - R - margin.
    """

    edges: int = 4

    name = "diamond"
