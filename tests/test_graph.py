"""The graph: typed edges end up in the right mask, ghosts are alone, and both ways to build it agree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same, make_trajectories, scene_state
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.rollout import Recording
from envs.state import no_contacts
from envs.trajectories import AGENT, GOAL, OBSTACLE, edge_types, from_recording
from gnn.graph import graph_of_edges, graph_of_state
from gnn.windows import Dataset, windows
from swarm_mjcf.spec import SceneSpec


def test_edges_from_source_to_target_become_masks_of_receiver_and_sender():
    # Nodes: goal 0, obstacles 1 and 2, agents 3, 4, 5.
    edges = np.zeros((1, 6, 6), int)
    edges[0, 0, 3] = 1  # the goal speaks to the first agent alone
    edges[0, 2, 4] = 2  # the second obstacle to the second agent
    edges[0, 3, 5] = 3  # the first agent to the third, one way
    graph = graph_of_edges(jnp.asarray(edges), jnp.ones((1, 6), bool), (1, 2, 3))
    assert graph.counts == (1, 2, 3)
    np.testing.assert_array_equal(graph.goal[0], [[True], [False], [False]])
    np.testing.assert_array_equal(graph.obstacle[0], [[False, False], [False, True], [False, False]])
    np.testing.assert_array_equal(graph.agent[0], [[False] * 3, [False] * 3, [True, False, False]])


def test_an_edge_into_a_static_node_or_of_another_type_is_no_message():
    edges = np.zeros((1, 3, 3), int)  # goal, obstacle, agent
    edges[0, 2, 0] = edges[0, 2, 1] = 3  # agents do not move goals or obstacles
    edges[0, 0, 2] = 2  # a goal is no obstacle
    graph = graph_of_edges(jnp.asarray(edges), jnp.ones((1, 3), bool), (1, 1, 1))
    assert not any(np.asarray(mask).any() for mask in (graph.goal, graph.obstacle, graph.agent))


def test_the_default_graph_has_every_edge_into_every_agent_but_its_own():
    kind = np.array([[GOAL, OBSTACLE, OBSTACLE, AGENT, AGENT, AGENT]], np.int8)
    everything = np.ones((1, 6), bool)
    graph = graph_of_edges(jnp.asarray(edge_types(kind, everything)), jnp.asarray(everything), (1, 2, 3))
    assert np.asarray(graph.goal).all()
    assert np.asarray(graph.obstacle).all()
    np.testing.assert_array_equal(graph.agent[0], ~np.eye(3, dtype=bool))


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6))
def test_ghosts_neither_send_nor_receive(seed: int):
    rng = np.random.default_rng(seed)
    goals, obstacles, agents = counts = (1, 2, 4)
    edges = rng.integers(0, 4, (2, 7, 7))
    present = rng.random((2, 7)) < 0.6
    graph = graph_of_edges(jnp.asarray(edges), jnp.asarray(present), counts)
    np.testing.assert_array_equal(graph.present, present)
    for scene in range(2):
        for i in range(agents):
            for mask, first, kind in ((graph.goal, 0, 1), (graph.obstacle, goals, 2), (graph.agent, 3, 3)):
                for j in range(mask.shape[-1]):
                    source, target = first + j, goals + obstacles + i
                    expected = (
                        edges[scene, source, target] == kind and present[scene, source] and present[scene, target]
                    )
                    assert bool(mask[scene, i, j]) == expected


@pytest.mark.parametrize("chasing", [False, True])
@pytest.mark.parametrize("goal", [True, False])
def test_a_state_and_its_recording_give_the_same_nodes_and_graph(goal: bool, chasing: bool):
    spec = SceneSpec(num_agents=4, num_obstacles=2, goal=goal, substeps=1, contacts=False)
    rng = np.random.default_rng(0)
    start = scene_state(
        spec,
        rng.uniform(-50, 50, (12, 4, 2)),
        rng.uniform(-5, 5, (12, 4, 2)),
        goal=rng.uniform(-50, 50, (12, 2)),
        obstacle=rng.uniform(-50, 50, (12, 2, 2)),
        agent_present=rng.random((12, 4)) < 0.6,
        obstacle_present=rng.random((12, 2)) < 0.6,
        target=rng.integers(-1, 4, (12, 4, 2)).astype(np.int32) if chasing else None,
    )
    twice = lambda x: np.stack([x, x], axis=1)  # noqa: E731
    still = jax.tree.map(lambda x: np.asarray(x)[:, None], no_contacts(12, 4))
    recording = Recording(start=start, position=twice(start.position), velocity=twice(start.velocity), contacts=still)
    trajectories = from_recording(recording, spec, {})
    everyone = jnp.arange(12)
    history, _, _, recorded = windows(
        Dataset.of(trajectories), everyone, jnp.zeros(12, int), window=1, horizon=1, counts=trajectories.counts
    )
    nodes, graph = graph_of_state(start, goal=goal)
    assert_same(jax.device_get(graph), jax.device_get(recorded))
    np.testing.assert_array_equal(nodes, history[:, 0])
    assert graph.counts == (int(goal), 2, 4)


def test_a_chaser_receives_from_its_targets_alone():
    spec = SceneSpec(num_agents=4, num_obstacles=0, goal=False, substeps=1, contacts=False)
    target = np.array([[[1, -1], [0, 3], [3, -1], [-1, -1]]], np.int32)
    place = np.zeros((1, 4, 2))
    _, graph = graph_of_state(scene_state(spec, place, place, target=target), goal=False)
    expected = np.zeros((4, 4), bool)
    expected[[0, 1, 1, 2], [1, 0, 3, 3]] = True  # (receiver, sender)
    np.testing.assert_array_equal(np.asarray(graph.agent)[0], expected)


def test_windows_are_the_rows_after_their_start():
    data = make_trajectories(scenes=3, rows=9, obstacles=2, agents=3)
    scene, start = np.array([2, 0]), np.array([4, 1])
    history, truth, mask, graph = windows(
        Dataset.of(data), jnp.asarray(scene), jnp.asarray(start), window=2, horizon=3, counts=data.counts
    )
    for b, (s, t) in enumerate(zip(scene, start, strict=True)):
        np.testing.assert_array_equal(history[b, ..., :2], data.position[s, t : t + 2])
        np.testing.assert_array_equal(truth[b, ..., 2:], data.velocity[s, t + 2 : t + 5])
        np.testing.assert_array_equal(mask[b], data.mask[s, t + 2 : t + 5])
        np.testing.assert_array_equal(graph.present[b], data.mask[s, t])


def test_a_node_that_enters_within_the_history_is_not_in_the_graph_and_not_judged():
    data = make_trajectories(scenes=1, rows=5, obstacles=0, agents=2)
    data.mask[:] = True
    data.mask[0, 0, 2] = False  # the second agent enters at row 1
    data.mask[0, 4, 1] = False  # the first leaves before row 4
    _, _, mask, graph = windows(
        Dataset.of(data), jnp.array([0]), jnp.array([0]), window=2, horizon=3, counts=data.counts
    )
    np.testing.assert_array_equal(graph.present[0], [True, True, False])
    np.testing.assert_array_equal(mask[0], [[True, True, False], [True, True, False], [True, False, False]])
