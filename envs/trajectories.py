"""The data record: trajectories of typed nodes with masks, contacts and provenance. NumPy; files: `envs.storage`."""

import dataclasses
import importlib.metadata
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from envs.record import Array
from envs.rollout import Recording
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.spec import SceneSpec

GOAL, OBSTACLE, AGENT = 0, 1, 2
"""Node kinds. Nodes are in the order goals, obstacles, agents."""
NO_EDGE, GOAL_EDGE, OBSTACLE_EDGE, AGENT_EDGE = 0, 1, 2, 3
"""Edge types (source, target): goal->agent, obstacle->agent, agent->agent."""


class TrajectoryError(SwarmError):
    """Trajectories, or a file of them, cannot be used; the message says which and why."""


@dataclass(frozen=True, kw_only=True)
class Trajectories:
    """S scenes, T states dt apart, V nodes. Masked entries are 0. Contacts at row t are of the step from t-1 to t.

    Raises TrajectoryError for non-finite positions or velocities of present nodes.
    """

    position: Float[np.ndarray, "S T V 2"]
    """[m]"""
    velocity: Float[np.ndarray, "S T V 2"]
    """[m/s]"""
    mask: Bool[np.ndarray, "S T V"]
    """Whether the node is present."""
    kind: Int[np.ndarray, "S V"]
    """GOAL, OBSTACLE or AGENT."""
    radius: Float[np.ndarray, "S V"]
    """Radius of the body [m]; 0 for a goal."""
    edges: Int[np.ndarray, "S V V"]
    """Edge type from source (row) to target (column)."""
    agent_contact: Int[np.ndarray, "S T V"]
    """Number of substep states at which the node touches another agent."""
    solid_contact: Int[np.ndarray, "S T V"]
    """Number of substep states at which the node touches an obstacle or wall."""
    agent_events: Int[np.ndarray, "S T V"]
    """Onsets of agent-agent contact."""
    solid_events: Int[np.ndarray, "S T V"]
    depth: Float[np.ndarray, "S T V"]
    """Deepest penetration of the step [m]."""
    dt: float
    """Time between rows [s]."""
    substeps: int
    """Physics steps per row; decoders need it."""
    max_speed: float
    """[m/s]"""
    max_acceleration: float
    """[m/s^2]"""
    provenance: dict
    """Scene, expert, seed, engine, versions: plain JSON."""
    saturated: Int[np.ndarray, "S T"] = None  # pyright: ignore[reportAssignmentType]
    """Number of substep states at which the engine's contact cap was full, so that contacts may be missing; when not
    given (there was no engine), zeros."""

    def __post_init__(self) -> None:
        if self.saturated is None:
            object.__setattr__(self, "saturated", np.zeros(self.mask.shape[:2], np.int16))
        for name in ("position", "velocity"):
            bad = ~np.isfinite(getattr(self, name)).all(axis=-1) & self.mask
            if bad.any():
                scene, t, node = (int(i) for i in np.argwhere(bad)[0])
                raise TrajectoryError(
                    f"{name} is not finite in {int(bad.any(axis=(1, 2)).sum())} of {len(bad)} scenes; "
                    f"first at scene {scene}, row {t}, node {node}"
                )

    def __len__(self) -> int:
        return len(self.position)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of goal, obstacle and agent nodes; the same places in every scene (absent ones are masked)."""
        goals, obstacles, agents = (int((self.kind[0] == kind).sum()) for kind in (GOAL, OBSTACLE, AGENT))
        return goals, obstacles, agents

    def rows(self, first: int, count: int) -> "Trajectories":
        """`count` rows of every scene, from row `first` on."""
        cut = {name: getattr(self, name)[:, first : first + count] for name in ARRAYS if name not in UNTIMED}
        return dataclasses.replace(self, **cut)

    def take(self, scenes: slice | Sequence[int] | Int[np.ndarray, " n"]) -> "Trajectories":
        """Some of the scenes."""
        return dataclasses.replace(self, **{name: getattr(self, name)[scenes] for name in ARRAYS})


ARRAYS = (
    "position", "velocity", "mask", "kind", "radius", "edges",
    "agent_contact", "solid_contact", "agent_events", "solid_events", "depth", "saturated",
)  # fmt: skip
"""The array fields of `Trajectories`, in the order of the file."""
UNTIMED = ("kind", "radius", "edges")
"""Those without an axis of rows."""


def concatenate(parts: Sequence[Trajectories]) -> Trajectories:
    """Scenes of all parts; dt, limits and provenance are the first part's."""
    return dataclasses.replace(parts[0], **{n: np.concatenate([getattr(p, n) for p in parts]) for n in ARRAYS})


def edge_types(kind: Int[np.ndarray, "S V"], present: Bool[np.ndarray, "S V"]) -> Int[np.ndarray, "S V V"]:
    """The graph in which every agent receives from every goal, obstacle and other agent that is present."""
    by_source = np.where(present, kind + 1, NO_EDGE).astype(np.int8)
    receives = (kind == AGENT) & present
    edges = by_source[:, :, None] * receives[:, None, :]
    nodes = np.arange(kind.shape[1])
    edges[:, nodes, nodes] = NO_EDGE
    return edges


def chasing(edges: Int[np.ndarray, "S V V"], target: Int[np.ndarray, "S N M"]) -> Int[np.ndarray, "S V V"]:
    """The graph of chasers: of the edges between agents only those from an agent's targets stay (-1: no target)."""
    agents = target.shape[1]
    chased = (target[..., None] == np.arange(agents)).any(axis=2)  # (scene, chaser, target)
    kept = edges.copy()
    kept[:, -agents:, -agents:] *= chased.transpose(0, 2, 1)
    return kept


def from_recording(recording: Recording, spec: SceneSpec, provenance: dict) -> Trajectories:
    """Trajectories of a rollout: nodes goal, obstacles, agents; absent nodes masked and zero."""
    start = recording.start
    position, velocity = np.asarray(recording.position), np.asarray(recording.velocity)
    scenes, rows, agents, _ = position.shape
    contacts = recording.contacts
    _warn_of_saturation(np.asarray(contacts.saturated), spec.substeps)

    def throughout(value: Array) -> np.ndarray:
        return np.repeat(np.asarray(value)[:, None], rows, axis=1)

    obstacle = throughout(start.obstacle) if recording.obstacle is None else np.asarray(recording.obstacle)
    velocities = throughout(np.asarray(start.obstacle_velocity) * spec.moving_obstacles)
    if spec.goal:
        goal = throughout(start.goal)[:, :, None]
        obstacle = np.concatenate([goal, obstacle], axis=2)
        velocities = np.concatenate([np.zeros_like(goal), velocities], axis=2)
    nodes = obstacle.shape[2]
    present = np.concatenate(
        [np.ones((scenes, int(spec.goal)), bool), np.asarray(start.obstacle_present), np.asarray(start.agent_present)],
        1,
    )
    kind = np.repeat([GOAL, OBSTACLE, AGENT], [int(spec.goal), spec.num_obstacles, agents]).astype(np.int8)
    kind = np.broadcast_to(kind, (scenes, nodes + agents)).copy()
    mask = np.broadcast_to(present[:, None], (scenes, rows, nodes + agents)).copy()

    def nodes_of(agents: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.where(mask[..., None], np.concatenate([others, agents], axis=2), 0).astype(np.float32)

    def per_row(values: Array, dtype: type = np.int16) -> np.ndarray:
        full = np.zeros((scenes, rows, nodes + agents), dtype)
        full[:, 1:, nodes:] = np.asarray(values)
        return full

    edges = edge_types(kind, present)
    if start.target.shape[-1]:
        edges = chasing(edges, np.asarray(start.target))
    radius = np.select([kind == AGENT, kind == OBSTACLE], [spec.agent_radius, spec.obstacle_radius], 0.0)
    return Trajectories(
        position=nodes_of(position, obstacle),
        velocity=nodes_of(velocity, velocities),
        mask=mask,
        kind=kind,
        radius=np.where(present, radius, 0).astype(np.float32),
        edges=edges,
        agent_contact=per_row(contacts.agent_states),
        solid_contact=per_row(np.asarray(contacts.obstacle_states) + np.asarray(contacts.wall_states)),
        agent_events=per_row(contacts.agent_events),
        solid_events=per_row(np.asarray(contacts.obstacle_events) + np.asarray(contacts.wall_events)),
        depth=per_row(
            np.maximum(np.maximum(contacts.agent_depth, contacts.obstacle_depth), contacts.wall_depth), np.float32
        ),
        dt=spec.dt,
        substeps=spec.substeps,
        max_speed=spec.max_speed,
        max_acceleration=spec.max_acceleration,
        provenance=provenance,
        saturated=np.pad(np.asarray(contacts.saturated), ((0, 0), (1, 0))).astype(np.int16),
    )


def _warn_of_saturation(saturated: Int[np.ndarray, "S T"], substeps: int) -> None:
    if saturated.any():
        warnings.warn(
            f"contacts may be missing: the engine's contact cap was full at {saturated.sum()} of "
            f"{saturated.size * substeps} states, in {saturated.any(axis=1).sum()} of {len(saturated)} scenes; give "
            "the engine larger caps",
            stacklevel=3,
        )


def versions() -> dict[str, str]:
    """Versions of the packages whose numbers matter."""
    return {name: importlib.metadata.version(name) for name in ("mujoco", "jax", "jaxlib", "flax", "numpy")}
