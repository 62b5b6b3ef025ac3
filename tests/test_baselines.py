"""The rivals: predictions written by hand in NumPy, symmetries, ghosts, the ELBO in numbers, sizes, and learning."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learning import INTEGRATOR, blank, complete, quick_compiles, random_swarm, scales

from envs.plain import from_plain, plain
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories
from gnn.baselines.config import PRESETS, BaselineConfig, DecoderConfig, KipfConfig, LSTMConfig, Seq2SeqConfig
from gnn.baselines.joint import SwarmSizeError
from gnn.baselines.kipf import divergence_from_uniform, gumbel_softmax
from gnn.baselines.registry import make_baseline
from gnn.checkpoint import load_model
from gnn.config import TrainConfig, config_kinds, model_preset
from gnn.evaluate import persistence, prediction_error
from gnn.family import Family
from gnn.graph import Graph
from gnn.losses import multi_step_loss
from gnn.metrics import read_metrics
from gnn.train import train
from swarm_mjcf.errors import SpecError

COUNTS = (1, 2, 4)
STILL = 3
GRAPHS = tuple(name for name in PRESETS if name.startswith("kipf"))
JOINT = ("lstm", "seq2seq")
UNIT = np.array([0.4, 0.4, 0.2, 0.2])
"""One-step changes of `learning.scales`."""
SEEDS = st.integers(0, 10**6)
everyone = pytest.mark.parametrize("name", tuple(PRESETS))
graphs = pytest.mark.parametrize("name", GRAPHS)
joint = pytest.mark.parametrize("name", JOINT)


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


def tiny(name: str, hidden: int = 7) -> BaselineConfig:
    """A preset with the same parts and few weights."""
    preset = PRESETS[name]
    if isinstance(preset, DecoderConfig):
        return replace(preset, hidden=hidden, convolutions=(5, 6) if preset.convolutions else ())
    return replace(preset, hidden=hidden, window=4)


def drawn(family: Family, history: np.ndarray, graph: Graph, seed: int = 0) -> dict:
    """Random weights, biases included: those that start at 0 would hide mistakes."""
    shapes = jax.eval_shape(family.init, jax.random.key(0), history, graph)
    rng = np.random.default_rng(seed)

    def draw(leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        size = 0.3 if leaf.ndim == 1 else np.prod(leaf.shape[:-1]) ** -0.5
        return rng.normal(0, size, leaf.shape).astype(np.float32)

    return jax.tree.map(draw, shapes)


@cache
def rival(name: str):
    """`(config, family, params, predict)` of a tiny rival at COUNTS; `predict(params, history, graph)` is compiled."""
    config = tiny(name)
    family = make_baseline(config, scales(), INTEGRATOR)
    history, _, graph = random_swarm(0, COUNTS, window=config.window)
    predict = jax.jit(lambda params, history, graph: family.predict(params, history, graph, horizon=3))
    return config, family, drawn(family, history, graph), predict


def close(a, b) -> None:
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


# --- second implementation, float64, node by node ---


def dense(layer: dict, x: np.ndarray) -> np.ndarray:
    return x @ layer["kernel"] + layer["bias"]


def relu_mlp(layers: dict, x: np.ndarray, hidden: int) -> np.ndarray:
    for depth in range(len(layers)):
        x = dense(layers[f"layer{depth}"], x)
        x = np.maximum(x, 0) if depth < hidden else x
    return x


def block(p: dict, x: np.ndarray) -> np.ndarray:
    """ELU, ELU, layer-norm."""

    def elu(y: np.ndarray) -> np.ndarray:
        return np.where(y > 0, y, np.exp(np.minimum(y, 0)) - 1)

    y = elu(dense(p["layer1"], elu(dense(p, x))))
    return (y - y.mean()) / np.sqrt(y.var() + 1e-6) * p["norm"]["scale"] + p["norm"]["bias"]


def cell(p: dict, memory: tuple, x: np.ndarray) -> tuple:
    """Hochreiter and Schmidhuber's cell, with forget gates."""
    c, h = memory
    i, f, g, o = (x @ p[f"i{gate}"]["kernel"] + dense(p[f"h{gate}"], h) for gate in "ifgo")

    def sigmoid(y: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-y))

    c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
    return c, sigmoid(o) * np.tanh(c)


def stack(p: dict, memory: list, x: np.ndarray) -> np.ndarray:
    """One row through stacked cells; `memory` is updated."""
    for depth in range(len(memory)):
        memory[depth] = cell(p[f"layer{depth}"], memory[depth], x)
        x = memory[depth][1]
    return x


def softmax(x: np.ndarray) -> np.ndarray:
    return np.exp(x) / np.exp(x).sum(axis=-1, keepdims=True)


def convolved(layers: dict, rows: np.ndarray) -> np.ndarray:
    for depth in range(len(layers)):
        p = layers[f"layer{depth}"]
        kernel = p["kernel"].reshape(3, -1, len(p["bias"]))
        rows = np.stack([
            np.maximum(sum(rows[t + i] @ kernel[i] for i in range(3)) + p["bias"], 0)
            for t in range(len(rows) - 2)
        ])  # fmt: skip
    return rows[-1]


def types_by_hand(p: dict, rows: np.ndarray, here: np.ndarray) -> np.ndarray:
    """Probabilities (receiver, sender, type) from one scene's agents (W, N, 4); absent pairs get 0."""
    alive = np.flatnonzero(here)
    node = {i: block(p["node0"], rows[:, i].ravel()) for i in alive}
    edge = {(i, j): block(p["edge0"], np.concatenate([node[i], node[j]])) for i in alive for j in alive if i != j}
    nothing = np.zeros(len(p["node0"]["bias"]))
    into = {i: sum((e for (to, _), e in edge.items() if to == i), nothing) / len(alive) for i in alive}
    node = {i: block(p["node1"], into[i]) for i in alive}
    types = np.zeros((len(here), len(here), len(p["logits"]["bias"])))
    for (i, j), skip in edge.items():
        types[i, j] = softmax(dense(p["logits"], block(p["edge1"], np.concatenate([node[i], node[j], skip]))))
    return types


def messages_by_hand(p: dict, nodes: np.ndarray, here: np.ndarray, edges: list) -> np.ndarray:
    """Changes of the agents; `edges`: (type, receiver, sender's node, weight)."""
    changes = np.zeros((len(here), 4))
    for i in np.flatnonzero(here):
        total = np.zeros(len(p["node"]["layer0"]["bias"]))
        for kind, to, sender, weight in edges:
            if to == i:
                pair = np.concatenate([nodes[STILL + i], nodes[sender]])
                total += weight * relu_mlp(p["edge"][kind], pair, 2)
        changes[i] = relu_mlp(p["node"], np.concatenate([nodes[STILL + i], total]), 2)
    return changes


def stepper(params: dict, config: BaselineConfig, rows: np.ndarray, here: np.ndarray, graph: dict):
    """`(scaled rows so far) -> changes (N, 4)` of one scene; `rows` (W, V, 4) are the scaled history."""
    empty = (np.zeros(config.hidden), np.zeros(config.hidden))
    if isinstance(config, KipfConfig):
        types = types_by_hand(params["encoder"], rows[:, STILL:], here)
        used = range(int(config.skip_first), config.edge_types)
        edges = [(f"type{k}", i, STILL + j, types[i, j, k]) for i, j in np.ndindex(types.shape[:2]) for k in used]
        return lambda rows: messages_by_hand(params["decoder"], rows[-1], here, edges)
    if isinstance(config, DecoderConfig):
        first = {"goal": 0, "obstacle": 1, "agent": STILL} if config.context else {"agent": STILL}
        edges = [(kind, i, first[kind] + j, 1.0) for kind in first for i, j in np.argwhere(graph[kind])]
        if not config.convolutions:
            return lambda rows: messages_by_hand(params["decoder"], rows[-1], here, edges)
        return lambda rows: messages_by_hand(
            params["decoder"], convolved(params["conv"], np.stack(rows[-config.window :])), here, edges
        )
    if isinstance(config, LSTMConfig):
        memory = [empty]

        def step(row: np.ndarray) -> np.ndarray:
            memory[0] = cell(params["lstm"], memory[0], relu_mlp(params["encoder"], row[STILL:].ravel(), 2))
            return relu_mlp(params["decoder"], memory[0][1], 1).reshape(-1, 4)

        for row in rows[:-1]:
            step(row)
        return lambda rows: step(rows[-1])
    assert isinstance(config, Seq2SeqConfig)
    memory = [empty] * config.layers
    for row in rows:
        stack(params["encoder"], memory, row[STILL:].ravel())
    return lambda rows: dense(
        params["readout"], stack(params["decoder"], memory, rows[-1][STILL:].ravel())
    ).reshape(-1, 4)  # fmt: skip


def by_hand(params: dict, config: BaselineConfig, history: np.ndarray, graph: Graph, horizon: int) -> np.ndarray:
    """Predictions of any rival, one scene, one step and one node at a time."""
    params = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    out = []
    for b, present in enumerate(np.asarray(graph.present)):

        def scaled(states: np.ndarray, present: np.ndarray = present) -> np.ndarray:
            x = np.concatenate([(states[..., :2] - [1, -2]) / 3, states[..., 2:] / 1.5], axis=-1)
            return np.where(present[:, None], x, 0)

        masks = {kind: np.asarray(getattr(graph, kind))[b] for kind in ("goal", "obstacle", "agent")}
        states = list(history[b].astype(np.float64))
        rows = [scaled(x) for x in states]
        step = stepper(params, config, np.stack(rows), present[STILL:], masks)
        for _ in range(horizon):
            after = states[-1].copy()
            after[:STILL, :2] += INTEGRATOR.dt * after[:STILL, 2:]
            after[STILL:] += step(rows) * UNIT
            states.append(np.where(present[:, None], after, states[-1]))
            rows.append(scaled(states[-1]))
        out.append(states[-horizon:])
    return np.asarray(out)


@everyone
@settings(max_examples=4)
@given(seed=SEEDS)
def test_a_prediction_written_by_hand_is_the_same(name: str, seed: int):
    config, _, params, predict = rival(name)
    history, present, graph = random_swarm(seed, COUNTS, window=config.window, absent=0.3)
    history[:, :, 1:STILL, 2:] += np.where(present[:, None, 1:STILL, None], np.float32(0.5), 0)  # moving obstacles
    found = predict(params, history, graph)
    assert found.shape == (3, 3, 7, 4)
    close(found, by_hand(params, config, history, graph, 3))


def test_an_edge_of_the_first_type_says_nothing_with_skip_first():
    config = replace(tiny("kipf"), skip_first=True, edge_types=3)
    family = make_baseline(config, scales(), INTEGRATOR)
    history, _, graph = random_swarm(1, COUNTS, window=4)
    params = drawn(family, history, graph)
    assert set(params["decoder"]["edge"]) == {"type1", "type2"}
    close(family.predict(params, history, graph, horizon=2), by_hand(params, config, history, graph, 2))
    params["encoder"]["logits"]["bias"] = np.array([1e4, 0, 0], np.float32)  # now all edges are of the first type
    moved = history.copy()
    moved[:, :, STILL + 1 :] += 1
    here, there = (family.predict(params, h, graph, horizon=1)[:, :, : STILL + 1] for h in (history, moved))
    close(here, there)


# --- who sees whom ---


@graphs
@settings(max_examples=6)
@given(seed=SEEDS)
def test_permuted_agents_are_predicted_in_their_new_order(name: str, seed: int):
    config, _, params, predict = rival(name)
    history, present, graph = random_swarm(seed, COUNTS, window=config.window, absent=0.2)
    nodes = np.concatenate([np.arange(STILL), STILL + np.random.default_rng(seed).permutation(4)])
    permuted = predict(params, history[:, :, nodes], complete(present[:, nodes], COUNTS))
    close(permuted, predict(params, history, graph)[:, :, nodes])


@joint
def test_a_joint_state_depends_on_the_order_of_its_slots(name: str):
    config, _, params, predict = rival(name)
    history, _, graph = random_swarm(3, COUNTS, window=config.window)
    nodes = np.array([0, 1, 2, 4, 3, 5, 6])
    difference = predict(params, history[:, :, nodes], graph) - predict(params, history, graph)[:, :, nodes]
    assert np.abs(difference).max() > 1e-3


@graphs
@pytest.mark.parametrize("garbage", [1e3, np.nan])
def test_ghosts_change_nothing_for_the_others(name: str, garbage: float):
    config, _, params, predict = rival(name)
    history, present, graph = random_swarm(5, COUNTS, window=config.window)
    places = np.array([0, 1, 2, 5, 6, 7, 8])
    padded = np.full((3, config.window, 12, 4), garbage, np.float32)
    padded[:, :, places] = history
    there = np.zeros((3, 12), bool)
    there[:, places] = present
    out = np.asarray(predict(params, padded, complete(there, (1, 4, 7))))
    close(out[:, :, places], predict(params, history, graph))
    ghosts = np.setdiff1d(np.arange(12), places)
    np.testing.assert_array_equal(out[:, :, ghosts], np.full((3, 3, 5, 4), garbage))


@joint
def test_what_stands_in_the_slot_of_a_ghost_is_not_seen(name: str):
    config, _, params, predict = rival(name)
    history, present, _ = random_swarm(5, COUNTS, window=config.window)
    present[:, -1] = False
    strange = history.copy()
    strange[:, :, -1] = np.nan
    graph = complete(present, COUNTS)
    close(predict(params, strange, graph)[:, :, :-1], predict(params, history, graph)[:, :, :-1])


@everyone
def test_ghosts_change_no_gradient(name: str):
    config, family, params, _ = rival(name)
    history, present, _ = random_swarm(6, COUNTS, window=config.window)
    present[:, -1] = False
    strange = history.copy()
    strange[:, :, -1] = np.nan
    graph, mask = complete(present, COUNTS), np.repeat(present[:, None], 2, axis=1)
    truth = np.repeat(history[:, -1:], 2, axis=1)
    gradient = jax.jit(jax.grad(lambda p, h: family.loss(p, h, truth, mask, graph, jax.random.key(0))))
    one, two = gradient(params, strange), gradient(params, history)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), one, two)
    assert max(float(jnp.abs(x).max()) for x in jax.tree.leaves(one)) > 1e-2


@everyone
def test_moving_the_world_and_its_centre_together_moves_the_prediction(name: str):
    """The world alone is another matter: the raw states are inputs, as in the papers, so no rival is invariant."""
    config, _, params, predict = rival(name)
    history, _, graph = random_swarm(6, COUNTS, window=config.window)
    shift = np.array([8, -4, 0, 0], np.float32)
    out = predict(params, history, graph)
    there = replace(scales(), centre=scales().centre + shift[:2])
    moved = make_baseline(config, there, INTEGRATOR).predict(params, history + shift, graph, horizon=3)
    close(moved, out + shift)
    assert np.abs(predict(params, history + shift, graph) - out - shift).max() > 1e-2


@everyone
def test_goals_and_obstacles_are_seen_with_context_alone(name: str):
    config, _, params, predict = rival(name)
    history, _, graph = random_swarm(7, COUNTS, window=config.window)
    for node in range(STILL):
        moved = history.copy()
        moved[:, :, node, :2] += 2
        difference = np.abs(predict(params, moved, graph) - predict(params, history, graph))[:, :, STILL:].max()
        assert (difference > 1e-4) == name.endswith("context")


@graphs
def test_kipf_infers_who_acts_and_the_decoders_are_told(name: str):
    """With all known edges between agents cut, Kipf predicts the same and the decoders do not."""
    config, _, params, predict = rival(name)
    history, _, graph = random_swarm(7, COUNTS, window=config.window)
    cut = replace(graph, agent=jnp.zeros_like(graph.agent))
    same = np.allclose(predict(params, history, cut), predict(params, history, graph), atol=1e-6)
    assert same == (name == "kipf")


# --- the ELBO ---


def test_divergence_from_the_uniform_prior_in_numbers():
    """0.8 ln 1.6 + 0.2 ln 0.4 = 0.19274; an even guess costs nothing, a certain one ln K."""
    logits = jnp.log(jnp.array([[0.8, 0.2], [0.5, 0.5]]))
    close(divergence_from_uniform(logits), [0.192745, 0])
    close(divergence_from_uniform(jnp.array([200.0, 0, 0])), np.log(3))


def test_the_loss_of_kipf_is_the_negative_elbo_in_the_units_of_the_common_loss():
    """An encoder that says (0.8, 0.2) everywhere; four agents, then three, among seven and six nodes."""
    config, family, params, _ = rival("kipf")
    says = {"kernel": np.zeros((7, 2), np.float32), "bias": np.log([0.8, 0.2]).astype(np.float32)}
    params = params | {"encoder": params["encoder"] | {"logits": says}}
    history, present, _ = random_swarm(8, COUNTS, window=4, batch=2)
    present[1, -1] = False
    graph, mask = complete(present, COUNTS), np.repeat(present[:, None], 5, axis=1)
    truth, key = np.repeat(history[:, -1:], 5, axis=1), jax.random.key(3)
    wide = make_baseline(replace(config, variance=0.5), scales(), INTEGRATOR)
    found = wide.loss(params, history, truth, mask, graph, key)
    predicted = np.asarray(family.predict(params, history, graph, horizon=5, key=key))
    nodes, divergence = 7 + 6, (4 * 3 + 3 * 2) * 0.192745
    close(found, multi_step_loss(predicted, truth, mask, scales()) + 2 * 0.5 / (4 * 5) * divergence / nodes)
    # From the definition: Gaussian NLL (without its constant) and KL per node, in all.
    errors = np.where(mask[..., None], (predicted - truth) / UNIT, 0)
    negative_elbo = ((errors**2).sum() / (2 * 0.5) + divergence) / nodes
    close(found, negative_elbo * 2 * 0.5 / (4 * 5))


@settings(max_examples=10)
@given(seed=SEEDS, temperature=st.floats(0.1, 5))
def test_soft_samples_of_edge_types_sum_to_one(seed: int, temperature: float):
    logits = 3 * np.random.default_rng(seed).normal(size=(2, 3, 3, 4)).astype(np.float32)
    sample = gumbel_softmax(logits, jax.random.key(seed), temperature)
    np.testing.assert_allclose(sample.sum(axis=-1), 1, rtol=1e-5)
    assert bool((sample >= 0).all())


def test_the_largest_entry_of_a_soft_sample_is_drawn_by_the_logits():
    logits = jnp.broadcast_to(jnp.log(jnp.array([0.7, 0.2, 0.1])), (20000, 3))
    sample = gumbel_softmax(logits, jax.random.key(0), 0.5)
    np.testing.assert_allclose(np.bincount(sample.argmax(axis=-1)) / 20000, [0.7, 0.2, 0.1], atol=0.02)


@everyone
def test_only_kipf_draws(name: str):
    config, family, params, predict = rival(name)
    history, _, graph = random_swarm(9, COUNTS, window=config.window)
    draw = jax.jit(lambda key: family.predict(params, history, graph, horizon=3, key=key))
    mean, one, two = predict(params, history, graph), draw(jax.random.key(0)), draw(jax.random.key(1))
    close(draw(jax.random.key(0)), one)
    assert np.allclose(one, two, atol=1e-5) == np.allclose(one, mean, atol=1e-5) == (name != "kipf")


# --- sizes, shapes, names ---


@joint
def test_another_number_of_agents_is_refused_when_traced(name: str):
    config, family, params, _ = rival(name)
    history, _, graph = random_swarm(0, (1, 2, 6), window=config.window)
    with pytest.raises(SwarmSizeError, match=r"6 agents were given .* joint state of 4: lstm and seq2seq") as error:
        jax.eval_shape(lambda p: family.predict(p, history, graph, horizon=2), params)
    assert (error.value.given, error.value.made_for) == (6, 4)


@graphs
def test_a_graph_network_predicts_swarms_of_any_size_without_goals_or_obstacles_too(name: str):
    config, family, params, _ = rival(name)
    predict = jax.jit(family.predict, static_argnames="horizon")
    for counts in ((1, 2, 6), (0, 0, 2), (0, 1, 1)):
        history, _, graph = random_swarm(0, counts, window=config.window)
        out = predict(params, history, graph, horizon=2)
        assert out.shape == (3, 2, sum(counts), 4)
        assert bool(jnp.isfinite(out).all())


@everyone
def test_horizons_share_their_first_steps_and_a_second_call_compiles_nothing(name: str):
    config, family, params, _ = rival(name)
    predict = jax.jit(family.predict, static_argnames="horizon")
    history, _, graph = random_swarm(2, COUNTS, window=config.window)
    short, long = (predict(params, history, graph, horizon=h) for h in (1, 4))
    assert (short.shape, long.shape) == ((3, 1, 7, 4), (3, 4, 7, 4))
    close(long[:, :1], short)
    before = predict._cache_size()
    predict(params, history + 1, graph, horizon=4)
    assert predict._cache_size() == before


@pytest.mark.parametrize("kind", [KipfConfig, LSTMConfig, Seq2SeqConfig])
def test_one_state_is_a_window_too(kind: type[BaselineConfig]):
    config = kind(window=1, hidden=5)
    family = make_baseline(config, scales(), INTEGRATOR)
    history, _, graph = random_swarm(0, COUNTS)
    params = drawn(family, history, graph)
    close(family.predict(params, history, graph, horizon=2), by_hand(params, config, history, graph, 2))


@everyone
def test_weights_are_named_by_their_part(name: str):
    _, _, params, _ = rival(name)
    leaves = jax.tree_util.tree_leaves_with_path(params)
    paths = ["/".join(key.key for key in path) for path, _ in leaves]
    agents = {"decoder/edge/agent", "decoder/node"}
    context = {"decoder/edge/goal", "decoder/edge/obstacle"}
    encoder = {f"encoder/{part}" for part in ("node0", "edge0", "node1", "edge1", "logits")}
    parts = {
        "kipf": encoder | {"decoder/edge/type0", "decoder/edge/type1", "decoder/node"},
        "kipf-decoder": agents,
        "kipf-decoder-context": agents | context,
        "kipf-decoder-conv1d": agents | {"conv"},
        "kipf-decoder-conv1d-context": agents | context | {"conv"},
        "lstm": {"encoder", "lstm", "decoder"},
        "seq2seq": {"encoder", "decoder", "readout"},
    }[name]
    assert all(any(path.startswith(part + "/") for part in parts) for path in paths)
    assert all(any(path.startswith(part + "/") for path in paths) for part in parts)


def test_presets_are_found_by_name_and_come_back_from_plain_data():
    kinds = config_kinds()
    for name, preset in PRESETS.items():
        assert model_preset(name) == preset
        assert from_plain(kinds[type(preset).__name__], plain(preset)) == preset
        assert not preset.acts
    kipf = KipfConfig()
    assert PRESETS["kipf"] == kipf
    assert (kipf.window, kipf.hidden, kipf.edge_types, kipf.temperature, kipf.variance) == (10, 256, 2, 0.5, 5e-5)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: KipfConfig(edge_types=1), "edge_types"),
        (lambda: KipfConfig(temperature=0.0), "temperature"),
        (lambda: KipfConfig(variance=-1.0), "variance"),
        (lambda: KipfConfig(window=0), "window"),
        (lambda: DecoderConfig(window=3), "window"),
        (lambda: LSTMConfig(hidden=0), "hidden"),
        (lambda: Seq2SeqConfig(layers=0), "layers"),
        (lambda: make_baseline(BaselineConfig(), scales(), INTEGRATOR), "model"),
    ],
)
def test_settings_that_make_no_model_are_refused(make, field: str):
    with pytest.raises(SpecError) as error:
        make()
    assert error.value.field == field


# --- learning ---


def tied(scenes: int, rows: int = 20, *, seed: int = 0) -> Trajectories:
    """Three agents tied to each other by springs: acceleration = 0.5 sum of differences - 0.2 v, steps of 0.1 s."""
    rng = np.random.default_rng(seed)
    still = rng.uniform(-2, 2, (scenes, 2, 2))
    x, v = rng.uniform(-3, 3, (scenes, 3, 2)), rng.uniform(-2, 2, (scenes, 3, 2))
    positions, velocities = [], []
    for _ in range(rows):
        positions.append(np.concatenate([still, x], axis=1))
        velocities.append(np.concatenate([0 * still, v], axis=1))
        v = v + 0.1 * (0.5 * (x.sum(axis=1, keepdims=True) - 3 * x) - 0.2 * v)
        x = x + 0.1 * v
    return blank(np.stack(positions, 1), np.stack(velocities, 1), [GOAL, OBSTACLE, AGENT, AGENT, AGENT])


@pytest.mark.parametrize("name", ["kipf", "kipf-decoder-conv1d-context", "lstm", "seq2seq"])
def test_springs_between_agents_are_learned_on_the_common_path_and_kept_in_checkpoints(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """In 400 steps far below persistence on unseen scenes; what was saved predicts what was trained.

    Graph networks share one law among pairs, a model of the joint state has to learn it for every slot.
    """
    monkeypatch.setitem(PRESETS, name, tiny(name, hidden=24))
    config = TrainConfig(model=name, horizons=(1,), stage_steps=(400,), chunk=100, batch=32, learning_rate=1e-2)
    trained = train(config, tied(64), tmp_path)
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert rows[2]["loss"] < rows[0]["loss"]
    found = load_model(tmp_path / "checkpoints")
    assert found.config == trained.config == PRESETS[name]
    jax.tree.map(np.testing.assert_array_equal, found.params, trained.params)
    unseen, window = tied(8, seed=1), found.config.window
    error = prediction_error(found.predict, found.params, unseen, window=window, horizons=(3,))
    nothing = prediction_error(persistence, {}, unseen, window=window, horizons=(3,))
    assert error.agents_mean[0] < (0.3 if name in ("lstm", "seq2seq") else 0.1) * nothing.agents_mean[0]
    again = prediction_error(trained.predict, trained.params, unseen, window=window, horizons=(3,))
    assert again.agents_mean == error.agents_mean
