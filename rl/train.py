"""PPO from an imitated swarm: compiled iterations (rollout and update in one), resumable to the bit.

Everything random in an iteration is drawn from (seed, iteration, slot) and every scene from (seed, number), so weights,
optimizer, the scenes under way and the iteration are the full state: a continued run does what an uninterrupted one
would.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from envs.plain import plain
from envs.record import Array
from gnn.checkpoint import CheckpointError, Checkpoints, Model, check_same, describe
from gnn.config import TrainConfig
from gnn.freeze import frozen
from gnn.metrics import Metrics, read_metrics
from gnn.train import Progress, fingerprint
from rl.actor_critic import STD, ActorCritic, network_weights, swarm_actor_critic
from rl.collect import Rollout, collect, start
from rl.config import PPOConfig
from rl.devices import AXIS, SHARED, Split, agreed, compiled, gathered, leads, placed, together
from rl.ppo import Total, explained_variance, make_optimizer, make_samples, update
from rl.task import SwarmTask, Task
from swarm_mjcf.errors import SwarmError


class RLError(SwarmError):
    """Training cannot go on: an update is not finite. The last good checkpoint stays."""


@dataclass(frozen=True)
class Learner:
    """PPO on one task. Nothing compiled depends on the number of iterations."""

    config: PPOConfig
    start: Callable[[], dict]
    """The state before the first iteration: weights, optimizer, scenes under way (`runner`), iteration."""
    iterate: Callable[[dict], tuple[dict, dict[str, Array]]]
    """`state -> (state, metrics)`, compiled once. Where metric `finite` is 0 the weights are those of before."""


def make_learner(task: Task, actor: ActorCritic, config: PPOConfig, *, mesh: Mesh | None = None) -> Learner:
    """Raises SpecError for patterns that match nothing or freeze all, and for scenes that devices cannot share."""

    def begin(split: Split) -> dict:
        runner = start(task, config, split.slots)
        params = actor.init(jax.random.key(config.seed), task.observe(runner.world))
        mask = frozen(params, config.freeze)
        state = {"params": params, "optimizer": make_optimizer(mask, config).init(params), SHARED: runner}
        # The first weights stay in the state where the update needs them: a run that goes on has the same anchor.
        state |= {"anchor": params} if config.imitation_weight else {}
        return state | {"iteration": jnp.zeros((), jnp.int32)}

    def iterate(split: Split, state: dict) -> tuple[dict, dict[str, Array]]:
        params, number = state["params"], state["iteration"]
        mask = frozen(params, config.freeze)
        runner, rollout = collect(task, actor, params, state[SHARED], config, number)
        anchor = rollout.mean
        if config.imitation_weight:
            anchor = jax.vmap(lambda seen: actor.apply(state["anchor"], seen)[0])(rollout.observation)
        samples = make_samples(rollout, anchor, config)
        new, opt_state, metrics = update(
            actor, make_optimizer(mask, config), params, state["optimizer"], samples, config,
            iteration=number, mask=mask, total=split.total,
        )  # fmt: skip
        sound = _finite((new, opt_state, metrics))
        new, opt_state = jax.tree.map(
            lambda a, b: jnp.where(sound, a, b), (new, opt_state), (params, state["optimizer"])
        )
        metrics |= _measured(rollout, split.total)
        metrics |= {
            "explained_variance": explained_variance(samples, split.total),
            "std": jnp.exp(new[STD]).mean() / actor.unit,
            "finite": sound,
        }
        state = state | {"params": new, "optimizer": opt_state, SHARED: runner, "iteration": number + 1}
        return state, {name: jnp.asarray(value, jnp.float32) for name, value in metrics.items()}

    names = ("params", "optimizer", SHARED, *(("anchor",) if config.imitation_weight else ()), "iteration")
    everywhere, spread = PartitionSpec(), PartitionSpec(AXIS)
    of_state = {name: spread if name == SHARED else everywhere for name in names}
    return Learner(
        config,
        compiled(begin, mesh, config.scenes, of_state),
        compiled(iterate, mesh, config.scenes, (of_state, everywhere)),
    )


@together()
def train(
    config: PPOConfig,
    task: SwarmTask,
    model: Model,
    folder: str | Path,
    *,
    scratch: bool = False,
    minutes: float | None = None,
    mesh: Mesh | None = None,
    progress: Progress | None = None,
) -> Model:
    """Improves `model` in `folder` (checkpoints/, metrics.jsonl, tensorboard/) or goes on from its newest checkpoint.

    The checkpoints are those of a model like any other; what PPO needs to go on lies beside the weights. `scratch`:
    random weights of the model's preset. `minutes`: ends with the iteration in which that much wall time has been spent
    on iterations, compilation included, or after `config.iterations`. Raises SwarmError for a model that does not
    steer, SpecError for patterns that match nothing, CheckpointError for a folder of other settings, RLError when an
    update is not finite.

    Over several processes all call this with the same arguments and a folder that all of them reach; the first writes
    metrics and calls `progress`. Raises ProcessError when another process ends.
    """
    folder = Path(folder)
    actor = swarm_actor_critic(model, gamma=config.gamma, initial_std=config.initial_std, scratch=scratch)
    learner = make_learner(task, actor, config, mesh=mesh)
    about = _about(config, task, model, scratch)
    checkpoints = Checkpoints(folder / "checkpoints")
    found = checkpoints.newest()
    state = learner.start()
    if found is not None:
        step, had, _ = found
        try:
            kinds = {"model": type(model.config), "train": TrainConfig, "rl": PPOConfig, "reward": type(task.reward)}
            check_same(folder, had, about, **kinds)
        except CheckpointError:
            checkpoints.close()
            raise
        checkpoints.drop_after(step)
        whole = gathered(state, mesh)
        state = placed(_unpacked(checkpoints.restore(step, _packed(whole)), whole), state, mesh)
    done = int(state["iteration"])
    metrics, saved_at = Metrics(folder, after_step=done) if leads() else None, time.monotonic()
    spent = sum(row["seconds"] for row in read_metrics(folder / "metrics.jsonl"))
    most = math.inf if minutes is None else 60 * minutes
    try:
        (over,) = agreed(done >= config.iterations or spent >= most)
        while not over:
            begun = time.monotonic()
            state, found = learner.iterate(state)
            row = {name: float(value) for name, value in found.items()}
            done += 1
            seconds = time.monotonic() - begun
            spent += seconds
            row |= {"seconds": seconds, "spent": spent, "env_steps": float(done * config.scenes * config.steps)}
            row["env_steps_per_second"] = config.scenes * config.steps / seconds
            if metrics:
                metrics.write(done, **row)
            refused = not row["finite"]
            due = time.monotonic() - saved_at + 2 * seconds > config.checkpoint_seconds
            over, due = agreed(done >= config.iterations or spent >= most, due)
            if refused or due or over:
                checkpoints.save(done, _packed(gathered(state, mesh)), about)
                saved_at = time.monotonic()
            if refused:
                raise RLError(
                    f"{folder}: the update of iteration {done} is not finite and was refused; the weights before it "
                    f"are in the checkpoint. Take a smaller learning_rate than {config.learning_rate}"
                )
            if progress and leads():
                progress(done, config.iterations, row)
    finally:
        if metrics:
            metrics.close()
        checkpoints.close()
    params = jax.device_get(network_weights(state["params"]))
    return Model(model.config, model.scales, model.integrator, params, about | {"step": done})


def _about(config: PPOConfig, task: SwarmTask, model: Model, scratch: bool) -> dict:
    """What is stored with the weights; how long and how often to save changes nothing else."""
    env = task.env
    return {
        **{name: model.about[name] for name in ("preset", "train", "data", "range") if name in model.about},
        "initial": None if scratch else {"weights": fingerprint(model.params), **model.about},
        "rl": plain(config) | {"checkpoint_seconds": None, "iterations": None},
        "reward": plain(task.reward),
        "task": {
            "scene": plain(env.spec),
            "spawn": plain(env.spawn_config),
            "horizon": env.horizon,
            "terminate_on_contact": env.terminate_on_contact,
            "engine": env.engine.name,
        },
        **describe(model.config, model.scales, model.integrator),
    }


def _packed(state: dict) -> dict:
    """As checkpoints have it: the network's weights as any model's, and the whole state, leaf by leaf."""
    leaves = enumerate(jax.tree.leaves(state))
    # Orbax saves no empty arrays.
    kept = {f"{number:04d}": leaf for number, leaf in leaves if leaf.size}
    return {"params": network_weights(state["params"]), "rl": kept}


def _unpacked(packed: dict, like: dict) -> dict:
    """The whole state, in the structure of `like`."""
    leaves = enumerate(jax.tree.leaves(like))
    kept = [packed["rl"].get(f"{number:04d}", leaf) for number, leaf in leaves]
    return jax.tree.unflatten(jax.tree.structure(like), kept)


def _measured(rollout: Rollout, total: Total) -> dict[str, Array]:
    """What the scenes went through: means over agents and control steps, and over episodes that ended."""
    counts = rollout.valid[..., None] & rollout.present
    samples = jnp.maximum(total(_count(counts)), 1)
    over = rollout.ended & rollout.valid
    episodes = total(_count(over))
    found: dict[str, Any] = {name: total(value.sum()) / samples for name, value in rollout.measures.items()}
    return found | {
        "reward": total(rollout.reward.sum()) / samples,
        "return": total(rollout.gained.sum()) / jnp.maximum(episodes, 1),
        "episodes": episodes,
        "terminated": total(_count(rollout.terminated & rollout.valid)) / jnp.maximum(episodes, 1),
        "diverged": total(_count(rollout.diverged)),
        "experience": total(_count(rollout.valid)),
    }


def _count(which: Array) -> Any:
    return which.sum()


def _finite(tree: Any) -> Array:
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()
