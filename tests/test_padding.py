"""Ghosts change nothing: shapes, edges, scales, errors; and mixes of sizes."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import assert_same, assert_same_trajectories, make_trajectories
from learning import blank, initial, quick_compiles, tiny

from envs.trajectories import AGENT, AGENT_EDGE, ARRAYS, GOAL, OBSTACLE, Trajectories, TrajectoryError
from gnn.decode import Integrator, make_predict
from gnn.evaluate import natural_change, prediction_error
from gnn.features import Scales
from gnn.padding import mix, pad
from gnn.windows import Dataset, windows


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


def swarm(agents: int, *, scenes: int = 3, rows: int = 9, seed: int = 0) -> Trajectories:
    """Smooth random motion of agents beside a goal and an obstacle, each agent seeing only the one before it."""
    rng = np.random.default_rng(seed)
    velocity = rng.normal(0, 1, (scenes, rows, agents + 2, 2)).cumsum(axis=1) / 3
    velocity[:, :, :2] = 0
    position = rng.normal(0, 5, (scenes, 1, agents + 2, 2)) + 0.1 * velocity.cumsum(axis=1)
    made = blank(position, velocity, [GOAL, OBSTACLE] + [AGENT] * agents)
    edges = made.edges.copy()
    edges[:, 2:, 2:] = AGENT_EDGE * np.eye(agents, k=1, dtype=edges.dtype)
    return replace(made, edges=edges, radius=np.full_like(made.radius, 0.7))


def test_nodes_keep_their_values_and_ghosts_have_none():
    given = make_trajectories(goals=1, obstacles=2, agents=3)
    full = pad(given, (2, 2, 5))
    places, ghosts = [0, 2, 3, 4, 5, 6], [1, 7, 8]
    assert full.counts == (2, 2, 5)
    assert full.kind[0].tolist() == [GOAL] * 2 + [OBSTACLE] * 2 + [AGENT] * 5
    for name in ARRAYS:
        before, after = getattr(given, name), getattr(full, name)
        assert after.dtype == before.dtype
        if name in ("saturated", "kind"):
            continue
        if name == "edges":
            np.testing.assert_array_equal(after[:, places][:, :, places], before)
            assert not after[:, ghosts].any()
            assert not after[:, :, ghosts].any()
            continue
        axis = 1 if name == "radius" else 2
        np.testing.assert_array_equal(np.take(after, places, axis), before)
        assert not np.take(after, ghosts, axis).any()
    assert_same_trajectories(pad(given, given.counts), given)
    with pytest.raises(TrajectoryError, match=r"\(1, 2, 3\).* do not fit \(1, 2, 2\)"):
        pad(given, (1, 2, 2))


def test_scales_and_the_natural_change_ignore_ghosts():
    given = swarm(3)
    full = pad(given, (1, 3, 6))
    assert_same(Scales.of(full), Scales.of(given))
    np.testing.assert_allclose(natural_change(full), natural_change(given), rtol=1e-12)


@pytest.mark.parametrize("name", ["best", "thesis-ch3"])
def test_prediction_errors_are_those_without_ghosts(name: str):
    given, config = swarm(3), tiny(name)
    full = pad(given, (1, 2, 5))
    scales, zero = Scales.of(given), np.zeros(1, np.int32)
    history, _, _, graph = windows(Dataset.of(given), zero, zero, window=config.window, horizon=1, counts=given.counts)
    params = initial(config, scales, np.asarray(history), graph)
    predict = make_predict(config, scales, Integrator(0.1, 1, 5.0, 5.0))
    alone, padded = (
        prediction_error(predict, params, data, window=config.window, horizons=(1, 4)) for data in (given, full)
    )
    assert alone.published_mean[1] > alone.published_mean[0] > 0
    for field in ("published_mean", "published_median", "agents_mean", "agents_median", "by_step"):
        np.testing.assert_allclose(getattr(padded, field), getattr(alone, field), rtol=1e-5, err_msg=field)
    assert padded.windows == alone.windows


def test_a_mix_has_the_scenes_of_all_with_room_for_the_largest():
    small, large = swarm(2, rows=7), replace(swarm(4, scenes=2, seed=1), provenance={"law": "other"})
    both = mix([small, large])
    assert (len(both), both.counts, both.position.shape[1]) == (5, (1, 1, 4), 7)
    assert both.provenance == {"mixed": [{"scenes": 3, "law": "given"}, {"scenes": 2, "law": "other"}]}
    assert both.mask[:3].any(axis=(0, 1)).tolist() == [True] * 4 + [False] * 2
    assert both.mask[3:].all()
    np.testing.assert_array_equal(both.position[3:], large.position[:, :7])
    np.testing.assert_array_equal(both.edges[:3, :4, :4], small.edges)
    assert mix([small]) is small


@pytest.mark.parametrize("change", [{"dt": 0.3}, {"substeps": 4}, {"max_speed": 3.0}, {"max_acceleration": 3.0}])
def test_what_one_model_cannot_decode_is_not_mixed(change: dict):
    (field,) = change
    with pytest.raises(TrajectoryError, match=field):
        mix([swarm(2), replace(swarm(3), **change)])
    with pytest.raises(TrajectoryError, match="nothing to mix"):
        mix([])
