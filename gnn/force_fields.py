"""The output of an edge function as a force field: what one sender at a relative place adds to a lone receiver."""

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from envs.dynamics import clip_norm
from envs.experts.config import ExpertConfig
from envs.record import Array
from gnn.checkpoint import Model
from gnn.graph import EDGE_TYPES, Graph
from gnn.laws import check_kinds, pair_force
from gnn.messages import acceleration, edge_kinds
from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class ForceField:
    """An edge function on a grid of R x R relative states, beside the true law where there is one."""

    kind: str
    """Edge type."""
    over: str
    """`position` or `velocity`: which relative quantity the grid is of."""
    grid: Float[np.ndarray, "R R 2"]
    """Position [m] or velocity [m/s] of the sender minus the receiver's."""
    velocity: Float[np.ndarray, "2"]
    """Velocity of the receiver [m/s], unless the grid is of it."""
    learned: Float[np.ndarray, "R R 2"]
    """[m/s^2], before any limit."""
    true: Float[np.ndarray, "R R 2"] | None
    """[m/s^2], before any limit; None where no expert is known."""
    limit: float = float("inf")
    """Largest acceleration that is ever executed [m/s^2]. What either field has beyond it no data can show, so both are
    compared, and drawn, shortened to it."""

    def executed(self, force: Float[np.ndarray, "R R 2"]) -> Float[np.ndarray, "R R 2"]:
        """A field within the limit [m/s^2]."""
        return np.asarray(clip_norm(jnp.asarray(force), self.limit))

    @property
    def r2(self) -> float:
        """Share of the true field's variance over the grid that the learned one explains; NaN without a true one."""
        return float("nan") if self.true is None else r_squared(self.executed(self.true), self.executed(self.learned))

    @property
    def relative_error(self) -> float:
        """Root mean square of the difference by that of the true field; NaN without one."""
        if self.true is None:
            return float("nan")
        true, learned = self.executed(self.true), self.executed(self.learned)
        size = float(np.sum(np.square(true, dtype=np.float64)))
        off = float(np.sum(np.square(learned - true, dtype=np.float64)))
        return (off / size) ** 0.5 if size else float("nan")


@dataclass(frozen=True, kw_only=True)
class Spans:
    """What fields are looked at over: a network knows nothing of distances and speeds that it never saw."""

    speed: float
    """Of the receiver, along y [m/s]."""
    velocity: float
    """Greatest difference of velocities on each axis [m/s]."""
    agents: float
    """Greatest distance of another agent on each axis [m]."""
    others: float
    """Of a goal or obstacle [m]."""
    apart: float
    """Distance of the other agent ahead while velocities vary [m]."""
    beside: tuple[float, float]
    """Place of a goal or obstacle while velocities vary [m]."""
    goal: tuple[float, float]
    """Where a lone receiver's goal is while other edges are looked at [m]: straight ahead."""


SIMULATED = Spans(speed=5.0, velocity=10.0, agents=20.0, others=40.0, apart=4.0, beside=(3.0, 25.0), goal=(0.0, 60.0))
"""Of swarms that fly at up to 10 m/s in an arena of 200 m."""
PEOPLE_AROUND = 5.0
"""Median distances to the nearest other that a field over positions reaches."""


def spans_of(samples: Mapping[str, Float[np.ndarray, " n"]]) -> Spans:
    """Of recordings in which somebody moves (`gnn.ranges`): median and greatest speed of those who do, and spacing."""
    moving = samples["speed"][samples["speed"] > 0]
    speed, fast = (float(np.quantile(moving, share)) for share in (0.5, 0.99))
    spacing = samples["spacing"][samples["spacing"] > 0]
    near = float(np.median(spacing)) if len(spacing) else SIMULATED.apart * speed / SIMULATED.speed
    unit = PEOPLE_AROUND * near
    return Spans(
        speed=speed,
        velocity=2 * fast,
        agents=unit,
        others=2 * unit,
        apart=near,
        beside=(0.15 * unit, 1.25 * unit),
        goal=(0.0, 3 * unit),
    )


def r_squared(true: Float[np.ndarray, "*n 2"], found: Float[np.ndarray, "*n 2"]) -> float:
    """1 - squared error / variance of the truth, both components together; NaN for a constant truth."""
    true, found = (np.asarray(x, np.float64).reshape(-1, 2) for x in (true, found))
    spread = float(np.sum((true - true.mean(axis=0)) ** 2))
    return 1 - float(np.sum((found - true) ** 2)) / spread if spread > 0 else float("nan")


def effect(
    model: Model,
    kind: str,
    receiver: Float[Array, "P 4"],
    sender: Float[Array, "P 4"],
    goal: Float[Array, "2"] | None = None,
) -> Float[Array, "P 2"]:
    """Acceleration [m/s^2] that an edge of a type adds: with it minus without it, before any limit.

    The receiver is otherwise alone; with `goal` [m] it also has a goal there in both cases, as in the data of a network
    that never saw an agent without one. A model with a window sees both move at constant velocity. Raises SpecError for
    a type that the model has no function for.
    """
    check_kinds((kind,))
    kinds = edge_kinds(model)
    if kind not in kinds:
        raise SpecError("kind", kind, "one that the model has a function for: " + ", ".join(kinds))
    if goal is not None and (kind == "goal" or "goal" not in kinds):
        raise SpecError("goal", tuple(goal), "None for goal edges, and for a model without a goal function")
    receiver, sender = (jnp.asarray(x, jnp.float32) for x in (receiver, sender))
    pairs = len(receiver)
    # A place for every type that the network knows, for it to have the shape it was trained in; sender last.
    places = {k: sender for k in kinds if k != "agent"}
    if goal is not None:
        places["goal"] = jnp.broadcast_to(jnp.concatenate([jnp.asarray(goal), jnp.zeros(2)]), (pairs, 4))
    nodes = jnp.stack([*(places[k] for k in EDGE_TYPES if k in places), receiver, sender], axis=1)
    back = model.integrator.dt * jnp.arange(model.config.window - 1, -1, -1)[None, :, None, None]
    past = jnp.concatenate(
        [nodes[:, None, :, :2] - back * nodes[:, None, :, 2:], jnp.broadcast_to(nodes[:, None, :, 2:], (
            pairs, model.config.window, nodes.shape[1], 2))], axis=-1
    )  # fmt: skip
    held = () if goal is None else ("goal",)
    wanted = [acceleration(model, past, _two(kinds, on, pairs)) for on in ((*held, kind), held)]
    return (wanted[0] - wanted[1])[:, 0]


def _two(kinds: tuple[str, ...], on: tuple[str, ...], pairs: int) -> Graph:
    """Nodes of `kinds` (one each), the receiver and another agent; edges into the receiver of the types that are on."""

    def mask(kind: str, senders: int) -> Bool[Array, "P 2 M"]:
        first = np.zeros((2, senders), bool)
        first[0, -1:] = kind in on
        return jnp.broadcast_to(first, (pairs, 2, senders))

    context = [kind for kind in EDGE_TYPES if kind in kinds and kind != "agent"]
    here = np.array([kind in on for kind in context] + [True, "agent" in on])
    return Graph(
        present=jnp.broadcast_to(here, (pairs, len(here))),
        goal=mask("goal", int("goal" in kinds)),
        obstacle=mask("obstacle", int("obstacle" in kinds)),
        agent=mask("agent", 2),
    )


def force_field(
    model: Model,
    kind: str,
    expert: ExpertConfig | None = None,
    *,
    over: str = "position",
    reach: float | None = None,
    velocity: tuple[float, float] = (0.0, 5.0),
    apart: tuple[float, float] = (0.0, 10.0),
    place: tuple[float, float] = (0.0, 0.0),
    goal: tuple[float, float] | None = None,
    resolution: int = 25,
) -> ForceField:
    """An edge function over relative position or velocity.

    The receiver is at `place` [m] with `velocity` [m/s]. Over `position` the sender is up to `reach` [m] away on each
    axis (20 for agents, 40 otherwise); it moves with the receiver if it is an agent, else it stands. Over `velocity` it
    is `apart` [m] from the receiver and their velocities differ by up to `reach` [m/s] (10): an agent's varies; goals
    and obstacles stand, and the receiver's varies. Raises LawError where the expert has no law for this type, SpecError
    for an `over` that is neither.
    """
    if over not in ("position", "velocity"):
        raise SpecError("over", over, "position or velocity")
    if reach is None:
        reach = 10.0 if over == "velocity" else 20.0 if kind == "agent" else 40.0
    line = np.linspace(-reach, reach, resolution, dtype=np.float32)
    grid = np.stack(np.meshgrid(line, line), axis=-1)
    flat = grid.reshape(-1, 2)
    own = np.broadcast_to(np.asarray([*place, *velocity], np.float32), (len(flat), 4)).copy()
    sender = np.zeros_like(own)
    sender[:, :2] = own[:, :2] + (flat if over == "position" else np.asarray(apart, np.float32))
    if kind == "agent":
        sender[:, 2:] = own[:, 2:] + flat * (over == "velocity")
    elif over == "velocity":
        own[:, 2:] = -flat
    there = None if goal is None else jnp.asarray(goal, jnp.float32)
    learned = jax.jit(lambda r, s: effect(model, kind, r, s, there))(own, sender)
    true = None if expert is None else np.asarray(pair_force(expert, kind, own, sender)).reshape(grid.shape)
    return ForceField(
        kind=kind,
        over=over,
        grid=grid,
        velocity=np.asarray(velocity, np.float32),
        learned=np.asarray(learned).reshape(grid.shape),
        true=true,
        limit=model.integrator.max_acceleration,
    )
