"""The range of the training data: what is stored of it, and when a model is used outside of it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from by_hand import by_hand
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.trajectories import AGENT, GOAL, Trajectories, edge_types
from gnn.ranges import figures_of, joined, samples_of
from swarmnet.out_of_range import out_of_range


def marching(agents: int, *, speed: float = 1.0, apart: float = 2.0, scenes: int = 3, rows: int = 12) -> Trajectories:
    """Agents abreast `apart` [m] walk at `speed` [m/s]; a goal beside the first is nobody's neighbour."""
    kind = np.asarray([[GOAL] + [AGENT] * agents] * scenes, np.int8)
    shape = (scenes, rows, agents + 1)
    position = np.zeros((*shape, 2), np.float32)
    position[:, :, 1:, 1] = apart * np.arange(agents)
    position[..., 1:, 0] = speed * 0.1 * np.arange(rows)[None, :, None]
    position[:, :, 0, 1] = 0.01
    velocity = np.zeros((*shape, 2), np.float32)
    velocity[:, :, 1:, 0] = speed
    none = np.zeros(shape, np.int16)
    return Trajectories(
        position=position,
        velocity=velocity,
        mask=np.ones(shape, bool),
        kind=kind,
        radius=np.zeros(kind.shape, np.float32),
        edges=edge_types(kind, np.ones(kind.shape, bool)),
        agent_contact=none,
        solid_contact=none,
        agent_events=none,
        solid_events=none,
        depth=np.zeros(shape, np.float32),
        dt=0.1,
        substeps=1,
        max_speed=float("inf"),
        max_acceleration=float("inf"),
        provenance={},
    )


def test_the_figures_by_hand():
    figures = figures_of(marching(4, speed=1.5, apart=0.8))
    assert figures == {"agents": [4.0] * 4, "speed": [1.5] * 4, "spacing": [pytest.approx(0.8, rel=1e-5)] * 4}
    assert json.loads(json.dumps(figures)) == figures


def test_absent_nodes_do_not_count():
    data = marching(3)
    mask = data.mask.copy()
    mask[:, :6, 2:] = False  # two come later
    mask[0] = False  # nobody at all
    figures = samples_of(replace(data, mask=mask))
    assert sorted(set(figures["agents"])) == [1, 3]
    assert len(figures["agents"]) == 24
    assert len(figures["speed"]) == 2 * (6 * 1 + 6 * 3)
    assert len(figures["spacing"]) == 2 * 6 * 3


def test_one_agent_has_no_neighbour_and_no_agent_no_figures():
    assert set(figures_of(marching(1))) == {"agents", "speed"}
    alone = marching(1)
    assert figures_of(replace(alone, mask=np.zeros_like(alone.mask))) == {}


def test_nothing_is_said_of_the_same_data_and_of_models_that_stored_nothing():
    data = marching(5)
    assert out_of_range(figures_of(data), data) is None
    assert out_of_range(None, data) is None
    assert out_of_range({}, data) is None


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (marching(20), "agents at a time 20, trained on 5 (100% outside)"),
        (marching(5, speed=3), "speed 3 m/s, trained on 1 m/s (100% outside)"),
        (marching(5, apart=0.5), "distance to the nearest other 0.5 m, trained on 2 m (100% outside)"),
    ],
)
def test_one_line_says_what_was_seen_and_what_is_given(other: Trajectories, said: str):
    line = out_of_range(figures_of(marching(5)), other)
    assert line == f"out of the range of the training data: {said}"


def test_everything_outside_is_in_one_line():
    line = out_of_range(figures_of(marching(5)), marching(9, speed=0.1, apart=30))
    assert line is not None
    assert "\n" not in line
    assert [word in line for word in ("agents at a time 9", "speed 0.1", "nearest other 30 m")] == [True] * 3


def test_a_tuned_model_has_seen_what_it_learned_from_before():
    five, ten, twenty = (marching(agents, apart=10 / agents) for agents in (5, 10, 20))
    first = {"range": figures_of(five)}
    tuned = replace(by_hand(), about={"range": figures_of(ten), "initial": first})
    assert tuned.seen is not None
    assert [out_of_range(tuned.seen, data) for data in (five, ten)] == [None, None]
    assert out_of_range(figures_of(ten), five) is not None, "the data of tuning alone are not like those"
    line = out_of_range(tuned.seen, twenty)
    assert line is not None
    assert "agents at a time 20, trained on 5 to 10 (100% outside)" in line
    again = replace(tuned, about={"range": figures_of(twenty), "initial": tuned.about})
    assert again.seen is not None
    assert (again.seen["agents"], again.seen["spacing"]) == ([5, 20, 20, 20], pytest.approx([0.5, 0.5, 2, 2], rel=1e-4))
    assert replace(tuned, about={"initial": {"range": None}}).seen is None
    assert replace(tuned, about={"initial": first}).seen == first["range"]


def test_what_only_one_of_two_data_sets_has_is_kept():
    alone, two = figures_of(marching(1)), figures_of(marching(2, speed=3))
    both = joined([alone, two])
    assert both == {"agents": [1, 1, 2, 2], "speed": [1, 1, 3, 3], "spacing": two["spacing"]}


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), share=st.floats(0, 1))
def test_a_warning_comes_above_a_tenth_outside(seed: int, share: float):
    seen, rng = figures_of(marching(2)), np.random.default_rng(seed)
    data = marching(2, scenes=20, rows=20)
    fast = rng.random(data.mask.shape) < share
    data = replace(data, velocity=np.where(fast[..., None], 7, data.velocity).astype(np.float32))
    outside = fast[..., 1:].mean()
    assert (out_of_range(seen, data) is not None) == (outside > 0.1)


def test_much_data_is_sampled(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gnn.ranges._CELLS", 1000)
    data = marching(4, scenes=200, rows=50)
    samples = samples_of(data)
    assert len(samples["agents"]) <= 1100
    assert figures_of(data)["speed"] == [1.0] * 4
