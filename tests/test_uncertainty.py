"""Sampled futures: members, dropout and noise each do what they say; in a noisy world whose law is known they cover."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning import INTEGRATOR, blank, complete, initial, quick_compiles, random_swarm, scales, tiny

from envs.dynamics import free_flight
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, TrajectoryError
from gnn.calibration import with_noise
from gnn.checkpoint import Model
from gnn.decode import Integrator, make_predict
from gnn.features import Scales
from gnn.process_noise import (
    SPREAD,
    NoiseError,
    ProcessNoise,
    Residuals,
    acceleration,
    along_across,
    fit_noise,
    following,
    spread,
    to_world,
    with_memory,
)
from gnn.scores import Scores
from gnn.uncertainty import Sampler, SamplerError, make_sampler, one_step_residuals, pushed, score_futures
from swarm_mjcf.errors import SpecError
from swarmnet.figures import svg
from swarmnet.figures_uncertainty import figure_3_9, most_spread, passing_share, scores_by_horizon

COUNTS = (1, 1, 3)


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


def model(*, dropout: float = 0.0, seed: int = 0) -> Model:
    config = replace(tiny("best"), dropout=dropout)
    history, _, graph = random_swarm(0, COUNTS)
    return Model(config, scales(), INTEGRATOR, initial(config, scales(), history, graph, seed), {})


def constant_noise(along: float, across: float) -> ProcessNoise:
    """The same standard deviations [m/s^2] everywhere: all weights 0 but the last bias."""
    history, _, graph = random_swarm(0, COUNTS)
    params = jax.tree.map(np.zeros_like, initial(SPREAD, Scales.ones(), history, graph))
    params["readout"]["layer0"]["bias"] = np.log(np.array([along, across], np.float32) - 1e-3).astype(np.float32)
    return ProcessNoise(params=params, scales=Scales.ones(), factor=jnp.ones(()), memory=jnp.zeros(()))


def coasting(step: Integrator):
    """Everybody keeps its velocity."""

    def predict(params, history, graph, *, horizon, key=None):
        ahead = step.dt * jnp.arange(1, horizon + 1)[None, :, None, None]
        last = history[:, -1:]
        return jnp.concatenate([last[..., :2] + ahead * last[..., 2:], last[..., 2:].repeat(horizon, 1)], axis=-1)

    return predict


def test_a_deterministic_model_without_noise_samples_its_prediction():
    history, _, graph = random_swarm(1, COUNTS)
    one = model()
    futures = make_sampler([one]).sample(jax.random.key(0), history, graph, 4, 3)
    assert futures.shape == (3, 3, 4, 5, 4)
    np.testing.assert_allclose(
        futures, np.repeat(one.predict(one.params, history, graph, horizon=4)[None], 3, 0), atol=1e-5
    )


def test_an_ensemble_samples_its_members_in_turn():
    history, _, graph = random_swarm(1, COUNTS)
    members = [model(seed=seed) for seed in range(3)]
    futures = make_sampler(members).sample(jax.random.key(0), history, graph, 3, 5)
    for number, future in enumerate(futures):
        expected = members[0].predict(members[number % 3].params, history, graph, horizon=3)
        np.testing.assert_allclose(future, expected, atol=1e-5)


def test_dropout_draws_anew_at_every_step_and_from_the_key_alone():
    history, _, graph = random_swarm(1, COUNTS)
    sampler = make_sampler([model(dropout=0.4)])
    futures = np.asarray(sampler.sample(jax.random.key(0), history, graph, 3, 6))
    assert (futures[:, :, :, 2:].std(axis=0).max(axis=(0, 2, 3)) > 1e-3).all()
    assert (futures[:, :, :, :2].std(axis=0) < 1e-5).all()  # goal and obstacle stand still
    np.testing.assert_array_equal(futures, sampler.sample(jax.random.key(0), history, graph, 3, 6))
    assert not np.array_equal(futures, sampler.sample(jax.random.key(1), history, graph, 3, 6))


def test_ghosts_and_static_nodes_feel_no_noise():
    history, present, graph = random_swarm(4, COUNTS, absent=0.4)
    sampler = replace(make_sampler([model()]), noise=constant_noise(1.0, 1.0))
    futures = np.asarray(sampler.sample(jax.random.key(0), history, graph, 3, 4))
    moved = futures.std(axis=0).max(axis=(1, 3)) > 1e-4  # (B, V)
    np.testing.assert_array_equal(moved, present & (np.arange(5) >= 2))
    speed = np.linalg.norm(futures[..., 2:, 2:], axis=-1)[
        :, present[:, 2:].nonzero()[0], :, present[:, 2:].nonzero()[1]
    ]
    assert speed.max() <= INTEGRATOR.max_speed * (1 + 1e-5)


def test_a_push_by_hand():
    before = np.array([[[0, 0, 0, 0], [0, 0, 1, 0]]], np.float32)  # a goal and an agent
    after = np.array([[[0, 0, 0, 0], [1, 0, 1, 0]]], np.float32)
    free = Integrator(dt=0.5, substeps=1, max_speed=float("inf"), max_acceleration=float("inf"))
    pushed_on = pushed(before, after, np.array([[[2.0, -4.0]]], np.float32), free)
    np.testing.assert_allclose(pushed_on[0], [[0, 0, 0, 0], [1.5, -1, 2, -2]])
    # Half of the push fits the limit of acceleration, and the integral of k substeps is shorter.
    bound = replace(free, substeps=2, max_acceleration=1.0)
    np.testing.assert_allclose(
        pushed(before, after, np.array([[[2.0, 0.0]]], np.float32), bound)[0, 1], [1 + 0.25 * 3 / 4, 0, 1.5, 0]
    )


def test_noise_is_drawn_along_and_across_the_heading():
    _, _, graph = random_swarm(0, COUNTS, batch=2000)
    last = np.zeros((2000, 5, 4), np.float32)
    last[:, 2:, 2:] = (3.0, 4.0)
    noise = constant_noise(0.5, 2.0)
    standard = np.random.default_rng(0).normal(size=(2000, 3, 2)).astype(np.float32)
    found = np.asarray(acceleration(noise, standard, last, graph)).reshape(-1, 2)
    axes = np.array([[0.6, 0.8], [-0.8, 0.6]], np.float32)
    np.testing.assert_allclose((found @ axes.T).std(axis=0), [0.5, 2.0], rtol=0.05)
    np.testing.assert_allclose(along_across(last[:, 2, 2:], found[:2000]), found[:2000] @ axes.T, atol=1e-5)
    np.testing.assert_allclose(to_world(last[:, 2, 2:], found[:2000]), found[:2000] @ axes, atol=1e-5)
    np.testing.assert_allclose(np.asarray(spread(noise.scaled(3.0), last, graph))[0, 0], [1.5, 6.0], rtol=1e-4)
    still = np.array([5.0, 7.0], np.float32)
    np.testing.assert_array_equal(along_across(np.zeros(2, np.float32), still), still)


def test_the_spread_of_residuals_is_found_where_it_depends_on_the_state():
    rng = np.random.default_rng(0)
    many = 3000
    history = rng.normal(0, 2, (many, 1, 3, 4)).astype(np.float32)
    graph = complete(np.ones((many, 3), bool), (1, 0, 2))
    fast = np.linalg.norm(history[:, 0, 1:, 2:], axis=-1) > 2
    width = np.where(fast[..., None], [0.3, 1.5], [0.9, 0.6])
    own = 0.25  # what the model's own samples spread already
    error = np.asarray(to_world(history[:, 0, 1:, 2:], rng.normal(0, np.hypot(width, own)).astype(np.float32)))
    residuals = Residuals(history=history, graph=graph, error=error, variance=np.full(width.shape, own**2, np.float32))
    noise = fit_noise(residuals, Scales.ones(), steps=400)
    found = np.asarray(spread(noise, history[:, 0], graph))
    clear = np.abs(np.linalg.norm(history[:, 0, 1:, 2:], axis=-1) - 2) > 0.7
    for group in (fast & clear, ~fast & clear):
        np.testing.assert_allclose(found[group].mean(axis=0), width[group][0], rtol=0.12)


@pytest.mark.parametrize("rho", [0.6, 0.0, -0.5])
def test_noise_remembers_as_much_as_the_residuals_do(rho):
    rng, rows, scenes = np.random.default_rng(0), 60, 20
    z = [rng.normal(size=(scenes, 3, 2))]
    for _ in range(rows - 1):
        z.append(rho * z[-1] + np.sqrt(1 - rho**2) * rng.normal(size=z[0].shape))
    history = np.zeros((rows * scenes, 1, 5, 4), np.float32)
    history[..., 2] = 1  # flies east: along is x
    residuals = Residuals(
        history=history,
        graph=complete(np.ones((rows * scenes, 5), bool), COUNTS),
        error=(np.concatenate(z) * [0.5, 2.0]).astype(np.float32),
        variance=np.zeros((rows * scenes, 3, 2), np.float32),
    )
    noise = with_memory(constant_noise(0.5, 2.0), residuals, scenes)
    assert float(noise.memory) == pytest.approx(max(rho, 0), abs=0.04)
    before = rng.normal(size=(5000, 3, 2)).astype(np.float32)
    after = np.asarray(following(noise, jax.random.key(0), before))
    assert after.std() == pytest.approx(1, abs=0.03)
    assert (before * after).mean() == pytest.approx(float(noise.memory), abs=0.03)


def test_residuals_that_cannot_be_fitted_are_refused():
    history, _, graph = random_swarm(0, COUNTS)
    nothing = np.zeros((3, 3, 2), np.float32)
    residuals = Residuals(history=history, graph=graph, error=nothing, variance=nothing)
    with pytest.raises(NoiseError, match="no agent is present"):
        fit_noise(replace(residuals, graph=replace(graph, present=np.zeros((3, 5), bool))), scales(), steps=2)
    with pytest.raises(NoiseError, match="finite"):
        fit_noise(replace(residuals, error=nothing + np.float32(np.nan)), scales(), steps=2)


SIGMA, DT = 2.0, 0.1


def spring_step(x, v, goal):
    """Semi-implicit: 1.5 (goal - x) - 0.8 v."""
    a = 1.5 * (goal - x) - 0.8 * v
    return free_flight(x, v, a, Integrator(DT, 1, float("inf"), float("inf")))


@cache
def noisy_springs(scenes: int, rows: int, seed: int) -> Trajectories:
    """Two agents on springs to the goal, pushed by normal accelerations of `SIGMA` at every step."""
    rng = np.random.default_rng(seed)
    goal = rng.uniform(-2, 2, (scenes, 1, 2))
    x, v = rng.uniform(-3, 3, (scenes, 2, 2)), rng.uniform(-2, 2, (scenes, 2, 2))
    positions, velocities = [], []
    for _ in range(rows):
        positions.append(np.concatenate([goal, x], axis=1))
        velocities.append(np.concatenate([0 * goal, v], axis=1))
        push = SIGMA * rng.normal(size=v.shape)
        x, v = (np.asarray(part) for part in spring_step(x, v, goal))
        x, v = x + DT * DT * push, v + DT * push
    return blank(np.stack(positions, 1), np.stack(velocities, 1), [GOAL, AGENT, AGENT])


def predict_spring(params, history, graph, *, horizon, key=None):
    """The law itself, without its noise."""
    states, now = [], history[:, -1]
    for _ in range(horizon):
        x, v = spring_step(now[:, 1:, :2], now[:, 1:, 2:], now[:, :1, :2])
        now = jnp.concatenate([now[:, :1], jnp.concatenate([x, v], axis=-1)], axis=1)
        states.append(now)
    return jnp.stack(states, axis=1)


def spring_sampler() -> Sampler:
    free = Integrator(DT, 1, float("inf"), float("inf"))
    return Sampler(predict_spring, {"nothing": jnp.zeros((1, 1))}, Scales.of(noisy_springs(60, 24, 0)), free, 1)


def test_residuals_are_the_accelerations_that_were_not_predicted():
    data = noisy_springs(60, 24, 0)
    exact = one_step_residuals(spring_sampler(), data)
    assert exact.error.shape == (60 * 23, 2, 2)
    assert float(np.asarray(exact.error).std()) == pytest.approx(SIGMA, rel=0.05)
    np.testing.assert_allclose(exact.variance, 0, atol=1e-6)
    coast = one_step_residuals(replace(spring_sampler(), predict=coasting(spring_sampler().integrator)), data)
    change = np.diff(data.velocity, axis=1)[:, :, 1:] / DT
    np.testing.assert_allclose(np.asarray(coast.error).reshape(23, 60, 2, 2).swapaxes(0, 1), change, atol=1e-3)


def test_who_leaves_has_no_residual():
    data = noisy_springs(4, 6, 1)
    mask = data.mask.copy()
    mask[:, 3:, 1] = False
    here = mask[..., None]
    gone = replace(
        data, mask=mask, position=np.where(here, data.position, 0), velocity=np.where(here, data.velocity, 0)
    )
    found = one_step_residuals(spring_sampler(), gone)
    present = np.asarray(found.graph.present).reshape(5, 4, 3)
    assert present[:2].all()
    assert not present[2:, :, 1].any()
    assert (np.asarray(found.error).reshape(5, 4, 2, 2)[2:, :, 0] == 0).all()


def test_in_a_noisy_world_calibrated_bands_cover_at_every_horizon_and_the_bare_model_does_not():
    horizon = 15
    test = noisy_springs(150, 24, 2)
    bare = spring_sampler()
    noisy = with_noise(bare, noisy_springs(60, 24, 0), horizon=horizon, samples=30, fit_steps=200)
    assert noisy.noise is not None
    assert float(noisy.noise.factor) == pytest.approx(1, abs=0.15)
    scores = score_futures(noisy, test, horizon=horizon, samples=40, batch=75)
    assert ((scores.coverage_90 > 0.85) & (scores.coverage_90 < 0.95)).all()
    assert ((scores.coverage_50 > 0.43) & (scores.coverage_50 < 0.57)).all()
    narrow = replace(noisy, noise=noisy.noise.scaled(0.4))
    worse = score_futures(narrow, test, horizon=horizon, samples=40, batch=75)
    assert (worse.coverage_90 < 0.75).all()
    assert (worse.energy > scores.energy).all()
    assert (worse.nll > scores.nll).all()


def test_scores_do_not_depend_on_how_windows_are_batched():
    data, sampler = noisy_springs(7, 12, 3), spring_sampler()
    whole = score_futures(sampler, data, horizon=4, samples=20, starts=3, batch=21)
    split = score_futures(sampler, data, horizon=4, samples=20, starts=3, batch=8)  # the last batch is filled up
    for name in vars(whole):
        np.testing.assert_allclose(getattr(split, name), getattr(whole, name), rtol=1e-4, atol=1e-5)


def test_what_makes_no_sampler_is_refused():
    with pytest.raises(SamplerError, match="at least one"):
        make_sampler([])
    with pytest.raises(SamplerError, match="model 1 has another config"):
        make_sampler([model(), model(dropout=0.1)])
    other = replace(scales(), position=jnp.asarray(9.0, jnp.float32))
    with pytest.raises(SamplerError, match="other scales"):
        make_sampler([model(), replace(model(), scales=other)])
    with pytest.raises(TrajectoryError, match="at least 2 held-out scenes"):
        with_noise(spring_sampler(), noisy_springs(4, 6, 1).take(slice(0, 1)))
    with pytest.raises(TrajectoryError, match="needs at least 41"):
        score_futures(spring_sampler(), noisy_springs(4, 6, 1))
    with pytest.raises(SpecError, match="starts"):
        score_futures(spring_sampler(), noisy_springs(4, 6, 1), horizon=3, starts=0)


def flat(coverage: float, energy: float, nll: float, steps: int = 3) -> Scores:
    same = np.ones(steps)
    return Scores(0.5 * same, coverage * same, same, 2 * same, energy * same, nll * same, same)


def test_passing_share_by_hand():
    up = np.stack([np.zeros(5), np.linspace(-40, 40, 5)], axis=-1)
    paths = np.stack([up, up, up + np.array([20, 0]), up - np.array([20, 0])])
    share = passing_share(paths, np.zeros(2), 50.0, reach=0.01)
    assert share[75, 75] == 0.5  # (y, x): two of four pass the middle
    assert share[75, 105] == share[75, 45] == 0.25  # 20 m of 100 m to the right and left
    assert share[75, 90] == 0
    assert share[2, 75] == 0  # nobody gets that far down


def world(rows: int = 9) -> tuple[Trajectories, np.ndarray]:
    """A goal, an obstacle and three agents that fly east; the futures of the last one spread most, then the first's."""
    position = np.zeros((1, rows, 5, 2), np.float32)
    position[:, :, 0], position[:, :, 1] = (30, 0), (15, 10)
    position[0, :, 2:, 0] = np.arange(rows)[:, None] * 3
    position[0, :, 2:, 1] = np.array([-10.0, 0.0, 5.0])
    truth = blank(position, np.zeros_like(position), [GOAL, OBSTACLE, AGENT, AGENT, AGENT])
    rng = np.random.default_rng(0)
    futures = np.zeros((20, rows - 1, 5, 4), np.float32)
    futures[..., :2] = position[0, 1:]
    futures[:, :, 2:, :2] += np.array([2, 1, 3])[:, None] * rng.normal(size=(20, 1, 3, 2))
    return truth, futures


def test_figure_3_9_shows_truth_envelopes_and_histograms():
    truth, futures = world()
    assert most_spread(futures[:, :, 2:, :2]) == (2, 0)
    figure = figure_3_9(futures, truth, step=5)
    left, middle, first, second = figure.axes
    lines = {str(line.get_gid()): line for line in left.lines if "truth" in str(line.get_gid())}
    assert sorted(lines) == ["truth 0", "truth 1", "truth 2"]
    np.testing.assert_allclose(np.asarray(lines["truth 1"].get_ydata()), truth.position[0, :, 3, 1])
    assert {line.get_gid() for line in middle.lines if "truth" in str(line.get_gid())} == {"truth 2", "truth 0"}
    assert middle.get_title() == "agents 3 and 1"
    assert first.get_title() == "5 steps ahead (0.5 s)"
    assert [np.asarray(line.get_xdata())[0] for line in second.lines] == pytest.approx([-10, 0, 5])  # true y
    for wrong in ({"step": 9}, {"highlight": (0, 3)}):
        with pytest.raises(SpecError, match=next(iter(wrong))):
            figure_3_9(futures, truth, **{"step": 5, **wrong})


def test_scores_by_horizon_shows_the_numbers():
    scores = {"dropout": flat(0.9, 2.0, 5.0), "ensemble": flat(0.88, 1.5, 5.5)}
    figure = scores_by_horizon(scores, dt=0.3)
    coverage, energy, nll, width = figure.axes
    for ax, gid, value in (
        (coverage, "90 ensemble", 0.88), (coverage, "50 dropout", 0.5), (energy, "dropout", 2), (nll, "ensemble", 5.5),
        (width, "dropout", 2),
    ):  # fmt: skip
        line = next(line for line in ax.lines if line.get_gid() == gid)
        np.testing.assert_allclose(np.asarray(line.get_ydata()), value)
        assert np.asarray(line.get_xdata()).tolist() == [1, 2, 3]
    assert svg(figure) == svg(scores_by_horizon(scores, dt=0.3))


def test_one_step_at_a_time_is_the_multi_step_prediction_of_a_model_with_a_history():
    config = tiny("thesis-ch3")
    history, _, graph = random_swarm(2, COUNTS, window=config.window)
    params = initial(config, scales(), history, graph)
    sampler = make_sampler([Model(config, scales(), INTEGRATOR, params, {})])
    expected = make_predict(config, scales(), INTEGRATOR)(params, history, graph, horizon=3)
    np.testing.assert_allclose(sampler.sample(jax.random.key(0), history, graph, 3, 1)[0], expected, atol=1e-4)
