"""Settings of repair as plain data. Standard library only."""

from dataclasses import dataclass, field
from typing import Literal

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


@dataclass(frozen=True, kw_only=True)
class DescentConfig:
    """Adam towards the filter's actions (`repair.descend`)."""

    steps: int = 3000
    """Gradient steps of a round, in chunks of 250."""
    batch: int = 512
    """Decisions per gradient step."""
    learning_rate: float = 3e-3
    """At the first step; a cosine takes it to 0."""
    price: float = 1.0
    """Of missing a condition by 1 m/s^2, beside half the squared deviation of an action [(m/s^2)^2]."""
    margin: float = 0.2
    """Added to every condition [m/s^2]."""
    clip_norm: float = 1.0
    """Largest global norm of a gradient."""
    average: float = 0.995
    """Decay per step of the running mean of the weights that is the result."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch"):
            if getattr(self, name) < 1:
                raise SpecError(name, getattr(self, name), "at least 1")
        for name in ("learning_rate", "clip_norm"):
            if not 0 < getattr(self, name) < float("inf"):
                raise SpecError(name, getattr(self, name), "a finite number above 0")
        for name in ("price", "margin"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise SpecError(name, getattr(self, name), "a finite number of at least 0")
        if not 0 <= self.average < 1:
            raise SpecError("average", self.average, "from 0 up to 1")


EDGES = ("edge/obstacle/*", "edge/agent/*")
"""Edge functions of what can be touched."""


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """The counter-example loop (`repair.loop`)."""

    constraint: ConstraintConfig = field(default_factory=ConstraintConfig)
    """What must hold."""
    free: tuple[str, ...] = (*EDGES, "node/*", "readout/*")
    """Weights that may change, as patterns over their paths."""
    polish: tuple[str, ...] = ("node/*", "readout/*")
    """Weights that the quadratic programs at the end may change; none: they are left out."""
    method: Literal["distil", "relax", "thesis", "last-layer"] = "distil"
    """How the weights change. distil: Adam towards the filter's actions, and quadratic programs at the end for what
    still breaks the constraint. relax: quadratic programs alone, for some thousands of free weights at most. thesis:
    mixed-integer programs, a layer at a time, on states taken once. last-layer: branch and bound over the sides on
    which the last layer passes true discs, on states taken once."""
    targets: Literal["filter", "own"] = "filter"
    """Which actions it learns or holds on to: the policy's first ones as a filter would let them through, or as they
    were (the penalty method)."""
    rounds: int = 6
    """Times that it acts and learns."""
    scenes: int = 512
    """Scenes of a round."""
    steps: int = 50
    """Control steps of a scene."""
    seed: int = 0
    """Of scenes, samples and minibatches."""
    reserve_margin: float = 0.4
    """Added to the constraint's margin in what is learned, so that what must hold has room [m]."""
    reserve_share: float = 0.85
    """Factor on the constraint's share of braking in what is learned."""
    lessons: int = 20_000
    """Decisions that a round adds to the pool: at most so many that the filter would change or that are near a body,
    and as many of all."""
    pool: int = 200_000
    """Decisions in the pool at most; the oldest go."""
    hard: int = 1000
    """Counter-examples of a round that become constrained rows: the worst; with relax, a sample."""
    anchors: int = 2000
    """Decisions that the quadratic programs leave as they are."""
    price: float = 100.0
    """Of a missed condition in the quadratic programs (`repair.relax`)."""
    agents: bool = True
    """thesis, last-layer: keep agents from each other too; the thesis keeps them from obstacles alone."""
    states: int = 1000
    """thesis, last-layer: states of the roll-outs that the program is about, each of all its agents."""
    layers: tuple[str, ...] = ("readout/layer0",)
    """thesis: layers that take turns in being free; the thesis has results for the last one."""
    box: float = 0.3
    """thesis: how far a weight of the free layer may go."""
    solver: Literal["highspy", "HIGHS", "SCIP", "GUROBI"] = "highspy"
    """thesis: highspy starts HiGHS from the weights that are there; the others are called through cvxpy, SCIP and
    GUROBI where they are installed."""
    solver_seconds: float = 120.0
    """thesis, last-layer: time for each program [s]."""
    descent: DescentConfig = field(default_factory=DescentConfig)

    def __post_init__(self) -> None:
        methods = ("distil", "relax", "thesis", "last-layer")
        if self.method not in methods:
            raise SpecError("method", self.method, "one of " + ", ".join(methods))
        for name in ("box", "solver_seconds"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise SpecError(name, getattr(self, name), "a finite number of at least 0")
        if self.targets not in ("filter", "own"):
            raise SpecError("targets", self.targets, "filter or own")
        for name, low in (("rounds", 0), ("scenes", 1), ("steps", 1), ("seed", 0), ("lessons", 1), ("pool", 1)):
            if getattr(self, name) < low:
                raise SpecError(name, getattr(self, name), f"at least {low}")
        if not 0 < self.price < float("inf"):
            raise SpecError("price", self.price, "a finite number above 0")
        kinds = {"thesis": ("barrier", "polygon", "diamond"), "last-layer": ("disc",)}.get(self.method, CONSTRAINTS)
        if self.constraint.name not in kinds:
            raise SpecError("constraint", self.constraint.name, f"{' or '.join(kinds)} with method {self.method}")
        for name in ("hard", "anchors", "states"):
            if getattr(self, name) < 1:
                raise SpecError(name, getattr(self, name), "at least 1")
        if not 0 <= self.reserve_margin < float("inf"):
            raise SpecError("reserve_margin", self.reserve_margin, "a finite number of at least 0 [m]")
        if not 0 < self.reserve_share <= 1:
            raise SpecError("reserve_share", self.reserve_share, "above 0, at most 1")
