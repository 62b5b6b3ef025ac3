"""Which pair touches at which physics state: the table between contacts seen (replay, engine) and contacts told."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int

PARTNERS = ("agent", "obstacle", "wall")
"""What an agent can touch, by the number in `Touches.kind`; walls are numbered east, north, west, south."""
BY_AGENT, BY_OBSTACLE, BY_WALL = range(3)


@dataclass(frozen=True, kw_only=True)
class Touches:
    """P entries, one for each pair and each state at which it touches. Two agents are one pair, the lower one first.

    A scene's states are numbered through: control step t (1, 2, ...) of k substeps has the states (t - 1) k + 1 .. t k;
    state 0 is the start, at which nothing is counted.
    """

    scene: Int[np.ndarray, " P"]
    state: Int[np.ndarray, " P"]
    agent: Int[np.ndarray, " P"]
    """Number of the agent among the agents."""
    kind: Int[np.ndarray, " P"]
    """Of its partner, a place in `PARTNERS`."""
    partner: Int[np.ndarray, " P"]
    """Number of the partner among its kind."""
    depth: Float[np.ndarray, " P"]
    """Penetration [m], above 0."""
    relative_speed: Float[np.ndarray, " P"]
    """|v_partner - v_agent| [m/s]."""
    closing_speed: Float[np.ndarray, " P"]
    """How fast the centre distance (for a wall: the distance to it) shrinks [m/s]; 0 where two centres coincide."""
    impulse: Float[np.ndarray, " P"]
    """Normal contact force times the physics step that it acts for [N s]; NaN where no engine told it."""

    def __len__(self) -> int:
        return len(self.scene)

    def take(self, chosen: np.ndarray) -> "Touches":
        """Some of the entries, by mask or number."""
        return Touches(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})

    @classmethod
    def concatenate(cls, parts: list["Touches"]) -> "Touches":
        """All entries of all parts, in order of scene, state, agent, kind, partner; an empty table for no parts."""
        whole = {
            f.name: np.concatenate([getattr(part, f.name) for part in parts] or [np.zeros(0)]).astype(dtype)
            for f, dtype in zip(fields(cls), [np.int64] * 5 + [np.float64] * 4, strict=True)
        }
        order = np.lexsort([whole[name] for name in ("partner", "kind", "agent", "state", "scene")])
        return cls(**{name: values[order] for name, values in whole.items()})
