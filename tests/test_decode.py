"""The decoder: it is the physics of free flight, limits included; what stands, stands; horizons are repeated steps."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import scene_state
from learning import INTEGRATOR, NAMES, complete, initial, numpy_swarmnet, quick_compiles, random_swarm, scales, tiny

from envs.dynamics import free_flight, limited
from envs.swarm_env import SwarmEnv
from gnn.config import ModelConfig
from gnn.decode import Integrator, make_policy, make_predict
from gnn.graph import graph_of_state
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.spec import SceneSpec

COUNTS = (1, 2, 3)
FIRST = 3
ACTING = ("thesis-ch5", "best")
COARSE = replace(scales(), position=jnp.float32(50), velocity=jnp.float32(5), acceleration=jnp.float32(30))
"""Strong accelerations, so that the limits bite."""


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


@cache
def compiled(config: ModelConfig, integrator: Integrator, coarse: bool = False):
    predict = make_predict(config, COARSE if coarse else scales(), integrator)
    return jax.jit(predict, static_argnames="horizon")


def swarm(name: str, seed: int = 0, absent: float = 0.3):
    config = tiny(name)
    history, present, graph = random_swarm(seed, COUNTS, window=config.window, absent=absent)
    return config, history, present, graph, initial(config, scales(), history, graph)


def test_an_acceleration_passes_through_free_flight():
    config, history, present, graph, params = swarm("thesis-ch5")
    after = np.asarray(compiled(config, INTEGRATOR)(params, history, graph, horizon=1))[:, 0]
    acceleration = numpy_swarmnet(params, config, scales(), history, graph)
    x, v = history[:, 0, FIRST:, :2], history[:, 0, FIRST:, 2:]
    # dt 0.3 s in 4 substeps, by hand: v' = v + u dt, x' = x + v dt + u dt^2 (k + 1) / (2 k).
    expected = np.concatenate([x + 0.3 * v + acceleration * 0.09 * 5 / 8, v + 0.3 * acceleration], axis=-1)
    there = present[:, FIRST:]
    np.testing.assert_allclose(after[:, FIRST:][there], expected[there], rtol=1e-5, atol=1e-5)
    assert np.abs(acceleration).max() > 0.05


@pytest.mark.parametrize("name", ACTING)
def test_static_nodes_stay_and_ghosts_do_not_move(name: str):
    config, history, present, graph, params = swarm(name)
    history = np.where(present[:, None, :, None], history, 7.0).astype(np.float32)
    history[:, :, :FIRST, 2:] = 0
    after = np.asarray(compiled(config, INTEGRATOR)(params, history, graph, horizon=4))
    for step in range(4):
        np.testing.assert_array_equal(after[:, step, :FIRST], history[:, 0, :FIRST])
        np.testing.assert_array_equal(after[:, step][~present], history[:, 0][~present])
    assert (after[:, 0, FIRST:][present[:, FIRST:]] != history[:, 0, FIRST:][present[:, FIRST:]]).any(axis=-1).all()


def test_a_moving_obstacle_keeps_its_velocity():
    config, history, _, graph, params = swarm("best")
    history = history.copy()
    history[:, :, 1, 2:] = [3.0, -2.0]
    after = np.asarray(compiled(config, INTEGRATOR)(params, history, graph, horizon=4))
    for step in range(4):
        moved = history[:, 0, 1, :2] + np.float32(0.3 * (step + 1)) * np.float32([3, -2])
        np.testing.assert_allclose(after[:, step, 1, :2], moved, atol=1e-5)
        np.testing.assert_array_equal(after[:, step, 1, 2:], history[:, 0, 1, 2:])


def test_a_state_change_is_added_to_the_last_state():
    config, history, _, graph, params = swarm("thesis-ch3")
    after = np.asarray(compiled(config, INTEGRATOR)(params, history, graph, horizon=1))[:, 0]
    change = numpy_swarmnet(params, config, scales(), history, graph)
    np.testing.assert_allclose(after, history[:, -1] + change, rtol=1e-5, atol=1e-5)
    assert np.abs(change[:, :FIRST]).max() > 1e-3, "as published, static nodes are predicted too"


@pytest.mark.parametrize("name", NAMES)
def test_a_horizon_is_so_many_single_steps_each_fed_back(name: str):
    config, history, _, graph, params = swarm(name, absent=0.2)
    predict = compiled(config, INTEGRATOR)
    whole = np.asarray(predict(params, history, graph, horizon=3))
    assert whole.shape == (3, 3, 6, 4)
    for step in range(3):
        after = np.asarray(predict(params, history, graph, horizon=1))
        np.testing.assert_allclose(whole[:, step], after[:, 0], rtol=1e-4, atol=1e-5)
        history = np.concatenate([history[:, 1:], after], axis=1)


def test_limits_are_clips_of_the_best_preset_alone():
    for name in ACTING:
        config, history, _, graph, _ = swarm(name, absent=0)
        params = initial(config, COARSE, history, graph)
        after = np.asarray(compiled(config, INTEGRATOR, coarse=True)(params, history, graph, horizon=5))
        speed = np.linalg.norm(after[:, :, FIRST:, 2:], axis=-1)
        assert (speed.max() <= INTEGRATOR.max_speed * (1 + 1e-5)) == (name == "best")
        raw = numpy_swarmnet(params, config, COARSE, history, graph)
        assert np.linalg.norm(raw, axis=-1).max() > INTEGRATOR.max_acceleration, "the limits must bite"


def test_the_first_clipped_step_by_hand():
    config, history, _, graph, _ = swarm("best", absent=0)
    params = initial(config, COARSE, history, graph)
    after = np.asarray(compiled(config, INTEGRATOR, coarse=True)(params, history, graph, horizon=1))[:, 0, FIRST:]
    wanted = numpy_swarmnet(params, config, COARSE, history, graph)
    for b, i in np.ndindex(3, 3):
        x, v = np.split(history[b, 0, FIRST + i].astype(np.float64), 2)
        u = wanted[b, i] * min(1, 2.0 / np.linalg.norm(wanted[b, i]))
        faster = v + 0.3 * u
        faster = faster * min(1, 3.0 / np.linalg.norm(faster))
        u = (faster - v) / 0.3
        np.testing.assert_allclose(after[b, i], [*(x + 0.3 * v + u * 0.09 * 5 / 8), *faster], rtol=1e-4, atol=1e-5)


REGIMES = {
    "best": SceneSpec(num_agents=3, num_obstacles=2),
    "thesis-ch5": SceneSpec(
        num_agents=3, num_obstacles=2, contacts=False, substeps=7, max_speed=np.inf, max_acceleration=np.inf
    ),
}


@pytest.mark.parametrize("name", ACTING)
def test_prediction_and_physics_agree_in_free_flight(name: str):
    """The learned policy in MuJoCo goes where `predict` says, to 1e-5 of the arena's half-width, over 5 steps."""
    spec = REGIMES[name]
    rng = np.random.default_rng(0)
    start = scene_state(
        spec,
        np.array([[-60, 0], [0, 60], [60, 0]]) + rng.uniform(-5, 5, (4, 3, 2)),
        rng.uniform(-6, 6, (4, 3, 2)),
        goal=rng.uniform(-20, 20, (4, 2)),
        obstacle=np.array([[0, -60], [0, 0]]) + rng.uniform(-5, 5, (4, 2, 2)),
        agent_present=[[True, True, True], [True, False, True], [True, True, False], [False, False, True]],
        obstacle_present=[[True, True], [True, False], [False, False], [False, True]],
    )
    config = tiny(name)
    nodes, graph = graph_of_state(start, goal=True)
    params = initial(config, COARSE, np.asarray(nodes)[:, None], graph)
    policy = make_policy(config, COARSE)
    env = SwarmEnv(spec, engine="native", horizon=5)
    step = jax.jit(lambda state: env.step(state, policy(state, params)))
    wanted = np.asarray(jax.jit(policy)(start, params))
    executed = np.asarray(limited(start.velocity, jnp.asarray(wanted), spec))
    assert (np.abs(wanted - executed).max() > 1) == (name == "best"), "the limits must bite, where there are any"
    integrator = Integrator(spec.dt, spec.substeps, spec.max_speed, spec.max_acceleration)
    predicted = compiled(config, integrator, coarse=True)(params, nodes[:, None], graph, horizon=5)
    state, here = start, np.asarray(start.agent_present)
    for t in range(5):
        transition = jax.device_get(step(state))
        state = transition.state
        assert not transition.contacts.agent_states.any()
        assert not transition.contacts.obstacle_states.any()
        agents = np.asarray(predicted)[:, t, FIRST:]
        np.testing.assert_allclose(agents[here][:, :2], state.position[here], atol=1e-5 * spec.arena)
        np.testing.assert_allclose(agents[here][:, 2:], state.velocity[here], atol=1e-5 * spec.arena)


def test_free_flight_is_the_sum_of_its_substeps():
    """`predict` and this test use `free_flight`: here it is judged by stepping semi-implicit Euler."""
    rng = np.random.default_rng(0)
    x, v, u = (rng.normal(size=(6, 2)) for _ in range(3))
    position, velocity = free_flight(*(jnp.asarray(a, jnp.float32) for a in (x, v, u)), INTEGRATOR)
    for _ in range(4):
        v = v + u * 0.3 / 4
        x = x + v * 0.3 / 4
    np.testing.assert_allclose(position, x, atol=1e-6)
    np.testing.assert_allclose(velocity, v, atol=1e-6)


@pytest.mark.parametrize("config", [tiny("thesis-ch3"), replace(tiny("thesis-ch5"), output="state_change")])
def test_a_model_that_only_predicts_cannot_be_a_policy(config: ModelConfig):
    with pytest.raises(SwarmError, match="use preset thesis-ch5 or best"):
        make_policy(config, scales())


def test_a_policy_without_a_goal_has_no_goal_edges():
    spec = SceneSpec(num_agents=3, num_obstacles=1, goal=False)
    start = scene_state(spec, [[[-60, 0], [0, 60], [60, 0]]], obstacle=[[[0, 0]]])
    config = tiny("thesis-ch5")
    nodes, graph = graph_of_state(start, goal=False)
    params = initial(config, scales(), np.asarray(nodes)[:, None], graph)
    assert set(params["edge"]) == {"obstacle", "agent"}
    found = make_policy(config, scales(), goal=False)(start, params)
    by_hand = numpy_swarmnet(params, config, scales(), np.asarray(nodes)[:, None], graph)
    np.testing.assert_allclose(np.asarray(found), by_hand, rtol=1e-5, atol=1e-5)


def test_complete_graphs_of_the_tests_are_those_of_the_environment():
    spec = SceneSpec(num_agents=3, num_obstacles=2)
    start = scene_state(spec, [[[-60, 0], [0, 60], [60, 0]]], obstacle=[[[0, 0], [0, -60]]])
    _, graph = graph_of_state(start, goal=True)
    jax.tree.map(np.testing.assert_array_equal, complete(np.ones((1, 6), bool), COUNTS), graph)
