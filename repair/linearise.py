"""How the actions move with chosen weights: those weights as one vector, and the Jacobian by JAX."""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.record import Array
from gnn.family import Params
from gnn.features import Scales
from gnn.freeze import paths_of
from repair.network import Situations, actions
from swarm_mjcf.errors import SpecError

CHUNK = 512
"""Rows per compiled call."""


@dataclass(frozen=True)
class FreeWeights:
    """The weights that may change, in a fixed order; the others stay as they are to the bit."""

    chosen: tuple[bool, ...]
    """For every leaf in the order of the tree."""

    @classmethod
    def matching(cls, params: Params, patterns: Sequence[str]) -> "FreeWeights":
        """Leaves whose path matches a pattern, `edge/obstacle/layer2/*` or `readout/*`, say.

        Raises SpecError for a pattern that matches nothing, and where a chosen weight is not finite.
        """
        paths = paths_of(params)
        for pattern in patterns:
            if not any(fnmatchcase(path, pattern) for path in paths):
                raise SpecError("free", pattern, "a pattern that matches some of " + ", ".join(paths))
        chosen = tuple(any(fnmatchcase(path, pattern) for pattern in patterns) for path in paths)
        if not any(chosen):
            raise SpecError("free", list(patterns), "at least one pattern")
        for path, leaf in zip(paths, jax.tree.leaves(params), strict=True):
            if not np.isfinite(leaf).all():
                raise SpecError("weights", path, "finite numbers: this part has NaN or infinite ones")
        return cls(chosen)

    def leaves(self, params: Params) -> list[Any]:
        """The free leaves."""
        return [leaf for leaf, free in zip(jax.tree.leaves(params), self.chosen, strict=True) if free]

    def vector(self, params: Params) -> Float[Array, " P"]:
        """Their values side by side."""
        return np.concatenate([np.asarray(leaf, np.float64).ravel() for leaf in self.leaves(params)])

    def put(self, params: Params, vector: Float[Array, " P"]) -> Params:
        """The same weights with these values for the free ones, in float32 as networks hold them."""
        leaves, at = [], 0
        for leaf, free in zip(jax.tree.leaves(params), self.chosen, strict=True):
            if free:
                size = np.size(leaf)
                leaves.append(np.asarray(vector[at : at + size], np.float32).reshape(np.shape(leaf)))
                at += size
            else:
                leaves.append(leaf)
        return jax.tree.unflatten(jax.tree.structure(params), leaves)


class Linearised:
    """Jacobians of the actions for one choice of free weights; compiled once."""

    def __init__(self, free: FreeWeights, scales: Scales, *, normalise: bool) -> None:
        self.free = free

        def one(moving: list[Any], params: Params, situation: Situations) -> Any:
            leaves = iter(moving)
            mixed = [
                next(leaves) if free_ else leaf
                for leaf, free_ in zip(jax.tree.leaves(params), free.chosen, strict=True)
            ]
            whole = jax.tree.unflatten(jax.tree.structure(params), mixed)
            alone = jax.tree.map(lambda x: x[None], situation)
            return actions(whole, scales, alone, normalise=normalise)[0]

        def rows(params: Params, situations: Situations) -> Any:
            found = jax.vmap(jax.jacrev(one), in_axes=(None, None, 0))(free.leaves(params), params, situations)
            return jnp.concatenate([x.reshape(x.shape[0], 2, -1) for x in found], axis=-1)

        self._rows = jax.jit(rows)

    def jacobian(self, params: Params, situations: Situations) -> Float[Array, "R 2 P"]:
        """d u / d w [m/s^2 per unit of weight], in float32."""
        parts = [np.zeros((0, 2, self.free.vector(params).size), np.float32)]
        for first in range(0, len(situations), CHUNK):
            part = situations.take(slice(first, first + CHUNK))
            short = CHUNK - len(part)
            padded = jax.tree.map(lambda x, n=short: np.concatenate([x, np.repeat(x[:1], n, axis=0)]), part)
            as_given = jax.tree.map(lambda x: jnp.asarray(x, bool if x.dtype == bool else jnp.float32), padded)
            parts.append(np.asarray(self._rows(params, as_given))[: len(part)])
        return np.concatenate(parts)
