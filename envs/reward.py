"""The reward of the thesis (eq. 5.26-5.27), term by term; what collides is told by contacts, or by what you pass."""

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Float, Int

from envs.config import RewardConfig
from envs.record import Array, record
from envs.state import Contacts, State
from swarm_mjcf.spec import SceneSpec

Collisions = Callable[[State, Contacts], tuple[Array, Array]]
"""`(state, contacts) -> (with agents, with solids)`, both int (S, N): collisions charged for the step that led here."""


def coefficients(reward: RewardConfig | None, spec: SceneSpec) -> RewardConfig:
    """Those asked for, the published ones by default; nothing is paid for a goal in scenes that have none."""
    chosen = RewardConfig() if reward is None else reward
    return chosen if spec.goal else replace(chosen, goal_gain=0.0, goal_offset=0.0)


@record
class RewardTerms:
    """What each agent earned in one control step, by cause; absent agents earn 0."""

    goal: Float[Array, "S N"]
    """`gamma / (d + alpha) + beta` at distance d to the goal."""
    formation: Float[Array, "S N"]
    """`-rho` times the sum of the distances to all other agents."""
    agent_collision: Float[Array, "S N"]
    """`-c` per collision with agents."""
    solid_collision: Float[Array, "S N"]
    """`-c` per collision with obstacles and walls."""

    @property
    def total(self) -> Float[Array, "S N"]:
        """Equation 5.27: the sum."""
        return self.goal + self.formation + self.agent_collision + self.solid_collision


def by_contacts(state: State, contacts: Contacts) -> tuple[Int[Array, "S N"], Int[Array, "S N"]]:
    """1 where the agent touched at any substep state of the control step, as physics saw it: agents, solids."""
    solid = contacts.obstacle_states + contacts.wall_states
    return (contacts.agent_states > 0).astype(jnp.int32), (solid > 0).astype(jnp.int32)


def by_distance(agent_radius: float | int, obstacle_radius: float | int) -> Collisions:
    """As printed and as coded: every other agent closer than 2 a, every obstacle closer than a + a_o [m], counts.

    Only the state at the end of the step is seen. For the published world, whose bodies pass through each other; the
    published code has a = 2 m and a_o = 7 m.
    """

    def collisions(state: State, contacts: Contacts) -> tuple[Array, Array]:
        near = (_apart(state.position, state.position) < 2 * agent_radius) & _pairs(state)
        inside = _apart(state.position, state.obstacle) < agent_radius + obstacle_radius
        inside &= state.obstacle_present[:, None] & state.agent_present[..., None]
        return near.sum(axis=2, dtype=jnp.int32), inside.sum(axis=2, dtype=jnp.int32)

    return collisions


def reward_terms(
    state: State, contacts: Contacts, config: RewardConfig | None = None, *, collisions: Collisions = by_contacts
) -> RewardTerms:
    """The terms of the step that ended in `state` with `contacts`; pure, callable inside `jit`.

    With d in metres: `r_i = gamma / (d_ig + alpha) + beta - rho sum_j d_ij - c (collisions of i)`. As coded, rho d_ij
    is paid for colliding pairs too; the text leaves it out for them, a difference of at most 2 rho a per pair. Physics
    says that an agent touches agents, not how many: `by_contacts` charges c once, `by_distance` for every partner.
    """
    config = RewardConfig() if config is None else config
    here = state.agent_present
    with_agents, with_solids = collisions(state, contacts)
    to_goal = _apart(state.position, state.goal[:, None])[..., 0]
    others = jnp.where(_pairs(state), _apart(state.position, state.position), 0).sum(axis=2)

    def present(value: Array) -> Array:
        return jnp.where(here, value, 0).astype(state.position.dtype)

    return RewardTerms(
        goal=present(config.goal_gain / (to_goal + config.goal_softening) + config.goal_offset),
        formation=present(-config.formation * others),
        agent_collision=present(-config.collision * with_agents),
        solid_collision=present(-config.collision * with_solids),
    )


def reward(
    state: State, contacts: Contacts, config: RewardConfig | None = None, *, collisions: Collisions = by_contacts
) -> Float[Array, "S N"]:
    """Equation 5.27 for every agent: the sum of `reward_terms`."""
    return reward_terms(state, contacts, config, collisions=collisions).total


def _pairs(state: State) -> Array:
    """Which (i, j) are two different agents that are both there, (S, N, N)."""
    here = state.agent_present
    return here[:, :, None] & here[:, None] & ~jnp.eye(here.shape[1], dtype=bool)


def _apart(one: Array, other: Array) -> Array:
    """Distances [m] from each of `one` (S, N, 2) to each of `other` (S, M, 2)."""
    dx, dy = (one[:, :, None, axis] - other[:, None, :, axis] for axis in (0, 1))
    return jnp.sqrt(dx * dx + dy * dy)
