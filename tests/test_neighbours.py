"""Neighbour search against brute force in NumPy, on scenes made to break cells; the interactions of the experts."""

import math
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import scene_state
from hypothesis import given, settings
from hypothesis import strategies as st

import envs.neighbours as search
from envs.experts.boids import boids
from envs.experts.config import BoidsConfig, Interaction
from envs.neighbours import make_cells, neighbours
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec
from swarmnet.numpy_boids import flocking, seen_by

AGENTS = 60
"""More than `FEW`: cells are used."""


@cache
def searcher(radius: float | None, nearest: int | None):
    return jax.jit(lambda position, present: neighbours(position, present, radius=radius, nearest=nearest))


def brute_force(
    position: np.ndarray, present: np.ndarray, radius: float | None, nearest: int | None
) -> list[list[set]]:
    """Neighbours of every agent of every scene as sets, by float32 distances as the search computes them."""
    found = []
    for places, there in zip(position, present, strict=True):
        square = ((places[None] - places[:, None]) ** 2).sum(-1, dtype=np.float32)
        ok = there[:, None] & there[None] & ~np.eye(len(places), dtype=bool)
        ok &= True if radius is None else square < np.float32(radius) ** 2
        ranked = np.argsort(np.where(ok, square, np.inf), axis=1, kind="stable")[:, :nearest]
        found.append([{int(j) for j in row if ok[i, j]} for i, row in enumerate(ranked)])
    return found


def found_by(position: np.ndarray, present: np.ndarray, radius: float | None, nearest: int | None) -> list[list[set]]:
    index, valid = jax.device_get(searcher(radius, nearest)(position, present))
    for numbers, real in zip(index.reshape(-1, index.shape[-1]), valid.reshape(-1, valid.shape[-1]), strict=True):
        assert len(set(numbers[real].tolist())) == real.sum()  # nobody twice
    return [
        [set(i[v].tolist()) for i, v in zip(rows, masks, strict=True)] for rows, masks in zip(index, valid, strict=True)
    ]


def scenes(agents: int = AGENTS) -> tuple[np.ndarray, np.ndarray]:
    """Spread, all in one cell, in two far heaps, on a line, with one far outlier, with ghosts among them, empty."""
    rng = np.random.default_rng(1)
    spread = rng.uniform(-100, 100, (7, agents, 2))
    spread[1] *= 0.01
    spread[2, : agents // 2] = spread[2, : agents // 2] * 0.05 + 900
    spread[3, :, 1] = 0
    spread[4, 0] = 1e5
    present = np.ones((7, agents), bool)
    present[5] = rng.random(agents) < 0.5
    present[6] = False
    return spread.astype(np.float32), present


@pytest.mark.parametrize(("radius", "nearest"), [(30.0, None), (30.0, 8), (3.0, 4), (None, 8), (500.0, 59)])
def test_every_scene_gets_exactly_the_neighbours_of_brute_force(radius, nearest, monkeypatch):
    monkeypatch.setattr(search, "MANY", 32)  # so that the nearest are searched in cells, too
    position, present = scenes()
    assert found_by(position, present, radius, nearest) == brute_force(position, present, radius, nearest)


@pytest.mark.parametrize(("radius", "nearest"), [(60.0, None), (60.0, 3), (None, 3), (None, 20), (None, None)])
def test_few_agents_compare_all_pairs(radius, nearest):
    position, present = scenes(9)
    assert found_by(position, present, radius, nearest) == brute_force(position, present, radius, nearest)


def test_one_agent_has_no_neighbours():
    index, valid = neighbours(jnp.zeros((2, 1, 2)), jnp.ones((2, 1), bool), nearest=3)
    assert index.shape == valid.shape == (2, 1, 0)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e4))
def test_any_spread_any_ghosts_any_scale(seed: int, scale: float):
    rng = np.random.default_rng(seed)
    position = (rng.standard_cauchy((3, AGENTS, 2)) * scale).astype(np.float32)
    present = rng.random((3, AGENTS)) < rng.random()
    assert found_by(position, present, 20.0, 5) == brute_force(position, present, 20.0, 5)


def test_cells_hold_every_present_agent_once_and_no_other():
    position, present = scenes()
    cells = jax.device_get(jax.jit(make_cells)(position, present, jnp.full(7, 30.0)))
    np.testing.assert_array_equal(np.sort(cells.order, axis=1), np.tile(np.arange(AGENTS), (7, 1)))
    np.testing.assert_array_equal(np.take_along_axis(cells.place, cells.order, axis=1)[0], np.arange(AGENTS))
    for scene in range(7):
        count = present[scene].sum()
        assert set(cells.order[scene, :count]) == set(np.flatnonzero(present[scene]))
        assert (cells.last[scene] <= count).all()
        assert (cells.first[scene, count:] == cells.last[scene, count:]).all()


BOIDS = BoidsConfig(obstacle=0.0, goal=0.0, separation_range=12.0, separation_summed=True)
SEEN = (
    Interaction(),
    Interaction(radius=30.0),
    Interaction(nearest=8),
    Interaction(radius=30.0, nearest=4),
)


@pytest.mark.parametrize("interaction", SEEN, ids=["full", "radius", "nearest", "both"])
@pytest.mark.parametrize("averaged", [False, True])
def test_boids_see_whom_they_should(interaction: Interaction, averaged: bool):
    config = replace(BOIDS, interaction=interaction, separation_summed=not averaged)
    position, present = scenes()
    velocity = np.random.default_rng(2).uniform(-5, 5, position.shape).astype(np.float32)
    spec = SceneSpec(num_agents=AGENTS, num_obstacles=0)
    state = scene_state(spec, position, velocity, agent_present=present)
    got = np.asarray(jax.jit(boids(config))(state))
    for scene in (0, 1, 2, 3, 5):  # 4 has an outlier at 1e5 m: float32 means are coarse there
        there = present[scene]
        places, speeds = position[scene][there].astype(float), velocity[scene][there].astype(float)
        expected = flocking(config, places, speeds, seen_by(config, places))
        np.testing.assert_allclose(got[scene][there], expected, rtol=1e-3, atol=2e-3)
        assert not got[scene][~there].any()
    assert np.isfinite(got).all()


def test_a_scene_depends_on_nothing_else_in_the_batch():
    """The crowded scene makes the batch read more blocks; the spread one must not notice."""
    config = replace(BOIDS, interaction=Interaction(radius=30.0))
    position, present = scenes()
    velocity = np.ones_like(position)
    spec = SceneSpec(num_agents=AGENTS, num_obstacles=0)
    law = jax.jit(boids(config))

    def pushed(rows: list[int]) -> np.ndarray:
        return np.asarray(law(scene_state(spec, position[rows], velocity[rows], agent_present=present[rows])))

    np.testing.assert_array_equal(pushed([0, 1])[0], pushed([0, 3])[0])


def test_scenes_that_are_not_finite_harm_no_other():
    position, present = scenes()
    broken = position.copy()
    broken[0, 3] = np.nan
    broken[1] = np.inf
    index, valid = jax.device_get(searcher(30.0, 8)(broken, present))
    whole_index, whole_valid = jax.device_get(searcher(30.0, 8)(position, present))
    np.testing.assert_array_equal(index[2:], whole_index[2:])
    np.testing.assert_array_equal(valid[2:], whole_valid[2:])


def test_more_agents_than_cells_can_number_are_refused():
    shapes = [
        jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in (((1, 50_000, 2), jnp.float32), ((1, 50_000), bool))
    ]
    with pytest.raises(SpecError, match="num_agents"):
        jax.eval_shape(lambda position, present: neighbours(position, present, radius=1.0, nearest=1), *shapes)


@pytest.mark.parametrize("radius", [0.0, -1.0, math.inf, math.nan])
def test_a_radius_that_makes_no_sense_is_refused(radius: float):
    with pytest.raises(SpecError, match="radius"):
        Interaction(radius=radius)


@pytest.mark.parametrize("nearest", [0, -3])
def test_a_number_of_neighbours_that_makes_no_sense_is_refused(nearest: int):
    with pytest.raises(SpecError, match="nearest"):
        Interaction(nearest=nearest)
