"""Chasers (thesis, chapter 4): agents that accelerate toward others, who these are, and where they start."""

import math
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Key

from envs.experts.config import ChaserConfig, Interaction
from envs.neighbours import neighbours
from envs.policy import Policy
from envs.record import Array
from envs.state import State

Vectors = Float[Array, "S N 2"]


def chaser(config: ChaserConfig) -> Policy:
    """The expert `(state, params, key) -> acceleration`; it uses neither params nor key."""

    def policy(state: State, params: object = None, key: object = None) -> Vectors:
        acceleration = config.gain * displacement(state, config)
        return jnp.where(state.agent_present[..., None], acceleration, 0)

    return policy


def displacement(state: State, config: ChaserConfig) -> Vectors:
    """Sum of the displacements to the targets seen [m], or their mean with `average`; 0 without targets."""
    target, seen = state.target, targets_seen(state, config.interaction)
    if not target.shape[2]:
        return jnp.zeros_like(state.position)
    offset = state.position[jnp.arange(len(target))[:, None, None], target] - state.position[:, :, None]
    total = jnp.where(seen[..., None], offset, 0).sum(axis=2)
    return total / jnp.maximum(seen.sum(axis=2), 1)[..., None].astype(total.dtype) if config.average else total


def targets_seen(state: State, interaction: Interaction) -> Bool[Array, "S N M"]:
    """Which entries of `State.target` name a present agent that the chaser sees."""
    target, scenes = state.target, jnp.arange(len(state.target))[:, None, None]
    there = (target >= 0) & state.agent_present[scenes, target]
    if interaction.full:
        return there
    if interaction.nearest is None:
        offset = state.position[scenes, target] - state.position[:, :, None]
        return there & (jnp.sum(offset * offset, axis=-1) < (interaction.radius or 0) ** 2)
    index, valid = neighbours(
        state.position, state.agent_present, radius=interaction.radius, nearest=interaction.nearest
    )
    return there & ((target[..., None] == index[:, :, None]) & valid[:, :, None]).any(axis=3)


def draw_targets(
    key: Key[Array, ""], present: Bool[Array, " N"], targets: int, assignment: Literal["fixed", "scene", "agent"]
) -> Int[Array, "N M"]:
    """Whom each agent of a scene chases: different others that are present, every such choice equally likely.

    Their number is `targets` (`fixed`), or uniform in 1..targets, once for the whole scene (`scene`, "x" in the
    thesis's table 4.2) or for each agent (`agent`, "y" in the published code). Who finds fewer others chases all of
    them. Unused entries are -1.
    """
    agents = present.shape[0]
    k_number, k_choice = jax.random.split(key)
    shape = {"fixed": None, "scene": (), "agent": (agents,)}[assignment]
    number = targets if shape is None else jax.random.randint(k_number, shape, 1, targets + 1)
    others = jnp.where(present, present.sum() - 1, 0)  # whom each agent can choose from
    number = jnp.minimum(number, others)
    # Floyd's sampling without replacement, all agents at once: step m draws from 0..limit and takes the limit
    # itself where the drawn one was chosen before.
    draws = jax.random.uniform(k_choice, (targets, agents))
    chosen = jnp.full((agents, targets), -1, jnp.int32)
    for m in range(targets):
        limit = others - number + m
        drawn = jnp.minimum((draws[m] * (limit + 1)).astype(jnp.int32), limit)
        drawn = jnp.where((chosen == drawn[:, None]).any(axis=1), limit, drawn)
        chosen = chosen.at[:, m].set(jnp.where(m < number, drawn, -1))
    # From ranks among the present others to agents: skip oneself, then look up.
    rank = jnp.cumsum(present) - 1
    chosen = jnp.where(chosen >= rank[:, None], chosen + (chosen >= 0), chosen)
    everyone = jnp.argsort(jnp.logical_not(present), stable=True).astype(jnp.int32)
    return jnp.where(chosen >= 0, everyone[chosen], -1)


def circle_start(
    key: Key[Array, ""], agents: int, *, radius: float | int = 20.0, speed_range: float | int = 2.0
) -> tuple[Float[Array, "N 2"], Float[Array, "N 2"]]:
    """Positions at uniform angles on a circle [m] and velocities U(-speed_range, speed_range)^2 [m/s], as published."""
    k_angle, k_velocity = jax.random.split(key)
    angle = jax.random.uniform(k_angle, (agents,), maxval=2 * math.pi)
    position = radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    return position, jax.random.uniform(k_velocity, (agents, 2), minval=-speed_range, maxval=speed_range)
