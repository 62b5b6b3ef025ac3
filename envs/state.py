"""What the world is at an instant (`State`) and what happened between two (`Contacts`). Batch on the leading axis."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from envs.record import Array, record
from swarm_mjcf.spec import SceneSpec


@record
class State:
    """S scenes of up to N agents and up to K obstacles. Absent bodies are parked far away, still, and never counted."""

    position: Float[Array, "S N 2"]
    """Agents' positions [m]."""
    velocity: Float[Array, "S N 2"]
    """Agents' velocities [m/s]."""
    goal: Float[Array, "S 2"]
    """Goal [m]; zeros in a scene without one."""
    obstacle: Float[Array, "S K 2"]
    """Obstacles' positions [m]."""
    obstacle_velocity: Float[Array, "S K 2"]
    """Obstacles' constant velocities [m/s]; moved only in a scene with `SceneSpec.moving_obstacles`."""
    target: Int[Array, "S N M"]
    """Agents that each agent chases, -1 for none; M = 0 unless the expert is a chaser."""
    agent_present: Bool[Array, "S N"]
    obstacle_present: Bool[Array, "S K"]
    touching_agent: Bool[Array, "S N"]
    """Whether the agent touches another agent at this very state; onsets are counted against it."""
    touching_obstacle: Bool[Array, "S N K"]
    touching_wall: Bool[Array, "S N"]
    step: Int[Array, " S"]
    """Control steps since the reset."""


@record
class Contacts:
    """Contacts of one control step, over its states 1..k: each state of every substep exactly once, none twice."""

    agent_states: Int[Array, "S N"]
    """Number of the k states at which the agent touches another agent."""
    obstacle_states: Int[Array, "S N"]
    wall_states: Int[Array, "S N"]
    agent_events: Int[Array, "S N"]
    """Onsets: states at which the agent touches another agent and did not at the state before."""
    obstacle_events: Int[Array, "S N"]
    """Onsets, each obstacle for itself."""
    wall_events: Int[Array, "S N"]
    agent_depth: Float[Array, "S N"]
    """Deepest penetration of another agent [m]; 0 without contact."""
    obstacle_depth: Float[Array, "S N"]
    wall_depth: Float[Array, "S N"]
    saturated: Int[Array, " S"]
    """Number of the k states at which an engine's contact cap was full, so that contacts may be missing from all fields
    above; 0 without caps."""


def no_contacts(scenes: int, agents: int) -> Contacts:
    """Contacts of a step in which nothing touched."""
    count, depth = jnp.zeros((scenes, agents), jnp.int32), jnp.zeros((scenes, agents), jnp.float32)
    return Contacts(
        agent_states=count,
        obstacle_states=count,
        wall_states=count,
        agent_events=count,
        obstacle_events=count,
        wall_events=count,
        agent_depth=depth,
        obstacle_depth=depth,
        wall_depth=depth,
        saturated=jnp.zeros(scenes, jnp.int32),
    )


def park(state: State, spec: SceneSpec) -> State:
    """Moves absent bodies to their waiting places, at rest."""
    agents, obstacles = (jnp.asarray(places, state.position.dtype).reshape(-1, 2) for places in spec.parking())
    here = state.agent_present[..., None]
    return replace(
        state,
        position=jnp.where(here, state.position, agents),
        velocity=jnp.where(here, state.velocity, 0),
        obstacle_velocity=jnp.where(state.obstacle_present[..., None], state.obstacle_velocity, 0),
        obstacle=jnp.where(state.obstacle_present[..., None], state.obstacle, obstacles),
    )


def make_state(
    *,
    position: Float[Array, "S N 2"],
    velocity: Float[Array, "S N 2"],
    goal: Float[Array, "S 2"],
    obstacle: Float[Array, "S K 2"],
    agent_present: Bool[Array, "S N"] | None = None,
    obstacle_present: Bool[Array, "S K"] | None = None,
    obstacle_velocity: Float[Array, "S K 2"] | None = None,
    target: Int[Array, "S N M"] | None = None,
) -> State:
    """A state at step 0 that touches nothing; all bodies are present unless masks say otherwise. Positions [m]."""
    scenes, agents, _ = position.shape
    obstacles = obstacle.shape[1]
    return State(
        position=position,
        velocity=velocity,
        goal=goal,
        obstacle=obstacle,
        obstacle_velocity=jnp.zeros_like(obstacle) if obstacle_velocity is None else obstacle_velocity,
        target=jnp.zeros((scenes, agents, 0), jnp.int32) if target is None else target,
        agent_present=jnp.ones((scenes, agents), bool) if agent_present is None else agent_present,
        obstacle_present=jnp.ones((scenes, obstacles), bool) if obstacle_present is None else obstacle_present,
        touching_agent=jnp.zeros((scenes, agents), bool),
        touching_obstacle=jnp.zeros((scenes, agents, obstacles), bool),
        touching_wall=jnp.zeros((scenes, agents), bool),
        step=jnp.zeros(scenes, jnp.int32),
    )
