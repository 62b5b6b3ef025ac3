"""What no model of the mean can predict: random accelerations at every step, as wide as the situation makes them.

In a noisy world the spread of an expert's accelerations depends on the state (an obstacle ahead, a neighbour close by)
and on the direction: at the limit of speed it is all sideways. A small SwarmNet therefore gives two standard deviations
for each agent, along and across its heading, fitted by maximum likelihood to one-step residuals that the model of the
mean leaves on held-out data; the variance that its samples have already is not counted twice. What the model of the
mean does wrong at one step it tends to do wrong at the next, so the noise has a memory (an AR(1) process), measured on
the same residuals.
"""

from dataclasses import replace
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Key

from envs.record import Array, record
from gnn.config import ModelConfig
from gnn.decode import network, network_init
from gnn.family import Params
from gnn.features import Scales
from gnn.graph import Graph
from gnn.swarmnet import heading, turned, turned_back
from swarm_mjcf.errors import SwarmError

SPREAD = ModelConfig(
    frame=True, normalise=True, edge_hidden=(32,), message=16, node_hidden=(32,), aggregate=("sum", "mean", "max")
)
"""The network of the standard deviations: the two components of its output along and across the heading are their
logarithms, in units of `Scales.acceleration`."""
SMALLEST = 1e-3
"""Standard deviation [units of `Scales.acceleration`] below which nothing is told apart."""


class NoiseError(SwarmError):
    """Process noise cannot be fitted to these residuals."""


@record
class ProcessNoise:
    """Normal accelerations along and across the heading of every agent."""

    params: Params
    """Of the network `SPREAD`."""
    scales: Scales
    factor: Float[Array, ""]
    """Calibration: multiplies every standard deviation; 1 as fitted."""
    memory: Float[Array, ""]
    """Correlation of the noise of successive steps in units of its standard deviation; 0: drawn anew at every step."""

    def scaled(self, factor: float) -> "ProcessNoise":
        """The same noise with another calibration factor."""
        return replace(self, factor=jnp.asarray(factor, jnp.float32))


@record
class Residuals:
    """One-step errors of a model on held-out data, n situations."""

    history: Float[Array, "n 1 V 4"]
    """The state before the step."""
    graph: Graph
    error: Float[Array, "n N 2"]
    """True minus mean predicted acceleration, world frame [m/s^2]; 0 where an agent is absent."""
    variance: Float[Array, "n N 2"]
    """Of the model's own samples along and across the heading [m^2/s^4]; 0 for one that does not draw."""


@jax.jit
def spread(noise: ProcessNoise, last: Float[Array, "B V 4"], graph: Graph) -> Float[Array, "B N 2"]:
    """Standard deviations along and across the heading [m/s^2]; 0 for absent agents."""
    unit = noise.scales.acceleration
    vector = network(SPREAD, noise.scales)(noise.params, last[:, None], graph) / unit
    raw = along_across(last[:, -vector.shape[1] :, 2:], vector)
    here = graph.present[:, -raw.shape[1] :, None]
    return jnp.where(here, noise.factor * unit * (SMALLEST + jnp.exp(jnp.clip(raw, -12, 3))), 0)


def following(noise: ProcessNoise, key: Key[Array, ""], standard: Float[Array, "B N 2"]) -> Float[Array, "B N 2"]:
    """Standard normal numbers for the next step, correlated with those of the step before by `memory`."""
    fresh = jax.random.normal(key, standard.shape, standard.dtype)
    return noise.memory * standard + jnp.sqrt(1 - noise.memory**2) * fresh


def acceleration(
    noise: ProcessNoise, standard: Float[Array, "B N 2"], last: Float[Array, "B V 4"], graph: Graph
) -> Float[Array, "B N 2"]:
    """Standard normal numbers as accelerations of the agents, world frame [m/s^2]."""
    return to_world(last[:, -standard.shape[1] :, 2:], spread(noise, last, graph) * standard)


def along_across(velocity: Float[Array, "*n 2"], vector: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """Components of vectors along the velocities and to their left; the world's own for one who stands."""
    return turned(heading(velocity), vector)


def to_world(velocity: Float[Array, "*n 2"], parts: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """Back from components along and across the velocities to the world's."""
    return turned_back(heading(velocity), parts)


def fit_noise(
    residuals: Residuals,
    scales: Scales,
    *,
    steps: int = 800,
    batch: int = 256,
    learning_rate: float = 5e-3,
    seed: int = 0,
) -> ProcessNoise:
    """Maximum likelihood of the residuals under N(0, spread^2 + the variance the model's samples have) per direction.

    Adam, cosine learning rate. Raises NoiseError when no agent is present or the likelihood is not finite.
    """
    residuals = jax.tree.map(jnp.asarray, residuals)
    agents = residuals.error.shape[1]
    if not bool(residuals.graph.present[:, -agents:].any()):
        raise NoiseError("process noise: no agent is present in the residuals")
    optimizer = optax.adam(optax.cosine_decay_schedule(learning_rate, steps))

    def loss_of(params: Params, given: Residuals) -> Array:
        noise = _white(params, scales)
        last = given.history[:, -1]
        here = jnp.asarray(given.graph.present)[:, -agents:, None]
        error = along_across(last[:, -agents:, 2:], given.error)
        variance = jnp.where(here, spread(noise, last, given.graph) ** 2 + given.variance, 1)
        nll = 0.5 * (error * error / variance + jnp.log(variance))
        return jnp.where(here, nll, 0).sum() / jnp.maximum(2 * here.sum(), 1)

    @jax.jit
    def fit(key: Key[Array, ""], residuals: Residuals) -> tuple[Params, Array]:
        k_init, k_order = jax.random.split(key)
        first = jax.tree.map(lambda x: x[:1], residuals)
        params = network_init(SPREAD, scales)(k_init, first.history, first.graph)

        def one(carry: tuple, key: Key[Array, ""]):
            params, state = carry
            chosen = jax.random.randint(key, (batch,), 0, len(residuals.error))
            loss, gradient = jax.value_and_grad(loss_of)(params, jax.tree.map(lambda x: x[chosen], residuals))
            updates, state = optimizer.update(gradient, state, params)
            return (optax.apply_updates(params, updates), state), loss

        (params, _), loss = jax.lax.scan(one, (params, optimizer.init(params)), jax.random.split(k_order, steps))
        return cast(Params, params), loss[-1]

    params, loss = fit(jax.random.key(seed), residuals)
    if not np.isfinite(float(loss)):
        raise NoiseError(f"process noise: the likelihood of the residuals is {float(loss)}; are they finite?")
    return _white(params, scales)


def _white(params: Params, scales: Scales) -> ProcessNoise:
    return ProcessNoise(
        params=params, scales=scales, factor=jnp.ones((), jnp.float32), memory=jnp.zeros((), jnp.float32)
    )


def with_memory(noise: ProcessNoise, residuals: Residuals, scenes: int) -> ProcessNoise:
    """The noise with the correlation that successive residuals have, each in units of its own standard deviation.

    `residuals` of `scenes` scenes, row after row, as `one_step_residuals` gives them. Negative correlations, which a
    model's bias cannot make, count as none.
    """
    last = jnp.asarray(residuals.history)[:, -1]
    agents = residuals.error.shape[1]
    here = jnp.asarray(residuals.graph.present)[:, -agents:, None]
    width = jnp.sqrt(jnp.where(here, spread(noise, last, residuals.graph) ** 2 + residuals.variance, 1))
    error = jnp.where(here, along_across(last[:, -agents:, 2:], residuals.error) / width, 0)
    z, there = (x.reshape(len(x) // scenes, scenes, *x.shape[1:]) for x in (error, here))
    both = there[1:] & there[:-1]
    before, after = jnp.where(both, z[:-1], 0), jnp.where(both, z[1:], 0)
    size = jnp.sqrt(jnp.sum(before**2) * jnp.sum(after**2))
    return replace(noise, memory=jnp.clip(jnp.sum(before * after) / jnp.maximum(size, 1e-9), 0, 0.95))
