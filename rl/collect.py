"""Rollouts: many scenes under way at once, a fresh one wherever one has ended, all inside one compiled scan.

A scene that ended is started anew in the step after: that step's row holds the last observation and is no experience
(`valid` is off). So the value of a last observation, which truncation needs, comes without a second pass.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, UInt

from envs.record import Array, record
from gnn.family import Params
from rl.actor_critic import STD, ActorCritic, log_probability
from rl.config import PPOConfig
from rl.task import Observation, Task, World

_NOISE = 2**31
"""Sets the keys of exploration apart from those of scenes, which are smaller numbers."""


@record
class Runner:
    """S scenes under way. Slot i runs the global scenes i, i + S, i + 2 S, ... of the seed."""

    world: World
    slot: Int[Array, " S"]
    scene: UInt[Array, " S"]
    """Global number of the scene in each slot."""
    over: Bool[Array, " S"]
    """Scenes that have ended and start anew in the next step."""
    gained: Float[Array, " S"]
    """Undiscounted return of the episode so far, mean over its agents."""


@record
class Rollout:
    """T control steps of S scenes; time first, because minibatches are made of control steps."""

    observation: Observation
    """Leaves (T, S, ...)."""
    action: Float[Array, "T S N A"]
    mean: Float[Array, "T S N A"]
    """Means of the policy that acted."""
    log_prob: Float[Array, "T S N"]
    value: Float[Array, "T1 S N"]
    """T + 1 rows: the last is that of the state after the last step."""
    reward: Float[Array, "T S N"]
    terminated: Bool[Array, "T S"]
    ended: Bool[Array, "T S"]
    """Terminated, truncated or diverged."""
    valid: Bool[Array, "T S"]
    """Rows that are experience: neither a restart nor a step that diverged."""
    diverged: Bool[Array, "T S"]
    present: Bool[Array, "T S N"]
    gained: Float[Array, "T S"]
    """Return of the episode that ended in this row, else 0."""
    measures: dict[str, Float[Array, "T S N"]]


def start(task: Task, config: PPOConfig, slot: Int[Array, " S"]) -> Runner:
    """The first scenes; slots are global numbers, so that a part of them may run elsewhere."""
    scene = slot.astype(jnp.uint32)
    world, ok = task.start(_keys(config.seed, scene))
    return Runner(world=world, slot=slot, scene=scene, over=~ok, gained=jnp.zeros(len(slot), jnp.float32))


def collect(
    task: Task, actor: ActorCritic, params: Params, runner: Runner, config: PPOConfig, iteration: Int[Array, ""]
) -> tuple[Runner, Rollout]:
    """`config.steps` control steps of every scene; a scene's exploration depends on (seed, iteration, slot) alone."""
    apart = jnp.uint32(_NOISE) + iteration.astype(jnp.uint32)
    draw = jax.vmap(partial(jax.random.fold_in, jax.random.fold_in(jax.random.key(config.seed), apart)))
    keys = draw(runner.slot)
    ends = config.terminations is None or iteration < config.terminations

    def step(runner: Runner, t: Array):
        seen, here = task.observe(runner.world), task.present(runner.world)
        mean, value = actor.apply(params, seen)
        each = jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, t), mean.shape[1:]))(keys)
        action = mean + jnp.exp(params[STD]) * each
        outcome = task.step(runner.world, action)
        again = runner.over
        sick = outcome.diverged & ~again
        terminated = outcome.terminated & ends & ~again & ~sick
        ended = terminated | (outcome.truncated | outcome.diverged) & ~again
        valid = ~again & ~sick
        counts = valid[:, None] & here
        gained = runner.gained + jnp.where(counts, outcome.reward, 0).sum(axis=1) / jnp.maximum(here.sum(axis=1), 1)
        row = {
            "observation": seen,
            "action": action,
            "mean": mean,
            "log_prob": log_probability(mean, params[STD], action),
            "value": value,
            "reward": jnp.where(counts, outcome.reward, 0),
            "terminated": terminated,
            "ended": ended,
            "valid": valid,
            "diverged": sick,
            "present": here,
            "gained": jnp.where(ended & valid, gained, 0),
            "measures": {name: jnp.where(counts, measure, 0) for name, measure in outcome.measures.items()},
        }
        # A scene that diverged keeps its last finite state until it starts anew.
        world = _where(sick, runner.world, outcome.world)
        runner = replace(runner, world=world, over=ended, gained=jnp.where(ended, 0, gained))
        return _restarted(task, config, runner, again), row

    rows: dict[str, Any]
    runner, rows = jax.lax.scan(step, runner, jnp.arange(config.steps))
    _, last = actor.apply(params, task.observe(runner.world))
    rows["value"] = jnp.concatenate([rows["value"], last[None]])
    return runner, Rollout(**rows)


def _restarted(task: Task, config: PPOConfig, runner: Runner, again: Bool[Array, " S"]) -> Runner:
    """The next scene of its slot wherever `again`; one that cannot be made is passed over for the next."""
    total = jnp.uint32(config.scenes)

    def fresh(runner: Runner) -> Runner:
        scene = jnp.where(again, runner.scene + total, runner.scene)
        world, ok = task.start(_keys(config.seed, scene))
        return replace(
            runner, world=_where(again, world, runner.world), scene=scene, over=jnp.where(again, ~ok, runner.over),
            gained=jnp.where(again, 0, runner.gained),
        )  # fmt: skip

    # Starting costs as much as a step: only when a scene is over.
    return jax.lax.cond(again.any(), fresh, lambda runner: runner, runner)


def _keys(seed: int, scene: UInt[Array, " S"]) -> Array:
    return jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(scene)


def _where(which: Bool[Array, " S"], one: World, other: World) -> World:
    return jax.tree.map(lambda a, b: jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b), one, other)
