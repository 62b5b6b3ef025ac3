"""Figure 5.1 of the thesis: subsets of a network's edge functions against the expert with the same rules.

A subset is switched on in the data: `Trajectories.edges` without the other types makes every predictor's typed masks
False there, so the network runs unchanged. The truth is the expert from the same starts, in free flight (the published
world has no contacts), with the rules that belong to these edges.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.dynamics import free_flight, limited
from envs.experts.config import ExpertConfig
from envs.experts.registry import make_expert
from envs.policy import Policy
from envs.record import Array
from envs.state import State, make_state
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories
from gnn.checkpoint import Model
from gnn.evaluate import PredictionError, prediction_error
from gnn.forecast import forecast
from gnn.graph import EDGE_TYPES
from gnn.laws import check_kinds, same_rules
from gnn.windows import check_rows

COLUMNS: dict[str, tuple[str, ...]] = {
    "a": ("goal", "obstacle", "agent"),
    "b": ("goal",),
    "c": ("goal", "agent"),
    "d": ("goal", "obstacle"),
    "e": ("agent",),
    "f": ("obstacle", "agent"),
}
"""Edge functions that are on in each column of figure 5.1; the thesis calls (e) and (f) failures."""
HORIZONS = (5, 40)
"""Steps at which the tables of the thesis give errors."""


@dataclass(frozen=True)
class Column:
    """One column of the figure."""

    kinds: tuple[str, ...]
    """Edge functions that are on."""
    error: PredictionError
    """Of the network with these edges, against `truth`; normalized by the changes in `truth` itself."""
    truth: Trajectories
    """The expert with the same rules, from the same starts."""
    predicted: Trajectories
    """The network from the first rows of `truth` alone; those rows are repeated."""


def separation(
    model: Model,
    trajectories: Trajectories,
    expert: ExpertConfig,
    *,
    walls_stay: bool = False,
    columns: dict[str, tuple[str, ...]] = COLUMNS,
    shown: int = 2,
) -> dict[str, Column]:
    """Errors of every subset over windows of all scenes, and predictions of the first `shown` scenes.

    The first rows of `trajectories` say where scenes start, `expert` is the law that made them. The virtual walls of
    Boids are part of the obstacle rule and go with it; no edge carries them, so with `walls_stay` they act in every
    column, as they do in every scene a network was trained on. Raises LawError for an expert without rules that belong
    to edges (`gnn.laws.same_rules`), TrajectoryError for trajectories too short.
    """
    made = {}
    for name, kinds in columns.items():
        truth = with_only(rerun(trajectories, expert, kinds, walls_stay=walls_stay), kinds)
        window = model.config.window
        error = prediction_error(model.predict, model.params, truth, window=window, horizons=HORIZONS)
        made[name] = Column(kinds, error, truth, forecast(model, truth.take(slice(0, shown))))
    return made


def with_only(trajectories: Trajectories, kinds: tuple[str, ...]) -> Trajectories:
    """The same motion with edges of these types alone. Raises SpecError for an unknown type."""
    check_kinds(kinds)
    kept = np.isin(trajectories.edges, [EDGE_TYPES[kind] for kind in kinds])
    return replace(trajectories, edges=np.where(kept, trajectories.edges, 0).astype(trajectories.edges.dtype))


def rerun(
    trajectories: Trajectories,
    expert: ExpertConfig,
    kinds: tuple[str, ...] = ("goal", "obstacle", "agent"),
    *,
    walls_stay: bool = False,
) -> Trajectories:
    """The expert with the rules of these edges, from the first rows of `trajectories`, for as many rows.

    Free flight with the limits as clips: contacts do not act. Masks are those of the first row. Obstacles whose edges
    are off are absent for the expert.
    """
    check_rows(trajectories, 2, "a run from the first one")
    policy = make_expert(same_rules(expert, kinds, walls_stay=walls_stay))
    start = state_of(trajectories)
    if "obstacle" not in kinds:
        start = replace(start, obstacle_present=jnp.zeros_like(start.obstacle_present))
    steps = trajectories.position.shape[1] - 1
    limits = (trajectories.dt, trajectories.substeps, trajectories.max_speed, trajectories.max_acceleration)
    moved = np.asarray(_fly(policy, start, steps, _Limits(*limits)))
    agents = np.flatnonzero(trajectories.kind[0] == AGENT)
    there = np.broadcast_to(trajectories.mask[:, :1], trajectories.mask.shape)
    position, velocity = trajectories.position.copy(), trajectories.velocity.copy()
    position[:, :, agents], velocity[:, :, agents] = moved[..., :2], moved[..., 2:]
    fixed = [np.where(there[..., None], part, 0).astype(np.float32) for part in (position, velocity)]
    return replace(trajectories, position=fixed[0], velocity=fixed[1], mask=there.copy())


@dataclass(frozen=True)
class _Limits:
    dt: float
    substeps: int
    max_speed: float
    max_acceleration: float


@partial(jax.jit, static_argnames=("policy", "steps", "limits"))
def _fly(policy: Policy, start: State, steps: int, limits: _Limits) -> Float[Array, "S T N 4"]:
    def step(state: State, _: None):
        executed = limited(state.velocity, policy(state, None, None), limits)
        position, velocity = free_flight(state.position, state.velocity, executed, limits)
        drifted = state.obstacle + state.obstacle_velocity * limits.dt
        after = replace(state, position=position, velocity=velocity, obstacle=drifted)
        return after, jnp.concatenate([position, velocity], axis=-1)

    first = jnp.concatenate([start.position, start.velocity], axis=-1)
    _, rest = jax.lax.scan(step, start, length=steps)
    return jnp.swapaxes(jnp.concatenate([first[None], rest]), 0, 1)


def state_of(trajectories: Trajectories, row: int = 0) -> State:
    """The environment's state at a row; the first goal, zeros without one. Nobody chases anybody."""
    t = trajectories
    goals, obstacles, agents = (np.flatnonzero(t.kind[0] == kind) for kind in (GOAL, OBSTACLE, AGENT))
    position, velocity, there = (jnp.asarray(x[:, row]) for x in (t.position, t.velocity, t.mask))
    return make_state(
        position=position[:, agents],
        velocity=velocity[:, agents],
        goal=position[:, goals[0]] if len(goals) else jnp.zeros((len(t), 2), jnp.float32),
        obstacle=position[:, obstacles],
        obstacle_velocity=velocity[:, obstacles],
        agent_present=there[:, agents],
        obstacle_present=there[:, obstacles],
    )
