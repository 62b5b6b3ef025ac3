"""Where scenes start: the published distributions, room between bodies, one key per scene, refusal when too dense."""

import math
from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import assert_same, scenes_of
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.config import SpawnConfig, clear, make_world, mixed, published
from envs.spawn import JAMMING, SpawnError, check_spawn, spawn
from envs.state import State
from envs.swarm_env import SwarmEnv, scene_keys
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.spec import SceneSpec

SCENES = 2000


def starts(world, scenes: int = SCENES, seed: int = 0) -> State:
    env = SwarmEnv(world.scene, engine="native", spawn=world.spawn)
    return jax.device_get(env.reset(scene_keys(seed, range(scenes))))


def assert_uniform(values: np.ndarray, half: float) -> None:
    """Within [-half, half], mean and spread of a uniform distribution within five standard errors, ends reached."""
    values = values.ravel()
    assert np.abs(values).max() <= half
    assert abs(values.mean()) < 5 * half / math.sqrt(3 * values.size)
    assert values.std() == pytest.approx(half / math.sqrt(3), rel=0.05)
    assert values.min() < -0.98 * half
    assert values.max() > 0.98 * half


def test_published_starts_have_the_published_ranges():
    world = published()
    state = starts(world)
    assert_uniform(state.goal, 40)
    assert_uniform(state.position, 80)
    speed = np.linalg.norm(state.velocity, axis=-1)
    assert speed.max() <= 10 * (1 + 1e-6)
    # Uniform in a square of half-width 15 and clipped at 10: the inner disc keeps its share pi 100 / 900.
    assert (speed < 9.999).mean() == pytest.approx(math.pi * 100 / 900, abs=0.03)
    assert state.agent_present.all()
    assert state.obstacle_present.all()
    np.testing.assert_array_equal(state.step, 0)
    assert not state.touching_agent.any()


def test_published_obstacles_lie_about_the_line_from_the_goal_to_the_mean_agent():
    r = SpawnConfig().obstacle_radius
    state = starts(published(num_obstacles=2))
    centre = state.position.mean(axis=1)
    line = centre - state.goal
    length = np.linalg.norm(line, axis=-1, keepdims=True)
    along = line / length
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    offset = state.obstacle - state.goal[:, None]
    distance, aside = (np.einsum("skd,sd->sk", offset, axis) for axis in (along, across))
    assert_uniform(aside, 2 * r + 1e-3)
    room = length - r - (2 + r)
    share = ((distance - (2 + r)) / room)[room[:, 0] > 5]  # 0..1 along the room that is left
    assert len(share) > SCENES / 2
    assert_uniform(2 * share - 1, 1 + 1e-3)


@pytest.mark.parametrize("world", [clear(), clear(num_agents=12, num_obstacles=3), mixed(clear(num_obstacles=2))])
def test_clear_starts_keep_every_surface_apart_by_the_clearance(world):
    state = starts(world, 500)
    spec, clearance = world.scene, world.spawn.clearance
    assert clearance > 0
    apart = np.linalg.norm(state.position[:, :, None] - state.position[:, None], axis=-1) - 2 * spec.agent_radius
    apart[:, np.arange(spec.num_agents), np.arange(spec.num_agents)] = np.inf
    assert apart.min() >= clearance - 1e-4
    solid = np.linalg.norm(state.position[:, :, None] - state.obstacle[:, None], axis=-1)
    assert (solid - spec.agent_radius - spec.obstacle_radius).min() >= clearance - 1e-4
    assert np.abs(state.position[state.agent_present]).max() <= world.spawn.agent_range


def test_published_starts_may_overlap():
    state = starts(published(num_agents=20), 200)
    apart = np.linalg.norm(state.position[:, :, None] - state.position[:, None], axis=-1)
    assert (apart[apart > 0] < 2).any()


def test_mixed_batches_draw_every_composition_evenly_and_park_the_absent():
    world = mixed(clear(num_agents=4, num_obstacles=2))
    state = starts(world, 1200)
    agents, obstacles = state.agent_present.sum(axis=1), state.obstacle_present.sum(axis=1)
    assert np.bincount(agents)[1:] == pytest.approx([300] * 4, rel=0.3)
    assert np.bincount(obstacles) == pytest.approx([400] * 3, rel=0.3)
    waiting_agents, waiting_obstacles = world.scene.parking()
    for i, place in enumerate(waiting_agents):
        absent = ~state.agent_present[:, i]
        np.testing.assert_array_equal(state.position[absent, i], np.broadcast_to(place, (absent.sum(), 2)))
        np.testing.assert_array_equal(state.velocity[absent, i], 0)
    for k, place in enumerate(waiting_obstacles):
        absent = ~state.obstacle_present[:, k]
        np.testing.assert_array_equal(state.obstacle[absent, k], np.broadcast_to(place, (absent.sum(), 2)))


@settings(max_examples=10)
@given(st.integers(0, 1000), st.integers(0, 50))
def test_a_scene_depends_on_its_seed_and_number_alone(seed: int, first: int):
    whole = jax.device_get(SPAWN(scene_keys(seed, range(first, first + 8))))
    part = jax.device_get(SPAWN(scene_keys(seed, np.arange(first, first + 8)[[5, 5, 2, 0, 1, 7, 3, 4]])))
    assert_same(part, scenes_of(whole, [5, 5, 2, 0, 1, 7, 3, 4]))
    other = jax.device_get(SPAWN(scene_keys(seed + 1, range(first, first + 8))))
    assert (other[0].goal != whole[0].goal).any(axis=1).all()


WORLD = clear(num_agents=3)
SPAWN = jax.jit(lambda keys: spawn(keys, WORLD.scene, WORLD.spawn))


def test_scenes_of_another_batch_size_are_the_same():
    """To float32 rounding: XLA may order a sum differently for another shape."""
    few, many = starts(WORLD, 3), scenes_of(starts(WORLD, 8), slice(0, 3))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-5), few, many)


def test_a_world_without_a_goal_has_none():
    world = clear()
    world = replace(world, scene=replace(world.scene, goal=False))
    np.testing.assert_array_equal(starts(world, 4).goal, 0)


def test_too_many_bodies_are_refused_before_anything_is_drawn():
    spec = SceneSpec(num_agents=500, num_obstacles=0)
    config = SpawnConfig(agent_range=20.0)  # 500 pi / 1600 = 98% of the area
    with pytest.raises(SpawnError, match=r"too dense: 500 agents of radius 1\.0 m") as caught:
        SwarmEnv(spec, engine="native", spawn=config)
    assert isinstance(caught.value, SwarmError)
    assert f"{JAMMING:.0%}" in str(caught.value)
    check_spawn(spec, replace(config, overlap=True))  # bodies inside each other always fit


def test_scenes_that_find_no_room_are_counted():
    # 45% of the area: below the static bound, but 200 draws do not find it for every scene.
    spec = SceneSpec(num_agents=57, num_obstacles=0)
    env = SwarmEnv(spec, engine="native", spawn=SpawnConfig(agent_range=10.0))
    keys = scene_keys(0, range(8))
    _, ok = jax.jit(env.spawn)(keys)
    failed = int((~np.asarray(ok)).sum())
    assert failed > 0
    with pytest.raises(SpawnError, match=f"{failed} of 8 scenes found no room") as caught:
        env.reset(keys)
    assert (caught.value.failed, caught.value.scenes) == (failed, 8)


def test_an_obstacle_that_covers_the_spawning_area_is_too_dense():
    spec = SceneSpec(num_agents=2, num_obstacles=1, obstacle_radius=90.0)
    env = SwarmEnv(spec, engine="native", spawn=SpawnConfig(agent_range=5.0, goal_range=0.0))
    with pytest.raises(SpawnError, match="4 of 4 scenes"):
        env.reset(scene_keys(0, range(4)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        (field, value)
        for field in ("goal_range", "agent_range", "speed_range", "clearance")
        for value in (-1.0, math.nan, math.inf)
    ]
    + [("min_agents", 0), ("min_agents", -1), ("min_obstacles", -1)],
)
def test_a_spawn_range_that_makes_no_sense_is_refused(field: str, value: float):
    with pytest.raises(SpecError) as caught:
        SpawnConfig(**{field: value})
    assert (caught.value.field, caught.value.given) == (field, value)


@pytest.mark.parametrize(
    "config", [SpawnConfig(min_agents=6), SpawnConfig(min_obstacles=2), SpawnConfig(agent_range=100.5)]
)
def test_a_spawn_that_does_not_belong_to_the_scene_is_refused(config: SpawnConfig):
    with pytest.raises(SpecError):
        SwarmEnv(SceneSpec(), engine="native", spawn=config)


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(SpecError, match="published, clear"):
        make_world("chaotic")
