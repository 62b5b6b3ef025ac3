"""Policy in the loop: one compiled scan over control steps, recorded."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, Key

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
    """Fields with a time axis after the scenes: (S, T, N); `saturated` is (S, T)."""
    obstacle: Float[Array, "S T1 K 2"] | None = None
    """Obstacles' positions [m] at steps 0..T; None: they stood still where `start` has them."""


_POLICY = 2**31
"""Sets the policy's keys apart from those of the start, which come from the same key of the scene by small numbers."""


def step_keys(keys: Key[Array, " S"], step: Int[Array, "*S"]) -> Key[Array, " S"]:
    """The keys that a policy gets at a control step (of all scenes, or each its own), from the scenes' keys."""
    each = jnp.broadcast_to(jnp.asarray(step, jnp.int32), keys.shape)
    return jax.vmap(lambda key, t: jax.random.fold_in(jax.random.fold_in(key, _POLICY), t))(keys, each)


def rollout(
    env: SwarmEnv, policy: Policy, params: object, start: State, keys: Key[Array, " S"], *, steps: int
) -> Recording:
    """Runs `policy` for `steps` control steps from `start`; pure, for use inside `jit` (see `make_rollout`).

    The policy is called as `policy(state, params, step_keys(keys, t))` with one key per scene.
    """

    def step(state: State, t: Array):
        transition = env.step(state, policy(state, params, step_keys(keys, t)))
        return transition.state, (seen(transition.state), transition.contacts)

    def seen(state: State) -> dict[str, Array]:
        moving = {"obstacle": state.obstacle} if env.spec.moving_obstacles else {}
        return {"position": state.position, "velocity": state.velocity, **moving}

    _, (after, contacts) = jax.lax.scan(step, start, jnp.arange(steps))
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), seen(start), after)
    states, contacts = jax.tree.map(partial(jnp.swapaxes, axis1=0, axis2=1), (states, contacts))
    return Recording(start=start, contacts=contacts, **states)


def make_rollout(env: SwarmEnv, policy: Policy, *, steps: int):
    """`(params, start, keys) -> Recording`, compiled once per number of scenes."""
    return jax.jit(lambda params, start, keys: rollout(env, policy, params, start, keys, steps=steps))
