"""Policy in the loop: one compiled scan over control steps, recorded."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Float, Key

from envs.policy import Policy
from envs.record import Array, record
from envs.state import Contacts, State
from envs.swarm_env import SwarmEnv


@record
class Recording:
    """T + 1 states and the contacts of the T control steps between them."""

    start: State
    position: Float[Array, "S T1 N 2"]
    """Agents' positions [m] at steps 0..T."""
    velocity: Float[Array, "S T1 N 2"]
    contacts: Contacts
    """Fields with a time axis after the scenes: (S, T, N)."""


def rollout(
    env: SwarmEnv, policy: Policy, params: object, start: State, keys: Key[Array, " S"], *, steps: int
) -> Recording:
    """Runs `policy` for `steps` control steps from `start`; pure, for use inside `jit` (see `make_rollout`).

    The policy is called as `policy(state, params, step_keys)` with one key per scene.
    """

    def step(state: State, t: Array):
        step_keys = jax.vmap(partial(jax.random.fold_in, data=t))(keys)
        transition = env.step(state, policy(state, params, step_keys))
        return transition.state, (transition.state.position, transition.state.velocity, transition.contacts)

    _, (position, velocity, contacts) = jax.lax.scan(step, start, jnp.arange(steps))
    position = jnp.concatenate([start.position[None], position])
    velocity = jnp.concatenate([start.velocity[None], velocity])
    swap = partial(jnp.swapaxes, axis1=0, axis2=1)
    return Recording(
        start=start, position=swap(position), velocity=swap(velocity), contacts=jax.tree.map(swap, contacts)
    )


def make_rollout(env: SwarmEnv, policy: Policy, *, steps: int):
    """`(params, start, keys) -> Recording`, compiled once per number of scenes."""
    return jax.jit(lambda params, start, keys: rollout(env, policy, params, start, keys, steps=steps))
