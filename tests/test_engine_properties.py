"""For any composition of a scene: counts are those of geometry, and ghosts, order and the batch change nothing."""

import functools
from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import scene_state, scenes_of, truth
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.engines import make_engine
from envs.state import Contacts, State
from swarm_mjcf.spec import SceneSpec

ENGINES = ("native", "mjx")
SPEC = SceneSpec(
    num_agents=4, num_obstacles=2, obstacle_radius=2.0, arena=20.0, dt=0.02, substeps=1, moving_obstacles=True
)
SCENES = 32


@functools.cache
def stepper(engine: str):
    return jax.jit(make_engine(SPEC, engine).step)


def step(engine: str, state: State, pull: np.ndarray) -> tuple[State, Contacts]:
    return jax.device_get(stepper(engine)(*jax.device_put((state, pull))))


compositions = st.tuples(
    st.integers(0, 2**32 - 1),
    st.floats(1.0, 12.0),
    st.lists(st.lists(st.booleans(), min_size=6, max_size=6), min_size=1, max_size=8),
)
"""Seed, half-width of the crowd [m], and which of four agents and two obstacles are there, in up to eight ways."""


def scenes(seed: int, half: float, bodies: list[list[bool]]) -> tuple[State, np.ndarray]:
    """A batch of scenes as dense as `half` makes them, each with bodies present in one of the ways; accelerations."""
    rng = np.random.default_rng(seed)
    present = np.array(bodies)[rng.integers(0, len(bodies), SCENES)]
    agents, obstacles = present[:, :4], present[:, 4:]
    position, velocity, pull = (rng.uniform(-h, h, (SCENES, 4, 2)) for h in (half, 7, 7))
    state = scene_state(
        SPEC,
        position,
        velocity,
        obstacle=rng.uniform(-half, half, (SCENES, 2, 2)),
        agent_present=agents,
        obstacle_present=obstacles,
    )
    pace = np.where(obstacles[..., None], rng.uniform(-7, 7, (SCENES, 2, 2)), 0).astype(np.float32)
    return replace(state, obstacle_velocity=pace), np.where(agents[..., None], pull, 0).astype(np.float32)


@pytest.mark.parametrize("engine", ENGINES)
@settings(max_examples=15)
@given(drawn=compositions)
def test_counts_equal_geometry(engine: str, drawn: tuple[int, float, list[list[bool]]]):
    start, pull = scenes(*drawn)
    after, contacts = step(engine, start, pull)
    expected = truth(SPEC, after)
    clear, here = ~expected.borderline, start.agent_present
    for count, flag, true in (
        (contacts.agent_states, after.touching_agent, expected.agent),
        (contacts.obstacle_states, after.touching_obstacle.any(-1), expected.obstacle.any(-1)),
    ):
        np.testing.assert_array_equal(count[clear], true[clear])
        np.testing.assert_array_equal(flag[clear], true[clear])
        assert not count[~here].any()
    onsets = after.touching_obstacle.sum(-1)
    np.testing.assert_array_equal(contacts.obstacle_events, onsets)
    np.testing.assert_allclose(contacts.agent_depth[clear], expected.agent_depth[clear], atol=2e-5)
    assert not contacts.saturated.any()


@pytest.mark.parametrize("engine", ENGINES)
@settings(max_examples=10)
@given(drawn=compositions, seed=st.integers(0, 1000))
def test_the_order_of_agents_of_obstacles_and_of_scenes_changes_nothing(
    engine: str, drawn: tuple[int, float, list[list[bool]]], seed: int
):
    start, pull = scenes(*drawn)
    rng = np.random.default_rng(seed)
    batch, agent, obstacle = rng.permutation(SCENES), rng.permutation(4), rng.permutation(2)
    shuffled = replace(
        start,
        position=start.position[:, agent],
        velocity=start.velocity[:, agent],
        agent_present=start.agent_present[:, agent],
        obstacle=start.obstacle[:, obstacle],
        obstacle_velocity=start.obstacle_velocity[:, obstacle],
        obstacle_present=start.obstacle_present[:, obstacle],
    )
    whole, counted = step(engine, start, pull)
    after, contacts = step(engine, scenes_of(shuffled, batch), pull[batch][:, agent])
    sure = ~truth(SPEC, whole).borderline.any(axis=1)[batch]
    for field in ("agent_states", "obstacle_states", "agent_events", "obstacle_events"):
        expected = getattr(counted, field)[batch][:, agent]
        np.testing.assert_array_equal(getattr(contacts, field)[sure], expected[sure], err_msg=field)
    # The solver stops after few iterations, so that deep clumps differ in what order leaves undone.
    apart = np.abs(after.position - whole.position[batch][:, agent]).max(axis=(1, 2))
    assert (apart < 1e-3).all()
    np.testing.assert_allclose(after.obstacle, whole.obstacle[batch][:, obstacle], atol=1e-6)


@pytest.mark.parametrize("engine", ENGINES)
@settings(max_examples=10)
@given(drawn=compositions, seed=st.integers(0, 1000))
def test_ghosts_change_nothing_wherever_they_say_they_are(
    engine: str, drawn: tuple[int, float, list[list[bool]]], seed: int
):
    start, pull = scenes(*drawn)
    rng = np.random.default_rng(seed)
    whole, counted = step(engine, start, pull)
    # Other ghosts: farther away still, at other places; and told to accelerate by what the environment would clear.
    ghost, gone = ~start.agent_present[..., None], ~start.obstacle_present[..., None]
    haunted = replace(
        start,
        position=np.where(ghost, start.position - rng.uniform(0, 90, (SCENES, 4, 1)), start.position).astype(
            np.float32
        ),
        obstacle_velocity=np.where(gone, np.float32(5), start.obstacle_velocity),
    )
    after, contacts = step(engine, haunted, pull)
    here = start.agent_present
    np.testing.assert_array_equal(after.obstacle, whole.obstacle)
    np.testing.assert_allclose(after.position[here], whole.position[here], atol=1e-5)
    for field in ("agent_states", "obstacle_states", "agent_events", "obstacle_events"):
        np.testing.assert_array_equal(getattr(contacts, field)[here], getattr(counted, field)[here], err_msg=field)
