"""Gymnasium spaces of a core, for one agent and for a scene."""

import numpy as np
from gymnasium.spaces import Box

from envs.adapters.core import SwarmCore


def agent_spaces(core: SwarmCore) -> tuple[Box, Box]:
    """Observation (D,) and action (2,) of one agent; see `Observation.labels` for the entries and their units."""
    seen = core.observation
    return Box(seen.low, seen.high, dtype=np.float32), Box(-1.0, 1.0, (2,), np.float32)


def scene_spaces(core: SwarmCore) -> tuple[Box, Box]:
    """Observation (N, D) and action (N, 2) of all agents of a scene: one controller steers them together."""
    seen, agents = core.observation, core.spec.num_agents
    low, high = (np.tile(bound, (agents, 1)) for bound in (seen.low, seen.high))
    return Box(low, high, dtype=np.float32), Box(-1.0, 1.0, (agents, 2), np.float32)
