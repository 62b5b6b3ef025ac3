"""What several test modules share: states from plain lists, and the float64 geometry that judges contacts."""

from dataclasses import dataclass

import jax
import numpy as np

from envs.state import State, make_state, park
from swarm_mjcf.spec import SceneSpec


def scene_state(
    spec: SceneSpec,
    position,
    velocity=None,
    *,
    goal=None,
    obstacle=None,
    agent_present=None,
    obstacle_present=None,
    target=None,
) -> State:
    """A float32 state from anything array-like; what is not given is zero, present, or (obstacles) absent."""
    position = np.asarray(position, np.float32)
    scenes = len(position)
    if obstacle is None:
        obstacle = np.zeros((scenes, spec.num_obstacles, 2))
        obstacle_present = np.zeros((scenes, spec.num_obstacles), bool)
    state = make_state(
        position=position,
        velocity=np.zeros_like(position) if velocity is None else np.asarray(velocity, np.float32),
        goal=np.zeros((scenes, 2), np.float32) if goal is None else np.asarray(goal, np.float32),
        obstacle=np.asarray(obstacle, np.float32),
        agent_present=None if agent_present is None else np.asarray(agent_present, bool),
        obstacle_present=None if obstacle_present is None else np.asarray(obstacle_present, bool),
        target=target,
    )
    return jax.device_get(park(state, spec))


def scenes_of(tree, rows):
    """The same record with some of its scenes, in the given order."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


def assert_same(first, second) -> None:
    """Every leaf of two records is identical to the bit (NaN equals NaN)."""
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b), err_msg=jax.tree_util.keystr(path))


@dataclass
class Truth:
    """What touches what by sphere geometry in float64, and agents of which a pair is within 1e-4 m of touching."""

    agent: np.ndarray
    obstacle: np.ndarray
    wall: np.ndarray
    agent_depth: np.ndarray
    obstacle_depth: np.ndarray
    wall_depth: np.ndarray
    borderline: np.ndarray


def truth(spec: SceneSpec, state: State, margin: float = 1e-4) -> Truth:
    """Spheres touch when centres are closer than the sum of radii; a wall where a sphere reaches over the border."""
    position, obstacle = (np.asarray(x, np.float64) for x in (state.position, state.obstacle))
    apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) - 2 * spec.agent_radius
    apart[:, np.arange(spec.num_agents), np.arange(spec.num_agents)] = np.inf
    solid = np.linalg.norm(position[:, :, None] - obstacle[:, None], axis=-1) - spec.agent_radius - spec.obstacle_radius
    wall = np.full(position.shape[:2], np.inf)
    if spec.walls:
        inside = np.asarray(state.agent_present)
        wall = np.where(inside, spec.arena - spec.agent_radius - np.abs(position).max(axis=-1), np.inf)
    near = (np.abs(apart) < margin).any(-1) | (np.abs(solid) < margin).any(-1) | (np.abs(wall) < margin)
    return Truth(
        agent=(apart < 0).any(axis=-1),
        obstacle=solid < 0,
        wall=wall < 0,
        agent_depth=np.maximum(-apart.min(axis=-1), 0),
        obstacle_depth=np.maximum(-solid.min(axis=-1, initial=np.inf), 0),
        wall_depth=np.maximum(-wall, 0),
        borderline=near,
    )


def make_trajectories(
    *, scenes: int = 2, rows: int = 4, goals: int = 1, obstacles: int = 1, agents: int = 2, seed: int = 0
):
    """Random trajectories of any shape, consistent in masks and edges, with no engine behind them."""
    from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, edge_types

    rng = np.random.default_rng(seed)
    nodes = goals + obstacles + agents
    shape = (scenes, rows, nodes)
    kind = np.broadcast_to(np.repeat([GOAL, OBSTACLE, AGENT], [goals, obstacles, agents]), (scenes, nodes)).astype(
        np.int8
    )
    mask = np.broadcast_to((rng.random((scenes, 1, nodes)) < 0.8), shape).copy()

    def field(dtype: type, *more: int) -> np.ndarray:
        values = rng.uniform(-50, 50, (*shape, *more)) if dtype is np.float32 else rng.integers(0, 30, shape)
        return np.where(mask[(...,) + (None,) * len(more)], values, 0).astype(dtype)

    return Trajectories(
        position=field(np.float32, 2),
        velocity=field(np.float32, 2),
        mask=mask,
        kind=kind.copy(),
        radius=rng.uniform(0, 8, (scenes, nodes)).astype(np.float32),
        edges=edge_types(kind, mask[:, 0]),
        agent_contact=field(np.int16),
        solid_contact=field(np.int16),
        agent_events=field(np.int16),
        solid_events=field(np.int16),
        depth=np.abs(field(np.float32)),
        dt=0.3,
        substeps=15,
        max_speed=10.0,
        max_acceleration=float("inf"),
        provenance={"seed": seed, "text": "Jülich", "nested": {"list": [1, 2.5, None, True]}},
    )


def assert_same_trajectories(first, second) -> None:
    """Equal arrays, dtypes, scalars and provenance."""
    from envs.trajectories import ARRAYS

    for name in ARRAYS:
        a, b = getattr(first, name), getattr(second, name)
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b, err_msg=name)
    for name in ("dt", "substeps", "max_speed", "max_acceleration", "provenance"):
        assert getattr(first, name) == getattr(second, name), name
