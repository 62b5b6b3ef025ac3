"""Obstacles that move: where they are at every state, what they touch there, and that still ones change nothing."""

import functools
from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import assert_same, scene_state, truth

from envs.engines import make_engine
from envs.rollout import Recording, make_rollout
from envs.state import Contacts, State
from envs.swarm_env import SwarmEnv, check_obstacles, scene_keys
from envs.trajectories import from_recording
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

ENGINES = ("native", "mjx")
MOVING = SceneSpec(
    num_agents=2, num_obstacles=2, obstacle_radius=2.0, arena=30.0, dt=0.1, substeps=5, moving_obstacles=True
)
SINGLE = replace(MOVING, dt=0.02, substeps=1)
SCENES = 192
"""Of every batch: one compilation per engine and spec."""
H, SPEED, SHALLOW = 0.02, 10.0, 5e-4


@functools.cache
def stepper(spec: SceneSpec, engine: str):
    return jax.jit(make_engine(spec, engine).step)


def step(spec: SceneSpec, engine: str, state: State) -> tuple[State, Contacts]:
    still = np.zeros(state.position.shape, np.float32)
    return jax.device_get(stepper(spec, engine)(*jax.device_put((state, still))))


def moving(spec: SceneSpec, position, obstacle, obstacle_velocity, velocity=None, obstacle_present=None) -> State:
    state = scene_state(spec, position, velocity, obstacle=obstacle, obstacle_present=obstacle_present)
    return replace(state, obstacle_velocity=np.asarray(obstacle_velocity, np.float32))


def fly_by(obstacle_present=None) -> State:
    """Scenes j, j + 6, ...: an obstacle passes agent 0, which stands still, and reaches it at state j alone, by 0.5 mm.

    The obstacle moves 0.2 m per state, so that at the states beside it, it is out of reach. Nothing else is near.
    """
    states = np.arange(SCENES) % (MOVING.substeps + 1)
    place = np.zeros((SCENES, 2, 2))
    place[:, 0, 0], place[:, 0, 1] = -SPEED * H * states, 3 - SHALLOW
    place[:, 1] = 20, 20
    agents = np.tile([[0.0, 0.0], [0.0, -20.0]], (SCENES, 1, 1))
    velocity = np.tile([[SPEED, 0.0], [0.0, 0.0]], (SCENES, 1, 1))
    return moving(MOVING, agents, place, velocity, obstacle_present=obstacle_present)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_passing_obstacle_is_counted_once_at_each_of_the_states_1_to_k(engine: str):
    start = fly_by()
    after, contacts = step(MOVING, engine, start)
    once = np.minimum(np.arange(SCENES) % 6, 1)  # scene 0 touches at state 0, which belongs to the step before
    for field in ("obstacle_states", "obstacle_events"):
        np.testing.assert_array_equal(getattr(contacts, field), np.stack([once, 0 * once], axis=1), err_msg=field)
    np.testing.assert_allclose(contacts.obstacle_depth[:, 0], SHALLOW * once, atol=2e-5)
    assert np.argwhere(after.touching_obstacle).tolist() == [[j, 0, 0] for j in range(5, SCENES, 6)]  # state k alone
    assert not contacts.agent_states.any()
    np.testing.assert_allclose(after.obstacle[:, 0], start.obstacle[:, 0] + [SPEED * 0.1, 0], atol=1e-5)
    np.testing.assert_array_equal(after.obstacle[:, 1], start.obstacle[:, 1])
    np.testing.assert_array_equal(after.obstacle_velocity, start.obstacle_velocity)


@pytest.mark.parametrize("engine", ENGINES)
def test_absent_obstacles_stay_parked_and_touch_nothing(engine: str):
    start = fly_by(np.tile([False, True], (SCENES, 1)))  # its velocity is still given
    assert np.abs(start.obstacle[:, 0]).max() > 5 * MOVING.arena
    after, contacts = step(MOVING, engine, start)
    np.testing.assert_array_equal(after.obstacle, start.obstacle)
    assert not any(leaf.any() for leaf in jax.tree.leaves(contacts))


def crowded(spec: SceneSpec) -> State:
    rng = np.random.default_rng(1)
    position = rng.uniform(-3, 3, (SCENES, 2, 2))
    obstacle, pace = rng.uniform(-4, 4, (SCENES, 2, 2)), rng.uniform(-7, 7, (SCENES, 2, 2))
    present = np.arange(2) < rng.integers(0, 3, (SCENES, 1))
    return moving(spec, position, obstacle, pace * present[..., None], rng.uniform(-7, 7, position.shape), present)


@pytest.mark.parametrize(("engine", "spec"), [("native", SINGLE), ("native", MOVING), ("mjx", MOVING)])
def test_no_flag_is_wrong_against_float64_geometry_where_the_obstacle_is_after_the_step(engine: str, spec: SceneSpec):
    start = crowded(spec)
    after, contacts = step(spec, engine, start)
    np.testing.assert_allclose(after.obstacle, start.obstacle + start.obstacle_velocity * spec.dt, atol=2e-4)
    expected, before = truth(spec, after), truth(spec, replace(after, obstacle=start.obstacle))
    clear = ~expected.borderline
    # Judged where the obstacle was before, some flags would be wrong: the test can tell.
    assert (expected.obstacle != before.obstacle)[clear].sum() >= 5
    np.testing.assert_array_equal(after.touching_obstacle[clear], expected.obstacle[clear])
    np.testing.assert_array_equal(after.touching_agent[clear], expected.agent[clear])
    if spec.substeps == 1:
        np.testing.assert_array_equal(contacts.obstacle_states[clear], expected.obstacle.any(-1)[clear])
        np.testing.assert_allclose(contacts.obstacle_depth[clear], expected.obstacle_depth[clear], atol=2e-5)


def test_both_engines_agree_over_a_control_step_of_many_substeps():
    (here, native), (there, mjx) = (step(MOVING, engine, crowded(MOVING)) for engine in ENGINES)
    np.testing.assert_allclose(here.position, there.position, atol=1e-3)
    np.testing.assert_allclose(here.obstacle, there.obstacle, atol=1e-5)
    assert native.obstacle_states.sum() > 300
    for field in ("agent_states", "obstacle_states", "obstacle_events"):
        one, other = getattr(native, field), getattr(mjx, field)
        assert (one != other).mean() <= 0.01, field  # a state within rounding of touching


def test_obstacles_at_rest_give_the_bits_that_still_obstacles_give():
    start = replace(crowded(MOVING), obstacle_velocity=np.zeros((SCENES, 2, 2), np.float32))
    still = replace(MOVING, moving_obstacles=False)
    for spec in (MOVING, replace(MOVING, dt=0.02, substeps=1)):
        at_rest = step(spec, "native", start)
        assert at_rest[1].obstacle_states.any()
        assert_same(at_rest, step(replace(spec, moving_obstacles=False), "native", start))
    # And a scene whose obstacles do not move ignores the velocities it is given.
    assert_same(step(still, "native", crowded(MOVING))[1], step(still, "native", start)[1])


def test_without_contacts_obstacles_move_all_the_same():
    spec = replace(MOVING, contacts=False, substeps=1)
    after, _ = step(spec, "native", fly_by())
    np.testing.assert_allclose(after.obstacle[:, 0], fly_by().obstacle[:, 0] + [1.0, 0], atol=1e-5)


def test_an_obstacle_that_runs_an_agent_over_never_passes_it_unseen():
    """Head-on at 20 m/s, from many distances: every pair meets, and no agent ends up behind the obstacle's centre."""
    spec = SceneSpec(num_agents=1, num_obstacles=1, obstacle_radius=2.0, moving_obstacles=True)
    distance = 3.0 + np.linspace(0.05, 5.9, 200)
    zero = np.zeros(200)
    start = moving(
        spec,
        np.zeros((200, 1, 2)),
        np.stack([distance, zero], axis=1)[:, None],
        np.tile([[-10.0, 0.0]], (200, 1, 1)),
        np.tile([[10.0, 0.0]], (200, 1, 1)),
    )
    after, contacts = step(spec, "native", start)
    assert (contacts.obstacle_states > 0).all()
    assert (after.position[:, 0, 0] < after.obstacle[:, 0, 0]).all()
    # A mocap body has no velocity for MuJoCo: an agent sinks in by 4 steps of its way, 4 * 0.01 s * 10 m/s.
    np.testing.assert_allclose(contacts.obstacle_depth.max(), 0.4, atol=0.01)


ENV_SPEC = replace(MOVING, num_obstacles=1, arena=100.0)


def recorded() -> Recording:
    env = SwarmEnv(ENV_SPEC, engine="native")
    start = moving(
        ENV_SPEC,
        [[[0.0, 0.0], [9, 9]]] * 2,
        [[[5.0, -8.0]]] * 2,
        [[[-1.0, 2.0]]] * 2,
        obstacle_present=[[True], [False]],
    )

    def after_it(state: State, params: object, keys: object):
        return state.obstacle[:, :1] - state.position  # a policy sees the obstacle where it is now

    return jax.device_get(make_rollout(env, after_it, steps=3)(None, start, scene_keys(0, range(2))))


def test_a_rollout_records_the_obstacles_and_trajectories_have_their_velocities():
    recording = recorded()
    expected = np.array([5.0, -8.0]) + 0.1 * np.arange(4)[:, None] * [-1.0, 2.0]
    np.testing.assert_allclose(recording.obstacle[0, :, 0], expected, atol=1e-5)
    t = from_recording(recording, ENV_SPEC, {})
    np.testing.assert_allclose(t.position[0, :, 1], expected, atol=1e-5)
    np.testing.assert_array_equal(t.velocity[0, :, 1], [[-1.0, 2.0]] * 4)
    assert not t.position[1, :, 1].any()  # absent
    assert not t.velocity[1, :, 1].any()
    # Agent 0 was pulled, at each step, to where the obstacle was then: x' = x + v dt + u dt^2 (k + 1) / (2 k).
    pull = np.array([5.0, -8.0])
    first = pull * 0.01 * 6 / 10
    np.testing.assert_allclose(recording.position[0, 1, 0], first, atol=1e-5)
    second = first + pull * 0.01 + (expected[1] - first) * 0.01 * 6 / 10
    np.testing.assert_allclose(recording.position[0, 2, 0], second, atol=1e-5)


@pytest.mark.parametrize("velocity", [[8.0, 7.0], [np.nan, 0.0], [0.0, np.inf]])
def test_an_obstacle_that_outruns_the_speed_limit_is_refused_and_never_reaches_physics(velocity: list[float]):
    position, obstacle = [[[0.0, 0.0], [9, 9]]] * 2, [[[5.0, -8.0]]] * 2
    state = moving(ENV_SPEC, position, obstacle, [[velocity], [[6.0, 8.0]]])
    with pytest.raises(SpecError, match=r"at most max_speed = 10\.0 m/s") as caught:
        check_obstacles(state, ENV_SPEC)
    assert caught.value.field == "obstacle_velocity"
    after = jax.device_get(SwarmEnv(ENV_SPEC, engine="native").step(state, np.zeros((2, 2, 2), np.float32))).state
    assert np.isnan(after.position[0]).all()
    assert np.isfinite(after.position[1]).all()  # 10 m/s is allowed
    absent = moving(ENV_SPEC, position, obstacle, [[velocity], [[6.0, 8.0]]], obstacle_present=[[False], [True]])
    check_obstacles(absent, ENV_SPEC)
    check_obstacles(state, replace(ENV_SPEC, contacts=False))
