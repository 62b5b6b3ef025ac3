"""Scores of sampled futures: by hand, on laws whose predictive distribution is known, and proper at the truth."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from learning import quick_compiles

from gnn.scores import Scores, central_band, energy_score, gaussian_nll, mean_scores, score_sums
from swarm_mjcf.errors import SpecError


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


def test_bands_are_order_statistics():
    samples = np.random.default_rng(0).permutation(np.arange(1.0, 20.0))[:, None].astype(np.float32)  # 1..19
    assert [float(x[0]) for x in central_band(samples, 0.9)] == pytest.approx([1, 19])
    assert [float(x[0]) for x in central_band(samples, 0.5)] == pytest.approx([5, 15])
    assert [float(x[0]) for x in central_band(samples, 0.52)] == pytest.approx([4.8, 15.2])


@pytest.mark.parametrize("count", [19, 24, 100])
def test_bands_cover_exactly_at_every_number_of_samples(count):
    draws = np.random.default_rng(count).gumbel(size=(count + 1, 20000)).astype(np.float32)
    for level in (0.5, 0.9):
        low, high = central_band(draws[1:], level)
        covered = float(((low <= draws[0]) & (draws[0] <= high)).mean())
        assert abs(covered - level) < 4 * np.sqrt(level * (1 - level) / 20000)


def test_levels_that_few_samples_cannot_tell_are_refused():
    with pytest.raises(SpecError, match="with 17 samples"):
        central_band(np.zeros((17, 3), np.float32), 0.9)
    with pytest.raises(SpecError, match="level"):
        central_band(np.zeros((17, 3), np.float32), 0.0)


def test_energy_score_by_hand():
    pair = np.array([[0.0, 0.0], [3.0, 4.0]], np.float32)  # 5 apart
    assert float(energy_score(pair, np.array([6.0, 8.0], np.float32))) == pytest.approx((10 + 5) / 2 - 5 / 2)
    assert float(energy_score(pair, np.array([0.0, 0.0], np.float32))) == pytest.approx(0)
    # One dimension: CRPS of three samples, pair differences 1, 2 and 3.
    three = np.array([[0.0], [1.0], [3.0]], np.float32)
    assert float(energy_score(three, np.array([2.0], np.float32))) == pytest.approx(
        (2 + 1 + 1) / 3 - (1 + 2 + 3) / 3 / 2
    )


def test_energy_score_of_a_normal_law_is_its_closed_form():
    """CRPS of N(0, 1) at y is y (2 Phi(y) - 1) + 2 phi(y) - 1 / sqrt(pi)."""
    samples = np.random.default_rng(0).normal(size=(4000, 1)).astype(np.float32)
    for y in (0.0, 1.0, -2.5):
        phi, cumulative = np.exp(-y * y / 2) / np.sqrt(2 * np.pi), float(jax.scipy.stats.norm.cdf(y))
        exact = y * (2 * cumulative - 1) + 2 * phi - 1 / np.sqrt(np.pi)
        assert float(energy_score(samples, np.array([y], np.float32))) == pytest.approx(exact, abs=0.04)


def test_nll_by_hand():
    cross = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]], np.float32)  # covariance 2/3 I
    expected = 0.5 * (1 / (2 / 3) + 2 * np.log(2 / 3) + 2 * np.log(2 * np.pi))
    assert float(gaussian_nll(cross, np.array([1.0, 0.0], np.float32))) == pytest.approx(expected, rel=1e-5)
    # Correlated: with the covariance's root R, the samples R c have NLL larger by log det R.
    root = np.array([[2.0, 0.0], [1.0, 0.5]], np.float32)
    turned = float(gaussian_nll(cross @ root.T, root @ np.array([1.0, 0.0], np.float32)))
    assert turned == pytest.approx(expected + np.log(1.0), rel=1e-4)


def test_equal_samples_have_a_density():
    same = np.ones((5, 2), np.float32)
    assert np.isfinite(float(gaussian_nll(same, np.ones(2, np.float32))))
    assert float(gaussian_nll(same, np.array([1.0, 1.01], np.float32))) == pytest.approx(
        0.5 * (100 + 4 * np.log(1e-3) + 2 * np.log(2 * np.pi)), rel=1e-3
    )


def test_too_few_samples_are_refused():
    with pytest.raises(SpecError, match="at least 2"):
        energy_score(np.zeros((1, 2), np.float32), np.zeros(2, np.float32))
    with pytest.raises(SpecError, match="more than the 2 dimensions"):
        gaussian_nll(np.zeros((2, 2), np.float32), np.zeros(2, np.float32))


@cache
def walks(paths: int, steps: int, *, seed: int, samples: int = 0, width: float = 1.0, pull: float = 0.9) -> np.ndarray:
    """AR(1) in two dimensions, `x' = pull x + width N(0, 1)`, from 0: (samples, B, h, V=3, 4), or without samples."""
    rng = np.random.default_rng(seed)
    shape = ((samples,) if samples else ()) + (paths, 3, 4)
    x, found = np.zeros(shape), []
    for _ in range(steps):
        x = pull * x + width * rng.normal(size=shape)
        found.append(x)
    return np.stack(found, axis=-3).astype(np.float32)


def scored(samples: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> Scores:
    mask = np.ones(truth.shape[:-1], bool) if mask is None else mask
    return mean_scores(jax.jit(score_sums)(samples, truth, mask))


PATHS, STEPS = 400, 6


def test_the_true_law_covers_what_it_says_and_an_overconfident_one_does_not():
    truth = walks(PATHS, STEPS, seed=0)
    right = scored(walks(PATHS, STEPS, seed=1, samples=60), truth)
    draws = PATHS * 3 * 2
    for level, covered in ((0.5, right.coverage_50), (0.9, right.coverage_90)):
        assert (np.abs(covered - level) < 4.5 * np.sqrt(level * (1 - level) / draws)).all()
    narrow = scored(walks(PATHS, STEPS, seed=1, samples=60, width=0.5), truth)
    assert (narrow.coverage_90 < 0.7).all()
    assert (narrow.coverage_50 < 0.4).all()
    np.testing.assert_allclose(narrow.width_90, right.width_90 / 2, rtol=1e-5)
    # The stationary law's spread is known: the variance of step h is the sum of 0.9^(2 i), i < h.
    spread = np.sqrt(np.cumsum(0.9 ** (2 * np.arange(STEPS))))
    np.testing.assert_allclose(right.width_90, 2 * 1.645 * spread, rtol=0.05)
    np.testing.assert_allclose(right.nll, np.log(2 * np.pi) + 2 * np.log(spread) + 1, atol=0.15)
    np.testing.assert_allclose(right.rmse, np.sqrt(2) * spread, rtol=0.08)


@pytest.mark.parametrize("wrong", [{"width": 0.6}, {"width": 1.6}, {"pull": 0.2}, {"shift": 1.0}])
def test_both_scores_are_best_at_the_true_law(wrong):
    truth = walks(PATHS, STEPS, seed=0)
    right = scored(walks(PATHS, STEPS, seed=1, samples=60), truth)
    other = dict(wrong)
    shift = other.pop("shift", 0.0)
    false = scored(walks(PATHS, STEPS, seed=1, samples=60, **other) + np.float32(shift), truth)
    assert false.energy[-1] > right.energy[-1]
    assert false.nll[-1] > right.nll[-1]


def test_sums_add_up_and_what_is_masked_does_not_count():
    truth, samples = walks(10, 3, seed=0), walks(10, 3, seed=1, samples=25)
    mask = np.random.default_rng(0).random(truth.shape[:-1]) < 0.6
    whole = scored(samples, truth, mask)
    parts = [score_sums(samples[:, p], truth[p], mask[p]) for p in (slice(0, 4), slice(4, 10))]
    added = mean_scores(jax.tree.map(jnp.add, *parts))
    spoiled = np.where(mask[..., None], truth, np.float32(1e6))
    for other in (added, scored(samples, spoiled, mask)):
        for name in vars(whole):
            np.testing.assert_allclose(getattr(other, name), getattr(whole, name), rtol=1e-4)
    nobody = mask.copy()
    nobody[:, 1] = False
    assert np.isnan(scored(samples, truth, nobody).energy).tolist() == [False, True, False]


@given(st.integers(0, 10_000), st.floats(-50, 50), st.floats(0, 6.3))
def test_moving_and_turning_the_world_changes_no_energy_and_no_likelihood(seed, shift, angle):
    rng = np.random.default_rng(seed)
    samples, truth = rng.normal(size=(25, 2)), rng.normal(size=2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for score in (energy_score, gaussian_nll):
        before = float(score(samples.astype(np.float32), truth.astype(np.float32)))
        after = float(score((samples @ turn.T + shift).astype(np.float32), (turn @ truth + shift).astype(np.float32)))
        assert after == pytest.approx(before, abs=2e-3)
