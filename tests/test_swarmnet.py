"""SwarmNet: a second implementation, symmetries, ghosts, named parts, and the smallest scenes."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learning import INTEGRATOR, NAMES, complete, initial, numpy_swarmnet, quick_compiles, random_swarm, scales, tiny

from gnn.config import PRESETS, ModelConfig, model_preset
from gnn.decode import make_predict
from gnn.features import Scales
from gnn.graph import Graph
from gnn.swarmnet import SwarmNet
from swarm_mjcf.errors import SpecError

COUNTS = (1, 2, 4)
SEEDS = st.integers(0, 10**6)
presets = pytest.mark.parametrize("name", NAMES)


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


@partial(jax.jit, static_argnames=("config",))
def run(config: ModelConfig, params: dict, history, graph: Graph, units: Scales):
    """One compile per shape: without `jit` every operation compiles for itself."""
    return SwarmNet(config, units).apply({"params": params}, history, graph)


@cache
def network(name: str):
    """A tiny model of a preset as `(params, history, graph) -> output`, and weights for it."""
    config = tiny(name)
    history, _, graph = random_swarm(0, COUNTS, window=config.window)

    def apply(params, history, graph):
        return run(config, params, history, graph, scales())

    return config, apply, initial(config, scales(), history, graph)


def agents_of(name: str, out) -> np.ndarray:
    """The agents' rows of an output: state-change models answer for static nodes too."""
    return np.asarray(out)[:, -COUNTS[2] :] if tiny(name).output == "state_change" else np.asarray(out)


def close(a, b) -> None:
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def paths(params: dict) -> set[str]:
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {"/".join(key.key for key in path) for path, _ in leaves}


# --- second implementation ---


@presets
@settings(max_examples=8)
@given(seed=SEEDS)
def test_a_forward_pass_written_by_hand_gives_the_same(name: str, seed: int):
    config, apply, params = network(name)
    history, _, graph = random_swarm(seed, COUNTS, window=config.window, absent=0.3)
    found = np.asarray(apply(params, history, graph))
    expected = numpy_swarmnet(params, config, scales(), history, graph)
    assert found.shape == ((3, 7, 4) if config.output == "state_change" else (3, 4, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


@presets
def test_the_full_presets_agree_with_the_forward_pass_by_hand(name: str):
    config = PRESETS[name]
    history, _, graph = random_swarm(1, COUNTS, window=config.window)
    params = initial(config, scales(), history, graph)
    found = run(config, params, history, graph, scales())
    expected = numpy_swarmnet(params, config, scales(), history, graph)
    np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-5, atol=1e-5)


@presets
def test_parameters_are_a_plain_nested_dict_with_named_parts(name: str):
    _, _, params = network(name)
    config = tiny(name)
    parts = {"edge/agent", "node", "readout"} | ({"edge/goal", "edge/obstacle"} if config.context else set())
    parts |= {"conv", "psi"} if config.psi else set()
    parts |= {"reach/goal", "reach/obstacle", "reach/agent"} if "near" in config.aggregate else set()
    assert {path.split("/layer")[0].removesuffix("/skip/kernel") for path in paths(params)} == parts
    assert all(path.endswith(("/kernel", "/bias")) or path.startswith("reach/") for path in paths(params))

    def plain(tree) -> bool:
        return all(plain(v) for v in tree.values()) if type(tree) is dict else isinstance(tree, np.ndarray)

    assert plain(params)


# --- symmetries ---


@presets
@settings(max_examples=8)
@given(seed=SEEDS)
def test_permuted_agents_give_permuted_outputs(name: str, seed: int):
    config, apply, params = network(name)
    history, present, graph = random_swarm(seed, COUNTS, window=config.window, absent=0.2)
    order = np.random.default_rng(seed).permutation(COUNTS[2])
    nodes = np.concatenate([np.arange(3), 3 + order])
    out = agents_of(name, apply(params, history, graph))
    permuted = agents_of(name, apply(params, history[:, :, nodes], complete(present[:, nodes], COUNTS)))
    close(permuted, out[:, order])


@presets
@settings(max_examples=8)
@given(seed=SEEDS)
def test_the_order_of_obstacles_does_not_matter(name: str, seed: int):
    config, apply, params = network(name)
    history, present, graph = random_swarm(seed, COUNTS, window=config.window, absent=0.2)
    nodes = np.array([0, 2, 1, 3, 4, 5, 6])
    out = agents_of(name, apply(params, history, graph))
    close(agents_of(name, apply(params, history[:, :, nodes], complete(present[:, nodes], COUNTS))), out)


@presets
@settings(max_examples=8)
@given(seed=SEEDS)
def test_neither_position_nor_company_in_a_batch_matters(name: str, seed: int):
    config, apply, params = network(name)
    history, _, graph = random_swarm(seed, COUNTS, window=config.window, absent=0.2)
    out = np.asarray(apply(params, history, graph))
    for scene in range(3):
        one = jax.tree.map(lambda x, scene=scene: x[scene : scene + 1], graph)
        close(apply(params, history[scene : scene + 1], one)[0], out[scene])


@presets
@pytest.mark.parametrize("garbage", [1e3, np.nan])
def test_ghosts_change_nothing_for_the_others(name: str, garbage: float):
    config, apply, params = network(name)
    history, present, graph = random_swarm(5, COUNTS, window=config.window)
    # One more goal place is not padded: presets have 0 or 1. Two more obstacles and three more agents are.
    more = (1, 4, 7)
    places = np.array([0, 1, 2, 5, 6, 7, 8])
    padded = np.full((3, config.window, 12, 4), garbage, np.float32)
    padded[:, :, places] = history
    there = np.zeros((3, 12), bool)
    there[:, places] = present
    out = np.asarray(apply(params, padded, complete(there, more)))
    if config.output == "state_change":
        close(out[:, places], apply(params, history, graph))
        assert not out[:, [3, 4, 9, 10, 11]].any()
    else:
        close(out[:, :4], apply(params, history, graph))
        assert not out[:, 4:].any()


@presets
def test_ghosts_change_no_gradient(name: str):
    config, _, params = network(name)
    history, present, graph = random_swarm(5, COUNTS, window=config.window)
    padded = np.concatenate([history, np.full((3, config.window, 2, 4), 1e3, np.float32)], axis=2)
    there = np.concatenate([present, np.zeros((3, 2), bool)], axis=1)
    model = SwarmNet(config, scales())

    @jax.jit
    def gradient(params, history, graph):
        return jax.grad(lambda p: jnp.sum(jnp.square(model.apply({"params": p}, history, graph))))(params)

    one, two = gradient(params, history, graph), gradient(params, padded, complete(there, (1, 2, 6)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4), one, two)


@pytest.mark.parametrize("name", ["thesis-ch5", "best"])
def test_moving_the_world_and_its_centre_together_changes_nothing(name: str):
    config, apply, params = network(name)
    history, _, graph = random_swarm(6, COUNTS)
    shift = np.array([8.0, -4.0], np.float32)
    moved = history + np.array([8.0, -4.0, 0, 0], np.float32)
    there = replace(scales(), centre=scales().centre + shift)
    out = run(config, params, moved, graph, there)
    np.testing.assert_allclose(np.asarray(out), apply(params, history, graph), atol=1e-4)


@presets
def test_moving_the_world_alone_is_seen(name: str):
    """No preset is translation invariant: the published world has walls, so agents must know where they are."""
    config, apply, params = network(name)
    history, _, graph = random_swarm(6, COUNTS, window=config.window)
    moved = history + np.array([8.0, -4.0, 0, 0], np.float32)
    difference = agents_of(name, apply(params, moved, graph)) - agents_of(name, apply(params, history, graph))
    assert np.abs(difference).max() > 1e-2


FRAMED = [name for name in NAMES if PRESETS[name].frame]


def without_the_world(name: str) -> dict:
    """Weights of a node function that sees neither where its agent is nor how it moves."""
    params = jax.tree.map(np.array, network(name)[2])
    for layer in ("layer0", "skip"):
        params["node"][layer]["kernel"][:6] = 0  # position, velocity, heading
    return params


@pytest.mark.parametrize("name", FRAMED)
def test_messages_do_not_see_where_the_world_is(name: str):
    _, apply, _ = network(name)
    params = without_the_world(name)
    history, _, graph = random_swarm(6, COUNTS)
    moved = history + np.array([8.0, -4.0, 0, 0], np.float32)
    out = np.asarray(apply(params, history, graph))
    np.testing.assert_allclose(apply(params, moved, graph), out, atol=1e-4)
    assert np.abs(out).max() > 1e-2
    closer = history * np.array([0.5, 0.5, 1, 1], np.float32)
    assert np.abs(np.asarray(apply(params, closer, graph)) - out).max() > 1e-2


@pytest.mark.parametrize("name", FRAMED)
@settings(max_examples=8)
@given(seed=SEEDS, angle=st.floats(-3.0, 3.0))
def test_messages_turn_with_the_world(name: str, seed: int, angle: float):
    config, _, _ = network(name)
    params = without_the_world(name)
    history, _, graph = random_swarm(seed, COUNTS, absent=0.2)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]], np.float32)
    turned = np.concatenate([history[..., :2] @ turn, history[..., 2:] @ turn], axis=-1)
    units = replace(scales(), centre=jnp.zeros(2))
    out = np.asarray(run(config, params, history, graph, units))
    np.testing.assert_allclose(np.asarray(run(config, params, turned, graph, units)), out @ turn, atol=2e-4)


@pytest.mark.parametrize("name", FRAMED)
def test_who_stands_faces_along_x(name: str):
    config, apply, params = network(name)
    history, _, graph = random_swarm(12, COUNTS)
    history[..., 2:] = 0
    expected = numpy_swarmnet(params, config, scales(), history, graph)
    np.testing.assert_allclose(np.asarray(apply(params, history, graph)), expected, rtol=1e-5, atol=1e-5)


# --- structure ---


def mix(config: ModelConfig, weight: float) -> tuple[np.ndarray, np.ndarray]:
    """f(w x + (1 - w) y) and w f(x) + (1 - w) f(y) of the network without its hidden layers."""
    config = replace(config, edge_hidden=(), node_hidden=())
    x, _, graph = random_swarm(7, COUNTS)
    y, _, _ = random_swarm(8, COUNTS)
    params = initial(config, scales(), x, graph)

    def apply(history):
        return np.asarray(run(config, params, history, graph, scales()))

    return apply(weight * x + (1 - weight) * y), weight * apply(x) + (1 - weight) * apply(y)


def test_thesis_ch5_is_affine_in_the_state_before_its_first_relu():
    """Without hidden layers nothing is left but scaling, sums and linear maps: what `repair` can encode exactly."""
    np.testing.assert_allclose(*mix(tiny("thesis-ch5"), 2.5), atol=1e-4)


def test_without_context_goals_and_obstacles_are_not_seen():
    config, apply, params = network("thesis-ch3-blind")
    history, _, graph = random_swarm(13, COUNTS, window=config.window)
    moved = history.copy()
    moved[:, :, :3, :2] += 5
    close(
        agents_of("thesis-ch3-blind", apply(params, moved, graph)),
        agents_of("thesis-ch3-blind", apply(params, history, graph)),
    )


def test_a_linear_path_beside_the_hidden_layers():
    config = replace(tiny("best"), skip=True)
    history, _, graph = random_swarm(14, COUNTS)
    params = initial(config, scales(), history, graph)
    expected = numpy_swarmnet(params, config, scales(), history, graph)
    found = run(config, params, history, graph, scales())
    np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-5, atol=1e-5)
    assert set(params["node"]) == {"layer0", "layer1", "skip"}


def test_edge_functions_without_biases_say_nothing_at_the_origin_of_their_inputs():
    config = tiny("thesis-ch5-unbiased")
    history, _, graph = random_swarm(16, COUNTS)
    params = initial(config, scales(), history, graph)
    assert {path.rsplit("/")[-1] for path in paths(params["edge"])} == {"kernel"}
    still = np.zeros_like(history)
    still[..., :2] = scales().centre
    with_others = run(config, params, still, graph, scales())
    nobody = replace(graph, **{kind: jnp.zeros_like(getattr(graph, kind)) for kind in ("goal", "obstacle", "agent")})
    close(with_others, run(config, params, still, nobody, scales()))
    moved = np.asarray(run(config, params, history, graph, scales()))
    assert np.abs(moved - np.asarray(run(config, params, history, nobody, scales()))).max() > 0


def test_dropped_neurons_are_drawn_from_the_key():
    config = replace(tiny("best"), dropout=0.5)
    history, _, graph = random_swarm(15, COUNTS)
    params = initial(config, scales(), history, graph)
    predict = jax.jit(make_predict(config, scales(), INTEGRATOR), static_argnames="horizon")
    sure = [np.asarray(predict(params, history, graph, horizon=2)) for _ in range(2)]
    np.testing.assert_array_equal(*sure)
    one, again, other = (
        np.asarray(predict(params, history, graph, horizon=2, key=jax.random.key(k))) for k in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 1e-3
    assert np.abs(one - sure[0]).max() > 1e-3


def test_best_is_not_affine_in_the_state():
    one, two = mix(tiny("best"), 2.5)
    assert np.abs(one - two).max() > 1e-2


@presets
@pytest.mark.parametrize("counts", [(1, 0, 1), (0, 0, 1), (0, 2, 3)])
def test_small_scenes_work(name: str, counts: tuple[int, int, int]):
    """One agent, no goal, no obstacle: parts without senders have no weights, and the rest is as computed by hand."""
    config = tiny(name)
    history, _, graph = random_swarm(9, counts, window=config.window)
    params = initial(config, scales(), history, graph)
    out = np.asarray(run(config, params, history, graph, scales()))
    np.testing.assert_allclose(out, numpy_swarmnet(params, config, scales(), history, graph), rtol=1e-5, atol=1e-5)
    senders = {"goal", "obstacle", "agent"}
    seen = senders if config.context else {"agent"}
    assert set(params["edge"]) == {k for k, n in zip(("goal", "obstacle", "agent"), counts, strict=True) if n} & seen


@presets
def test_an_agent_with_nobody_in_sight_is_finite(name: str):
    config, apply, params = network(name)
    history, _, graph = random_swarm(10, COUNTS, window=config.window)
    alone = Graph(
        present=graph.present,
        goal=jnp.zeros_like(graph.goal),
        obstacle=jnp.zeros_like(graph.obstacle),
        agent=jnp.zeros_like(graph.agent),
    )
    found = np.asarray(apply(params, history, alone))
    np.testing.assert_allclose(found, numpy_swarmnet(params, config, scales(), history, alone), rtol=1e-5, atol=1e-5)


@presets
def test_gradients_are_finite_where_agents_coincide(name: str):
    config, _, params = network(name)
    history, _, graph = random_swarm(11, COUNTS, window=config.window)
    history[:, :, 4:] = history[:, :, 3:4]  # all agents in one place, at one speed
    history[0, :, 3:] = history[0, :, 1:2]  # and in the first scene on an obstacle, at rest
    predict = make_predict(config, scales(), INTEGRATOR)

    @jax.jit
    def gradients(params, history):
        return jax.grad(lambda p, h: jnp.sum(predict(p, h, graph, horizon=1) ** 2), argnums=(0, 1))(params, history)

    leaves = jax.tree.leaves(gradients(params, history))
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert any(np.abs(leaf).max() > 0 for leaf in leaves)


def test_presets_are_what_they_say():
    assert PRESETS["thesis-ch3"].window == 5
    assert PRESETS["thesis-ch3"].output == "state_change"
    assert PRESETS["thesis-ch5"].aggregate == ("sum",)
    assert PRESETS["best"].clip
    with pytest.raises(SpecError, match="thesis-ch3, thesis-ch3-blind, thesis-ch5, thesis-ch5-small, best"):
        model_preset("GAT")
    with pytest.raises(SpecError, match="window"):
        ModelConfig(window=4, convolutions=(8,))
    with pytest.raises(SpecError, match="aggregate"):
        ModelConfig(aggregate=())
