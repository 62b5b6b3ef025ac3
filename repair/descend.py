"""Distilling a constraint into weights by Adam: towards the actions that the filter would allow, at a price for less.

    L = mean [ 1/2 |u(w) - t|^2 + price * sum_c max(0, b_c + margin - n_c . u(w)) ]

over a pool of decisions with targets t, minibatch by minibatch. It is the penalty method that repair is compared with,
and where the counter-example loop starts its quadratic programs from.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Bool, Float

from envs.dynamics import Kinematics
from envs.record import Array, record
from gnn.family import Params
from gnn.features import Scales
from repair.config import DescentConfig
from repair.constraints.constraint import Constraint
from repair.encounters import Bodies, encounters
from repair.errors import RepairError
from repair.limits import as_executed
from repair.linearise import FreeWeights
from repair.network import Situations, actions

CHUNK = 250
"""Gradient steps per compiled call."""


@record
class Lessons:
    """R decisions to learn from."""

    situations: Situations
    target: Float[Array, "R 2"]
    """What the executed action should be [m/s^2]."""
    bound: Bool[Array, " R"]
    """Whether the constraint can be satisfied there, and so must."""

    def __len__(self) -> int:
        return len(self.target)


@dataclass
class Pool:
    """Lessons in arrays of a fixed size, so that more of them compile nothing anew. When it is full, the oldest go."""

    room: int
    lessons: Lessons | None = None
    count: int = 0
    at: int = 0

    def add(self, more: Lessons) -> None:
        """Takes up lessons, at most `room`."""
        more = jax.tree.map(lambda x: np.asarray(x, bool if x.dtype == bool else np.float32)[: self.room], more)
        if self.lessons is None:
            self.lessons = jax.tree.map(lambda x: np.zeros((self.room, *x.shape[1:]), x.dtype), more)
        places = (self.at + np.arange(len(more))) % self.room
        for place, rows in zip(jax.tree.leaves(self.lessons), jax.tree.leaves(more), strict=True):
            place[places] = rows
        self.at = (self.at + len(more)) % self.room
        self.count = min(self.count + len(more), self.room)


class Descent:
    """Adam on the free weights; compiled once for a pool's size."""

    def __init__(
        self,
        config: DescentConfig,
        free: FreeWeights,
        scales: Scales,
        constraint: Constraint,
        bodies: Bodies,
        kinematics: Kinematics,
        *,
        normalise: bool,
    ) -> None:
        self.config = config
        optimizer = optax.chain(optax.clip_by_global_norm(config.clip_norm), optax.scale_by_adam())

        def loss(leaves: list[Array], params: Params, lessons: Lessons) -> tuple[Array, dict[str, Array]]:
            mixed = iter(leaves)
            whole = jax.tree.unflatten(
                jax.tree.structure(params),
                [
                    next(mixed) if is_free else leaf
                    for leaf, is_free in zip(jax.tree.leaves(params), free.chosen, strict=True)
                ],
            )
            u = actions(whole, scales, lessons.situations, normalise=normalise)
            there = encounters(lessons.situations, bodies)
            planes = as_executed(constraint.half_planes(there, jax.lax.stop_gradient(u)), kinematics.max_acceleration)
            real = jnp.isfinite(planes.offset) & lessons.bound[:, None]
            needed = jnp.where(real, planes.offset, 0) + config.margin - jnp.sum(planes.normal * u[:, None], axis=-1)
            missed = jnp.sum(jnp.where(real, jnp.maximum(needed, 0), 0), axis=-1)
            deviation = jnp.sum((u - lessons.target) ** 2, axis=-1)
            value = 0.5 * deviation.mean() + config.price * missed.mean()
            return value, {"deviation": deviation.mean(), "missed": missed.mean()}

        def run(carry: Any, params: Params, pool: Lessons, count: Array, key: jax.Array, total: Array) -> Any:
            def one(carry: Any, step: Array) -> Any:
                leaves, state, mean = carry
                chosen = jax.random.randint(jax.random.fold_in(key, step), (config.batch,), 0, count)
                batch = jax.tree.map(lambda x: x[chosen], pool)
                gradient, seen = jax.grad(loss, has_aux=True)(leaves, params, batch)
                change, state = optimizer.update(gradient, state)
                rate = config.learning_rate * 0.5 * (1 + jnp.cos(jnp.pi * step / total))
                leaves = jax.tree.map(lambda w, d: w - rate * d, leaves, change)
                mean = jax.tree.map(lambda a, w: a + (1 - config.average) * (w - a), mean, leaves)
                return (leaves, state, mean), seen

            first, (leaves, state, mean) = carry
            (leaves, state, mean), seen = jax.lax.scan(one, (leaves, state, mean), first + jnp.arange(CHUNK))
            return (first + CHUNK, (leaves, state, mean)), jax.tree.map(jnp.mean, seen)

        self._run = jax.jit(run)
        self._start = optimizer.init
        self._free = free

    def __call__(
        self, params: Params, pool: Pool, *, seed: int, progress: Callable[[int, int, dict], None] | None = None
    ) -> tuple[Params, dict[str, float]]:
        """The running mean of the weights after `config.steps`, and the last metrics. Raises RepairError when weights
        are no longer finite; those given are never changed."""
        if pool.lessons is None:
            raise RepairError("there is nothing to learn from: no agent decided anything")
        steps = max(CHUNK, round(self.config.steps / CHUNK) * CHUNK)
        leaves = [jnp.asarray(leaf) for leaf in self._free.leaves(params)]
        lessons = jax.tree.map(jnp.asarray, pool.lessons)
        carry: Any = (jnp.asarray(0), (leaves, self._start(leaves), leaves))
        found: dict[str, float] = {}
        for done in range(CHUNK, steps + 1, CHUNK):
            carry, seen = self._run(carry, params, lessons, pool.count, jax.random.key(seed), jnp.float32(steps))
            found = {name: float(value) for name, value in seen.items()}
            if not np.isfinite(found["deviation"]):
                raise RepairError("the descent diverged: lower learning_rate or price", steps=done)
            if progress is not None:
                progress(done, steps, found)
        _, (_, _, mean) = carry
        vector = np.concatenate([np.asarray(leaf, np.float64).ravel() for leaf in mean])
        return self._free.put(params, vector), found
