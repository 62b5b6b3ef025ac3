"""Shorter scenes with smaller graphs hold the same trajectories."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import make_trajectories
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.recut import recut
from envs.trajectories import AGENT, TrajectoryError


def coming_and_going(seed: int):
    """One goal, two obstacles (one of them absent) and agents who are there for some rows."""
    data = make_trajectories(scenes=2, rows=12, goals=1, obstacles=2, agents=7, seed=seed)
    rng = np.random.default_rng(seed)
    mask = np.ones_like(data.mask)
    mask[:, :, 2] = False
    for scene in range(2):
        for node in range(3, 10):
            first = rng.integers(0, 12)
            mask[scene, :first, node] = mask[scene, first + rng.integers(1, 6) :, node] = False
    edges = np.where(mask.any(axis=1)[:, :, None] & mask.any(axis=1)[:, None], 1 + data.kind[:, :, None], 0)
    return replace(data, mask=mask, edges=edges.astype(np.int8))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000), rows=st.integers(2, 12), stride=st.integers(1, 5))
def test_every_present_node_is_found_again_with_its_states_and_edges(seed: int, rows: int, stride: int):
    data = coming_and_going(seed)
    short = recut(data, rows, stride=stride)
    starts = [(s, r) for s in range(2) for r in range(0, 12 - rows + 1, stride)]
    starts = [(s, r) for s, r in starts if (data.mask[s, r : r + rows] & (data.kind[s] == AGENT)).any(axis=1).sum() > 1]
    assert len(short) == len(starts)
    assert short.counts[:2] == (1, 1)
    for at, (scene, row) in enumerate(starts):
        nodes = np.flatnonzero(data.mask[scene, row : row + rows].any(axis=0))
        there = np.flatnonzero(short.mask[at].any(axis=0))
        for name in ("position", "velocity", "mask", "depth", "agent_contact"):
            np.testing.assert_array_equal(
                getattr(short, name)[at][:, there], getattr(data, name)[scene, row : row + rows][:, nodes]
            )
        np.testing.assert_array_equal(short.edges[at][np.ix_(there, there)], data.edges[scene][np.ix_(nodes, nodes)])
        assert not np.delete(short.edges[at], there, axis=0).any()
        np.testing.assert_array_equal(short.kind[at][there], data.kind[scene][nodes])
        np.testing.assert_array_equal(short.radius[at][there], data.radius[scene][nodes])
        np.testing.assert_array_equal(short.saturated[at], data.saturated[scene, row : row + rows])


def test_graphs_get_smaller():
    data = coming_and_going(3)
    assert recut(data, 3, stride=1).counts[2] < data.counts[2]


def test_what_does_not_fit_is_refused():
    data = coming_and_going(0)
    with pytest.raises(TrajectoryError, match="have 12 rows, scenes of 13 do not fit"):
        recut(data, 13, stride=1)
    empty = replace(data, mask=np.zeros_like(data.mask))
    with pytest.raises(TrajectoryError, match="no scene of 4 rows has an agent in two of them"):
        recut(empty, 4, stride=1)
