"""Figures show the very numbers they are given."""

import json

import numpy as np
import pytest

from envs.collective import UNITS, collective_measures
from envs.storage import save
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, edge_types
from swarm_mjcf.build import agent_color
from swarm_mjcf.errors import SwarmError
from swarmnet.figures import (
    contact_rates,
    error_by_horizon,
    goal_distance,
    goal_over_time,
    learning_curves,
    make_figures,
    paths_over_paths,
    stages,
    svg,
    telling_scenes,
)
from swarmnet.figures_collective import make_collective_figures, measures_over_time, quantiles

ROWS = [
    {"step": 10 * n, "stage": n > 2, "horizon": 5 if n > 2 else 1, "loss": 1 / n, "validation_error": 2 / n,
     "gradient_norm": 1.0, "steps_per_second": 10.0}
    for n in range(1, 5)
]  # fmt: skip
ERRORS = {
    "swarmnet best": {"by_step": [0.1, 0.4, 0.9]},
    "constant velocity": {"by_step": [0.5, 2.0, 4.5]},
    "persistence": {"by_step": [1.0, 4.0, 9.0]},
}


def estimate(value: float, low: float | None = None, high: float | None = None, unit: str = "share") -> dict:
    return {"value": value, "low": low, "high": high, "unit": unit}


def rates(any_step: float) -> dict:
    names = [f"{kind}_{who}" for kind in ("contact_steps", "ever_touching_trajectories") for who in ("any", "agent")]
    names += ["contact_steps_obstacle", "ever_touching_trajectories_obstacle"]
    return {name: estimate(any_step, any_step / 2, any_step * 2) for name in names}


def scenes(count: int = 2, rows: int = 6, *, shift: float = 0.0) -> Trajectories:
    """A goal, an obstacle and two agents that fly east; the second agent is absent in the last two rows."""
    position = np.zeros((count, rows, 4, 2), np.float32)
    position[:, :, 0] = (30, 0)
    position[:, :, 1] = (10, 12)
    position[:, :, 2, 0] = 4 * np.arange(rows)
    position[:, :, 3] = np.stack([4 * np.arange(rows), np.full(rows, 5 + shift)], axis=-1)
    mask = np.ones((count, rows, 4), bool)
    mask[:, -2:, 3] = False
    kind = np.tile(np.array([GOAL, OBSTACLE, AGENT, AGENT], np.int8), (count, 1))
    counts = {
        name: np.zeros((count, rows, 4), np.int16)
        for name in ("agent_contact", "solid_contact", "agent_events", "solid_events")
    }
    counts["solid_contact"][-1, 3, 2] = 2
    return Trajectories(
        position=np.where(mask[..., None], position, 0),
        velocity=np.zeros_like(position),
        mask=mask,
        kind=kind,
        radius=np.tile(np.array([0, 4, 1, 1], np.float32), (count, 1)),
        edges=edge_types(kind, mask[:, 0]),
        depth=np.zeros((count, rows, 4), np.float32),
        dt=0.5,
        substeps=1,
        max_speed=10.0,
        max_acceleration=10.0,
        provenance={"policy": "somebody"},
        **counts,
    )


def drawn(figure, name: str, panel: int = 0) -> np.ndarray:
    """x and y (2, P) of the only line with that name."""
    lines = [line for line in figure.axes[panel].lines if line.get_gid() == name]
    assert len(lines) == 1
    return np.array(lines[0].get_data(), float)


def test_learning_curves_are_the_metrics() -> None:
    figure = learning_curves(ROWS)
    np.testing.assert_allclose(drawn(figure, "loss"), [[10, 20, 30, 40], [1, 1 / 2, 1 / 3, 1 / 4]])
    np.testing.assert_allclose(drawn(figure, "validation_error", 1), [[10, 20, 30, 40], [2, 1, 2 / 3, 1 / 2]])
    assert [ax.get_yscale() for ax in figure.axes] == ["log", "log"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["1 step", "5 steps"]
    assert stages(ROWS) == [(0, 20, 1), (20, 40, 5)]


def test_error_by_horizon_is_by_step() -> None:
    figure = error_by_horizon(ERRORS, dt=0.3)
    for name, error in ERRORS.items():
        np.testing.assert_allclose(drawn(figure, name), [[1, 2, 3], error["by_step"]])
    assert figure.axes[0].get_yscale() == "log"
    assert "0.3 s" in figure.axes[0].get_xlabel()
    styles = {(line.get_color(), line.get_linestyle()) for line in figure.axes[0].lines}
    assert len(styles) == 3


def test_paths_are_the_trajectories() -> None:
    solid, dashed = scenes(), scenes(shift=3.0)
    figure = paths_over_paths(solid, dashed, ["one", "two"], columns=2, contacts=True)
    assert [ax.get_title() for ax in figure.axes] == ["one", "two"]
    for panel in range(2):
        for agent in range(2):
            for name, data in ((f"solid {agent}", solid), (f"dashed {agent}", dashed)):
                there = data.mask[panel, :, 2 + agent]
                x, y = drawn(figure, name, panel)
                np.testing.assert_array_equal(np.isnan(x), ~there)
                np.testing.assert_allclose(np.stack([x, y], -1)[there], data.position[panel, there, 2 + agent])
        np.testing.assert_allclose(drawn(figure, "goal", panel)[:, 0], [30, 0])
        obstacle = figure.axes[panel].patches[0]
        assert (obstacle.get_center(), obstacle.get_radius()) == ((10.0, 12.0), 4.0)
    colors = {line.get_gid(): line.get_color() for line in figure.axes[0].lines}
    assert colors["solid 0"] == agent_color(0)
    assert colors["solid 1"] == agent_color(1)
    assert colors["dashed 0"] == colors["dashed 1"]
    # The only contact is the first agent's in the second scene, in the step that ends at row 3.
    assert drawn(figure, "hit 0", 0).shape == (2, 0)
    np.testing.assert_allclose(drawn(figure, "hit 0", 1)[:, 0], [12, 0])


def test_arrowheads_point_forward_in_time() -> None:
    figure = paths_over_paths(scenes(), scenes(), ["one"], columns=1)
    heads = [line for line in figure.axes[0].lines if line.get_gid() == "arrowhead"]
    assert len(heads) == 6
    for head in heads:  # a triangle that pointed up, turned to the east
        tip = head._marker.get_transform().transform((0, 1))
        assert tip[0] > 0.4
        assert abs(tip[1]) < 1e-6


def test_goal_distance_counts_present_agents() -> None:
    data = scenes()
    distance = goal_distance(data)
    assert distance is not None
    assert distance.shape == (2, 6)
    np.testing.assert_allclose(distance[0, 0], (30 + np.hypot(30, 5)) / 2, rtol=1e-6)
    np.testing.assert_allclose(distance[0, -1], 10, rtol=1e-6)  # the second agent has left
    figure = goal_over_time({"expert": data, "model": scenes(shift=3.0)})
    x, y = drawn(figure, "expert")
    np.testing.assert_allclose(x, 0.5 * np.arange(6))
    np.testing.assert_allclose(y, distance.mean(axis=0))


def test_contact_rates_are_percent_with_their_intervals() -> None:
    figure = contact_rates({"expert": rates(0.001), "swarmnet best": rates(0.02)})
    np.testing.assert_allclose(drawn(figure, "expert")[0], [0.1] * 3)
    np.testing.assert_allclose(drawn(figure, "swarmnet best", 1)[0], [2] * 3)
    intervals = {c.get_gid(): np.array(c.get_segments()) for c in figure.axes[0].collections}
    np.testing.assert_allclose(intervals["interval swarmnet best"][:, :, 0], [[1, 4]] * 3)


def test_scenes_with_contacts_are_told_first() -> None:
    assert telling_scenes(scenes(4), 3) == [3, 0, 1]


def test_the_same_data_give_the_same_file() -> None:
    assert svg(error_by_horizon(ERRORS, dt=0.3)) == svg(error_by_horizon(ERRORS, dt=0.3))


def test_figures_of_what_is_there(tmp_path) -> None:
    run = tmp_path / "run"
    with pytest.raises(SwarmError, match="no such run folder"):
        make_figures(run)
    run.mkdir()
    assert make_figures(run) == []
    (run / "metrics.jsonl").write_text("".join(json.dumps(row | {"stage": int(row["stage"])}) + "\n" for row in ROWS))
    assert [figure.path.name for figure in make_figures(run)] == ["learning.svg"]
    save(run / "rollouts" / "sweep_truth.h5", scenes(4))
    save(run / "rollouts" / "sweep_predicted.h5", scenes(4, shift=1.0))
    sweep, learning = make_figures(run)
    assert sweep.narrow is not None
    assert learning.narrow is None
    assert "dt = 0.5 s" in sweep.caption
    for path in (sweep.path, sweep.narrow, learning.path):
        assert path.read_text().rstrip().endswith("</svg>")
    assert not list((run / "figures").glob("*.partial*"))


def test_an_unreadable_evaluation_is_named(tmp_path) -> None:
    (tmp_path / "evaluation.json").write_text("{")
    with pytest.raises(SwarmError, match=r"evaluation\.json: cannot be read"):
        make_figures(tmp_path)
    (tmp_path / "evaluation.json").write_text("[]")
    with pytest.raises(SwarmError, match="holds no evaluation"):
        make_figures(tmp_path)


def test_quantiles_are_over_the_scenes_that_have_a_value() -> None:
    values = np.array([[1.0, 5], [2, np.nan], [3, np.nan], [np.nan, np.nan]])
    values = np.concatenate([values, np.full((4, 1), np.nan)], axis=1)
    np.testing.assert_array_equal(quantiles(values, (0.0, 0.5, 1.0)), [[1, 5, np.nan], [2, 5, np.nan], [3, 5, np.nan]])


def test_measures_over_time_are_medians_with_bands() -> None:
    rng = np.random.default_rng(0)
    runs = {name: {measure: rng.random((40, 6)) for measure in UNITS} for name in ("expert", "mine")}
    figure = measures_over_time(runs, dt=0.5, columns=4)
    for panel, measure in enumerate(UNITS):
        for name, measures in runs.items():
            x, y = drawn(figure, name, panel)
            np.testing.assert_allclose(x, 0.5 * np.arange(6))
            np.testing.assert_allclose(y, np.median(measures[measure], axis=0))
            (band,) = (c for c in figure.axes[panel].collections if c.get_gid() == f"band {name}")
            corners = band.get_paths()[0].vertices
            low, high = np.quantile(measures[measure], [0.1, 0.9], axis=0)
            np.testing.assert_allclose([corners[:, 1].min(), corners[:, 1].max()], [low.min(), high.max()])
        assert ("[m]" in figure.axes[panel].get_title()) == bool(UNITS[measure])
    alone = measures_over_time({"mine": runs["mine"]}, dt=0.5, names=("spread",))
    assert alone.axes[0].get_ylabel() == "spread, mean [m]"


def test_collective_figures_of_a_run_and_when_they_are_made_anew(tmp_path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    assert make_collective_figures(run) == []
    save(run / "rollouts" / "expert.h5", scenes(4))
    save(run / "rollouts" / "learned.h5", scenes(4, shift=1.0))
    about = {
        "prediction": {},
        "collective": {"expert": {}},
        "reference": "expert",
        "policy": "mine",
        "dt": 0.5,
        "scenes": 4,
    }
    (run / "evaluation.json").write_text(json.dumps(about))
    (figure,) = make_collective_figures(run)
    pictures = sorted((run / "figures").glob("*.png"))
    assert [path.stem.removeprefix("collective-") for path in pictures] == sorted(UNITS)
    assert figure.path.read_text().rstrip().endswith("</svg>")
    assert set(collective_measures(scenes())) == set(UNITS)
    before = [path.stat().st_mtime_ns for path in pictures]
    make_collective_figures(run)
    assert [path.stat().st_mtime_ns for path in pictures] == before
