"""Decentralised execution: complete neighbourhoods act as the centralised pass, others as if nobody else were there."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import scene_state, scenes_of
from learning import initial, quick_compiles, scales, tiny
from test_neighbours import brute_force

from envs.experts.config import Interaction
from envs.state import State
from gnn.config import PRESETS as FULL
from gnn.config import ModelConfig
from gnn.decentral import make_decentralised, perceived
from gnn.decode import make_policy
from gnn.graph import graph_of_state
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.spec import SceneSpec

PRESETS = ("thesis-ch5", "best", "separable", "crowd")
SPEC = SceneSpec(num_agents=6, num_obstacles=2)
COMPLETE: tuple[dict[str, Any], ...] = ({"nearest": 5}, {"radius": 1e6})
BOTH: dict[str, Any] = {"nearest": 2, "radius": 11.0}
PARTIAL: tuple[dict[str, Any], ...] = ({"nearest": 3}, BOTH)


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


@cache
def swarm() -> State:
    """Three scenes of the size of the sights, with 6, 4 and 1 of 6 agents and 2, 1 and 1 of 2 obstacles."""
    rng = np.random.default_rng(1)
    return scene_state(
        SPEC,
        rng.uniform(-10, 10, (3, 6, 2)),
        rng.normal(0, 2, (3, 6, 2)),
        goal=rng.uniform(-10, 10, (3, 2)),
        obstacle=rng.uniform(-10, 10, (3, 2, 2)),
        agent_present=[[True] * 6, [True, False, True, True, False, True], [False, True, False, False, False, False]],
        obstacle_present=[[True, True], [False, True], [True, False]],
    )


@cache
def weights(config: ModelConfig) -> dict:
    nodes, graph = graph_of_state(swarm(), goal=True)
    return initial(config, scales(), np.asarray(nodes)[:, None], graph)


def small(name: str) -> ModelConfig:
    """Few weights; a crowd's network takes 4 of 5 others."""
    config = tiny(name)
    return replace(config, nearest=4) if config.nearest else config


@cache
def compiled(config: ModelConfig, **sight: Any) -> Any:
    """`state -> acceleration`."""
    if sight.pop("central", False):
        policy = make_policy(config, scales())
    else:
        policy = make_decentralised(config, scales(), **sight)
    params = weights(config)
    return jax.jit(lambda state: policy(state, params))


def acted(name: str, state: State, **sight: Any) -> np.ndarray:
    return np.asarray(compiled(small(name), **sight)(state))


def each_in_a_copy(state: State) -> State:
    """Three scenes as 18, one for each agent."""
    return scenes_of(state, np.repeat(np.arange(3), 6))


def scene_of_each(state: State, **sight: Any) -> State:
    return jax.device_get(jax.jit(perceived, static_argnums=1)(state, Interaction(**sight)))


def sights(state: Any, *, nearest: int | None = None, radius: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Whom and which obstacles each agent perceives, (S, N, N) and (S, N, K), by going through all of them."""
    scenes, agents, _ = state.position.shape
    seen = np.zeros((scenes, agents, agents), bool)
    for s, sets in enumerate(brute_force(state.position, state.agent_present, radius, nearest)):
        for i, others in enumerate(sets):
            seen[s, i, list(others)] = True
    apart = np.linalg.norm(state.obstacle[:, None] - state.position[:, :, None], axis=-1)
    noticed = state.agent_present[:, :, None] & state.obstacle_present[:, None]
    return seen, noticed & (apart < (radius or np.inf))


@pytest.mark.parametrize("name", PRESETS)
def test_complete_neighbourhoods_act_as_the_centralised_pass(name: str):
    state, central = swarm(), acted(name, each_in_a_copy(swarm()), central=True)[::6]
    assert np.linalg.norm(central, axis=-1)[state.agent_present].min() > 1e-3
    for sight in COMPLETE:
        found = acted(name, state, **sight)
        np.testing.assert_allclose(found, central, rtol=1e-5, atol=2e-6)
        np.testing.assert_array_equal(found[~state.agent_present], 0)


@pytest.mark.parametrize(
    ("name", "sight"), [*((name, sight) for name in PRESETS for sight in PARTIAL), ("best-all", BOTH)], ids=str
)
def test_whoever_is_not_perceived_might_as_well_not_be_there(name: str, sight: dict[str, Any]):
    state = swarm()
    seen, noticed = sights(state, **sight)
    assert (seen.sum(axis=2) < state.agent_present.sum(axis=1, keepdims=True) - 1).any()
    each = each_in_a_copy(state)
    everything = acted(name, each, central=True)[::6]
    itself = np.eye(6, dtype=bool) & state.agent_present[..., None]
    each = replace(each, agent_present=(seen | itself).reshape(18, 6), obstacle_present=noticed.reshape(18, 2))
    removed = acted(name, each, central=True).reshape(3, 6, 6, 2)[:, range(6), range(6)]
    found = acted(name, state, **sight)
    np.testing.assert_allclose(found, removed, rtol=1e-5, atol=2e-6)
    np.testing.assert_array_equal(found[~state.agent_present], 0)
    assert np.abs(found - everything).max() > 1e-3, "something must be lost"


@pytest.mark.parametrize("sight", [*PARTIAL, {"radius": 9.0}], ids=str)
def test_what_others_do_out_of_sight_changes_nothing_to_the_bit(sight: dict[str, Any]):
    """Positions move while they stay out of sight; velocities become NaN, which anything touched would carry on."""
    state = swarm()
    seen, noticed = sights(state, **sight)
    before = acted("best", state, **sight)
    moved = 0
    for j in range(6):
        position, velocity = np.array(state.position), np.array(state.velocity)
        position[0, j] += [0.3, -0.2]
        velocity[0, j] = np.nan
        after = replace(state, position=position, velocity=velocity)
        blind = (np.arange(6) != j) & ~seen[0, :, j] & ~sights(after, **sight)[0][0, :, j]
        found = acted("best", after, **sight)[0]
        np.testing.assert_array_equal(found[blind], before[0][blind])
        assert np.isnan(found[seen[0, :, j]]).all()
        moved += blind.sum()
    assert moved > 5
    if "radius" in sight:
        drift = np.where(np.array([True, False])[:, None], np.nan, state.obstacle_velocity)
        found = acted("best", replace(state, obstacle_velocity=drift), **sight)[0]
        np.testing.assert_array_equal(np.isnan(found).all(axis=1), noticed[0, :, 0])
        np.testing.assert_array_equal(found[~noticed[0, :, 0]], before[0][~noticed[0, :, 0]])
        assert 0 < noticed[0, :, 0].sum() < 6


@pytest.mark.parametrize("name", ["thesis-ch5", "crowd"])
def test_order_and_ghosts_change_nothing(name: str):
    state, found = swarm(), acted(name, swarm(), **BOTH)
    order = np.random.default_rng(0).permutation(6)
    fields = ("position", "velocity", "agent_present", "touching_agent", "touching_wall", "touching_obstacle", "target")
    permuted = replace(state, **{field: getattr(state, field)[:, order] for field in fields})
    np.testing.assert_allclose(acted(name, permuted, **BOTH), found[:, order], rtol=1e-5, atol=2e-6)
    ghosts = replace(state, **{field: np.pad(a := getattr(state, field), [(0, 0), (0, 3)] + [(0, 0)] * (a.ndim - 2))
                               for field in fields})  # fmt: skip
    ghosts.position[~ghosts.agent_present] = np.nan
    padded = acted(name, ghosts, **BOTH)
    np.testing.assert_allclose(padded[:, :6], found, rtol=1e-5, atol=2e-6)
    np.testing.assert_array_equal(padded[:, 6:], 0)


def test_a_perceived_scene_by_hand():
    """On a line at 0, 1, 3, 7 m, the third absent; two others at most, closer than 6.5 m; obstacles at 2 and 9 m."""
    spec = SceneSpec(num_agents=4, num_obstacles=2)
    x, on_line = np.array([0.0, 1.0, 3.0, 7.0]), np.array([1.0, 0.0])
    state = scene_state(
        spec, x[None, :, None] * on_line, 10 * x[None, :, None] * on_line, goal=[[5, 5]],
        obstacle=[[[2, 0], [9, 0]]], agent_present=[[True, True, False, True]], obstacle_present=[[True, True]],
    )  # fmt: skip
    alone = scene_of_each(replace(state, step=np.array([4], np.int32)), nearest=2, radius=6.5)
    np.testing.assert_array_equal(
        alone.agent_present, [[True, True, False], [True, True, True], [False] * 3, [True, True, False]]
    )
    np.testing.assert_array_equal(alone.position[..., 0], [[0, 1, 0], [1, 0, 7], [0, 0, 0], [7, 1, 0]])
    np.testing.assert_array_equal(alone.velocity, 10 * alone.position)
    np.testing.assert_array_equal(alone.obstacle_present, [[True, False], [True, False], [False] * 2, [True, True]])
    np.testing.assert_array_equal(alone.obstacle[..., 0], [[2, 0], [2, 0], [0, 0], [2, 9]])
    np.testing.assert_array_equal(alone.goal, [[5, 5]] * 4)
    np.testing.assert_array_equal(alone.step, [4] * 4)


def test_a_chaser_perceives_its_targets_among_those_in_sight():
    target = np.random.default_rng(2).integers(0, 6, (3, 6, 2)).astype(np.int32)
    target[0, 0] = -1
    state = replace(swarm(), target=np.where(target == np.arange(6)[:, None], -1, target))
    np.testing.assert_allclose(
        acted("best", state, nearest=5), acted("best", state, central=True), rtol=1e-5, atol=2e-6
    )
    chased = (state.target[..., None] == np.arange(6)).any(axis=2)
    seen, _ = sights(state, nearest=2)
    alone = scene_of_each(state, nearest=2).agent_present
    np.testing.assert_array_equal(alone[:, 1:].sum(axis=1), (seen & chased).sum(axis=2).ravel())
    assert (seen & ~chased).any()


def test_without_a_goal_and_without_others():
    spec = SceneSpec(num_agents=1, num_obstacles=1, goal=False)
    start, config = scene_state(spec, [[[3, 4]]], [[[1, 2]]], obstacle=[[[0, 0]]]), tiny("thesis-ch5")
    nodes, graph = graph_of_state(start, goal=False)
    params = initial(config, scales(), np.asarray(nodes)[:, None], graph)
    central = jax.jit(make_policy(config, scales(), goal=False))(start, params)

    def alone(**sight: Any) -> jax.Array:
        return jax.jit(make_decentralised(config, scales(), goal=False, **sight))(start, params)

    np.testing.assert_allclose(alone(nearest=3), central, rtol=1e-5, atol=1e-6)
    assert np.abs(alone(radius=4.9) - central).max() > 1e-3, "the obstacle is 5 m away"


def test_it_runs_inside_a_scan_and_is_compiled_once():
    act = compiled(small("best"), nearest=3)

    def step(state: State, _: None) -> tuple[State, jax.Array]:
        wanted = act(state)
        velocity = state.velocity + 0.1 * wanted
        return replace(state, velocity=velocity, position=state.position + 0.1 * velocity), wanted

    state = jax.tree.map(jnp.asarray, swarm())
    _, scanned = jax.lax.scan(step, state, length=5)
    once: Any = jax.jit(step)
    rows = []
    for _ in range(5):
        state, wanted = once(state, None)
        rows.append(wanted)
    np.testing.assert_allclose(scanned, np.stack(rows), rtol=1e-4, atol=1e-5)
    assert once._cache_size() == 1


@pytest.mark.parametrize("name", ["thesis-ch5", "separable"])
def test_a_message_costs_what_it_costs_in_the_centralised_pass(name: str):
    """6 places for messages of agents to each, as in the centralised pass, not 6 times 6; fewer in sight, fewer."""

    def operations(**sight: Any) -> float:
        return compiled(FULL[name], **sight).lower(swarm()).cost_analysis()["flops"]

    central = operations(central=True)
    assert operations(nearest=5) < 1.3 * central
    assert operations(nearest=1) < 0.7 * central


@pytest.mark.parametrize(
    ("sight", "said"),
    [
        ({"nearest": 0}, "nearest: 0 was given, allowed is None (no limit) or a whole number of at least 1"),
        ({"radius": 0.0}, "radius: 0.0 was given, allowed is None (no limit) or a finite number above 0 [m]"),
        ({"radius": float("nan")}, "radius: nan was given"),
        ({"radius": float("inf")}, "radius: inf was given"),
    ],
)
def test_what_is_no_limit_is_refused(sight: dict[str, Any], said: str):
    with pytest.raises(SpecError) as caught:
        make_decentralised(tiny("best"), scales(), **sight)
    assert str(caught.value).startswith(said)


@pytest.mark.parametrize("config", [tiny("thesis-ch3"), replace(tiny("thesis-ch5"), output="state_change")])
def test_a_model_that_does_not_act_is_refused_in_the_same_words(config: ModelConfig):
    with pytest.raises(SwarmError) as central:
        make_policy(config, scales())
    with pytest.raises(SwarmError) as caught:
        make_decentralised(config, scales(), nearest=3)
    assert str(caught.value) == str(central.value)
