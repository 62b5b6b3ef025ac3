"""Where scenes start: the published distributions, room between bodies, one key per scene, refusal when too dense."""

import math
from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import assert_same, scenes_of
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.config import SpawnConfig, World, clear, make_world, mixed, published
from envs.experts.registry import make_expert
from envs.rollout import make_rollout
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


def surfaces(state: State, radius: float) -> np.ndarray:
    """Least distance between surfaces of present obstacles in every scene [m]."""
    apart = np.linalg.norm(state.obstacle[:, :, None] - state.obstacle[:, None], axis=-1) - 2 * radius
    there = state.obstacle_present[:, :, None] & state.obstacle_present[:, None]
    there &= ~np.eye(apart.shape[1], dtype=bool)
    return np.where(there, apart, np.inf).min(axis=(1, 2))


@pytest.mark.parametrize("world", [clear(num_obstacles=2), mixed(clear(num_obstacles=4))])
def test_obstacles_of_clear_leave_a_gap(world):
    gap = world.spawn.obstacle_gap
    assert gap is not None
    state = starts(world, 600)
    assert surfaces(state, world.scene.obstacle_radius).min() >= gap - 1e-3
    assert np.abs(state.obstacle[state.obstacle_present]).max() < world.scene.arena + 30
    loose = starts(replace(world, spawn=replace(world.spawn, obstacle_gap=None)), 600)
    assert surfaces(loose, world.scene.obstacle_radius).min() < 0
    # Only what was too close has moved: the first obstacle never, and no scene that had the gaps already.
    np.testing.assert_array_equal(state.obstacle[:, 0], loose.obstacle[:, 0])
    fine = surfaces(loose, world.scene.obstacle_radius) >= gap + 1e-3
    assert 0 < fine.sum() < 600
    np.testing.assert_array_equal(state.obstacle[fine], loose.obstacle[fine])


def test_gaps_that_no_draw_leaves_are_refused():
    spawn = replace(clear().spawn, obstacle_gap=500.0)
    env = SwarmEnv(clear(num_obstacles=2).scene, engine="native", spawn=spawn)
    with pytest.raises(SpawnError, match=r"gaps of 500\.0 m, .*3 of 3 scenes found no room"):
        env.reset(scene_keys(0, range(3)))


def test_moving_obstacles_have_the_speed_in_every_direction():
    world = clear(num_obstacles=2)
    scene = replace(world.scene, moving_obstacles=True)
    moving = starts(World(scene, replace(world.spawn, obstacle_speed=3.0, min_obstacles=0), world.expert), 1000)
    there = moving.obstacle_present
    speed = np.linalg.norm(moving.obstacle_velocity, axis=-1)
    np.testing.assert_allclose(speed[there], 3.0, rtol=1e-5)
    assert not moving.obstacle_velocity[~there].any()
    mean = moving.obstacle_velocity[there].mean(axis=0)
    assert np.abs(mean).max() < 5 * 3 / math.sqrt(2 * there.sum())
    both = moving.obstacle_velocity[there.all(axis=1)]
    assert abs((both[:, 0] * both[:, 1]).sum(axis=-1).mean()) < 5 * 9 / math.sqrt(2 * len(both))  # independent
    still = starts(World(world.scene, replace(world.spawn, min_obstacles=0), world.expert), 1000)
    assert not still.obstacle_velocity.any()
    assert_same(replace(moving, obstacle_velocity=still.obstacle_velocity), still)  # nothing else is drawn anew


@pytest.mark.parametrize(
    ("change", "speed", "allowed"),
    [({}, 1.0, "moving_obstacles"), ({"moving_obstacles": True}, 10.5, "at most max_speed = 10.0 m/s")],
)
def test_obstacles_that_may_not_move_so_are_refused(change: dict, speed: float, allowed: str):
    spec = replace(clear().scene, **change)
    with pytest.raises(SpecError, match=allowed):
        check_spawn(spec, SpawnConfig(obstacle_speed=speed))


def test_chasers_start_on_a_circle_with_targets():
    world = make_world("chaser", num_agents=4)
    state = starts(world, 1000)
    np.testing.assert_allclose(np.linalg.norm(state.position, axis=-1), 20, rtol=1e-5)
    assert np.abs(state.position.mean(axis=(0, 1))).max() < 5 * 20 / math.sqrt(2 * 4000)
    assert_uniform(state.velocity, 2)
    assert state.target.shape == (1000, 4, 1)
    assert (state.target[..., 0] != np.arange(4)).all()
    for agent in range(4):  # everyone else equally often
        counts = np.bincount(state.target[:, agent, 0], minlength=4)
        assert counts[agent] == 0
        assert np.delete(counts, agent) == pytest.approx([1000 / 3] * 3, rel=0.25)


def axes_of(state: State) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors from the centre to the goal and to its left."""
    along = state.goal / np.linalg.norm(state.goal, axis=-1, keepdims=True)
    return along, np.stack([-along[:, 1], along[:, 0]], axis=-1)


def in_family(world: World, family: str, **more) -> World:
    return replace(world, spawn=replace(world.spawn, family=family, **more))


@pytest.mark.parametrize("preset", [clear, published])
def test_a_corridor_lies_between_the_swarm_and_the_goal_and_its_rows_are_shut(preset):
    world = in_family(preset(num_agents=6, num_obstacles=6), "corridor", corridor_width=16.0, start_range=25.0)
    radius, spec = world.scene.obstacle_radius, world.scene
    state = starts(world, 400)
    along, aside = axes_of(state)
    np.testing.assert_allclose(np.linalg.norm(state.goal, axis=-1), 60, rtol=1e-5)
    assert np.abs(along.mean(axis=0)).max() < 5 / math.sqrt(2 * 400)  # in every direction
    x, y = (np.einsum("skd,sd->sk", state.obstacle, axis) for axis in (along, aside))
    agents = np.stack([np.einsum("snd,sd->sn", state.position, axis) for axis in (along, aside)], axis=-1)
    assert_uniform(agents - [-60, 0], 25 + 1e-3)
    # Beyond the agents, before the goal.
    assert (x.min(axis=1) - radius > agents[..., 0].max(axis=1) + spec.agent_radius - 1e-3).all()
    assert (x.max(axis=1) + radius < 60 - 2 + 1e-3).all()
    # Two rows by turns, 16 m between their surfaces, the middle within 4 m of the straight way.
    odd, even = y[:, 1::2], y[:, ::2]
    np.testing.assert_allclose(np.ptp(odd, axis=1), 0, atol=1e-3)
    np.testing.assert_allclose(np.ptp(even, axis=1), 0, atol=1e-3)
    np.testing.assert_allclose(np.abs(odd[:, 0] - even[:, 0]), 16 + 2 * radius, atol=1e-3)
    assert_uniform((odd[:, 0] + even[:, 0]) / 2, 4 + 1e-3)
    assert (odd[:, 0] > even[:, 0]).mean() == pytest.approx(0.5, abs=0.125)
    # No agent (2 m wide) fits between two neighbours of a row, and no obstacle lies in another.
    np.testing.assert_allclose(np.diff(x[:, ::2], axis=1), 2 * radius + spec.agent_radius, atol=1e-3)
    assert surfaces(state, radius).min() > 0


def test_most_boids_pass_the_corridor_or_go_round_it_and_arrive():
    """The family is a task that can be done: the published Boids come to the far side in 60 steps."""
    world = in_family(published(num_agents=4, num_obstacles=6), "corridor")
    env = SwarmEnv(world.scene, engine="native", spawn=world.spawn, horizon=60)
    keys = scene_keys(1, range(64))
    run = jax.device_get(make_rollout(env, make_expert(world.expert), steps=60)(None, env.reset(keys), keys))
    along, aside = axes_of(run.start)
    x, y = (np.einsum("stnd,sd->stn", run.position, axis) for axis in (along, aside))
    obstacle = [np.einsum("skd,sd->sk", run.start.obstacle, axis) for axis in (along, aside)]
    middle = obstacle[1].mean(axis=1)[:, None, None]
    between = (x > obstacle[0].min(axis=1)[:, None, None]) & (x < obstacle[0].max(axis=1)[:, None, None])
    inside = np.abs(y - middle) < world.spawn.corridor_width / 2 + world.scene.obstacle_radius
    through = np.where(between, inside, True).all(axis=1) & between.any(axis=1)
    assert 0.3 < through.mean() < 0.9
    assert (x[:, -1] > obstacle[0].max(axis=1)[:, None]).mean() > 0.95


def test_crossing_groups_head_for_the_goal_from_different_sides():
    world = in_family(mixed(clear(num_agents=6, num_obstacles=2)), "crossing", start_range=20.0)
    state = starts(world, 600)
    assert_uniform(state.goal, 10)
    # Six agents and the velocities tell where the groups' centres are: the way from them to the goal.
    full = state.agent_present[:, :2].all(axis=1)
    speed = np.linalg.norm(state.velocity, axis=-1)
    np.testing.assert_allclose(speed[state.agent_present], 10, rtol=1e-5)
    heading = state.velocity / np.maximum(speed, 1e-9)[..., None]
    for group in (0, 1):  # by turns: all of a group head the same way, those of the other another way
        for agent in (group + 2, group + 4):
            there = state.agent_present[:, agent]
            np.testing.assert_allclose(heading[there, agent], heading[there, group], atol=1e-5)
    centres = np.stack([state.goal - _distance_back(state.goal, heading[:, g]) * heading[:, g] for g in (0, 1)], 1)
    np.testing.assert_allclose(np.linalg.norm(centres[full], axis=-1), 60, rtol=1e-4)
    angle = np.degrees(np.arccos(np.clip((centres[full, 0] * centres[full, 1]).sum(-1) / 3600, -1, 1)))
    assert_uniform(angle - 135, 45 + 0.1)
    offset = state.position - centres[:, np.arange(6) % 2]
    assert np.abs(offset[state.agent_present & full[:, None]]).max() <= 20 + 1e-3
    assert surfaces(state, world.scene.obstacle_radius).min() >= 14 - 1e-3


def _distance_back(goal: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """How far back along a heading from the goal the circle of 60 m about the centre lies."""
    along = (goal * heading).sum(axis=-1)
    return (along + np.sqrt(along**2 + 3600 - (goal**2).sum(axis=-1)))[:, None]


@settings(max_examples=15)
@given(st.sampled_from(("circle", "corridor", "crossing")), st.integers(0, 1000))
def test_a_scene_of_any_family_depends_on_its_key_alone_and_keeps_its_bodies_apart(family: str, seed: int):
    order = [5, 5, 2, 0, 1, 7, 3, 4]
    whole, ok = jax.device_get(SPAWNS[family](scene_keys(seed, range(8))))
    assert ok.all()
    assert_same(jax.device_get(SPAWNS[family](scene_keys(seed, np.arange(8)[order])))[0], scenes_of(whole, order))
    here = np.where(whole.agent_present[..., None], whole.position, np.nan)
    apart = np.linalg.norm(here[:, :, None] - here[:, None], axis=-1)
    assert np.nanmin(np.where(np.eye(4, dtype=bool), np.inf, apart)) >= 2 + 4 - 1e-3
    solid = np.linalg.norm(here[:, :, None] - whole.obstacle[:, None], axis=-1)
    assert np.nanmin(np.where(whole.obstacle_present[:, None], solid, np.inf)) >= 1 + 7 + 4 - 1e-3
    assert np.nanmax(np.abs(here)) <= 100


HARD = mixed(clear(num_agents=4, num_obstacles=3))
SPAWNS = {
    family: jax.jit(lambda keys, family=family: spawn(keys, HARD.scene, replace(HARD.spawn, family=family)))
    for family in ("circle", "corridor", "crossing")
}


def test_families_that_do_not_fit_are_refused_before_anything_is_drawn():
    def check(spec: SceneSpec | None = None, **config) -> None:
        check_spawn(spec or clear().scene, replace(clear().spawn, **config))

    check(family="corridor")
    with pytest.raises(SpecError, match=r"start_range: 35\.0 was given, allowed is at most 34\.0 m"):
        check(family="crossing", start_range=35.0)
    with pytest.raises(SpecError, match="half-width"):
        check(family="circle", start_range=101.0)
    # Room from -60 + 30 + 7 + 1 + 4 = -18 to 60 - 7 - 2 = 51 m, an obstacle every 7.5 m: 1 + 9.
    check(replace(clear().scene, num_obstacles=10), family="corridor")
    with pytest.raises(SpecError, match="at most 10 in a corridor"):
        check(replace(clear().scene, num_obstacles=11), family="corridor")
    # One obstacle lies 16.5 m along, up to 0.75 w + 7 m aside, and 93 m from the middle at most: w = 84.5 / 0.75.
    check(family="corridor", corridor_width=112.0)
    with pytest.raises(SpecError, match=r"corridor_width: 113\.0 was given, allowed is at most 112\.7 m with 1 obst"):
        check(family="corridor", corridor_width=113.0)
    # Half of 90 agents start in a square of 40 m: 45 discs of 3 m fill 80% of it.
    crowd = replace(clear().scene, num_agents=90)
    with pytest.raises(
        SpawnError, match=r"45 agents .* do not fit into a group's square of 40\.0 m .*larger start_range"
    ):
        check(crowd, family="crossing", start_range=20.0)
    ring = SwarmEnv(crowd, engine="native", spawn=replace(clear().spawn, family="circle", start_range=20.0))
    with pytest.raises(SpawnError, match=r"onto a circle of radius 20\.0 m"):
        ring.reset(scene_keys(0, range(2)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        (field, value)
        for field in (
            "goal_range",
            "agent_range",
            "speed_range",
            "clearance",
            "start_range",
            "corridor_width",
            "obstacle_gap",
            "obstacle_speed",
        )
        for value in (-1.0, math.nan, math.inf)
    ]
    + [("min_agents", 0), ("min_agents", -1), ("min_obstacles", -1), ("targets", -1)]
    + [("family", "anywhere")],
)
def test_a_spawn_range_that_makes_no_sense_is_refused(field: str, value: object):
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
