"""Calls of host functions from compiled ones, on the very buffers that XLA holds."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from envs.record import Array

Fill = Callable[..., None]
"""`fill(out, *args)` writes the NumPy arrays `out`, in the structure of `shapes`. It must keep none of them."""


def filled(fill: Fill, shapes: Any, *args: Array) -> Any:
    """Arrays like `shapes` that `fill` writes; pure, callable inside `jit`, one call after the other under `vmap`.

    On a CPU nothing is copied on the way: `jax.pure_callback`, which elsewhere carries the arrays to the host and back,
    makes JAX arrays of all that goes in and copies all that comes out, half of a millisecond for a thousand scenes.
    """

    def here(*args: Array) -> Any:
        def call(context: Any, out: Any, *args: Any) -> None:
            fill(jax.tree.map(np.asarray, out), *(np.asarray(x) for x in args))

        return buffer_callback(call, shapes, vmap_method="sequential")(*args)

    def elsewhere(*args: Array) -> Any:
        def call(*args: Array) -> Any:
            out = jax.tree.map(lambda shape: np.empty(shape.shape, shape.dtype), shapes)
            fill(out, *(np.asarray(x) for x in args))
            return out

        return jax.pure_callback(call, shapes, *args, vmap_method="sequential")

    return jax.lax.platform_dependent(*args, cpu=here, default=elsewhere)
