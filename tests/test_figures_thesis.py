"""Figures of chapters 3 and 4 show the numbers they are given; their cells leave what the figures need."""

import math
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from learning import INTEGRATOR, initial, published, quick_compiles, quick_training, random_swarm, scales, tiny

from envs.config import SimulateConfig
from envs.simulate import simulate_in_memory
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, TrajectoryError, edge_types
from gnn.checkpoint import Model
from gnn.config import TrainConfig
from gnn.evaluate import natural_change, prediction_error
from gnn.forecast import forecast
from swarm_mjcf.build import OBSTACLE_COLOR, agent_color
from swarm_mjcf.errors import SpecError
from swarmnet.figures_thesis import (
    Shown,
    error_by_size,
    log_density,
    norm_distributions,
    prediction_sheet,
    relative_errors,
)
from swarmnet.reproduce import borrow, figures_4, work
from swarmnet.reproduce.borrow import Learning, trained_once
from swarmnet.reproduce.cells import read_record, run_cells
from swarmnet.reproduce.experiment import Cell, Effort
from swarmnet.reproduce.figures_3 import FIGURE_3_6, FIGURE_3_8, SIZES
from swarmnet.reproduce.figures_4 import FIGURE_4_4, PAIRS
from swarmnet.reproduce.norms import norms
from swarmnet.reproduce.shown import keep, panels, scene_errors, show, until

DT = 0.5


def scene(shift: float = 0.0, rows: int = 6) -> Trajectories:
    """A goal, an obstacle and two agents that fly east at 8 m/s, the second `shift` metres farther north."""
    position, velocity = np.zeros((1, rows, 4, 2), np.float32), np.zeros((1, rows, 4, 2), np.float32)
    position[:, :, 0], position[:, :, 1] = (30, 0), (10, 12)
    position[:, :, 2:, 0], velocity[:, :, 2:, 0] = 8 * DT * np.arange(rows)[:, None], 8.0
    position[:, :, 3, 1] = 5 + shift
    mask = np.ones((1, rows, 4), bool)
    mask[:, -2:, 3] = False
    kind = np.array([[GOAL, OBSTACLE, AGENT, AGENT]], np.int8)
    nothing = np.zeros((1, rows, 4), np.int16)
    return Trajectories(
        position=np.where(mask[..., None], position, 0), velocity=np.where(mask[..., None], velocity, 0), mask=mask,
        kind=kind, radius=np.array([[0, 4, 1, 1]], np.float32), edges=edge_types(kind, mask[:, 0]),
        agent_contact=nothing, solid_contact=nothing, agent_events=nothing, solid_events=nothing,
        depth=nothing.astype(np.float32), dt=DT, substeps=1, max_speed=10.0, max_acceleration=10.0, provenance={},
    )  # fmt: skip


def named(artists, name: str) -> Any:
    """The only one of that name."""
    (found,) = (artist for artist in artists if artist.get_gid() == name)
    return found


def test_arrows_are_the_prediction_over_the_truth() -> None:
    truth, guess = scene(), scene(shift=2.0)
    figure = prediction_sheet([Shown(truth, guess, "one", first=1)], columns=1, note="dt 0.5 s, seed 3")
    (axes,) = figure.axes
    for number in (0, 1):
        x, y = np.array(named(axes.lines, f"truth {number}").get_data(), float)
        there = truth.mask[0, :, 2 + number]
        np.testing.assert_array_equal(np.isnan(x), ~there)
        np.testing.assert_allclose(np.stack([x, y], -1)[there], truth.position[0, there, 2 + number])
        arrows = named(axes.collections, f"predicted {2 + number}")
        rows = np.flatnonzero(guess.mask[0, :, 2 + number])[2:]  # the first two were given
        np.testing.assert_allclose(np.stack([arrows.X, arrows.Y], -1), guess.position[0, rows, 2 + number])
        np.testing.assert_allclose(np.stack([arrows.U, arrows.V], -1), guess.velocity[0, rows, 2 + number])
        assert arrows.scale * DT == 1  # v dt long
        np.testing.assert_allclose(arrows.get_facecolor()[0, :3], agent_color(number))
        start = named(axes.lines, f"start {number}")
        np.testing.assert_allclose(np.ravel(start.get_data()), guess.position[0, 1, 2 + number])
        assert named(axes.lines, f"truth {number}").is_dashed()
    obstacle = named(axes.patches, "obstacle")
    assert (obstacle.get_center(), obstacle.get_radius()) == ((10.0, 12.0), 4.0)
    np.testing.assert_allclose(obstacle.get_facecolor()[:3], OBSTACLE_COLOR)
    np.testing.assert_allclose(np.ravel(named(axes.lines, "goal").get_data()), [30, 0])
    assert axes.get_aspect() == 1
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    (legend,) = figure.legends
    words = [text.get_text() for text in legend.get_texts()]
    assert words == ["prediction starts", "predicted", "truth", "goal", "obstacle"]
    assert legend.get_title().get_text() == "dt 0.5 s, seed 3"


def test_two_agents_keep_their_colours() -> None:
    truth, guess = scene(), scene(shift=2.0)
    figure = prediction_sheet(
        [Shown(truth, guess, "all"), Shown(truth, guess, "", agents=(1,))], columns=1, side=("all agents", "one agent")
    )
    above, below = figure.axes
    assert [c.get_gid() for c in below.collections] == ["predicted 3"]
    np.testing.assert_allclose(
        named(below.collections, "predicted 3").get_facecolor(), named(above.collections, "predicted 3").get_facecolor()
    )
    assert not [line for line in below.lines if line.get_gid() == "truth 0"]
    assert [axes.get_ylabel() for axes in figure.axes] == ["all agents\ny [m]", "one agent\ny [m]"]


def test_what_runs_away_leaves_the_panel() -> None:
    truth, guess = scene(), scene()
    position = guess.position.copy()
    position[0, -1, 2] = (5000, 0)
    figure = prediction_sheet([Shown(truth, replace(guess, position=position), "one")], columns=1)
    low, high = figure.axes[0].get_xlim()
    assert low < 0
    assert 30 < high < 60


def test_panels_beyond_the_last_are_empty_and_bad_panels_are_refused() -> None:
    figure = prediction_sheet([Shown(scene(), scene(), str(n)) for n in range(3)], columns=2)
    assert [axes.axison for axes in figure.axes] == [True, True, True, False]
    with pytest.raises(SpecError, match="at least 1 panel"):
        prediction_sheet([], columns=2)
    with pytest.raises(SpecError, match="one for each line"):
        prediction_sheet([Shown(scene(), scene(), "")], columns=1, side=("a", "b"))
    with pytest.raises(SpecError, match="one scene, twice"):
        Shown(scene(), scene(rows=7), "")


def test_errors_by_size_are_relative_to_the_first_size() -> None:
    values = {1: np.array([[2.0, 1, np.nan], [4, 3, np.nan]]), 40: np.array([[10.0, 5, 1], [10, 5, 4]])}
    figure = error_by_size(values, [1000, 2000, 5000])
    (axes,) = figure.axes
    np.testing.assert_allclose(named(axes.lines, "mean 1").get_data(), [[1000, 2000], [1, 2 / 3]])
    np.testing.assert_allclose(named(axes.lines, "mean 40").get_data(), [[1000, 2000, 5000], [1, 0.5, 0.25]])
    band = named(axes.collections, "spread 40").get_paths()[0].vertices
    np.testing.assert_allclose([band[:, 1].min(), band[:, 1].max()], [0.1, 1])
    np.testing.assert_allclose(named(axes.lines, "seeds 1").get_ydata(), np.array([2, 1, 4, 3]) / 3)
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["1K", "2K", "5K"]
    assert len({line.get_color() for line in axes.lines}) == 2
    np.testing.assert_array_equal(relative_errors(np.array([[np.nan, 1.0]]), 2), [[np.nan, np.nan]])
    assert not [c for c in error_by_size({5: values[1][:1]}, [1, 2, 3]).axes[0].lines if c.get_gid() == "seeds 5"]
    with pytest.raises(SpecError, match="growing"):
        error_by_size(values, [2000, 1000, 5000])
    with pytest.raises(SpecError, match=r"\(seeds, 2\)"):
        error_by_size(values, [1000, 2000])


def test_a_histogram_of_norms_has_unit_area_over_decades() -> None:
    rng = np.random.default_rng(0)
    data = {"(3, 1)": rng.lognormal(0, 1, 4000), "(20, 17)": rng.lognormal(3, 1, 4000)}
    norms = {line: {"message": data, "sum": {"(3, 1)": data["(3, 1)"]}} for line in ("before", "after")}
    figure = norm_distributions(norms)
    assert len(figure.axes) == 4
    curves = {}
    for axes in figure.axes[::2]:
        for label, values in data.items():
            curve = named(axes.patches, f"norms {label}").get_data()
            assert np.sum(curve.values * np.diff(np.log10(curve.edges))) == pytest.approx(1, abs=0.005)
            np.testing.assert_allclose(curve.values, log_density(values, curve.edges))
            curves[label] = curve
    middle = {label: np.average(np.log10(curve.edges[1:]), weights=curve.values) for label, curve in curves.items()}
    assert middle["(20, 17)"] - middle["(3, 1)"] == pytest.approx(3 / math.log(10), abs=0.1)
    assert [axes.get_ylabel() for axes in figure.axes] == ["before", "", "after", ""]
    np.testing.assert_allclose(log_density(np.array([0.0, 1, 1, 30]), np.array([0.1, 10, 1000])), [0.25, 0.125])
    with pytest.raises(SpecError, match="at least one part"):
        norm_distributions({"before": {}})


@pytest.fixture(scope="module")
def still() -> Model:
    """A network whose weights are all 0: no acceleration, so that everybody keeps its velocity."""
    history, _, graph = random_swarm(0, (1, 2, 4))
    params = jax.tree.map(np.zeros_like, initial(tiny("thesis-ch5"), scales(), history, graph))
    integrator = replace(INTEGRATOR, dt=DT, max_speed=math.inf, max_acceleration=math.inf)
    return Model(tiny("thesis-ch5"), scales(), integrator, params, {})


def test_predictions_start_from_the_first_rows_alone(still) -> None:
    truth = scene(rows=12)
    velocity = truth.velocity.copy()
    velocity[0, 0, 2] = (0, 3)
    guess = forecast(still, replace(truth, velocity=velocity))
    assert guess.provenance["given"] == 1
    np.testing.assert_allclose(guess.position[0, :, 2], np.stack([np.zeros(12), 3 * DT * np.arange(12)], -1), atol=1e-4)
    np.testing.assert_allclose(guess.position[0, :10, 3], truth.position[0, :10, 3], atol=1e-4)
    np.testing.assert_array_equal(guess.position[0, 0], truth.position[0, 0])


def test_agents_that_overflow_are_absent_and_their_error_is_infinite(still) -> None:
    truth = scene(rows=12)
    params = jax.tree.map(lambda leaf: leaf, still.params)
    params["readout"]["layer0"]["bias"] = np.array([1e38, 0], np.float32)
    guess = forecast(replace(still, params=params), truth)
    assert not guess.mask[0, -1, 2]
    assert guess.mask[0, :, :2].all()
    assert np.isinf(scene_errors(truth, guess, 1)).all()


def test_long_titles_are_broken_and_keep_off_each_other() -> None:
    figure = prediction_sheet([Shown(scene(), scene(), "swarmnet thesis-ch3 context, sample 1")] * 12, columns=6)
    figure.draw_without_rendering()
    boxes = [axes.title.get_window_extent() for axes in figure.axes]
    assert not any(one.overlaps(other) for i, one in enumerate(boxes) for other in boxes[:i])
    assert all(figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1 for box in boxes)
    panels = [axes.get_window_extent() for axes in figure.axes]
    assert not any(box.overlaps(panel) for box in boxes for panel in panels)
    assert panels[0].width > 0.1 * figure.bbox.width


def test_scene_errors_by_hand() -> None:
    # The second agent is 2 m off in y in 3 of the 5 rows after the first: 3 * 4 over 3 * 5 + 3 nodes of 4 dimensions.
    np.testing.assert_allclose(scene_errors(scene(), scene(shift=2.0), 1), [3 * 4 / (18 * 4)])


def test_scenes_are_kept_and_come_back(tmp_path) -> None:
    truth, guess = scene(), replace(scene(shift=2.0), provenance={"given": 3})
    keep(tmp_path, "N = 3, M = 1", truth, guess)
    (panel,) = panels(tmp_path, "N = 3, M = 1", ["title"], agents=(0,))
    assert (panel.first, panel.agents, panel.title) == (2, (0,), "title")
    np.testing.assert_array_equal(panel.truth.position, truth.position)
    np.testing.assert_array_equal(panel.predicted.position, guess.position)
    assert until(truth, 4).mask.shape == (1, 4, 4)
    with pytest.raises(TrajectoryError, match="6 rows"):
        until(truth, 7)


def test_the_error_of_a_shown_scene_is_the_published_one(still, tmp_path) -> None:
    """A scene of exactly 41 rows has one window: the error of what is shown is the published error of its data."""
    truth = until(published(), 41).take([2])
    model = replace(still, integrator=replace(still.integrator, dt=truth.dt))
    with quick_compiles():
        found = show(model, truth, tmp_path, "one", unit=natural_change(truth)[0])
        error = prediction_error(model.predict, model.params, truth, window=1, horizons=(40,))
    np.testing.assert_allclose(found, error.published_mean, rtol=1e-5)


@pytest.mark.parametrize(("preset", "times"), [("thesis-ch3", 2), ("best-mean", 1), ("best", 2)])
def test_norms_of_messages_and_of_what_joins_them(preset, times) -> None:
    """Edge functions that say (3, 4, 0, ...) to everybody: length 5, and with two senders 10 when summed."""
    with quick_compiles():
        swarm = simulate_in_memory(SimulateConfig(preset="chaser", num_agents=3, scenes=2, steps=9, engine="native"))
        config = tiny(preset)
        history, _, graph = random_swarm(0, (0, 0, 3), window=config.window)
        params = initial(config, scales(), history, graph)
        last = params["edge"]["agent"]["layer2"]
        last["kernel"], last["bias"] = 0 * last["kernel"], np.array([3, 4, 0, 0, 0, 0], np.float32)
        if "skip" in params["edge"]["agent"]:
            params["edge"]["agent"]["skip"]["kernel"] *= 0
        every = edge_types(swarm.kind, swarm.mask[:, 0])
        found = norms(Model(config, scales(), INTEGRATOR, params, {}), replace(swarm, edges=every), count=7)
    assert {part: len(lengths) for part, lengths in found.items()} == {"message": 42, "joined": 21, "output": 21}
    np.testing.assert_allclose(found["message"], 5)
    np.testing.assert_allclose(found["joined"], 5 * times)
    assert (found["output"] > 0).all()


@pytest.fixture
def short(monkeypatch):
    """Presets of few weights, and trainings of 2 steps, since the minutes allow no more."""

    def config(model: str, seed: int, minutes: float) -> TrainConfig:
        return TrainConfig(model=model, seed=seed, horizons=(1,), stage_steps=(2,), chunk=2, batch=4)

    for module in (work, borrow):
        monkeypatch.setattr(module, "curriculum", config)
    with quick_training():
        yield


def effort(tmp_path, **changes) -> Effort:
    given = {"profile": "quick", "demonstrations": 6, "test_scenes": 4, "minutes": 1e-4, "data": tmp_path / "data"}
    return Effort(**{**given, **changes})


@pytest.mark.parametrize(
    ("experiment", "row", "files"),
    [
        (FIGURE_3_8, "swarmnet thesis-ch3 context", ["figure-3.8"]),
        (FIGURE_4_4, "swarmnet thesis-ch3", ["figure-4.4-thesis-ch3"]),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_cells_give_their_columns_and_their_figure(experiment, row, files, tmp_path, short, monkeypatch) -> None:
    some = PAIRS[0], PAIRS[2]  # every size of swarm is compiled anew
    monkeypatch.setattr(figures_4, "PAIRS", some)
    columns = set(experiment.columns)
    if experiment is FIGURE_4_4:
        columns = {name for name in columns if any(f" {n},{m} " in name for n, m in some)}
        assert len(columns) == len(experiment.columns) * len(some) // len(PAIRS)
    cells = experiment.cells([0], rows=(row,))
    folder = tmp_path / "out" / experiment.name
    assert not run_cells(experiment, cells, effort(tmp_path), folder).failed
    done = [(cell, read_record(cell.path(folder)) or {}) for cell in cells]
    assert set(done[0][1]["values"]) == columns
    made = experiment.figure(folder, done)
    assert [path.name for path in made] == [f"{name}{ending}" for name in files for ending in (".png", ".pdf")]
    assert all(path.stat().st_size > 2000 for path in made)
    if experiment is FIGURE_4_4:  # frozen edge functions say the same before and after tuning
        values = done[0][1]["values"]
        assert all(values[f"message {n},{m} before tuning"] == values[f"message {n},{m} after tuning"] for n, m in some)
        assert values["output 3,1 before tuning"] != values["output 3,1 after tuning"]


def test_figure_3_6_draws_the_sizes_that_the_profile_allows(tmp_path) -> None:
    sizes, seeds = [row for row, size in SIZES.items() if size <= 5000], (0, 1)
    record = {"minutes": 1.0, "dt": 0.3, "seed": 0, "profile": "quick", "demonstrations": 1000}
    values = {column: 0.5 for column in FIGURE_3_6.columns}
    done = [(Cell(row, "boids", seed), record | {"values": values}) for row in sizes for seed in seeds]
    assert FIGURE_3_6.figure
    assert [path.name for path in FIGURE_3_6.figure(tmp_path, done)] == ["figure-3.6.png", "figure-3.6.pdf"]
    assert FIGURE_3_6.figure(tmp_path, done[2:]) == []  # nothing to compare with
    big = Cell("100K", "boids", 0)
    assert FIGURE_3_6.run(big, effort(tmp_path), tmp_path / "a" / "b" / "c" / "d", lambda *_, **__: None) == {}


def test_a_run_of_a_sibling_is_copied_and_only_the_same_one(tmp_path, short) -> None:
    data, mean = published(6, 45), effort(tmp_path)

    def learn(name: str, effort: Effort, **changes) -> tuple[Model, bytes]:
        """A network and its metrics, whose timings tell one training from the next."""
        place = tmp_path / "out" / name / "row" / "boids" / "seed-1"
        wanted = Learning(**{"model": "thesis-ch5", "seed": 1, **changes})
        model = trained_once(wanted, data, effort, place, lambda *_, **__: None)
        return model, (place / wanted.part / "metrics.jsonl").read_bytes()

    first, metrics = learn("table-9", mean)
    again, copied = learn("figure-9", mean, part="start")
    assert copied == metrics
    jax.tree.map(np.testing.assert_array_equal, again.params, first.params)
    assert learn("longer", replace(mean, minutes=2e-4))[1] != metrics
    tuning = {"initial": first, "freeze": ("edge/*",)}
    tuned, of_tuning = learn("tuned", mean, **tuning)
    assert of_tuning != metrics
    np.testing.assert_array_equal(
        tuned.params["edge"]["agent"]["layer0"]["kernel"], first.params["edge"]["agent"]["layer0"]["kernel"]
    )
    assert learn("tuned too", mean, part="tuned", **tuning)[1] == of_tuning
    assert learn("all free", mean, initial=first)[1] not in (metrics, of_tuning)
    assert not list((tmp_path / "out").rglob("*.partial*"))
