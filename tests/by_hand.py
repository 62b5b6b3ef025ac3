"""Networks made by hand: with no hidden layers a SwarmNet is linear, and can be a known law exactly."""

import numpy as np
from learning import blank, initial, random_swarm, scales, tiny

from envs.experts.config import BoidsConfig
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories
from gnn.checkpoint import Model
from gnn.config import ModelConfig
from gnn.decode import Integrator
from gnn.features import Scales

COUNTS = (1, 1, 3)
FREE = Integrator(dt=0.1, substeps=1, max_speed=float("inf"), max_acceleration=float("inf"))
LAW = BoidsConfig(
    cohesion=0.3, alignment=0.2, separation=0.0, obstacle=0.0, goal=0.5, cruise_speed=10.0, slowdown_distance=1e4
)
"""Linear in the states: cohesion and alignment of agents, 0.5 (10 / 10^4 (goal - x) - v) of the goal."""
BY_HAND = ModelConfig(edge_hidden=(), message=2, node_hidden=(), aggregate=("mean",))


def linear(position: float, own: float, other: float) -> np.ndarray:
    """Kernel (8, 2) of `position (p_j - p_i) + own v_i + other v_j` on a receiver's and a sender's state."""
    one = np.eye(2)
    return np.concatenate([-position * one, own * one, position * one, other * one]).astype(np.float32)


def by_hand(*, own_speed: float = 0.0) -> Model:
    """`LAW` as a network. `own_speed` moves so much of the goal term's -0.5 v_i from its edge to the node."""
    drag = -LAW.goal + own_speed
    kernels = {
        "goal": linear(LAW.goal * 1e-3, drag, 0),
        "obstacle": linear(0, 0, 0),
        "agent": linear(LAW.cohesion, -LAW.alignment, LAW.alignment),
    }
    node = np.concatenate([np.zeros((2, 2)), -own_speed * np.eye(2), *[np.eye(2)] * 3]).astype(np.float32)
    zero = np.zeros(2, np.float32)
    params = {
        "edge": {kind: {"layer0": {"kernel": kernel, "bias": zero}} for kind, kernel in kernels.items()},
        "readout": {"layer0": {"kernel": node, "bias": zero}},
    }
    return Model(BY_HAND, Scales.ones(), FREE, params, {})


def random_model(name: str, seed: int = 0) -> Model:
    config = tiny(name)
    history, _, graph = random_swarm(0, COUNTS, window=config.window)
    return Model(config, scales(), FREE, initial(config, scales(), history, graph, seed), {})


def flock(scenes: int = 12, rows: int = 5, agents: int = 3, seed: int = 0) -> Trajectories:
    """Random states of agents beside a goal and an obstacle that stand: a probe asks for no motion."""
    rng = np.random.default_rng(seed)
    shape = (scenes, rows, 2 + agents, 2)
    position, velocity = rng.normal(0, 20, shape), rng.normal(0, 5, shape)
    position[:, :, :2], velocity[:, :, :2] = position[:, :1, :2], 0
    return blank(position, velocity, [GOAL, OBSTACLE] + [AGENT] * agents)
