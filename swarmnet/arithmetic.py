"""What a machine's arithmetic would allow: the rate of matrix products, operations of a function, seconds of a call."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

SECONDS = 6.0
"""Each figure is measured for about that long."""
SIDE = 1024
"""Of the square matrices whose product is the machine's rate."""


def matrix_rate() -> float:
    """Floating-point operations per second of a product of square matrices, float32 [1/s]."""
    one = jnp.ones((SIDE, SIDE), jnp.float32)
    product = jax.jit(lambda a: a @ a)
    return 2 * SIDE**3 / seconds_of(lambda: product(one))


def operations(function: Callable[..., Any], *arguments: Any) -> float:
    """Floating-point operations of a call, as XLA counts them in what it compiled; bodies of loops count once."""
    counted: Any = jax.jit(function).lower(*arguments).compile().cost_analysis()
    return float(counted["flops"])


def seconds_of(call: Callable[[], Any]) -> float:
    """Seconds of one call, the fastest of as many as fit into `SECONDS`; the first, which compiles, does not count."""
    jax.block_until_ready(call())
    best, begun = float("inf"), time.perf_counter()
    while time.perf_counter() - begun < SECONDS:
        before = time.perf_counter()
        jax.block_until_ready(call())
        best = min(best, time.perf_counter() - before)
    return best
