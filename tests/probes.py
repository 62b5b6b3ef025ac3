"""Tasks with known answers for PPO, in the order in which one looks for a fault, and a tiny actor-critic for them."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp

from envs.dynamics import free_flight
from envs.record import Array, record
from envs.state import Contacts, State, no_contacts
from gnn.swarmnet import MLP
from rl.actor_critic import STD, VALUE, ActorCritic
from rl.task import Outcome
from swarm_mjcf.spec import SceneSpec

AGENTS = 2


@record
class ProbeWorld:
    """Every scene has a sign, +1 or -1, for each agent; the second agent is a ghost in every other scene."""

    sign: Array
    here: Array
    step: Array


class Probe:
    """Episodes of `length` steps; `reward(sign (S, N), action (S, N, 1), last (S, 1))` is paid in each."""

    def __init__(self, reward: Callable[..., Array], *, length: int = 1, truncates: bool = False) -> None:
        self.reward, self.length, self.truncates = reward, length, truncates

    def start(self, keys):
        """See `rl.task.Task`."""
        sign = jax.vmap(lambda key: jax.random.rademacher(key, (AGENTS,), jnp.float32))(keys)
        ghost = jax.vmap(lambda key: jax.random.bernoulli(jax.random.fold_in(key, 1)))(keys)
        here = jnp.stack([jnp.ones_like(ghost), ghost], axis=1)
        none = jnp.zeros(len(sign), jnp.int32)
        return ProbeWorld(sign=sign, here=here, step=none), jnp.ones(len(sign), bool)

    def observe(self, world):
        """The signs, (S, N, 1); what a ghost has there is absurd."""
        return jnp.where(world.here, world.sign, 1e3)[..., None]

    def present(self, world):
        """See `rl.task.Task`."""
        return world.here

    def step(self, world, action):
        """One step."""
        last = world.step + 1 >= self.length
        no = jnp.zeros_like(last)
        return Outcome(
            world=ProbeWorld(sign=world.sign, here=world.here, step=world.step + 1),
            reward=self.reward(world.sign, action, last[:, None]),
            terminated=no if self.truncates else last,
            truncated=last if self.truncates else no,
            diverged=no,
            measures={},
        )


def probe_actor() -> ActorCritic:
    """Two small functions of an agent's own sign."""
    mean, value = MLP((16,), 1), MLP((16,), 1)

    def init(key, observation):
        one, other = jax.random.split(key)
        return {
            "mean": mean.init(one, observation)["params"],
            VALUE: value.init(other, observation)["params"],
            STD: jnp.full(1, jnp.log(0.3), jnp.float32),
        }

    def apply(params, observation):
        return mean.apply({"params": params["mean"]}, observation), value.apply({"params": params[VALUE]}, observation)[
            ..., 0
        ]

    return ActorCritic(init, apply, lambda observation: observation.reshape(-1, 1, 1), 1.0)


class Plain:
    """An engine in plain JAX for what is not about physics: free flight, and a contact wherever bodies overlap after
    it. It compiles in a second, and what was compiled can be kept, which callbacks into MuJoCo cannot."""

    name = "plain"

    def __init__(self, spec: SceneSpec) -> None:
        self.spec = spec

    def step(self, state: State, acceleration: Array) -> tuple[State, Contacts]:
        """See `envs.engines.engine.Engine`."""
        position, velocity = free_flight(state.position, state.velocity, acceleration, self.spec)
        position = jnp.where(state.agent_present[..., None], position, state.position)

        def overlap(others: Array, reach: float) -> Array:
            return jnp.sum((position[:, :, None] - others[:, None]) ** 2, axis=-1) < reach**2

        agents = overlap(position, 2 * self.spec.agent_radius) & ~jnp.eye(position.shape[1], dtype=bool)
        solids = overlap(state.obstacle, self.spec.agent_radius + self.spec.obstacle_radius)
        touched = [(flags.any(axis=2) & state.agent_present).astype(jnp.int32) for flags in (agents, solids)]
        contacts = replace(
            no_contacts(*position.shape[:2]),
            agent_states=touched[0], agent_events=touched[0], obstacle_states=touched[1], obstacle_events=touched[1],
        )  # fmt: skip
        return replace(state, position=position, velocity=velocity), contacts
