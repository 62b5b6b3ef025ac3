"""Are messages forces? R2 of a linear map from messages to the true pairwise force (Cranmer et al. 2020)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.experts.config import ExpertConfig
from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.force_fields import r_squared
from gnn.laws import pair_force
from gnn.messages import messages, swarmnet_config
from gnn.swarmnet import heading, turned
from gnn.windows import Dataset, check_rows, windows
from swarm_mjcf.errors import SwarmError


@dataclass(frozen=True)
class Probe:
    """How well a linear map reads the true pairwise force off messages between agents, on scenes it was not fitted to.

    R2 of both components together; a message that is a linear image of the force has 1.
    """

    r2: float
    shuffled: float
    """The same when each message is given the force of another pair: about 0, or the probe fits noise."""
    fitted: int
    """Pairs that the map was fitted to."""
    tested: int
    """Pairs that R2 is of."""
    kernel: Float[np.ndarray, "F 2"]
    """[m/s^2] per unit of the message."""
    bias: Float[np.ndarray, "2"]
    """[m/s^2]"""


def linear_probe(
    model: Model,
    trajectories: Trajectories,
    expert: ExpertConfig,
    *,
    pairs: int = 20_000,
    ridge: float = 1e-6,
    seed: int = 0,
) -> Probe:
    """Fits on the first half of the scenes, tests on the second.

    Up to `pairs` pairs of each half are drawn from `seed`. Forces are those of two alone (`pair_force`): a message
    cannot know how many others an average is over. Raises LawError for an expert without a pair law, SwarmError when a
    half holds no two agents at once.
    """
    half = len(trajectories) // 2
    rng = np.random.default_rng(seed)
    one, other = (
        message_force_pairs(model, trajectories.take(part), expert, pairs=pairs, rng=rng)
        for part in (slice(0, half), slice(half, None))
    )
    for found in (one, other):
        if len(found[0]) < 2:
            raise SwarmError(f"a probe needs pairs of agents in both halves of {len(trajectories)} scenes")
    kernel, bias = fit_linear(*one, ridge=ridge)
    mixed = one[1][rng.permutation(len(one[1]))]
    control = fit_linear(one[0], mixed, ridge=ridge)
    return Probe(
        r2=r_squared(other[1], other[0] @ kernel + bias),
        shuffled=r_squared(other[1][rng.permutation(len(other[1]))], other[0] @ control[0] + control[1]),
        fitted=len(one[0]),
        tested=len(other[0]),
        kernel=kernel,
        bias=bias,
    )


def message_force_pairs(
    model: Model, trajectories: Trajectories, expert: ExpertConfig, *, pairs: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "P F"], Float[np.ndarray, "P 2"]]:
    """Messages between agents and the true forces [m/s^2] of the same pairs, from rows drawn at random.

    Forces are turned into the receiver's frame where messages are in it.
    """
    window, rows = model.config.window, trajectories.position.shape[1]
    check_rows(trajectories, window, "the model's history")
    goals, obstacles, agents = trajectories.counts
    wanted = -(-pairs // max(agents * (agents - 1), 1))
    scene = jnp.asarray(rng.integers(0, max(len(trajectories), 1), wanted))
    start = jnp.asarray(rng.integers(0, rows - window + 1, wanted))
    history, _, _, graph = windows(
        Dataset.of(trajectories), scene, start, window=window, horizon=0, counts=trajectories.counts
    )
    found = jax.jit(lambda history, graph: messages(model, history, graph))(history, graph)["agent"]
    edge = np.asarray(graph.agent)
    states = np.asarray(history)[:, -1, goals + obstacles :]
    shape = (*edge.shape, 4)
    receiver, sender = np.broadcast_to(states[:, :, None], shape), np.broadcast_to(states[:, None], shape)
    force = pair_force(expert, "agent", receiver[edge], sender[edge])
    if swarmnet_config(model).frame:
        force = turned(heading(jnp.asarray(receiver[edge][:, 2:])), jnp.asarray(force))
    return np.asarray(found)[edge], np.asarray(force)


def fit_linear(
    inputs: Float[np.ndarray, "P F"], targets: Float[np.ndarray, "P 2"], *, ridge: float = 0.0
) -> tuple[Float[np.ndarray, "F 2"], Float[np.ndarray, "2"]]:
    """Kernel and bias of least squares, with `ridge` times the number of pairs on the kernel of standardized inputs."""
    inputs, targets = np.asarray(inputs, np.float64), np.asarray(targets, np.float64)
    mean, spread = inputs.mean(axis=0), inputs.std(axis=0)
    spread = np.where(spread > 1e-9 * max(float(spread.max(initial=0)), 1e-30), spread, 1)
    x, y = (inputs - mean) / spread, targets - targets.mean(axis=0)
    penalty = np.sqrt(ridge * len(x)) * np.eye(x.shape[1])
    kernel = np.linalg.lstsq(np.concatenate([x, penalty]), np.concatenate([y, np.zeros((x.shape[1], 2))]))[0]
    kernel = kernel / spread[:, None]
    return kernel, targets.mean(axis=0) - mean @ kernel
