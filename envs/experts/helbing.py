"""Helbing et al. (2000) as the thesis's author coded it: forces from agents and obstacles, and the goal term."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Float

from envs.experts.config import HelbingConfig
from envs.experts.goal import goal_seeking
from envs.experts.pairs import Pairs, sum_over
from envs.policy import Policy
from envs.record import Array
from envs.state import State

Vectors = Float[Array, "S N 2"]
FORCES = ("repulsion", "body", "friction")


def helbing(config: HelbingConfig) -> Policy:
    """The expert `(state, params, key) -> acceleration`; it uses neither params nor key."""

    def policy(state: State, params: object = None, key: object = None) -> Vectors:
        total = jnp.zeros_like(state.position)
        for name, force in forces(state, config).items():
            if getattr(config, name):  # 0 times the infinity of a force that overflows would be NaN
                total = total + getattr(config, name) * force
        if config.goal:
            total = total + config.goal * _goal(state, config)
        return jnp.where(state.agent_present[..., None], total, 0)

    return policy


def rules(config: HelbingConfig) -> dict[str, Callable[[State], Vectors]]:
    """The four terms by name, without their weights: `state -> (S, N, 2)`."""
    return {
        "repulsion": lambda s: forces(s, config)["repulsion"],
        "body": lambda s: forces(s, config)["body"],
        "friction": lambda s: forces(s, config)["friction"],
        "goal": lambda s: _goal(s, config),
    }


def forces(state: State, config: HelbingConfig) -> dict[str, Vectors]:
    """Repulsion, body force and sliding friction, each summed over the agents and obstacles felt."""
    sums: dict[str, Array] = {f"{name} {axis}": jnp.zeros(()) for name in FORCES for axis in "xy"}
    if config.agents:
        contact = 2 * config.agent_size
        found = sum_over(
            config.interaction,
            lambda pairs: _pair_forces(pairs, contact, config.repulsion_range),
            position=state.position,
            velocity=state.velocity,
            present=state.agent_present,
        )
        sums = {name: sums[name] + found[name] for name in sums}
    if config.obstacles and state.obstacle.shape[1]:
        contact = config.agent_size + config.avoided_radius
        found = _pair_forces(_obstacles(state), contact, config.repulsion_range)
        sums = {name: sums[name] + found[name] for name in sums}
    shape, dtype = state.position.shape[:2], state.position.dtype
    planes = {name: jnp.broadcast_to(plane, shape).astype(dtype) for name, plane in sums.items()}
    return {name: jnp.stack([planes[f"{name} x"], planes[f"{name} y"]], axis=-1) for name in FORCES}


def _pair_forces(pairs: Pairs, contact: float | int, reach: float | int) -> dict[str, Array]:
    """Unweighted sums, with n the unit vector from the other to self, d their distance and r the contact distance.

    Repulsion `exp((r - d) / B) n`; for `d < r`: body `(r - d) n`, friction `(r - d) (dv - (dv . n) n)` with dv the
    velocity of the other minus own. Where two coincide n is 0.
    """
    d = pairs.distance
    x, y = -pairs.dx / jnp.maximum(d, 1e-12), -pairs.dy / jnp.maximum(d, 1e-12)
    repulsion = jnp.exp((contact - d) / reach)
    overlap = jnp.maximum(contact - d, 0)
    along = pairs.du * x + pairs.dw * y
    return {
        "repulsion x": pairs.total(repulsion * x),
        "repulsion y": pairs.total(repulsion * y),
        "body x": pairs.total(overlap * x),
        "body y": pairs.total(overlap * y),
        "friction x": pairs.total(overlap * (pairs.du - along * x)),
        "friction y": pairs.total(overlap * (pairs.dw - along * y)),
    }


def _obstacles(state: State) -> Pairs:
    """The obstacles as what every agent sees."""
    dx, dy = (state.obstacle[:, None, :, axis] - state.position[..., axis, None] for axis in (0, 1))
    du, dw = (state.obstacle_velocity[:, None, :, axis] - state.velocity[..., axis, None] for axis in (0, 1))
    return Pairs(seen=jnp.broadcast_to(state.obstacle_present[:, None], dx.shape), dx=dx, dy=dy, du=du, dw=dw)


def _goal(state: State, config: HelbingConfig) -> Vectors:
    return goal_seeking(state, cruise_speed=config.cruise_speed, slowdown_distance=config.slowdown_distance)
