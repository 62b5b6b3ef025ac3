"""Scenes that nobody could have saved: by hand, and against policies of every kind."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from helpers import scene_state
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.rollout import make_rollout
from envs.swarm_env import SwarmEnv, scene_keys
from gnn.decode import Integrator
from gnn.graph import Graph, graph_of_state
from repair.lost import lost
from repair.screen import Acted
from swarm_mjcf.spec import SceneSpec

MOTION = Integrator(dt=0.3, substeps=3, max_speed=20.0, max_acceleration=10.0)
BODIES = SimpleNamespace(agent_radius=1.0, obstacle_radius=2.0)
STEPS = 10


def acted(nodes: np.ndarray, present: np.ndarray | None = None) -> Acted:
    """Scenes of a goal, an obstacle and two agents that begin in `nodes` (S, 4, 4); what follows does not matter."""
    here = np.ones(nodes.shape[:2], bool) if present is None else present
    agents = here[:, 2:]
    empty = np.zeros((len(nodes), STEPS, 2), bool)
    return Acted(
        nodes=np.repeat(nodes[:, None], STEPS + 1, axis=1),
        graph=Graph(
            goal=agents[:, :, None],
            obstacle=agents[:, :, None] & here[:, None, 1:2],
            agent=agents[:, :, None] & agents[:, None] & ~np.eye(2, dtype=bool),
            present=here,
        ),
        touching_agent=empty,
        touching_obstacle=empty,
    )


def scene(gap: float, speed: float, aside: float = 0.0, *, other: tuple[float, float] = (500.0, 0.0)) -> np.ndarray:
    """An agent `gap` metres before the obstacle (centres 3 m apart touch) and `aside` of the line, flying at it; the
    second agent is elsewhere."""
    return np.array([[0.0] * 4, [0.0] * 4, [-3.0 - gap, aside, speed, 0.0], [*other, 0.0, 0.0]])


def test_by_hand():
    """h = 0.1 s, so that a body can be moved by 0.05 n (n + 1) m in n physics steps."""
    cases = (
        (scene(0.5, 0.0), False),
        (scene(0.5, 10.0), True),  # n = 1: 2.5 m from the centre, 0.1 m can be added, 3 m touch
        (scene(0.99, 12.0), True),  # n = 1: 2.79 + 0.1; n = 2: 1.59 + 0.3
        (scene(1.3, 5.0), False),  # it passes the centre at n = 9, where it can be 4.5 m aside; n = 5: 1.8 + 1.5 = 3.3
        (scene(0.5, 10.0, aside=2.95), False),  # n = 3, 4: at the side of the obstacle, 2.99 + 0.6 and 2.99 + 1
    )
    found = lost(acted(np.stack([nodes for nodes, _ in cases])), BODIES, MOTION)
    assert found.tolist() == [wrong for _, wrong in cases]


def test_two_agents_can_add_twice_as_much():
    """Centres 2 m apart touch; at 10 m/s towards each other they come to 1 m less a physics step, and can add 0.1 n
    (n + 1) m."""
    nodes = np.zeros((4, 4, 4))
    nodes[:, 1, :2] = 90.0
    nodes[:, 2, 0], nodes[:, 3, 0] = 50.0, 50.0 + np.array([2.85, 4.9, 2.85, 2.85])
    nodes[:, 2, 2], nodes[:, 3, 2] = 5.0, -5.0
    nodes[3, 2:, 2] *= 0.08
    here = np.ones((4, 4), bool)
    here[2, 3] = False
    # n = 2: 0.85 + 0.6; 2.9 + 0.6 and then n = 3: 1.9 + 1.2, n = 4: 0.9 + 2; nobody there; 0.8 m/s.
    assert lost(acted(nodes, here), BODIES, MOTION).tolist() == [True, False, False, False]


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**31), with_obstacle=st.booleans())
def test_whoever_is_lost_touches_whatever_it_does(seed: int, with_obstacle: bool):
    """Accelerations at random, fixed and straight away from each other; limits as in physics."""
    rng = np.random.default_rng(seed)
    nodes = np.zeros((1000, 4, 4))
    angle = rng.uniform(0, 2 * np.pi, (1000, 2))
    nodes[:, 2:, :2] = rng.uniform(3.0, 7.0, (1000, 2, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    nodes[:, 2:, 2:] = -nodes[:, 2:, :2] * rng.uniform(0, 4, (1000, 2, 1)) + rng.normal(0, 3, (1000, 2, 2))
    speed = np.linalg.norm(nodes[:, 2:, 2:], axis=-1, keepdims=True)
    nodes[:, 2:, 2:] *= np.minimum(1, MOTION.max_speed / np.maximum(speed, 1e-9))
    apart = np.linalg.norm(nodes[:, 2, :2] - nodes[:, 3, :2], axis=-1) > 2
    nodes = nodes[apart]
    here = np.ones(nodes.shape[:2], bool)
    here[:, 1] = with_obstacle
    hopeless = lost(acted(nodes, here), BODIES, MOTION)
    assert 0 < hopeless.sum() < len(nodes)
    for kind in ("random", "away", "fixed"):
        position, velocity = nodes[:, 2:, :2].copy(), nodes[:, 2:, 2:].copy()
        touched = np.zeros(len(nodes), bool)
        fixed = rng.normal(size=position.shape)
        for _ in range(STEPS):
            between = position[:, :1] - position[:, 1:]
            away = with_obstacle * position / 2 + np.concatenate([between, -between], axis=1)
            want = {"random": rng.normal(size=position.shape), "away": away, "fixed": fixed}[kind]
            u = MOTION.max_acceleration * want / np.linalg.norm(want, axis=-1, keepdims=True)
            after = velocity + u * MOTION.dt
            size = np.linalg.norm(after, axis=-1, keepdims=True)
            u = (after * np.minimum(1, MOTION.max_speed / size) - velocity) / MOTION.dt
            for _ in range(MOTION.substeps):
                velocity = velocity + u * MOTION.dt / MOTION.substeps
                position = position + velocity * MOTION.dt / MOTION.substeps
                touched |= with_obstacle & (np.linalg.norm(position, axis=-1) < 3).any(axis=1)
                touched |= np.linalg.norm(position[:, 0] - position[:, 1], axis=-1) < 2
        assert touched[hopeless].all(), kind


def test_physics_agrees():
    """Agents in MuJoCo that start at random among two others and an obstacle, braking as hard as they can."""
    spec = SceneSpec(num_agents=3, num_obstacles=1)
    env, scenes = SwarmEnv(spec, engine="native", horizon=6), 300
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, (scenes, 3))
    side = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    start = scene_state(
        spec,
        rng.uniform(8.2, 12, (scenes, 3, 1)) * side,
        -rng.uniform(0, 9, (scenes, 3, 1)) * side,
        obstacle=np.zeros((scenes, 1, 2)),
        obstacle_present=np.ones((scenes, 1), bool),
    )

    def brake(state, params, key=None):
        return -10.0 * state.velocity / jnp.maximum(jnp.linalg.norm(state.velocity, axis=-1, keepdims=True), 1e-6)

    recording = jax.device_get(make_rollout(env, brake, steps=6)(None, start, scene_keys(0, np.arange(scenes))))
    nodes, graph = jax.device_get(graph_of_state(start, goal=True))
    touching = recording.contacts.agent_states > 0, recording.contacts.obstacle_states > 0
    begun = Acted(
        nodes=np.repeat(nodes[:, None], 7, axis=1),
        graph=graph,
        touching_agent=touching[0],
        touching_obstacle=touching[1],
    )
    hopeless, touched = lost(begun, spec, spec), (touching[0] | touching[1]).any(axis=(1, 2))
    assert touched[hopeless].all()
    assert 10 < hopeless.sum() < touched.sum() < scenes


def test_nothing_is_said_of_who_begins_faster_than_it_may():
    """At 20 m/s with a limit of 5 m/s the first control step slows it down by 50 m/s^2."""
    slower = Integrator(dt=0.3, substeps=3, max_speed=5.0, max_acceleration=10.0)
    nodes = scene(1.6, 20.0)[None]
    assert lost(acted(nodes), BODIES, MOTION).all()
    assert not lost(acted(nodes), BODIES, slower).any()


def test_who_can_do_anything_is_never_lost():
    unlimited = Integrator(dt=0.3, substeps=3, max_speed=np.inf, max_acceleration=np.inf)
    assert not lost(acted(scene(0.01, 30.0)[None]), BODIES, unlimited).any()
