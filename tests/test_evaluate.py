"""Prediction error: by hand, against a slow second implementation, and with predictors whose error is known."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import make_trajectories
from learning import blank, published, quick_compiles

from envs.config import published as published_world
from envs.dynamics import free_flight, limited
from envs.experts.registry import make_expert
from envs.state import make_state
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, TrajectoryError
from gnn.evaluate import constant_velocity, natural_change, persistence, prediction_error


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


def states_of(data: Trajectories) -> np.ndarray:
    return np.concatenate([data.position, data.velocity], axis=-1).astype(np.float64)


def halving(params, history, graph, *, horizon):
    """Each step the state of the row before last is halved: wrong, but a function of two rows."""
    factor = 0.5 ** jnp.arange(1, horizon + 1)[None, :, None, None]
    return history[:, -2][:, None] * factor


def halving_by_hand(history: np.ndarray, step: int) -> np.ndarray:
    return history[-2] * 0.5**step


def slow_error(data: Trajectories, by_hand, *, window: int, horizon: int, agents_only: bool):
    """Mean and median over windows of the normalized error, one window, node and step at a time."""
    states, (scenes, rows, nodes) = states_of(data), data.mask.shape
    judged = [v for v in range(nodes) if not agents_only or data.kind[0, v] == AGENT]
    changes = [
        np.mean((states[s, t + 1, v] - states[s, t, v]) ** 2)
        for s in range(scenes) for t in range(rows - 1) for v in judged
        if data.mask[s, t, v] and data.mask[s, t + 1, v]
    ]  # fmt: skip
    errors = []
    for s in range(scenes):
        for t in range(rows - window - horizon + 1):
            history, terms = states[s, t : t + window], []
            for v in judged:
                if not data.mask[s, t : t + window, v].all():
                    continue
                for step in range(1, horizon + 1):
                    if data.mask[s, t + window - 1 + step, v]:
                        truth = states[s, t + window - 1 + step, v]
                        terms.append(np.mean((by_hand(history, step)[v] - truth) ** 2))
            if terms:
                errors.append(np.mean(terms))
    return np.mean(errors) / np.mean(changes), np.median(errors) / np.mean(changes)


@cache
def comings_and_goings() -> Trajectories:
    """Mixed compositions of the published world, in which some agents also enter late or leave early."""
    data = published(6, 12, seed=3, mixed=True)
    rng = np.random.default_rng(0)
    mask, first = data.mask.copy(), data.counts[0] + data.counts[1]
    for s in range(len(data)):
        mask[s, : rng.integers(0, 5), first] = False
        mask[s, rng.integers(6, 13) :, first + 1] = False
    there = mask[..., None]
    return replace(
        data, mask=mask, position=np.where(there, data.position, 0), velocity=np.where(there, data.velocity, 0)
    )


def test_the_data_of_the_next_tests_has_ghosts_of_every_kind():
    mask = comings_and_goings().mask
    assert not mask.all(axis=(1, 2)).any()
    assert (mask[:, :-1] & ~mask[:, 1:]).any(), "somebody must leave"
    assert (~mask[:, :-1] & mask[:, 1:]).any(), "somebody must enter"
    assert (~mask.any(axis=1)).any(), "somebody must never be there"


@pytest.mark.parametrize(("window", "batch"), [(2, 32), (3, 4)])
def test_the_metrics_are_those_of_the_slow_implementation(window: int, batch: int):
    data = comings_and_goings()
    found = prediction_error(halving, {}, data, window=window, horizons=(5, 1, 3), scenes_per_batch=batch)
    assert found.horizons == (1, 3, 5)
    for i, horizon in enumerate(found.horizons):
        for kind, agents_only in (("published", False), ("agents", True)):
            mean, median = slow_error(data, halving_by_hand, window=window, horizon=horizon, agents_only=agents_only)
            np.testing.assert_allclose(getattr(found, f"{kind}_mean")[i], mean, rtol=1e-4)
            np.testing.assert_allclose(getattr(found, f"{kind}_median")[i], median, rtol=1e-4)
        assert found.windows[i] == 6 * (13 - window - horizon + 1)


def test_a_case_by_hand():
    """One agent at 0, 1, 3 m with 0 velocity, beside a goal that stands: changes 1^2 and 2^2, each over 4 numbers."""
    position = np.zeros((1, 3, 2, 2))
    position[0, :, 1, 0] = [0, 1, 3]
    data = blank(position, np.zeros((1, 3, 2, 2)), [GOAL, AGENT])
    agents = (1 + 4) / 2 / 4
    np.testing.assert_allclose(natural_change(data), (agents / 2, agents))
    found = prediction_error(persistence, {}, data, window=1, horizons=(1, 2))
    # 1 step: errors 1 and 4 of mean 2.5, over a mean change of 2.5. 2 steps: one window, errors 1 and 9, mean 5.
    np.testing.assert_allclose(found.agents_mean, (1, 2))
    np.testing.assert_allclose(found.published_mean, (1, 2))
    np.testing.assert_allclose(found.agents_median, (1, 2))
    assert found.windows == (2, 1)
    # Step 1 alone: from both starts, 2.5 / 2.5. Step 2 alone: 9 / 2.5.
    np.testing.assert_allclose(found.by_step, (1, 3.6))


def test_displacement_is_of_agents_who_stay():
    """Two agents walk 1 and 3 m a row beside a goal that persistence predicts; the second leaves after row 2."""
    data = blank_walk()
    found = prediction_error(persistence, {}, data, window=1, horizons=(1, 2, 3))
    assert found.paths == (5, 3, 1)  # from rows 0, 1 both, from row 2 the first; ...
    np.testing.assert_allclose(found.fde, [(3 * 1 + 2 * 3) / 5, (2 * 2 + 6) / 3, 3])
    np.testing.assert_allclose(found.ade, [(3 * 1 + 2 * 3) / 5, (2 * 1.5 + 4.5) / 3, 2])
    np.testing.assert_allclose(found.displacement, found.fde)


def blank_walk() -> Trajectories:
    data = make_trajectories(scenes=1, rows=4, goals=1, obstacles=0, agents=2)
    mask, position = np.ones_like(data.mask), np.zeros_like(data.position)
    mask[0, 3, 2] = False
    position[0, :, 1, 0], position[0, :, 2, 1] = np.arange(4), 3 * np.arange(4)
    return replace(data, mask=mask, position=position, velocity=np.zeros_like(position))


def test_persistence_over_one_step_is_one_by_definition():
    found = prediction_error(persistence, {}, published(), window=1, horizons=(1,))
    np.testing.assert_allclose(found.published_mean, 1, rtol=1e-5)
    np.testing.assert_allclose(found.agents_mean, 1, rtol=1e-5)
    np.testing.assert_allclose(found.by_step, 1, rtol=1e-5)


def test_constant_velocity_makes_no_error_where_velocities_are_constant():
    rng = np.random.default_rng(0)
    start, speed = rng.uniform(-5, 5, (3, 1, 3, 2)), rng.uniform(-2, 2, (3, 1, 3, 2))
    speed[:, :, :1] = 0
    position = start + 0.1 * np.arange(20)[None, :, None, None] * speed
    data = blank(position, np.broadcast_to(speed, position.shape), [OBSTACLE, AGENT, AGENT])
    found = prediction_error(constant_velocity(0.1), {}, data, window=1, horizons=(1, 10))
    assert max(found.published_mean) < 1e-8
    assert prediction_error(constant_velocity(0.05), {}, data, window=1, horizons=(10,)).published_mean[0] > 1


def test_the_true_law_makes_no_error_at_40_steps():
    """The expert and free flight in the place of a network: what is left is rounding, in a world with bends."""
    data, world = published(), published_world(num_agents=3)
    expert = make_expert(world.expert)

    def law(params, history, graph, *, horizon):
        last = history[:, -1]

        def step(moving, _):
            position, velocity = moving[..., :2], moving[..., 2:]
            state = make_state(position=position, velocity=velocity, goal=last[:, 0, :2], obstacle=last[:, 1:2, :2])
            executed = limited(velocity, expert(state), world.scene)
            after = jnp.concatenate(free_flight(position, velocity, executed, world.scene), axis=-1)
            return after, jnp.concatenate([last[:, :2], after], axis=1)

        return jnp.swapaxes(jax.lax.scan(step, last[:, 2:], None, length=horizon)[1], 0, 1)

    found = prediction_error(law, {}, data, window=1)
    assert found.horizons == (1, 5, 10, 40)
    assert found.windows == (8 * 45, 8 * 41, 8 * 36, 8 * 6)
    assert max(found.published_median) < 1e-6
    assert max(found.published_mean) < 1e-4
    assert prediction_error(persistence, {}, data, window=1).published_mean[-1] > 10, "the task must not be trivial"


def test_horizons_longer_than_the_data_are_left_out():
    found = prediction_error(persistence, {}, published(6, 12, seed=3, mixed=True), window=3)
    assert found.horizons == (1, 5, 10)
    assert found.windows == (6 * 10, 6 * 6, 6)
    assert len(found.by_step) == 10


def test_trajectories_too_short_for_any_horizon_are_refused():
    with pytest.raises(TrajectoryError, match=r"have 4 rows.*needs at least 6"):
        prediction_error(persistence, {}, make_trajectories(rows=4), window=1, horizons=(5, 10))


def test_a_predictor_that_diverges_is_not_hidden():
    """A window whose prediction is NaN must not drop out of the mean."""

    def broken(params, history, graph, *, horizon):
        return persistence(params, history, graph, horizon=horizon).at[0].set(jnp.nan)

    found = prediction_error(broken, {}, published(), window=1, horizons=(1,))
    assert np.isnan(found.published_mean).all()
    assert np.isnan(found.agents_mean).all()
