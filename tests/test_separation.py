"""Figure 5.1: edge functions switched by the data, the same rules of the expert, and networks that are the law."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from by_hand import LAW, by_hand, flock, random_model
from learning import published, quick_compiles

from envs.experts.config import BoidsConfig, ChaserConfig, HelbingConfig
from envs.trajectories import AGENT, OBSTACLE, Trajectories, TrajectoryError
from gnn.checkpoint import Model
from gnn.config import PRESETS as PRESETS_OF
from gnn.forecast import forecast
from gnn.laws import LawError, same_rules
from gnn.separation import COLUMNS, rerun, separation, state_of, with_only
from swarm_mjcf.errors import SpecError
from swarmnet.figures_probe import error_grid, separation_figure
from swarmnet.reproduce.experiment import Cell
from swarmnet.reproduce.figure_5_1 import FIGURE_5_1, FIXED, MIXED, NONE, column, draw

PRESETS = pytest.mark.parametrize("name", ["thesis-ch3", "thesis-ch5", "best"])


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


def permuted(t: Trajectories, order: np.ndarray) -> Trajectories:
    return replace(
        t,
        position=t.position[:, :, order],
        velocity=t.velocity[:, :, order],
        mask=t.mask[:, :, order],
        edges=t.edges[:, order][:, :, order],
    )


def foreseen(model: Model, scenes: Trajectories) -> np.ndarray:
    guess = forecast(model, scenes)
    return np.concatenate([guess.position, guess.velocity], axis=-1)


# --- subsets ---


@PRESETS
def test_an_edge_type_switched_off_equals_data_without_its_node(name: str):
    model, scenes = random_model(name), flock(3, 9)
    gone = scenes.mask & (scenes.kind != OBSTACLE)[:, None]
    absent = foreseen(model, replace(scenes, mask=gone))
    off = foreseen(model, with_only(scenes, ("goal", "agent")))
    on = foreseen(model, scenes)
    np.testing.assert_allclose(off[:, :, 2:], absent[:, :, 2:], rtol=1e-4, atol=1e-3)
    assert np.abs(off - on)[:, :, 2:].max() > 1e-2


@PRESETS
def test_subsets_follow_the_agents(name: str):
    model, scenes = random_model(name), with_only(flock(3, 9), ("obstacle", "agent"))
    order = np.array([0, 1, 4, 2, 3])
    one, other = foreseen(model, scenes), foreseen(model, permuted(scenes, order))
    np.testing.assert_allclose(other, one[:, :, order], rtol=1e-3, atol=1e-2)


def test_only_the_edges_change():
    scenes = flock(2, 4)
    none = with_only(scenes, ())
    assert not none.edges.any()
    np.testing.assert_array_equal(with_only(scenes, ("goal", "obstacle", "agent")).edges, scenes.edges)
    np.testing.assert_array_equal(none.position, scenes.position)
    with pytest.raises(SpecError, match="goal, obstacle, agent"):
        with_only(scenes, ("walls",))


# --- the expert's side ---


def test_rules_belong_to_edges():
    boids = BoidsConfig()
    assert same_rules(boids, ("goal", "obstacle", "agent")) == boids
    agent = same_rules(boids, ("agent",))
    assert (agent.cohesion, agent.separation, agent.alignment, agent.obstacle, agent.goal) == (0.2, 2, 0.2, 0, 0)
    assert same_rules(boids, ("goal",), walls_stay=True).obstacle == boids.obstacle
    assert same_rules(replace(boids, walls=False), ("goal",), walls_stay=True).obstacle == 0
    helbing = same_rules(HelbingConfig(), ("obstacle",))
    assert (helbing.goal, helbing.agents, helbing.obstacles) == (0, False, True)


def test_the_expert_again_in_free_flight_is_what_the_engine_recorded():
    scenes = published(4, 20, mixed=True)
    again = rerun(scenes, BoidsConfig())
    np.testing.assert_allclose(again.position, scenes.position, atol=2e-2)
    np.testing.assert_array_equal(again.mask, scenes.mask)
    # An edge type that is off is a law that does not see these bodies.
    goal = rerun(scenes, BoidsConfig(), ("goal",))
    assert np.abs(goal.position - scenes.position).max() > 1
    np.testing.assert_array_equal(goal.position[:, 0], scenes.position[:, 0])


def test_walls_go_with_the_obstacle_rule_or_stay():
    scenes = flock(1, 30, agents=1)
    scenes.position[0, 0, 2], scenes.velocity[0, 0, 2] = (95, 0), (10, 1)
    scenes = replace(scenes, max_speed=10.0)
    gone = rerun(scenes, BoidsConfig(), ("agent",))
    stay = rerun(scenes, BoidsConfig(), ("agent",), walls_stay=True)
    np.testing.assert_allclose(gone.velocity[0, -1, 2], [10, 1] / np.sqrt(np.float32(1.01)), rtol=0.02)
    assert np.abs(stay.velocity[0, -1, 2] - gone.velocity[0, -1, 2]).max() > 1


def test_the_state_of_a_row():
    scenes = flock(2, 4)
    state = state_of(scenes, 2)
    np.testing.assert_array_equal(state.goal, scenes.position[:, 2, 0])
    np.testing.assert_array_equal(state.obstacle, scenes.position[:, 2, 1:2])
    np.testing.assert_array_equal(state.velocity, scenes.velocity[:, 2, 2:])


def test_a_run_needs_rows_and_an_expert_with_typed_rules():
    with pytest.raises(TrajectoryError, match="at least 2"):
        rerun(flock(1, 1), LAW)
    with pytest.raises(LawError, match="not chaser"):
        separation(by_hand(), flock(1, 8), ChaserConfig())


# --- both ---


def test_a_network_that_is_the_law_has_no_error_in_any_column_and_one_with_mixed_functions_fails_where_the_thesis_did():
    scenes = flock(6, 44, agents=3)
    exact = separation(by_hand(), scenes, LAW)
    assert list(exact) == list(COLUMNS)
    for one in exact.values():
        assert one.error.horizons == (5, 40)
        assert max(one.error.published_mean) < 1e-6
        agents = one.truth.kind[0] == AGENT
        truth = np.concatenate([one.truth.position, one.truth.velocity], axis=-1)[:2]
        guess = np.concatenate([one.predicted.position, one.predicted.velocity], axis=-1)
        np.testing.assert_allclose(guess[:, :, agents], truth[:, :, agents], rtol=1e-3, atol=1e-2)
    # The drag of the goal term sits in the node function: right as long as the goal is there.
    names = {name: COLUMNS[name] for name in "ce"}
    mixed = separation(by_hand(own_speed=0.5), scenes, LAW, columns=names, shown=1)
    assert max(mixed["c"].error.published_mean) < 1e-6
    assert min(mixed["e"].error.published_mean) > 1e-3


def test_the_figure_shows_each_subset_with_its_error_and_leaves_out_what_is_not_felt():
    columns = separation(by_hand(), flock(3, 8), LAW, columns={"a": COLUMNS["a"], "f": COLUMNS["f"]})
    figure = separation_figure(columns)
    assert len(figure.axes) == 4
    assert figure.axes[1].get_title().startswith("(f) obstacle + agent\n")
    goals = [[line.get_gid() for line in ax.lines].count("goal") for ax in figure.axes]
    assert goals == [1, 0, 1, 0]
    solid = {line.get_gid(): line for line in figure.axes[3].lines}["solid 0"]
    np.testing.assert_allclose(np.asarray(solid.get_xdata()), columns["f"].predicted.position[1, :, 2, 0])


def test_the_grid_has_a_line_for_each_network_and_no_number_where_there_is_none():
    errors = {"one": {"a": 0.5, "b": 2e-5}, "other": {"a": 957.4, "b": math.inf}, "third": {"a": 0.0}}
    figure = error_grid(errors, {"a": "(a)", "b": "(b)"}, label="error")
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.texts] == ["0.5", "2e-05", "957", "inf", "0"]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["one", "other", "third"]
    (mesh,) = axes.collections
    np.testing.assert_array_equal(np.ma.getmaskarray(mesh.get_array()), [[False, False], [False, True], [True, True]])


def test_the_figure_of_all_networks_shows_the_mean_over_seeds_and_each_ones_sheet(tmp_path, monkeypatch):
    done = []
    for data, seed, value in ((MIXED, 0, 1.0), (MIXED, 1, 3.0), (FIXED, 0, 7.0)):
        cell = Cell("swarmnet best", data, seed)
        values = dict.fromkeys((c for d in FIGURE_5_1.data_sets if d.name == data for c in d.columns), value)
        folder = cell.path(tmp_path)
        folder.mkdir(parents=True)
        for ending in (".png", ".pdf"):
            (folder / f"shown{ending}").write_bytes(data.encode())
        done.append((cell, {"values": values}))
    seen = []
    monkeypatch.setattr(
        "swarmnet.reproduce.figure_5_1.error_grid", lambda *a, **k: (seen.append(a[0]), error_grid(*a, **k))[1]
    )
    values[column(FIXED, "e", 40, NONE)] = None  # ran away
    files = {path.name for path in draw(tmp_path, done)}
    assert files == {f"figure-5.1{which}{ending}" for which in ("", "-best") for ending in (".png", ".pdf")}
    fixed = dict.fromkeys(COLUMNS, 7.0) | {"e": math.inf}
    assert seen == [{"best": dict.fromkeys(COLUMNS, 2.0), "best, fixed": fixed}]
    assert (tmp_path / "figure-5.1-best.png").read_bytes() == MIXED.encode()


def test_networks_of_the_study_differ_in_one_thing():
    for row in FIGURE_5_1.rows:
        name = row.removeprefix("swarmnet ")
        base = PRESETS_OF["thesis-ch5" if name.startswith("thesis-ch5") else "best"]
        changed = [f.name for f in fields(base) if getattr(base, f.name) != getattr(PRESETS_OF[name], f.name)]
        assert len(changed) == (0 if PRESETS_OF[name] is base else 2 if name == "separable" else 1), (name, changed)
