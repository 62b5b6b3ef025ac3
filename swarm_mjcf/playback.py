"""What a picture or a video shows: positions over time, who is present, and who touches whom. Plain arrays, checked."""

import math
from dataclasses import dataclass

import numpy as np

from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class Playback:
    """One run of N agents among K obstacles over T rows, as it is drawn.

    Raises:
      SpecError: an array has the wrong shape or kind, or the position of somebody present is not finite.
    """

    position: np.ndarray
    """Where the agents are [m], (T, N, 2); values of absent agents are ignored and may be NaN."""
    agent_present: np.ndarray
    """Who is there, bool (T, N), or (N,) for the whole run; kept as (T, N)."""
    obstacle: np.ndarray
    """Where the obstacles are [m], (T, K, 2), or (K, 2) when they stand still; kept as (T, K, 2)."""
    obstacle_present: np.ndarray
    """Which obstacles are there, bool (T, K), or (K,) for the whole run; kept as (T, K)."""
    goal: np.ndarray | None = None
    """Where the goal lies [m], (2,), or None without one."""
    touching: np.ndarray
    """Whether an agent touches another agent, bool (T, N)."""
    touching_solid: np.ndarray
    """Whether an agent touches an obstacle or a wall, bool (T, N)."""
    dt: float | int
    """Time between two rows [s]."""
    title: str = ""
    """One line above the picture."""
    depth: np.ndarray | None = None
    """Deepest penetration of each agent in the step that ends at the row [m], (T, N), or None where unknown."""
    reference: np.ndarray | None = None
    """A second trajectory [m], (T, N, 2), drawn dashed: the truth below a prediction, say. NaN where unknown."""
    reference_title: str = ""
    """What the dashed trajectory is, for the caption."""

    def __post_init__(self) -> None:
        if self.position.ndim != 3 or 0 in self.position.shape or self.position.shape[2] != 2:
            raise SpecError(
                "position", self.position.shape, "an array of shape (T, N, 2) with at least 1 row and 1 agent"
            )
        rows, agents, _ = self.position.shape
        solids = self.obstacle.shape[-2] if self.obstacle.ndim >= 2 else 0
        if self.obstacle.shape != (solids, 2):
            _need_shape("obstacle", self.obstacle, (rows, solids, 2))
        if self.obstacle_present.shape != (solids,):
            _need_shape("obstacle_present", self.obstacle_present, (rows, solids))
        _need_shape("touching", self.touching, (rows, agents))
        _need_shape("touching_solid", self.touching_solid, (rows, agents))
        if self.agent_present.shape != (agents,):
            _need_shape("agent_present", self.agent_present, (rows, agents))
        for field in ("agent_present", "obstacle_present", "touching", "touching_solid"):
            if getattr(self, field).dtype != np.bool_:
                raise SpecError(field, getattr(self, field).dtype, "an array of bool")
        if self.goal is not None:
            _need_shape("goal", self.goal, (2,))
        if self.depth is not None:
            _need_shape("depth", self.depth, (rows, agents))
        if self.reference is not None:
            _need_shape("reference", self.reference, self.position.shape)
        if not 0 < self.dt < math.inf:
            raise SpecError("dt", self.dt, "a finite number above 0 [s]")
        object.__setattr__(self, "agent_present", np.broadcast_to(self.agent_present, (rows, agents)))
        object.__setattr__(self, "obstacle", np.broadcast_to(self.obstacle, (rows, solids, 2)))
        object.__setattr__(self, "obstacle_present", np.broadcast_to(self.obstacle_present, (rows, solids)))
        lost = self.agent_present & ~np.isfinite(self.position).all(-1)
        if lost.any():
            t, i = np.argwhere(lost)[0]
            raise SpecError(f"position[{t}, {i}]", self.position[t, i], "finite wherever agent_present is True")
        if not np.isfinite(self.obstacle[self.obstacle_present]).all():
            raise SpecError("obstacle", self.obstacle, "finite wherever obstacle_present is True")

    @property
    def agent_hit(self) -> np.ndarray:
        """Whether a present agent touches another agent, bool (T, N)."""
        return self.touching & self.agent_present

    @property
    def solid_hit(self) -> np.ndarray:
        """Whether a present agent touches an obstacle or a wall, bool (T, N)."""
        return self.touching_solid & self.agent_present


def began(hit: np.ndarray) -> np.ndarray:
    """Where a contact begins, bool (T, N); `hit` is bool (T, N)."""
    onset = hit.copy()
    onset[1:] &= ~hit[:-1]
    return onset


def onsets(hit: np.ndarray) -> np.ndarray:
    """Contact events so far, (T,): how often an agent began to touch, counted per agent. `hit` is bool (T, N)."""
    return np.cumsum(began(hit).sum(axis=1))


def _need_shape(field: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise SpecError(field, array.shape, f"an array of shape {shape}")
