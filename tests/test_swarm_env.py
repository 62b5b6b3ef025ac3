"""The environment: limits as clips, endings told apart, sick scenes isolated, absent agents inert."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same, scene_state, scenes_of

from envs.config import SpawnConfig, clear
from envs.dynamics import clip_norm, free_flight
from envs.engines import make_engine
from envs.state import State
from envs.swarm_env import SwarmEnv, Transition, scene_keys
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

SPEC = SceneSpec(num_agents=3, num_obstacles=1, max_speed=10.0, max_acceleration=5.0, substeps=15)
APART = [[-50.0, 0.0], [0.0, 50.0], [50.0, 0.0]]


def step(env: SwarmEnv, state: State, acceleration) -> Transition:
    return jax.device_get(jax.jit(env.step)(state, np.asarray(acceleration, np.float32)))


def at_rest(scenes: int = 1, velocity=None, **masks) -> State:
    moving = None if velocity is None else [velocity] * scenes
    return scene_state(SPEC, [APART] * scenes, moving, obstacle=[[[0.0, -50.0]]] * scenes, **masks)


@pytest.fixture(scope="module")
def env() -> SwarmEnv:
    return SwarmEnv(SPEC, engine="native", horizon=3)


def test_accelerations_are_clipped_to_their_limit(env: SwarmEnv):
    after = step(env, at_rest(), [[[30, 40], [3, 4], [0, -2]]]).state
    # 50 m/s^2 shrinks to 5 in its own direction; 5 and 2 pass unchanged. All for 0.3 s.
    np.testing.assert_allclose(after.velocity[0], np.array([[3, 4], [3, 4], [0, -2]]) * 0.3, rtol=1e-5)


def test_speeds_are_clipped_to_their_limit(env: SwarmEnv):
    after = step(env, at_rest(velocity=[[10, 0], [9, 0], [0, 9.9]]), [[[0, 5], [5, 0], [0, 0]]]).state
    turned = np.array([10, 1.5]) * 10 / np.hypot(10, 1.5)
    np.testing.assert_allclose(after.velocity[0], [turned, [10, 0], [0, 9.9]], rtol=1e-5)
    assert np.linalg.norm(after.velocity, axis=-1).max() <= 10 * (1 + 1e-6)


def test_no_limits_clip_nothing():
    free = replace(SPEC, max_speed=float("inf"), max_acceleration=float("inf"), contacts=False, substeps=1)
    state = scene_state(free, [APART], [[[100, 0]] * 3])
    after = step(SwarmEnv(free, engine="native"), state, [[[1000, 0]] * 3]).state
    np.testing.assert_allclose(after.velocity, np.full((1, 3, 2), [400, 0]), rtol=1e-6)


def test_clipping_is_differentiable_at_zero():
    gradient = jax.grad(lambda v: clip_norm(v, 5.0).sum())
    np.testing.assert_array_equal(gradient(jnp.zeros((1, 2))), 1)
    assert np.isfinite(gradient(jnp.array([[30.0, 40.0]]))).all()


def test_clipping_survives_numbers_whose_squares_overflow():
    """3-4-5 triangles of any size: the direction is kept, and what is short enough is kept bit for bit."""
    for size in (2.0, 1e10, 1e25, 6e37):
        found = np.asarray(clip_norm(jnp.array([[3 * size, -4 * size]], jnp.float32), 5.0))
        np.testing.assert_allclose(found, [[3.0, -4.0]], rtol=1e-6)
        assert np.isfinite(jax.grad(lambda v: clip_norm(v, 5.0).sum())(jnp.array([[3 * size, -4 * size]]))).all()
    short = np.random.default_rng(0).normal(size=(100, 2)).astype(np.float32)
    np.testing.assert_array_equal(jax.jit(lambda v: clip_norm(v, 10.0))(short), short)


def test_a_free_step_is_free_flight_and_counts_itself(env: SwarmEnv):
    state = at_rest(velocity=[[1, 2], [3, -1], [0, 0]])
    u = np.array([[[1, 0], [0, 2], [-3, 1]]], np.float32)
    transition = step(env, state, u)
    position, velocity = free_flight(jnp.asarray(state.position), jnp.asarray(state.velocity), jnp.asarray(u), SPEC)
    np.testing.assert_allclose(transition.state.position, position, atol=1e-3)
    np.testing.assert_allclose(transition.state.velocity, velocity, atol=1e-3)
    assert transition.state.step.tolist() == [1]
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(transition.contacts))


def crash(scenes: int = 2) -> State:
    """Scene 0 is about to crash, the others are not."""
    position = np.array([APART] * scenes)
    position[0] = [[0, 0], [2.5, 0], [50, 0]]
    velocity = np.zeros_like(position)
    velocity[0] = [[5, 0], [-5, 0], [0, 0]]
    return scene_state(SPEC, position, velocity, obstacle=[[[0.0, -50.0]]] * scenes)


def test_a_contact_terminates_only_where_that_is_asked_and_only_its_scene():
    still = np.zeros((2, 3, 2))
    for asked in (False, True):
        env = SwarmEnv(SPEC, engine="native", horizon=5, terminate_on_contact=asked)
        transition = step(env, crash(), still)
        assert transition.contacts.agent_events.tolist() == [[1, 1, 0], [0, 0, 0]]
        assert transition.terminated.tolist() == [asked, False]
        assert transition.truncated.tolist() == [False, False]


def test_an_obstacle_and_a_wall_terminate_too():
    spec = replace(SPEC, walls=True)
    state = scene_state(
        spec,
        [[[0, 0], [0, 50], [50, 0]], [[98.7, 0], [0, 50], [50, 0]]],
        [[[0, -5], [0, 0], [0, 0]], [[5, 0], [0, 0], [0, 0]]],
        obstacle=[[[0, -8.5]], [[0, -50]]],
    )
    env = SwarmEnv(spec, engine="native", horizon=5, terminate_on_contact=True)
    transition = step(env, state, np.zeros((2, 3, 2)))
    assert transition.terminated.tolist() == [True, True]
    assert transition.contacts.obstacle_events.tolist() == [[1, 0, 0], [0, 0, 0]]
    assert transition.contacts.wall_events.tolist() == [[0, 0, 0], [1, 0, 0]]


def test_the_horizon_truncates_and_does_not_terminate(env: SwarmEnv):
    state, still = at_rest(2), np.zeros((2, 3, 2))
    endings = []
    for _ in range(4):
        transition = step(env, state, still)
        state = transition.state
        endings.append((transition.terminated.tolist(), transition.truncated.tolist()))
    no, yes = [False, False], [True, True]
    assert endings == [(no, no), (no, no), (no, yes), (no, yes)]


def test_a_scene_can_end_both_ways_at_once():
    env = SwarmEnv(SPEC, engine="native", horizon=1, terminate_on_contact=True)
    transition = step(env, crash(), np.zeros((2, 3, 2)))
    assert transition.terminated.tolist() == [True, False]
    assert transition.truncated.tolist() == [True, True]


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_a_non_finite_acceleration_makes_its_own_scene_nan_for_good(env: SwarmEnv, poison: float):
    state = crash(4)
    wanted = np.zeros((4, 3, 2))
    healthy = step(env, state, wanted)
    wanted[2, 1, 0] = poison
    sick = step(env, state, wanted)
    others = [0, 1, 3]
    assert_same(scenes_of(sick, others), scenes_of(healthy, others))
    assert np.isnan(sick.state.position[2]).all()
    assert np.isnan(sick.state.velocity[2]).all()
    later = step(env, sick.state, np.zeros((4, 3, 2)))
    assert np.isnan(later.state.position[2]).all()
    assert not later.contacts.agent_states[2].any()
    assert np.isfinite(later.state.position[others]).all()
    assert later.state.step.tolist() == [2, 2, 2, 2]


class Suspicious:
    """An engine that refuses non-finite numbers with an exception, as MuJoCo would with a warning and a reset."""

    name = "suspicious"

    def __init__(self) -> None:
        self.spec, self.calls = SPEC, 0
        self._engine = make_engine(SPEC, "native")

    def step(self, state, acceleration):
        def look(*arrays):
            self.calls += 1
            assert all(np.isfinite(array).all() for array in arrays)
            return np.zeros((), np.float32)

        seen = jax.ShapeDtypeStruct((), np.float32)
        zero = jax.pure_callback(look, seen, state.position, state.velocity, acceleration)
        return self._engine.step(state, acceleration + zero)


def test_nothing_non_finite_reaches_the_engine():
    engine = Suspicious()
    env = SwarmEnv(SPEC, engine=engine)
    wanted = np.zeros((3, 3, 2), np.float32)
    wanted[1, 0, 0] = np.nan
    sick = step(env, at_rest(3), wanted)
    step(env, sick.state, np.full((3, 3, 2), np.inf, np.float32))
    assert engine.calls == 2


def test_absent_agents_do_nothing_whatever_they_are_told(env: SwarmEnv):
    state = at_rest(2, agent_present=[[True, False, True], [True, True, True]])
    after = step(env, state, np.full((2, 3, 2), 3.0)).state
    np.testing.assert_array_equal(after.position[0, 1], state.position[0, 1])
    np.testing.assert_array_equal(after.velocity[0, 1], 0)
    assert (np.linalg.norm(after.velocity[0, [0, 2]], axis=-1) > 1).all()


def test_reset_gives_the_spawned_scenes_again(env: SwarmEnv):
    keys = scene_keys(3, range(5))
    assert_same(jax.device_get(env.reset(keys)), jax.device_get(env.reset(keys)))
    assert_same(jax.device_get(env.reset(keys)), jax.device_get(jax.jit(env.spawn)(keys)[0]))


def test_step_and_spawn_work_inside_one_jit(env: SwarmEnv):
    @jax.jit
    def episode(keys):
        state, ok = env.spawn(keys)
        state, _ = jax.lax.scan(lambda s, _: (env.step(s, -s.velocity).state, None), state, None, 3)
        return state, ok

    state, ok = episode(scene_keys(0, range(4)))
    assert ok.all()
    assert state.step.tolist() == [3] * 4


def test_an_engine_made_for_another_scene_is_refused():
    with pytest.raises(SpecError, match="engine made for the environment's spec") as caught:
        SwarmEnv(SPEC, engine=make_engine(replace(SPEC, agent_radius=2.0), "native"))
    assert caught.value.field == "engine"
    engine = make_engine(SPEC, "native")
    assert SwarmEnv(replace(SPEC), engine=engine).engine is engine


@pytest.mark.parametrize("horizon", [0, -3])
def test_an_episode_has_at_least_one_step(horizon: int):
    with pytest.raises(SpecError, match="horizon"):
        SwarmEnv(SPEC, engine="native", horizon=horizon)


def test_the_default_spawn_is_used_and_auto_is_native_on_a_cpu():
    env = SwarmEnv(clear().scene)
    assert env.spawn_config == SpawnConfig()
    assert env.engine.name == ("native" if jax.default_backend() == "cpu" else "mjx")
