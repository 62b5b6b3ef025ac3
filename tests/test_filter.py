"""The run-time filter: exact against a general solver, and safe in physics."""

from dataclasses import replace

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import scene_state

from envs.rollout import make_rollout
from envs.state import State
from envs.swarm_env import SwarmEnv, scene_keys
from repair.config import ConstraintConfig
from repair.constraints.barrier import Barrier
from repair.constraints.constraint import HalfPlanes
from repair.constraints.disc import Disc
from repair.constraints.registry import make_constraint
from repair.encounters import Encounters, encounters
from repair.filter import (
    DIRECTIONS,
    LOOKS,
    SIDE,
    TIGHTEST,
    TOLERANCE,
    evasive,
    looks,
    make_filtered,
    nearest_allowed,
    safe_actions,
    shielded,
)
from repair.network import situations_of_state
from swarm_mjcf.spec import SceneSpec

LIMIT = 10.0


def random_planes(seed: int, rows: int, conditions: int, near: float = 8.0) -> tuple[np.ndarray, HalfPlanes]:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, (rows, conditions))
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return rng.normal(0, 9, (rows, 2)), HalfPlanes(normal=normal, offset=rng.uniform(-10, near, (rows, conditions)))


def violation(u: np.ndarray, planes: HalfPlanes) -> np.ndarray:
    return (planes.offset - np.sum(planes.normal * u[:, None], axis=-1)).max(axis=1)


@pytest.mark.parametrize("conditions", [1, 2, 3, 6])
def test_nearest_is_the_solver_s(conditions):
    wanted, planes = random_planes(conditions, 30, conditions)
    found, possible = map(np.asarray, nearest_allowed(wanted, planes, LIMIT))
    u, given, offset = cp.Variable(2), cp.Parameter(2), cp.Parameter(conditions)
    normal = cp.Parameter((conditions, 2))
    problem = cp.Problem(cp.Minimize(cp.sum_squares(u - given)), [normal @ u >= offset, cp.norm(u) <= LIMIT])
    # The action is shortened to the limit first: it is what would be executed.
    wanted = wanted * np.minimum(1, LIMIT / np.linalg.norm(wanted, axis=1))[:, None]
    for row in range(len(wanted)):
        given.value, normal.value, offset.value = wanted[row], planes.normal[row], planes.offset[row]
        problem.solve(solver=cp.CLARABEL)
        assert (problem.status in ("optimal", "optimal_inaccurate")) == bool(possible[row])
        if possible[row]:
            np.testing.assert_allclose(found[row], u.value, atol=2e-3)


def test_what_is_allowed_stays_and_what_helps_is_taken():
    wanted, planes = random_planes(7, 2000, 5)
    found, possible = map(np.asarray, nearest_allowed(wanted, planes, LIMIT))
    short = wanted * np.minimum(1, LIMIT / np.linalg.norm(wanted, axis=1))[:, None]
    allowed = violation(short, planes) <= 0
    assert allowed.sum() > 50
    np.testing.assert_allclose(found[allowed], short[allowed], rtol=1e-12)
    assert 50 < possible.sum() < 1950
    assert violation(found[possible], planes_of(planes, possible)).max() <= TOLERANCE
    assert np.linalg.norm(found, axis=1).max() <= LIMIT * (1 + 1e-9)
    # Where nothing is allowed, no action tried at random does much better than the one taken.
    hopeless = planes_of(planes, ~possible)
    taken = violation(found[~possible], hopeless)
    for seed in range(50):
        rng = np.random.default_rng(seed)
        angle, size = rng.uniform(0, 2 * np.pi, len(taken)), LIMIT * np.sqrt(rng.random(len(taken)))
        tried = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        assert (violation(tried, hopeless) > 0).all()
        better = taken - violation(tried, hopeless)
        assert np.quantile(better, 0.5) <= 0


def planes_of(planes: HalfPlanes, rows: np.ndarray) -> HalfPlanes:
    return HalfPlanes(normal=planes.normal[rows], offset=planes.offset[rows])


@pytest.mark.parametrize(("low", "high"), [(-3, 0), (-20, 0), (-20, 2)])
def test_of_many_conditions_all_are_checked(low, high):
    """24 half-planes: what counts as allowed satisfies all of them; where no more than 8 are missed by the action or
    nearer to it than what is allowed, it is the nearest."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, (500, 24))
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    planes = HalfPlanes(normal=normal, offset=rng.uniform(low, high, angle.shape))
    wanted = rng.normal(0, 9, (500, 2))
    found, possible = map(np.asarray, nearest_allowed(wanted, planes, LIMIT))
    assert (violation(found, planes)[possible] <= TOLERANCE).all()
    assert possible.mean() > 0.4
    u, given = cp.Variable(2), wanted * np.minimum(1, LIMIT / np.linalg.norm(wanted, axis=1))[:, None]
    checked = 0
    for row in range(40):
        constraints = [normal[row] @ u >= planes.offset[row], cp.norm(u) <= LIMIT]
        problem = cp.Problem(cp.Minimize(cp.sum_squares(u - given[row])), constraints)
        problem.solve(solver=cp.CLARABEL)
        allowed = problem.status in ("optimal", "optimal_inaccurate")
        assert allowed or not possible[row]
        if not allowed or u.value is None:
            continue
        tight = normal[row] @ given[row] - planes.offset[row]
        if (tight < np.linalg.norm(u.value - given[row]) + 1e-3).sum() <= TIGHTEST:
            checked += 1
            np.testing.assert_allclose(found[row], u.value, atol=2e-3)
    assert checked > 5 or low == -3


def test_absent_conditions_and_no_limit():
    wanted, planes = random_planes(3, 40, 3)
    gone = replace(planes, offset=np.where(np.arange(3) == 1, planes.offset, -np.inf))
    alone = HalfPlanes(normal=planes.normal[:, 1:2], offset=planes.offset[:, 1:2])
    for limit in (LIMIT, np.inf):
        ours, theirs = nearest_allowed(wanted, gone, limit), nearest_allowed(wanted, alone, limit)
        np.testing.assert_array_equal(ours[1], theirs[1])
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-9)
    free, possible = nearest_allowed(wanted, replace(planes, offset=np.full((40, 3), -np.inf)), np.inf)
    np.testing.assert_array_equal(free, wanted)
    assert possible.all()


def test_jax_agrees():
    wanted, planes = random_planes(5, 200, 4)
    ours, possible = nearest_allowed(wanted, planes, LIMIT)
    cast = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), planes)
    theirs, there = jax.jit(lambda u, p: nearest_allowed(u, p, LIMIT))(jnp.asarray(wanted, jnp.float32), cast)
    same = np.asarray(there) == possible
    assert same.mean() > 0.99
    np.testing.assert_allclose(np.asarray(theirs)[same & possible], ours[same & possible], atol=2e-2)


SPEC = SceneSpec(num_agents=3, num_obstacles=2)


def test_every_constraint_is_kept_where_it_can_be():
    rng = np.random.default_rng(0)
    angle, far = rng.uniform(0, 2 * np.pi, (60, 3)), rng.uniform(8.1, 20, (60, 3))
    state = scene_state(
        SPEC,
        far[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1),
        rng.normal(0, 6, (60, 3, 2)),
        obstacle=np.array([[0.0, 0.0], [40.0, 0.0]]) + np.zeros((60, 2, 2)),
        obstacle_present=np.ones((60, 2), bool),
    )
    s = situations_of_state(state)
    wanted = rng.normal(0, 8, (180, 2))
    for name in ("barrier", "disc", "polygon", "diamond", "roll-out"):
        constraint = make_constraint(ConstraintConfig(name=name), SPEC)
        safe, possible = safe_actions(constraint, s, wanted, SPEC, SPEC)
        e = encounters(s, SPEC)
        slack = constraint.slack(e, safe).min(axis=1)
        assert possible.mean() > 0.7, name
        assert slack[possible].min() >= -2 * TOLERANCE, name
        assert constraint.slack(e, wanted).min() < -0.1, name


def headlong(state, params, key=None):
    """Full throttle towards the goal."""
    apart = state.goal[:, None] - state.position
    return 10.0 * apart / jnp.maximum(jnp.linalg.norm(apart, axis=-1, keepdims=True), 1e-6)


def test_nobody_touches_in_physics():
    env = SwarmEnv(SPEC, engine="native", horizon=40)
    scenes = 8
    rng = np.random.default_rng(1)
    start = scene_state(
        SPEC,
        np.stack([rng.uniform(-3, 3, (scenes, 3)) - 25, np.array([-6.0, 0.0, 6.0]) + np.zeros((scenes, 3))], axis=-1),
        goal=np.full((scenes, 2), [30.0, 0.0]),
        obstacle=np.stack([np.zeros((scenes, 2)), np.array([0.0, 30.0]) + np.zeros((scenes, 2))], axis=-1),
        obstacle_present=np.array([True, False]) & np.ones((scenes, 2), bool),
        agent_present=np.arange(3) < np.where(np.arange(scenes) % 2, 3, 1)[:, None],
    )
    traced = []

    def policy(state, params, key=None):
        traced.append(1)
        return headlong(state, params, key)

    filtered = make_filtered(policy, Barrier(kinematics=SPEC, margin=0.05), SPEC, SPEC)
    keys = scene_keys(0, np.arange(scenes))
    run = make_rollout(env, filtered, steps=40)
    recording = jax.device_get(run(None, start, keys))
    run(None, start, keys)
    assert len(traced) == 1  # compiled once
    bare = jax.device_get(make_rollout(env, headlong, steps=40)(None, start, keys))
    touched = [int(x.contacts.obstacle_states.sum()) for x in (recording, bare)]
    assert touched[0] == 0
    assert touched[1] > 0
    assert recording.contacts.agent_states.sum() == 0
    here = np.asarray(start.agent_present)
    assert recording.position[:, -1, 0, 0].min() > -15  # it goes on, where it may
    np.testing.assert_array_equal(recording.position[:, -1][~here], recording.position[:, 0][~here])


def test_chasers_are_kept_from_everybody_and_not_from_their_target_alone():
    """The second agent flies at the third, the target of both is the first."""
    state = scene_state(
        SPEC,
        np.array([[[0.0, 40.0], [4.0, 0], [0, 0]]]),
        np.array([[[0.0, 0], [-8.0, 0], [0, 0]]]),
        obstacle=np.full((1, 2, 2), -60.0),
    )
    chased = replace(state, target=np.array([[[1], [0], [0]]], np.int32))
    keep = make_filtered(lambda *_: jnp.zeros((1, 3, 2)), Barrier(kinematics=SPEC), SPEC, SPEC)
    np.testing.assert_array_equal(keep(chased, None), keep(state, None))
    assert float(jnp.abs(keep(chased, None)[0, 1]).max()) > 1


def crossing(rows: int, seed: int) -> State:
    """Two agents, mostly too near and too fast to stop before each other or the obstacle."""
    rng = np.random.default_rng(seed)
    near = np.stack([rng.uniform(4, 8, rows), rng.uniform(-2.5, 2.5, rows)], axis=-1)
    fast = np.stack([-rng.uniform(5, 10, rows), rng.uniform(-1, 1, rows)], axis=-1)
    return scene_state(
        replace(SPEC, num_agents=2, num_obstacles=1),
        np.stack([np.zeros((rows, 2)), near], axis=1),
        np.stack([-fast, fast], axis=1),
        obstacle=np.stack([np.full(rows, 1.0), np.where(np.arange(rows) % 2, 14.0, 80.0)], axis=-1)[:, None],
        obstacle_present=np.ones((rows, 1), bool),
    )


def clearance(e: Encounters, row: int, action: np.ndarray) -> float:
    """How near any body comes by one action, the other agent of a pair doing the opposite."""
    worst = np.inf
    for body in np.flatnonzero(e.present[row]):
        push = action * (2 if e.steers[row, body] else 1)
        for time in looks(SPEC):
            at = e.relative[row, body] + e.velocity[row, body] * time + push * time**2 / 2
            worst = min(worst, np.hypot(*at) - e.reach[row, body])
    return worst


def crowd(rows: int, seed: int) -> State:
    """Twelve agents at random, a few of them absent, and two obstacles, one of them absent, on the spot."""
    rng = np.random.default_rng(seed)
    return scene_state(
        replace(SPEC, num_agents=12, num_obstacles=2),
        rng.uniform(-12, 12, (rows, 12, 2)),
        rng.normal(0, 6, (rows, 12, 2)),
        obstacle=np.stack([np.full((rows, 2), [25.0, 0.0]), np.zeros((rows, 2))], axis=1),
        obstacle_present=np.array([True, False]) & np.ones((rows, 2), bool),
        agent_present=rng.random((rows, 12)) < 0.4,
    )


def test_it_looks_as_far_as_a_stop_takes():
    np.testing.assert_allclose(looks(SPEC)[[0, -1]], [1.2 / LOOKS, 1.2])  # 10 m/s at 10 m/s^2
    unlimited = replace(SPEC, max_speed=np.inf, contacts=False)
    np.testing.assert_allclose(looks(unlimited)[-1], 4 * SPEC.dt)


@pytest.mark.parametrize("state", [crossing(30, 0), crowd(6, 3)], ids=["crossing", "crowd"])
def test_who_cannot_brake_in_time_turns_where_it_stays_farthest_away(state):
    """Of the present alone; of no more than 8 bodies in these scenes."""
    s = situations_of_state(state)
    s = s.take(np.asarray(state.agent_present).ravel())
    e = encounters(s, SPEC)
    assert e.present.sum(axis=1).max() <= TIGHTEST
    rng = np.random.default_rng(1)
    given = rng.normal(0, 3, (len(s), 2))
    found = evasive(Barrier(kinematics=SPEC), e, given, SPEC)
    angle = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    rim = SPEC.max_acceleration * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for row in range(len(s)):
        values = [clearance(e, row, tried) for tried in (given[row], *rim)]
        assert clearance(e, row, found[row]) == pytest.approx(max(values), abs=2 * SIDE)


@pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi, 0.3])
def test_head_on_both_turn_to_the_same_side(angle: float):
    """Ties of left and right are broken so that neither turns into the other's way."""
    along = np.array([np.cos(angle), np.sin(angle)])
    state = scene_state(
        replace(SPEC, num_agents=2, num_obstacles=0),
        np.stack([-2.75 * along, 2.75 * along])[None],
        np.stack([9.5 * along, -9.5 * along])[None],
    )
    found = shielded(Barrier(kinematics=SPEC), situations_of_state(state), np.zeros((2, 2)), SPEC, SPEC)
    np.testing.assert_allclose(found[0], -found[1], atol=1e-6)
    assert abs(along[0] * found[0, 1] - along[1] * found[0, 0]) > 9


def test_only_who_has_no_allowed_action_is_turned_and_both_of_a_pair_alike():
    state = crossing(40, 2)
    state = replace(state, obstacle_present=np.zeros((40, 1), bool))
    s, barrier = situations_of_state(state), Barrier(kinematics=SPEC)
    wanted = np.zeros((80, 2))
    safe, possible = safe_actions(barrier, s, wanted, SPEC, SPEC)
    found = shielded(barrier, s, wanted, SPEC, SPEC)
    assert 10 < possible.sum() < 70
    np.testing.assert_array_equal(found[possible], safe[possible])
    turned = found[~possible].reshape(-1, 2, 2)  # both of a pair meet the same
    np.testing.assert_allclose(turned[:, 0], -turned[:, 1], atol=1e-9)
    assert np.abs(turned - safe[~possible].reshape(-1, 2, 2)).max() > 1


def test_a_turn_saves_in_physics_whom_brakes_do_not(monkeypatch):
    """6.2 m apart at 19 m/s: brakes need 9 m, a turn adds a metre to the 1.5 that they pass each other at."""
    spec = replace(SPEC, num_agents=2, num_obstacles=0)
    start = scene_state(
        spec, np.array([[[0.0, 0], [6.2, 1.5]]]), np.array([[[9.5, 0], [-9.5, 0]]]), goal=np.array([[50.0, 50.0]])
    )
    barrier, env = Barrier(kinematics=spec), SwarmEnv(spec, engine="native", horizon=8)

    for touching in (False, True):
        if touching:
            monkeypatch.setattr("repair.filter.evasive", lambda constraint, e, action, kinematics: action)
        policy = make_filtered(lambda state, *_: jnp.zeros((1, 2, 2)), barrier, spec, spec)
        recording = jax.device_get(make_rollout(env, policy, steps=8)(None, start, scene_keys(0, np.arange(1))))
        assert bool(recording.contacts.agent_states.any()) == touching


@pytest.mark.parametrize("name", ["barrier", "disc", "polygon", "diamond", "roll-out"])
def test_any_constraint_makes_a_filter(name: str):
    """Whose actions stay within the limit, and which does to the same rows what it does outside JAX."""
    state = crossing(20, 5)
    constraint = make_constraint(ConstraintConfig(name=name), SPEC)
    found = jax.jit(make_filtered(lambda *_: jnp.zeros((20, 2, 2)), constraint, SPEC, SPEC))(state, None)
    assert np.linalg.norm(found, axis=-1).max() <= SPEC.max_acceleration * (1 + 1e-5)
    s = situations_of_state(state)
    ours = shielded(constraint, s, np.zeros((40, 2)), SPEC, SPEC)
    assert (np.abs(np.asarray(found).reshape(-1, 2) - ours).max(axis=1) < 0.05).mean() > 0.9


def test_absent_agents_keep_their_action():
    state = scene_state(
        SPEC,
        np.array([[[9.0, 0], [9.5, 0], [0, 0]]]),
        np.array([[[-8.0, 0], [0, 0], [0, 0]]]),
        obstacle=np.zeros((1, 2, 2)),
        obstacle_present=np.array([[True, False]]),
        agent_present=np.array([[True, False, False]]),
    )
    wanted = jnp.asarray([[[-10.0, 0], [3.0, 40.0], [1.0, 1.0]]])
    filtered = jax.jit(make_filtered(lambda *_: wanted, Disc(kinematics=SPEC), SPEC, SPEC))(state, None)
    np.testing.assert_array_equal(filtered[0, 1:], wanted[0, 1:])
    assert float(filtered[0, 0, 0]) > 0  # 1 m away at 8 m/s: brakes
