"""Scenes that nobody could have saved: by hand, and against policies of every kind."""

from types import SimpleNamespace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gnn.decode import Integrator
from gnn.graph import Graph
from repair.lost import lost
from repair.screen import Acted

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
        (scene(0.5, 10.0, aside=2.95), False),  # n = 5: at the side of the obstacle, 2.99 + 1.5
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
@given(seed=st.integers(0, 2**31))
def test_whoever_is_lost_touches_whatever_it_does(seed: int):
    """Accelerations at random, bang-bang and straight away from each other; limits as in physics."""
    rng = np.random.default_rng(seed)
    nodes = np.zeros((200, 4, 4))
    angle = rng.uniform(0, 2 * np.pi, (200, 2))
    nodes[:, 2:, :2] = rng.uniform(3.0, 7.0, (200, 2, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    nodes[:, 2:, 2:] = -nodes[:, 2:, :2] * rng.uniform(0, 4, (200, 2, 1)) + rng.normal(0, 3, (200, 2, 2))
    speed = np.linalg.norm(nodes[:, 2:, 2:], axis=-1, keepdims=True)
    nodes[:, 2:, 2:] *= np.minimum(1, MOTION.max_speed / np.maximum(speed, 1e-9))
    apart = np.linalg.norm(nodes[:, 2, :2] - nodes[:, 3, :2], axis=-1) > 2
    nodes = nodes[apart]
    hopeless = lost(acted(nodes), BODIES, MOTION)
    for kind in ("random", "away", "fixed"):
        position, velocity = nodes[:, 2:, :2].copy(), nodes[:, 2:, 2:].copy()
        touched = np.zeros(len(nodes), bool)
        fixed = rng.normal(size=position.shape)
        for _ in range(STEPS):
            between = position[:, :1] - position[:, 1:]
            away = position / 2 + np.concatenate([between, -between], axis=1)
            want = {"random": rng.normal(size=position.shape), "away": away, "fixed": fixed}[kind]
            u = MOTION.max_acceleration * want / np.linalg.norm(want, axis=-1, keepdims=True)
            after = velocity + u * MOTION.dt
            size = np.linalg.norm(after, axis=-1, keepdims=True)
            u = (after * np.minimum(1, MOTION.max_speed / size) - velocity) / MOTION.dt
            for _ in range(MOTION.substeps):
                velocity = velocity + u * MOTION.dt / MOTION.substeps
                position = position + velocity * MOTION.dt / MOTION.substeps
                touched |= (np.linalg.norm(position, axis=-1) < 3).any(axis=1)
                touched |= np.linalg.norm(position[:, 0] - position[:, 1], axis=-1) < 2
        assert touched[hopeless].all(), kind


def test_some_of_those_are_lost():
    """The property above is about something."""
    rng = np.random.default_rng(0)
    nodes = np.stack([scene(gap, speed) for gap, speed in rng.uniform((0.1, 0), (4, 12), (200, 2))])
    assert 20 < lost(acted(nodes), BODIES, MOTION).sum() < 180


def test_who_can_do_anything_is_never_lost():
    unlimited = Integrator(dt=0.3, substeps=3, max_speed=np.inf, max_acceleration=np.inf)
    assert not lost(acted(scene(0.01, 30.0)[None]), BODIES, unlimited).any()
