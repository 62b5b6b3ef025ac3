"""Boids against the published code's own numbers (`data/golden_boids.npz`), hand-computed cases and its symmetries."""

import math
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden import golden_state, relative_error
from helpers import scene_state
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.config import published
from envs.dynamics import free_flight, limited
from envs.experts.boids import boids, rules
from envs.experts.config import BoidsConfig
from envs.state import State
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec
from swarmnet.numpy_boids import numpy_boids

GOLDEN = np.load(Path(__file__).parent / "data/golden_boids.npz")
WORLDS = ("boid_n1_k1", "boid_n5_k1", "boid_n5_k1_dense", "boid_n10_k3")
RULES = ("cohesion", "separation", "alignment", "obstacle", "goal")
PUBLISHED = BoidsConfig()
NO_WALLS = BoidsConfig(walls=False)


def computed(world: str, dtype: type) -> dict[str, np.ndarray]:
    """All that the published code computed for its states, computed by ours."""
    with jax.enable_x64(dtype == np.float64):
        return jax.device_get(jax.jit(everything)(golden_state(GOLDEN, world, dtype)))


def everything(state: State) -> dict[str, jax.Array]:
    ours = {f"rule_{name}": rule(state) for name, rule in rules(PUBLISHED).items()}
    ours["acceleration"] = boids(PUBLISHED)(state)
    ours["acceleration_no_walls"] = boids(NO_WALLS)(state)
    ours["acceleration_separation_summed"] = boids(replace(PUBLISHED, separation_summed=True))(state)
    scene = published().scene
    executed = limited(state.velocity, ours["acceleration"], scene)
    after = free_flight(state.position, state.velocity, executed, scene)
    return ours | dict(zip(("next_position_dt0.3", "next_velocity_dt0.3"), after, strict=True))


@pytest.mark.parametrize("world", WORLDS)
def test_golden_numbers_are_reproduced_in_float64(world: str):
    ours = computed(world, np.float64)
    recorded = {key.split("/")[1] for key in GOLDEN.files if key.startswith(world + "/")}
    assert recorded == set(ours) | {"position", "velocity", "goal", "obstacle"}  # nothing golden is left unchecked
    for name, value in ours.items():
        assert value.dtype == np.float64
        assert relative_error(value, GOLDEN[f"{world}/{name}"]).max() <= 1e-9, name


@pytest.mark.parametrize("world", WORLDS)
def test_the_numpy_law_that_experts_are_timed_against_is_the_published_one(world: str):
    state = {name: GOLDEN[f"{world}/{name}"] for name in ("position", "velocity", "goal", "obstacle")}
    scenes = [{name: value[scene] for name, value in state.items()} for scene in range(len(state["goal"]))]
    for config, name in ((PUBLISHED, "acceleration"), (NO_WALLS, "acceleration_no_walls")):
        ours = np.stack([numpy_boids(config, **scene) for scene in scenes])
        assert relative_error(ours, GOLDEN[f"{world}/{name}"]).max() <= 1e-6


def test_golden_numbers_are_reproduced_in_float32_but_for_flipped_branches():
    errors: dict[str, list[np.ndarray]] = {}
    for world in WORLDS:
        for name, value in computed(world, np.float32).items():
            assert value.dtype == np.float32
            errors.setdefault(name, []).append(relative_error(value, GOLDEN[f"{world}/{name}"]).ravel())
    for name, parts in errors.items():
        error = np.concatenate(parts)
        assert (error <= 1e-5).mean() >= 0.99, name
        assert error.max() <= 1e-2, name


def test_the_golden_states_put_every_rule_to_the_test():
    for name in RULES:
        active = np.concatenate([np.abs(GOLDEN[f"{world}/rule_{name}"]).max(-1).ravel() > 1e-6 for world in WORLDS])
        assert active.mean() > 0.05, name
    walls = [GOLDEN[f"{w}/acceleration"] != GOLDEN[f"{w}/acceleration_no_walls"] for w in WORLDS]
    assert any(part.any() for part in walls)


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_alone_is_its_weight_times_the_rule(rule: str):
    weights = dict.fromkeys(RULES, 0.0) | {rule: 3.0}
    state = golden_state(GOLDEN, "boid_n10_k3", np.float32)
    alone = boids(BoidsConfig(**weights))(state)
    np.testing.assert_allclose(alone, 3 * rules(PUBLISHED)[rule](state), rtol=1e-6)
    assert np.abs(alone).max() > 0.1


SPEC = SceneSpec(num_agents=3, num_obstacles=1)


def rule_of(name: str, config: BoidsConfig, position, velocity=None, **where) -> np.ndarray:
    """One rule for the agents of one scene."""
    velocity = np.zeros(np.shape(position)) if velocity is None else velocity
    if "obstacle" in where:
        where["obstacle"] = [where["obstacle"]]
    if "goal" in where:
        where["goal"] = [where["goal"]]
    spec = replace(SPEC, num_agents=len(position))
    state = scene_state(spec, [position], [velocity], **where)
    return np.asarray(rules(config)[name](jax.tree.map(jnp.asarray, state)))[0]


def test_cohesion_and_alignment_by_hand():
    places = [[0, 0], [2, 0], [4, 6]]
    expected = [[3, 3], [2 - 2, 3], [1 - 4, -6]]  # means of the others (3,3), (2,3), (1,0), minus own
    np.testing.assert_allclose(rule_of("cohesion", PUBLISHED, places), expected, atol=1e-6)
    np.testing.assert_allclose(rule_of("alignment", PUBLISHED, [[0, 0]] * 3, places), expected, atol=1e-6)


def test_separation_by_hand_as_mean_and_as_sum():
    places = [[0, 0], [2, 0], [0, -2.5]]  # 0 is near both (2 and 2.5 m); 1 and 2 are 3.2 m apart
    pushes = np.array([[-0.5, 0.4], [0.5, 0], [0, -0.4]])  # sums of (p_i - p_j) / d^2
    summed = replace(PUBLISHED, separation_summed=True)
    np.testing.assert_allclose(rule_of("separation", summed, places), pushes, rtol=1e-6)
    np.testing.assert_allclose(rule_of("separation", PUBLISHED, places), pushes / 2, rtol=1e-6)


def test_separation_ends_at_its_range_and_has_a_floor():
    two = replace(PUBLISHED, separation_summed=True)
    assert not rule_of("separation", two, [[0, 0], [3.0001, 0]]).any()
    assert rule_of("separation", two, [[0, 0], [2.9999, 0]])[0, 0] == pytest.approx(-1 / 2.9999, rel=1e-5)
    assert rule_of("separation", two, [[0, 0], [0.001, 0]])[0, 0] == pytest.approx(-0.001 / 0.01**2, rel=1e-5)
    assert not rule_of("separation", two, [[1, 1], [1, 1]]).any()


def test_the_goal_is_approached_at_cruise_speed_and_slower_near_it():
    places, velocity = [[30, 0], [0, -5], [0, 0]], [[1, 2], [0, 0], [4, 0]]
    expected = [[-10 - 1, -2], [0, 2.5], [-4, 0]]
    np.testing.assert_allclose(rule_of("goal", PUBLISHED, places, velocity, goal=[0, 0]), expected, atol=1e-6)


def test_an_obstacle_ahead_by_hand():
    # From (0, 0) to an obstacle at (20, 2) of radius 8 with velocity +x: passing it to the right (its centre is left).
    centre = math.hypot(20, 2)
    d, sine = centre - 8, 2 / centre
    miss = centre * sine - 8
    expected = (3 - miss) ** 2 / max(d, 3)
    got = rule_of("obstacle", NO_WALLS, [[0, 0], [0, 4], [0, 0]], [[5, 0], [5, 0], [-5, 0]], obstacle=[[20, 2]])
    assert got[0] == pytest.approx([0, -expected], rel=1e-5)
    assert got[1, 1] > 0  # below the other side of the centre: turns left
    assert not got[2].any()  # behind


def test_an_obstacle_missed_by_more_than_the_range_is_ignored():
    passing = rule_of("obstacle", NO_WALLS, [[0, 0]] * 2, [[5, 0], [0, 0]], obstacle=[[20, 11.1]])
    assert not passing.any()  # misses by 3.1 m, and an agent at rest has nothing ahead
    assert rule_of("obstacle", NO_WALLS, [[0, 0]], [[5, 0]], obstacle=[[20, 10.9]])[0, 1] < 0


@pytest.mark.parametrize("angle", [0.0, 0.5, 2.0, math.pi, -1.3])
def test_exactly_head_on_turns_left(angle: float):
    """The published law is 0/0 there; `left` is 90 degrees counter-clockwise of the heading."""
    heading = np.array([math.cos(angle), math.sin(angle)])
    exact = np.array([1.0, 0.0]) if angle == 0.0 else heading
    got = rule_of("obstacle", NO_WALLS, [[0, 0]], [4 * exact], obstacle=[20 * exact])[0]
    assert np.isfinite(got).all()
    expected = (3 + 8) ** 2 / 12
    assert np.linalg.norm(got) == pytest.approx(expected, rel=1e-3)
    if angle in (0.0, math.pi):  # elsewhere float32 cannot tell head-on from almost head-on
        assert got @ [-exact[1], exact[0]] == pytest.approx(expected, rel=1e-3)


def test_walls_are_felt_only_when_switched_on():
    position, velocity = [[95, 0], [0, 0]], [[3, 4], [0, 9]]
    with_walls = rule_of("obstacle", PUBLISHED, position, velocity)
    # 5 m to the east wall, sine 0.8: misses the foot point by 4 m, more than 3: no turn. Wall to the north is far.
    assert not with_walls[0].any()
    with_walls = rule_of("obstacle", PUBLISHED, [[96, 0]], [[4, 3]])
    # 4 m away, sine 0.6: miss 2.4, strength 0.6^2 / 4, turned left, away from the wall's foot.
    assert with_walls[0] == pytest.approx(0.36 / 4 * np.array([-0.6, 0.8]), rel=1e-4)
    assert not rule_of("obstacle", NO_WALLS, [[96, 0]], [[4, 3]]).any()


def test_an_agent_alone_feels_only_obstacles_and_the_goal():
    state = scene_state(replace(SPEC, num_agents=1), [[[3.0, 4.0]]], [[[1.0, 0.0]]], goal=[[3.0, 14.0]])
    got = boids(NO_WALLS)(jax.tree.map(jnp.asarray, state))
    np.testing.assert_allclose(got[0, 0], [0.5 * (0 - 1), 0.5 * 5], rtol=1e-6)
    assert np.isfinite(got).all()


def test_no_obstacles_and_no_walls_is_a_valid_world():
    spec = replace(SPEC, num_obstacles=0)
    state = scene_state(spec, [[[0.0, 0], [5, 0], [0, 5]]], np.ones((1, 3, 2)))
    assert np.isfinite(boids(NO_WALLS)(jax.tree.map(jnp.asarray, state))).all()


coordinate = st.floats(-60, 60, width=32)
agents = st.lists(st.tuples(coordinate, coordinate, coordinate, coordinate), min_size=5, max_size=5)
law = jax.jit(boids(PUBLISHED))
law_without_walls = jax.jit(boids(NO_WALLS))
FIVE = SceneSpec(num_agents=5, num_obstacles=2)


def random_state(rows, **kwargs) -> State:
    rows = np.array([rows], np.float32)
    where = {"goal": [[10.0, -20.0]], "obstacle": [[[25.0, 5.0], [-30.0, 12.0]]]} | kwargs
    return scene_state(FIVE, rows[..., :2], rows[..., 2:] / 6, **where)


def assert_close_but_for_flips(a: np.ndarray, b: np.ndarray, flips: int = 1) -> None:
    """Almost head-on agents and distances at a threshold may take the other branch of the law after rounding."""
    wrong = relative_error(np.asarray(a, float), np.asarray(b, float)) > 2e-3
    assert wrong.sum() <= flips


@settings(max_examples=60)
@given(agents, st.permutations(range(5)))
def test_renumbering_agents_renumbers_accelerations(rows, order):
    there = np.asarray(law(random_state(rows)))[:, order]
    here = np.asarray(law(random_state([rows[i] for i in order])))
    assert_close_but_for_flips(here, there, 0)


@settings(max_examples=60)
@given(agents, st.floats(-30, 30, width=32), st.floats(-30, 30, width=32))
def test_moving_everything_moves_nothing_else_without_walls(rows, x, y):
    state, shift = random_state(rows), np.array([x, y], np.float32)
    moved = replace(state, **{name: getattr(state, name) + shift for name in ("position", "goal", "obstacle")})
    assert_close_but_for_flips(law_without_walls(moved), law_without_walls(state))


@settings(max_examples=60)
@given(agents, st.lists(st.booleans(), min_size=5, max_size=5), st.booleans())
def test_ghosts_change_nothing_and_feel_nothing(rows, present, with_obstacle):
    assert law(random_state(rows)).shape == (1, 5, 2)
    present = np.array([present])
    obstacle_present = np.array([[True, with_obstacle]])
    state = random_state(rows, agent_present=present, obstacle_present=obstacle_present)
    got = np.asarray(law(state))
    assert not got[~present].any()
    elsewhere = replace(
        state,
        position=np.where(present[..., None], state.position, np.float32(3)),  # ghosts in the middle of the scene
        velocity=np.where(present[..., None], state.velocity, np.float32(-5)),
        obstacle=np.where(obstacle_present[..., None], state.obstacle, np.float32(1)),
    )
    np.testing.assert_array_equal(np.asarray(law(elsewhere)), got)
    count = int(present.sum())
    if count:
        alone = scene_state(
            replace(FIVE, num_agents=count),
            state.position[:, present[0]],
            state.velocity[:, present[0]],
            goal=state.goal,
            obstacle=state.obstacle,
            obstacle_present=obstacle_present,
        )
        assert_close_but_for_flips(law(alone), got[:, present[0]], 0)


@settings(max_examples=60)
@given(agents)
def test_accelerations_are_finite_everywhere_and_scenes_do_not_mix(rows):
    state = random_state(rows)
    twice = jax.tree.map(lambda a: np.concatenate([a, a]), state)
    got = np.asarray(law(twice))
    assert np.isfinite(got).all()
    np.testing.assert_array_equal(got[0], got[1])


@pytest.mark.parametrize("field", ["separation_range", "obstacle_range", "arena", "slowdown_distance"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_range_that_makes_no_sense_is_refused(field: str, value: float):
    with pytest.raises(SpecError) as caught:
        BoidsConfig(**{field: value})
    assert caught.value.field == field
