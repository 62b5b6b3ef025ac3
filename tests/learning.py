"""What the tests of learning share: tiny models, random graphs, data with a known law, and a forward pass in NumPy."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from envs.config import SimulateConfig
from envs.simulate import simulate_in_memory
from envs.trajectories import AGENT, GOAL, Trajectories, edge_types
from gnn.config import PRESETS, ModelConfig
from gnn.decode import Integrator
from gnn.features import Scales
from gnn.graph import Graph, graph_of_edges
from gnn.swarmnet import SwarmNet

NAMES = ("thesis-ch3", "thesis-ch5", "best", "best-all", "separable", "crowd")
"""Presets that differ in structure."""
INTEGRATOR = Integrator(dt=0.3, substeps=4, max_speed=3.0, max_acceleration=2.0)


def tiny(name: str) -> ModelConfig:
    """A preset with the same parts and few weights."""
    preset = PRESETS[name]
    filters = (5, 6) if preset.convolutions else ()
    few = {
        "convolutions": filters,
        "edge_hidden": (8, 7),
        "message": 2 if preset.additive else 6,
        "node_hidden": (8, 9),
    }
    return replace(preset, **few, nearest=2 if preset.nearest else None)


def scales() -> Scales:
    """Scales that are neither 1 nor alike, so that a confusion shows."""
    values = {"position": 3.0, "velocity": 1.5, "acceleration": 0.7, "position_change": 0.4, "velocity_change": 0.2}
    return Scales(
        centre=jnp.asarray([1.0, -2.0], jnp.float32), **{k: jnp.asarray(v, jnp.float32) for k, v in values.items()}
    )


def complete(present: np.ndarray, counts: tuple[int, int, int]) -> Graph:
    """Every present agent receives from everything present but itself."""
    kind = np.broadcast_to(np.repeat([0, 1, 2], counts), present.shape).astype(np.int8)
    return graph_of_edges(jnp.asarray(edge_types(kind, present)), jnp.asarray(present), counts)


def random_swarm(
    seed: int, counts: tuple[int, int, int] = (1, 2, 4), *, batch: int = 3, window: int = 1, absent: float = 0.0
) -> tuple[np.ndarray, np.ndarray, Graph]:
    """`(history, present, graph)` with random states; static nodes stand still."""
    rng = np.random.default_rng(seed)
    nodes = sum(counts)
    history = rng.normal(0, 2, (batch, window, nodes, 4)).astype(np.float32)
    still = counts[0] + counts[1]
    history[:, :, :still] = history[:, :1, :still]
    history[:, :, :still, 2:] = 0
    present = rng.random((batch, nodes)) >= absent
    return np.where(present[:, None, :, None], history, 0).astype(np.float32), present, complete(present, counts)


def initial(config: ModelConfig, units: Scales, history: np.ndarray, graph: Graph, seed: int = 0) -> dict:
    """Random weights, biases included: Flax starts biases at 0, which would hide mistakes. Compiles nothing."""
    shapes = jax.eval_shape(SwarmNet(config, units).init, jax.random.key(0), history, graph)["params"]
    rng = np.random.default_rng(seed)

    def draw(leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        size = np.prod(leaf.shape[:-1]) ** -0.5 if leaf.ndim > 1 else 0.1
        return rng.normal(0, size, leaf.shape).astype(np.float32)

    return jax.tree.map(draw, shapes)


def numpy_swarmnet(params: dict, config: ModelConfig, units: Scales, history: np.ndarray, graph: Graph) -> np.ndarray:
    """Second implementation: equations 3.1-3.3 and 5.22-5.25 node by node and edge by edge, in float64."""
    params = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    units = {name: np.asarray(value, np.float64) for name, value in vars(units).items()}
    goals, obstacles, agents = graph.counts
    first, everyone = goals + obstacles, config.output == "state_change"
    masks = {k: np.asarray(getattr(graph, k)) for k in ("goal", "obstacle", "agent")}
    offsets = {"goal": 0, "obstacle": goals, "agent": first}

    def dense(layer: dict, x: np.ndarray) -> np.ndarray:
        return x @ layer["kernel"] + layer["bias"]

    def mlp(layers: dict, x: np.ndarray, hidden: int) -> np.ndarray:
        given = x
        for depth in range(sum(name.startswith("layer") for name in layers)):
            x = dense(layers[f"layer{depth}"], x)
            x = np.maximum(x, 0) if depth < hidden else x
        return x + given @ layers["skip"]["kernel"] if "skip" in layers else x

    outputs = []
    for b in range(len(history)):
        rows = history[b].astype(np.float64).copy()  # (W, V, 4)
        if config.normalise:
            rows[..., :2] = (rows[..., :2] - units["centre"]) / units["position"]
            rows[..., 2:] /= units["velocity"]
        nodes = []
        for v in range(rows.shape[1]):
            x = rows[:, v]
            for depth in range(len(config.convolutions)):
                layer = params["conv"][f"layer{depth}"]
                kernel = layer["kernel"].reshape(3, -1, len(layer["bias"]))
                x = np.stack([
                    np.maximum(sum(x[t + i] @ kernel[i] for i in range(3)) + layer["bias"], 0)
                    for t in range(len(x) - 2)
                ])  # fmt: skip
            nodes.append(x[-1])
        out = []
        for i in range(0 if everyone else first, first + agents):
            if not np.asarray(graph.present)[b, i]:
                out.append(np.zeros(4 if everyone else 2))
                continue
            messages = {name: [] for name in offsets}
            turn, near = np.eye(2), np.zeros(config.message)
            if config.frame and (velocity := rows[-1, i, 2:]).any():
                ahead = velocity / np.linalg.norm(velocity)
                turn = np.array([ahead, [-ahead[1], ahead[0]]])
            square = np.array([((n - nodes[i])[:2] ** 2).sum() for n in nodes[first:]])
            square[~masks["agent"][b, max(i - first, 0)]] = np.inf
            within = np.sort(square)[: config.nearest].max() if config.nearest else np.inf
            seen = {name: offset for name, offset in offsets.items() if config.context or name == "agent"}
            for name, offset in seen.items():
                for j in range(masks[name].shape[-1]) if i >= first else ():
                    if not masks[name][b, i - first, j] or (name == "agent" and square[j] > within):
                        continue
                    to, of = nodes[i], nodes[offset + j]
                    pair = [to, of]
                    if config.frame:
                        away = turn @ (of - to)[:2]
                        distance = np.sqrt(away @ away + 1e-8)
                        speed = np.linalg.norm(to[2:])
                        pair = [away, away / distance, [np.log(distance + 0.02)], turn @ of[2:], [speed]]
                    message = mlp(params["edge"][name], np.concatenate(pair), len(config.edge_hidden))
                    messages[name].append(message)
                    if "near" in config.aggregate:
                        far = (nodes[offset + j] - nodes[i])[:2]
                        near += message * np.exp(-0.5 * far @ far / np.exp(2 * params["reach"][name]))
            nothing = np.zeros(config.message)
            kinds = [name for name in seen if masks[name].shape[-1]]
            joined = []
            for how in config.aggregate:
                if how == "sum":
                    joined.append(sum((m for name in kinds for m in messages[name]), nothing))
                    continue
                if how == "near":
                    joined.append(near)
                    continue
                join = {"mean": np.mean, "max": np.max}[how]
                joined += [join(messages[name], axis=0) if messages[name] else nothing for name in kinds]
            total = np.concatenate(joined)
            if config.psi:
                total = mlp(params["psi"], total, 1)

            def node(*parts: np.ndarray) -> np.ndarray:
                hidden = mlp(params["node"], np.concatenate(parts), len(config.node_hidden))
                return mlp(params["readout"], hidden, 0)

            own, ahead = nodes[i], turn[0]
            if config.additive:
                central = np.concatenate([np.zeros(2), own[2:]])
                result = total.reshape(-1, 2).sum(axis=0) @ turn + node(own, ahead) - node(central, ahead)
            else:
                result = node(own, ahead, total) @ turn if config.frame else node(own, total)
            out.append(result * units["acceleration"] if config.normalise else result)
        outputs.append(out)
    return np.asarray(outputs)


@cache
def published(scenes: int = 8, steps: int = 45, *, seed: int = 0, mixed: bool = False) -> Trajectories:
    """Published Boids, three agents at most, made once."""
    size = {"num_agents": 4, "num_obstacles": 2} if mixed else {"num_agents": 3, "num_obstacles": 1}
    return simulate_in_memory(
        SimulateConfig(preset="published", scenes=scenes, steps=steps, seed=seed, mixed=mixed, engine="native", **size)
    )


def blank(position: np.ndarray, velocity: np.ndarray, kind: list[int], mask: np.ndarray | None = None) -> Trajectories:
    """Trajectories from positions and velocities (S, T, V, 2), without contacts; dt 0.1 s, one substep, no limits."""
    scenes, rows, nodes, _ = position.shape
    mask = np.ones((scenes, rows, nodes), bool) if mask is None else mask
    kinds = np.broadcast_to(np.asarray(kind, np.int8), (scenes, nodes)).copy()
    here = mask[..., None]
    counts = {
        name: np.zeros((scenes, rows, nodes), np.int16)
        for name in ("agent_contact", "solid_contact", "agent_events", "solid_events")
    }
    return Trajectories(
        position=np.where(here, position, 0).astype(np.float32),
        velocity=np.where(here, velocity, 0).astype(np.float32),
        mask=mask,
        kind=kinds,
        radius=np.zeros((scenes, nodes), np.float32),
        edges=edge_types(kinds, mask.any(axis=1)),
        **counts,
        depth=np.zeros((scenes, rows, nodes), np.float32),
        dt=0.1,
        substeps=1,
        max_speed=float("inf"),
        max_acceleration=float("inf"),
        provenance={"law": "given"},
    )


def spring(scenes: int = 16, rows: int = 13, *, seed: int = 0, k: float = 1.5, c: float = 0.8) -> Trajectories:
    """Two agents on springs to the goal: acceleration = k (goal - x) - c v, one explicit step of 0.1 s per row."""
    rng = np.random.default_rng(seed)
    goal = rng.uniform(-2, 2, (scenes, 1, 2))
    x, v = rng.uniform(-3, 3, (scenes, 2, 2)), rng.uniform(-2, 2, (scenes, 2, 2))
    positions, velocities = [], []
    for _ in range(rows):
        positions.append(np.concatenate([goal, x], axis=1))
        velocities.append(np.concatenate([0 * goal, v], axis=1))
        v = v + 0.1 * (k * (goal - x) - c * v)
        x = x + 0.1 * v  # k = 1 substep: semi-implicit
    return blank(np.stack(positions, 1), np.stack(velocities, 1), [GOAL, AGENT, AGENT])


@cache
def _compiled() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="swarmnet-tests-")


@contextlib.contextmanager
def quick_compiles() -> Iterator[None]:
    """What was compiled once is not compiled again."""
    names = {
        "jax_compilation_cache_dir": _compiled().name,
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    before = {name: getattr(jax.config, name) for name in names}
    try:
        for name, value in names.items():
            jax.config.update(name, value)
        reset_cache()  # JAX looks up the folder once
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        reset_cache()


@contextlib.contextmanager
def quick_training() -> Iterator[None]:
    """Every preset with few weights, besides quick compiles: every `train` makes its own functions, and the same."""
    before = dict(PRESETS)
    with quick_compiles():
        try:
            PRESETS.update({name: tiny(name) for name in NAMES})
            yield
        finally:
            PRESETS.update(before)


def environment(cache_folder: str | None = None) -> dict[str, str]:
    """For a process of its own that imports our packages and this module, and compiles as quickly."""
    tests = Path(__file__).parent
    return os.environ | {
        "PYTHONPATH": os.pathsep.join([str(tests.parent), str(tests)]),
        "COLUMNS": "120",
        "JAX_COMPILATION_CACHE_DIR": cache_folder or _compiled().name,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
