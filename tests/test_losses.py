"""The imitation loss: by hand, masked, and its gradient against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from learning import scales

from gnn.features import Scales
from gnn.losses import multi_step_loss

UNIT = np.array([0.4, 0.4, 0.2, 0.2])  # one-step changes in `scales()`


def random_case(seed: int):
    rng = np.random.default_rng(seed)
    predicted, truth = (rng.normal(size=(2, 3, 4, 4)).astype(np.float32) for _ in range(2))
    return predicted, truth, rng.random((2, 3, 4)) < 0.7


def loss(predicted, truth, mask, units: Scales | None = None) -> float:
    return float(multi_step_loss(jnp.asarray(predicted), jnp.asarray(truth), jnp.asarray(mask), units or scales()))


def test_a_value_by_hand():
    truth = np.zeros((1, 2, 1, 4), np.float32)
    predicted = np.array([[[[0.4, 0, 0, 0]], [[0, 0, 0.2, 0.4]]]], np.float32)
    # Step 1: one change of position, 1^2 / 4. Step 2: one and two changes of velocity, (1 + 4) / 4. Mean: 0.75.
    np.testing.assert_allclose(loss(predicted, truth, np.ones((1, 2, 1), bool)), 0.75, rtol=1e-6)


def test_persistence_of_a_typical_change_costs_one():
    truth = np.zeros((5, 3, 2, 4), np.float32)
    predicted = truth + UNIT.astype(np.float32)
    np.testing.assert_allclose(loss(predicted, truth, np.ones((5, 3, 2), bool)), 1, rtol=1e-6)


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), garbage=st.sampled_from([1e6, np.nan, np.inf]))
def test_masked_nodes_do_not_count_and_the_rest_is_a_plain_mean(seed: int, garbage: float):
    predicted, truth, mask = random_case(seed)
    terms = [
        np.mean(((predicted[i].astype(np.float64) - truth[i]) / UNIT) ** 2) for i in np.ndindex(mask.shape) if mask[i]
    ]
    predicted[~mask] = garbage
    np.testing.assert_allclose(loss(predicted, truth, mask), np.mean(terms), rtol=1e-5)


def test_nothing_present_costs_nothing():
    predicted, truth, mask = random_case(0)
    assert loss(predicted, truth, mask & False) == 0


def test_the_gradient_is_that_of_finite_differences():
    predicted, truth, mask = random_case(1)
    found = jax.grad(lambda p: multi_step_loss(p, jnp.asarray(truth), jnp.asarray(mask), scales()))(predicted)
    found, step = np.asarray(found), 0.25  # a parabola: central differences are exact for any step
    assert not found[~mask].any()
    rng = np.random.default_rng(2)
    for index in rng.permutation(np.argwhere(mask))[:6]:
        for component in range(4):
            up, down = predicted.copy(), predicted.copy()
            up[(*index, component)] += step
            down[(*index, component)] -= step
            slope = (loss(up, truth, mask) - loss(down, truth, mask)) / (2 * step)
            np.testing.assert_allclose(found[(*index, component)], slope, rtol=2e-3, atol=2e-5)


def test_masked_garbage_does_not_reach_the_gradient_of_others():
    predicted, truth, mask = random_case(3)
    dirty = np.where(mask[..., None], predicted, 1e30).astype(np.float32)

    def gradient(p):
        return np.asarray(
            jax.grad(lambda p: multi_step_loss(p, jnp.asarray(truth), jnp.asarray(mask), scales()))(jnp.asarray(p))
        )

    np.testing.assert_array_equal(gradient(dirty)[mask], gradient(predicted)[mask])
