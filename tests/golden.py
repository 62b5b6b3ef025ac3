"""States and numbers that the author's code computed (tests/data/golden_*.npz)."""

import jax
import jax.numpy as jnp
import numpy as np

from envs.state import State, make_state


def golden_state(recorded: np.lib.npyio.NpzFile, world: str, dtype: type) -> State:
    """The states of a world of Boids or Helbing's people."""
    fields = {name: recorded[f"{world}/{name}"].astype(dtype) for name in ("position", "velocity", "goal", "obstacle")}
    return make_state(**jax.tree.map(jnp.asarray, fields))


def relative_error(ours: np.ndarray, golden: np.ndarray) -> np.ndarray:
    """Error of each agent's vector relative to max(|golden|, 1)."""
    return np.linalg.norm(ours - golden, axis=-1) / np.maximum(np.linalg.norm(golden, axis=-1), 1)
