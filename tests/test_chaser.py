"""Chasers against the published code's own numbers (`data/golden_chaser.npz`); whom they chase; where they start."""

import math
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import scene_state
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.config import SimulateConfig, make_world
from envs.dynamics import free_flight, limited
from envs.experts.chaser import chaser, circle_start, draw_targets
from envs.experts.config import ChaserConfig, Interaction
from envs.simulate import simulate_in_memory
from envs.state import State, make_state
from envs.swarm_env import scene_keys
from swarm_mjcf.spec import SceneSpec

GOLDEN = np.load(Path(__file__).parent / "data/golden_chaser.npz")
WORLDS = ("chaser_n3_m1", "chaser_n5_m1", "chaser_n10_m5", "chaser_n20_m12")


def golden_state(world: str, dtype: type) -> State:
    edges = GOLDEN[f"{world}/edges_source_target"]  # [j, i] = 1: i chases j
    scenes = len(edges)
    targets = int(edges.sum(axis=1).max())
    fields = {
        "position": GOLDEN[f"{world}/position"].astype(dtype),
        "velocity": GOLDEN[f"{world}/velocity"].astype(dtype),
        "goal": np.zeros((scenes, 2), dtype),
        "obstacle": np.zeros((scenes, 0, 2), dtype),
        "target": np.argsort(-edges, axis=1, kind="stable")[:, :targets].swapaxes(1, 2).astype(np.int32),
    }
    return make_state(**jax.tree.map(jnp.asarray, fields))


def computed(world: str, dtype: type) -> dict[str, np.ndarray]:
    scene = make_world("chaser", num_agents=golden_state(world, np.float32).position.shape[1]).scene

    def everything(state: State) -> dict[str, jax.Array]:
        summed = chaser(ChaserConfig())(state)
        executed = limited(state.velocity, summed, scene)
        position, velocity = free_flight(state.position, state.velocity, executed, scene)
        mean = chaser(ChaserConfig(average=True))(state)
        return {
            "acceleration_sum": summed,
            "acceleration_mean": mean,
            "next_position_dt0.3": position,
            "next_velocity_dt0.3": velocity,
        }

    with jax.enable_x64(dtype == np.float64):
        return jax.device_get(jax.jit(everything)(golden_state(world, dtype)))


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 1e-5)])
def test_golden_numbers_are_reproduced(world: str, dtype: type, tolerance: float):
    ours = computed(world, dtype)
    recorded = {key.split("/")[1] for key in GOLDEN.files if key.startswith(world + "/")}
    assert recorded == set(ours) | {"position", "velocity", "edges_source_target"}  # nothing golden is left unchecked
    for name, value in ours.items():
        assert value.dtype == dtype
        golden = GOLDEN[f"{world}/{name}"]
        error = np.linalg.norm(value - golden, axis=-1) / np.maximum(np.linalg.norm(golden, axis=-1), 1)
        assert error.max() <= tolerance, name


@cache
def law(config: ChaserConfig):
    return jax.jit(chaser(config))


def chasing(places, target, present=None, **config) -> np.ndarray:
    spec = SceneSpec(num_agents=len(places), num_obstacles=0)
    state = scene_state(spec, [places], agent_present=None if present is None else [present])
    state = replace(state, target=np.asarray([target], np.int32))
    return np.asarray(law(ChaserConfig(**config))(state))[0]


def test_sum_and_average_by_hand():
    places, target = [[0, 0], [4, 0], [0, 6]], [[1, 2], [0, -1], [-1, -1]]
    np.testing.assert_allclose(chasing(places, target), [[4, 6], [-4, 0], [0, 0]])
    np.testing.assert_allclose(chasing(places, target, average=True, gain=2.0), [[4, 6], [-8, 0], [0, 0]])


def test_absent_targets_and_absent_chasers():
    places, target = [[0, 0], [4, 0], [0, 6]], [[1, 2], [0, 2], [0, 1]]
    np.testing.assert_allclose(chasing(places, target, [True, False, True]), [[0, 6], [0, 0], [0, -6]])
    np.testing.assert_allclose(chasing(places, target, [True, False, True], average=True)[0], [0, 6])


def test_only_targets_in_sight_are_chased():
    places, target = [[0, 0], [4, 0], [0, 6], [3, 0]], [[1, 2], [0, -1], [0, -1], [-1, -1]]
    near = chasing(places, target, interaction=Interaction(radius=5.0))
    np.testing.assert_allclose(near[:3], [[4, 0], [-4, 0], [0, 0]])
    nearest = chasing(
        places, target, interaction=Interaction(nearest=2)
    )  # of 0 they are 3 and 1, of 2 they are 0 and 3
    np.testing.assert_allclose(nearest[:3], [[4, 0], [-4, 0], [0, -6]])


def test_no_targets_and_coincident_agents_stay_put():
    assert not chasing([[1, 1]] * 2, np.zeros((2, 0))).any()
    assert not chasing([[1, 1]] * 2, [[1], [0]]).any()


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.permutations(range(6)))
def test_renumbering_agents_renumbers_accelerations(seed: int, order):
    rng = np.random.default_rng(seed)
    places, target = rng.uniform(-20, 20, (6, 2)), rng.integers(-1, 6, (6, 3))
    renamed = np.append(np.argsort(order), -1)[target[order]]
    np.testing.assert_allclose(chasing(places[order], renamed), chasing(places, target)[order], atol=1e-4)


@pytest.fixture(scope="module")
def drawn():
    """Targets of 400 scenes of 6 agents, the last 2 of every other scene absent, for each assignment."""
    keys = scene_keys(0, range(400))
    present = np.ones((400, 6), bool)
    present[1::2, 4:] = False
    draw = {
        name: jax.jit(jax.vmap(partial(draw_targets, targets=4, assignment=name)))
        for name in ("fixed", "scene", "agent")
    }
    return present, {name: np.asarray(f(keys, jnp.asarray(present))) for name, f in draw.items()}


@pytest.mark.parametrize("assignment", ["fixed", "scene", "agent"])
def test_targets_are_different_others_that_are_present(drawn, assignment: str):
    present, target = drawn[0], drawn[1][assignment]
    for scene in range(0, 400, 7):
        for agent in range(6):
            chosen = target[scene, agent][target[scene, agent] >= 0]
            assert len(set(chosen)) == len(chosen)
            assert agent not in chosen
            assert present[scene, chosen].all()
            assert present[scene, agent] or not len(chosen)


def test_how_many_targets_an_agent_has(drawn):
    present, targets = drawn
    number = {name: (target >= 0).sum(axis=2) for name, target in targets.items()}
    assert (number["fixed"][::2] == 4).all()
    assert (number["fixed"][1::2, :4] == 3).all()  # of 4 present agents, 3 others: all of them
    assert (number["scene"][::2] == number["scene"][::2, :1]).all()
    for name in ("scene", "agent"):
        assert set(number[name][::2, 0]) == {1, 2, 3, 4}
    assert (number["agent"][::2].max(axis=1) > number["agent"][::2].min(axis=1)).mean() > 0.9
    assert not number["agent"][~present].any()


def test_every_set_of_targets_is_equally_likely():
    draw = jax.jit(jax.vmap(partial(draw_targets, targets=2, assignment="fixed")))
    target = np.sort(np.asarray(draw(scene_keys(1, range(6000)), jnp.ones((6000, 5), bool)))[:, 2], axis=1)
    sets, count = np.unique(target, axis=0, return_counts=True)
    assert len(sets) == 6  # of 4 others, 2
    assert np.abs(count - 1000).max() < 5 * math.sqrt(1000)


def test_the_circle_of_the_published_code():
    position, velocity = jax.vmap(partial(circle_start, agents=50))(scene_keys(0, range(40)))
    np.testing.assert_allclose(np.linalg.norm(position, axis=-1), 20, rtol=1e-5)
    angle = np.arctan2(position[..., 1], position[..., 0])
    assert np.histogram(angle, 8, (-math.pi, math.pi))[0].min() > 150  # 250 expected in each
    assert 1.9 < np.abs(velocity).max() <= 2
    assert abs(float(velocity.mean())) < 0.1


def test_the_preset_simulates():
    config = SimulateConfig(preset="chaser", scenes=3, steps=20, num_agents=4, engine="native", threads=1)
    t = simulate_in_memory(config)
    np.testing.assert_allclose(np.linalg.norm(t.position[:, 0], axis=-1), 20, rtol=1e-5)
    assert np.linalg.norm(t.velocity, axis=-1).max() <= 10.001
    # Every agent chases one other: after the first step each velocity has changed toward one of the others.
    step = t.position[:, 1] - t.position[:, 0] - t.dt * t.velocity[:, 0]
    toward = t.position[:, 0, None] - t.position[:, 0, :, None]
    cosine = (step[:, :, None] * toward).sum(-1) / np.maximum(
        np.linalg.norm(step, axis=-1)[..., None] * np.linalg.norm(toward, axis=-1), 1e-9
    )
    assert (cosine.max(axis=2) > 0.999).all()
