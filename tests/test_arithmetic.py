"""Operations against hand counts; the rate and the seconds against each other."""

import time

import jax
import jax.numpy as jnp
import pytest

from swarmnet import arithmetic
from swarmnet.arithmetic import matrix_rate, operations, seconds_of


def test_a_product_of_matrices_is_two_operations_for_each_pair():
    a, b = jnp.ones((8, 16)), jnp.ones((16, 4))
    assert operations(lambda a, b: a @ b, a, b) == 2 * 8 * 16 * 4
    gradient = jax.grad(lambda a, b: jnp.sum((a @ b) ** 2), argnums=(0, 1))
    assert operations(gradient, a, b) >= 3 * 2 * 8 * 16 * 4


def test_the_fastest_call_counts_and_not_the_first(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(arithmetic, "SECONDS", 0.2)
    waits = iter([0.3, 0.05, *[0.02] * 1000])
    assert 0.02 <= seconds_of(lambda: time.sleep(next(waits))) < 0.05


def test_the_rate_is_that_of_a_machine(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(arithmetic, "SECONDS", 0.05)
    assert 1e8 < matrix_rate() < 1e16
