"""Proximal policy optimisation (Schulman et al. 2017): pure functions from a rollout to new weights.

Every agent that is there is a sample of its own; ghosts, restarts and diverged steps count in nothing, and networks are
not run on them. Sums go through `total`, so that the same code runs on a part of the scenes per device: the result is
that of all of them together.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Bool, Float, Int

from envs.record import Array, record
from gnn.family import Params
from gnn.freeze import Mask, free_leaves
from rl.actor_critic import STD, VALUE, ActorCritic, entropy, log_probability
from rl.collect import Rollout
from rl.config import PPOConfig
from rl.gae import gae
from rl.task import Observation

Total = Callable[[Array], Array]
"""Sum over devices; the identity on one."""
ADVANTAGE_EPS = 1e-8


@record
class Samples:
    """What the update needs of a rollout (time first), or of its agents one by one (`by_agent`)."""

    observation: Observation
    action: Float[Array, "*n A"]
    log_prob: Float[Array, "*n"]
    advantage: Float[Array, "*n"]
    target: Float[Array, "*n"]
    """Of the value: advantage + value."""
    counts: Bool[Array, "*n"]
    """Agents that are there, in rows that are experience."""
    anchor: Float[Array, "*n A"]
    """The first policy's actions, which imitation weight keeps near to."""


@record
class Units:
    """What a minibatch's samples are measured by, over all devices."""

    number: Float[Array, ""]
    """Of samples that count."""
    centre: Float[Array, ""]
    """Mean advantage [reward]."""
    deviation: Float[Array, ""]
    """Of the advantages [reward]."""
    spread: Float[Array, ""]
    """Variance of the rollout's targets [reward^2], the unit of the value's error."""


@record
class Losses:
    """Terms of an update: shares of the means over a minibatch's samples, which add up to them."""

    policy: Float[Array, ""]
    value: Float[Array, ""]
    entropy: Float[Array, ""]
    imitation: Float[Array, ""]
    kl: Float[Array, ""]
    """From the policy that acted to the present one: mean of r - 1 - log r (Schulman 2020)."""
    clip_fraction: Float[Array, ""]


def alone(x: Array) -> Array:
    """`Total` of a single device."""
    return x


def make_samples(rollout: Rollout, anchor: Float[Array, "T S N A"], config: PPOConfig) -> Samples:
    """Advantages and targets of a rollout."""
    counts = rollout.valid[..., None] & rollout.present
    goes_on = ~rollout.ended[:-1] & rollout.valid[1:]
    follows = jnp.concatenate([goes_on, jnp.zeros_like(goes_on[:1])])[..., None]
    discount = config.gamma * (1.0 - rollout.terminated[..., None])
    advantage = gae(rollout.reward, rollout.value, discount, follows, config.gae_lambda)
    return Samples(
        observation=rollout.observation,
        action=rollout.action,
        log_prob=rollout.log_prob,
        advantage=advantage,
        target=advantage + rollout.value[:-1],
        counts=counts,
        anchor=anchor,
    )


def mean_and_variance(x: Array, counts: Bool[Array, "..."], total: Total = alone) -> tuple[Array, Array]:
    """Of the samples that count, over all devices."""
    number = jnp.maximum(total(counts.sum()), 1)
    mean = total(jnp.where(counts, x, 0).sum()) / number
    return mean, total(jnp.where(counts, (x - mean) ** 2, 0).sum()) / number


def units(part: Samples, spread: Float[Array, ""], total: Total = alone) -> Units:
    """Of a minibatch: advantages are normalised over its samples."""
    centre, variance = mean_and_variance(part.advantage, part.counts, total)
    number = jnp.maximum(total(part.counts.sum()), 1).astype(jnp.float32)
    return Units(number=number, centre=centre, deviation=jnp.sqrt(variance) + ADVANTAGE_EPS, spread=spread + 1e-6)


def by_agent(actor: ActorCritic, part: Samples) -> Samples:
    """A sample for every agent, (T S N, 1, ...), those that count before all others."""
    count = part.counts.size
    scenes = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), part)
    rest = {name: x.reshape(count, 1, *x.shape[2:]) for name, x in vars(scenes).items() if name != "observation"}
    order = jnp.argsort(~part.counts.reshape(count))
    return jax.tree.map(lambda x: x[order], Samples(observation=actor.views(scenes.observation), **rest))


def losses(
    actor: ActorCritic, params: Params, samples: Samples, config: PPOConfig, units: Units
) -> tuple[Array, Losses]:
    """The objective and its terms: what these samples contribute to the minibatch of which `units` are. (S, N, ...)"""
    mean, value = actor.apply(params, samples.observation)

    def share(x: Array) -> Array:
        return jnp.where(samples.counts, x, 0).sum() / units.number

    advantage = (samples.advantage - units.centre) / units.deviation
    log_ratio = log_probability(mean, params[STD], samples.action) - samples.log_prob
    log_ratio = jnp.where(samples.counts, log_ratio, 0)
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    away = jnp.sum(((mean - samples.anchor) / actor.unit) ** 2, axis=-1)
    terms = Losses(
        policy=-share(jnp.minimum(ratio * advantage, clipped * advantage)),
        value=0.5 * share((value - samples.target) ** 2) / units.spread,
        entropy=share(jnp.broadcast_to(entropy(params[STD]), samples.counts.shape)),
        imitation=share(away),
        kl=share(ratio - 1 - log_ratio),
        clip_fraction=share(jnp.abs(ratio - 1) > config.clip),
    )
    objective = terms.policy + config.value_weight * terms.value - config.entropy_weight * terms.entropy
    return objective + config.imitation_weight * terms.imitation, terms


def gradient(
    actor: ActorCritic, params: Params, part: Samples, config: PPOConfig, units: Units
) -> tuple[Params, Losses]:
    """Of the objective, and its terms: sums over chunks of this device's agents. Ghosts cost nothing, as there are only
    as many passes as it takes for those that count."""
    count = part.counts.size
    size = min(config.chunk or (256 if jax.default_backend() == "cpu" else 65536), count)
    agents = jax.tree.map(lambda x: jnp.pad(x, [(0, -count % size)] + [(0, 0)] * (x.ndim - 1)), by_agent(actor, part))

    def add(number: Array, sums: tuple[Params, Losses]) -> tuple[Params, Losses]:
        chunk = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, number * size, size), agents)
        found = jax.grad(lambda params: losses(actor, params, chunk, config, units), has_aux=True)(params)
        return jax.tree.map(jnp.add, sums, found)

    nothing = Losses(**dict.fromkeys(Losses.__annotations__, jnp.zeros((), jnp.float32)))
    passes = (part.counts.sum() + size - 1) // size
    return jax.lax.fori_loop(0, passes, add, (jax.tree.map(jnp.zeros_like, params), nothing))


def make_optimizer(mask: Mask, config: PPOConfig) -> optax.GradientTransformation:
    """Adam, clipped by global norm, for the actor (with the encoding that both share) and for the value's readout.

    Frozen leaves (`mask`) are in neither: they count in no norm and their updates are exactly 0.
    """

    def label(path: Any, stays: bool) -> str:
        return "frozen" if stays else "value" if path[0].key == VALUE else "actor"

    labels = jax.tree.map_with_path(label, mask)
    adam = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(config.learning_rate, eps=1e-5))
    return optax.partition({"actor": adam, "value": adam, "frozen": optax.set_to_zero()}, labels)


def update(
    actor: ActorCritic,
    optimizer: optax.GradientTransformation,
    params: Params,
    opt_state: Any,
    samples: Samples,
    config: PPOConfig,
    *,
    iteration: Int[Array, ""],
    mask: Mask,
    total: Total = alone,
) -> tuple[Params, Any, dict[str, Array]]:
    """Epochs of minibatches: `(weights, optimizer state, metrics)`.

    A minibatch is the same share of control steps of every scene, so it does not depend on how scenes are spread over
    devices. During the first `warmup` iterations, and those after the last of `terminations`, the value's readout alone
    moves. Once the policy has moved by `target_kl`, the rest of the update is passed over.
    """
    rows = config.steps // config.minibatches
    key = jax.random.fold_in(jax.random.key(config.seed + 1), iteration)
    order = jax.vmap(lambda epoch: jax.random.permutation(jax.random.fold_in(key, epoch), config.steps))(
        jnp.arange(config.epochs)
    ).reshape(-1, rows)
    _, spread = mean_and_variance(samples.target, samples.counts, total)
    warm = iteration < config.warmup
    if config.terminations:
        later = iteration - config.terminations
        warm |= (later >= 0) & (later < config.warmup)

    def one(carry: tuple[Params, Any, Array], chosen: Array):
        params, opt_state, stop = carry
        part = jax.tree.map(lambda x: x[chosen], samples)
        found, terms = jax.tree.map(total, gradient(actor, params, part, config, units(part, spread, total)))
        stop |= (terms.kl > config.target_kl) & ~warm
        step: Any = optimizer.update(found, opt_state, params)
        updates, after = step
        moved: Any = optax.apply_updates(params, updates)
        frozen_actor = {name: moved[name] if name == VALUE else part for name, part in params.items()}
        held = after._replace(inner_states=after.inner_states | {"actor": opt_state.inner_states["actor"]})
        new, state = _choose(warm, (frozen_actor, held), (moved, after))
        params, opt_state = _choose(stop, (params, opt_state), (new, state))
        return (params, opt_state, stop), (terms, optax.tree.norm(free_leaves(found, mask)), stop)

    (params, opt_state, _), (terms, norms, stops) = jax.lax.scan(one, (params, opt_state, jnp.zeros((), bool)), order)
    done = ~stops
    number = jnp.maximum(done.sum(), 1)
    metrics: dict[str, Any] = {
        f"loss_{name}" if name not in ("kl", "clip_fraction", "entropy") else name: jnp.where(done, x, 0).sum() / number
        for name, x in vars(terms).items()
    }
    metrics |= {
        "kl": terms.kl[jnp.argmax(jnp.where(done, jnp.arange(len(done)), -1))],
        "gradient_norm": jnp.where(done, norms, 0).sum() / number,
        "updates": done.mean(),
    }
    return params, opt_state, metrics


def explained_variance(samples: Samples, total: Total = alone) -> Float[Array, ""]:
    """Share of the returns' variance that the value knew: 1 is perfect, 0 is a constant."""
    _, of_targets = mean_and_variance(samples.target, samples.counts, total)
    _, of_errors = mean_and_variance(samples.advantage, samples.counts, total)
    return 1 - of_errors / jnp.maximum(of_targets, 1e-12)


def _choose(which: Array, one: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), one, other)
