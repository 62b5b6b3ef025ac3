"""Settings of repair as plain data. Standard library only."""

from dataclasses import dataclass

from swarm_mjcf.errors import SpecError

CONSTRAINTS = ("barrier", "disc", "polygon", "diamond", "roll-out")
"""Names of constraints."""


@dataclass(frozen=True, kw_only=True)
class ConstraintConfig:
    """A safety constraint by name; fields that it does not use are ignored."""

    name: str = "barrier"
    """barrier: the agent can still brake before it touches. disc: the next position lies outside every body. polygon,
    diamond (the thesis's): the same for a shape around the disc. roll-out: outside for some steps of one action."""
    margin: float = 0.0
    """Kept between surfaces beyond touching [m]."""
    share: float = 0.7
    """barrier: part of the largest acceleration counted on for braking."""
    edges: int = 16
    """polygon: its edges."""
    horizon: int = 5
    """roll-out: control steps."""

    def __post_init__(self) -> None:
        if self.name not in CONSTRAINTS:
            raise SpecError("constraint", self.name, "one of " + ", ".join(CONSTRAINTS))
        if not 0 <= self.margin < float("inf"):
            raise SpecError("margin", self.margin, "a finite number of at least 0 [m]")
        if not 0 < self.share <= 1:
            raise SpecError("share", self.share, "above 0, at most 1")
        if self.edges < 3:
            raise SpecError("edges", self.edges, "at least 3")
        if self.horizon < 1:
            raise SpecError("horizon", self.horizon, "at least 1 control step")
