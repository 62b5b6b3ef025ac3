"""Figures 5.2 to 5.4 and the report's part on PPO: numbers by hand, what is drawn, a cell from training to figure."""

import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from by_hand import random_model
from learning import blank, quick_training
from matplotlib.patches import Rectangle
from PIL import Image

from envs.config import SimulateConfig
from envs.trajectories import AGENT, GOAL, OBSTACLE
from gnn.checkpoint import Checkpoints
from gnn.config import TrainConfig
from rl.config import MODES, PPOConfig
from swarm_mjcf.errors import SpecError
from swarmnet.cli import parse
from swarmnet.config import RL
from swarmnet.figures_rl import (
    History,
    final_return,
    first_reach,
    history,
    make_rl_figures,
    needed,
    policy_sheet,
    return_history,
    rl_curves,
    smoothed,
    together,
)
from swarmnet.film import Panel
from swarmnet.report import write_report
from swarmnet.reproduce import figures_5
from swarmnet.reproduce.cells import read_record, records, run_cells
from swarmnet.reproduce.experiment import QUICK_MINUTES, Cell, Effort, find
from swarmnet.reproduce.figures_5 import FIGURE_5_2, FIGURE_5_3, FIGURE_5_4
from swarmnet.reproduce.shown import keep, write

METRICS = (
    "reward_goal", "reward_formation", "reward_agent_collision", "reward_solid_collision", "contact_events",
    "goal_distance", "kl", "clip_fraction", "explained_variance", "std",
)  # fmt: skip


def rows_of(returns, episodes=None, *, steps: float = 100.0, seconds: float = 6.0) -> list[dict]:
    """Rows of a training with these returns; metrics grow with their number and the iteration."""
    episodes = [2] * len(returns) if episodes is None else episodes
    return [
        {"step": k, "return": value, "episodes": count, "env_steps": k * steps, "spent": k * seconds}
        | {name: 0.01 * number * k for number, name in enumerate(METRICS, 1)}
        for k, (value, count) in enumerate(zip(returns, episodes, strict=True), 1)
    ]


def line(figure, name: str):
    """The y values of the only line of that name in each of the panels that have it."""
    return [np.asarray(one.get_ydata()) for ax in figure.axes for one in ax.get_lines() if one.get_gid() == name]


def silent(done: int, total: int, note: str = "") -> None:
    """Progress that nobody reads."""


def drawn(path: Path) -> bool:
    """Whether the picture is more than one colour."""
    with Image.open(path) as picture:
        colors = picture.convert("RGB").getcolors(1 << 24)
    return len(colors or []) > 50


def test_a_smoothed_return_is_the_mean_over_the_episodes_of_the_last_iterations():
    rows = rows_of([1.0, 3.0, 9.0, 5.0], [1, 3, 0, 2])
    np.testing.assert_allclose(smoothed(rows, 2), [1, (1 + 9) / 4, 3, 5])
    np.testing.assert_allclose(smoothed(rows, 10), [1, 2.5, 2.5, (1 + 9 + 10) / 6])
    np.testing.assert_array_equal(smoothed(rows_of([7.0, 2.0], [0, 1])), [np.nan, 2])
    assert len(smoothed([])) == 0


def test_the_final_return_is_that_of_the_last_tenth():
    assert final_return(rows_of(np.arange(20.0))) == pytest.approx(18.5)
    assert final_return(rows_of([4.0, 6.0])) == 6
    assert np.isnan(final_return([]))


def test_where_a_return_is_first_reached():
    """Means of up to ten: 0, 1, 2, ... 4.5 at ten iterations, then one more with each."""
    curve = history(rows_of(np.arange(0, 40.0)))
    assert curve.value[9] == 4.5
    assert first_reach(curve, 4.5) == 1000
    assert first_reach(curve, 4.6) == 1100
    assert first_reach(curve, -1.0) == 100
    assert np.isnan(first_reach(curve, 35.0))
    np.testing.assert_allclose(curve.minutes[[0, -1]], [0.1, 4.0])


def test_lines_of_several_lengths_meet_where_all_of_them_are():
    one = (np.array([0.0, 1.0, 2.0, 3.0]), np.array([np.nan, 10.0, 20.0, 30.0]))
    places, values = together([one, (np.array([0.0, 2.0]), np.array([0.0, 4.0]))], 3)
    np.testing.assert_allclose(places, [1, 1.5, 2])
    np.testing.assert_allclose(values, [[10, 15, 20], [2, 3, 4]])
    assert len(together([(np.zeros(1), np.array([np.nan]))])[0]) == 0


def test_curves_of_a_training_show_what_was_measured(tmp_path):
    rows = rows_of([1.0, 3.0, 9.0, 5.0], [1, 3, 0, 2])
    figure = rl_curves(rows)
    np.testing.assert_allclose(line(figure, "return")[0], smoothed(rows))
    for number, name in enumerate(METRICS, 1):
        factor = 1000 if name == "contact_events" else 1
        np.testing.assert_allclose(line(figure, name)[0], factor * 0.01 * number * np.array([1, 1.5, 2, 2.5]))
    assert make_rl_figures(tmp_path) == []
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (made,) = make_rl_figures(tmp_path)
    assert "<svg" in made.path.read_text()
    (tmp_path / "metrics.jsonl").write_text(json.dumps({"step": 1, "loss": 1.0}) + "\n")
    assert make_rl_figures(tmp_path) == []


def test_what_share_of_random_weights_steps_gives_their_return():
    """Better at 10 steps than scratch at 20 and 40, as good at 30 as scratch at 60, never as good as at 80."""
    minutes = np.zeros(4)
    scratch = History(np.array([20.0, 40.0, 60.0, 80.0]), minutes, np.array([np.nan, 1.0, 3.0, 9.0]))
    mine = History(np.array([10.0, 20.0, 30.0, 40.0]), minutes, np.array([2.0, np.nan, 3.0, 1.0]))
    np.testing.assert_allclose(needed(mine, scratch), [np.nan, 10 / 40, 30 / 60, np.nan])
    np.testing.assert_allclose(needed(scratch, scratch)[1:], 1)


def test_figure_5_2_draws_means_spreads_and_bars(tmp_path):
    steps, minutes = np.array([1e6, 2e6]), np.array([1.0, 3.0])
    curves = {
        "scratch": {
            0: History(steps, minutes, np.array([0.0, 2.0])),
            1: History(steps, minutes, np.array([2.0, 6.0])),
        },
        "mode 0, 10k": {0: History(steps / 2, minutes, np.array([1.0, 5.0]))},
    }
    curves["mode 0, longer"] = curves["mode 0, 10k"]
    figure = return_history(curves, {"expert": [0.25], "mode 0": [1.0, 2.0]}, note="seeds 0, 1")
    styles = {one.get_gid(): one.get_linestyle() for one in figure.axes[0].lines}
    assert styles == {"scratch": "-", "mode 0, 10k": "--", "mode 0, longer": ":"}
    for values in line(figure, "scratch"):
        np.testing.assert_allclose(values[[0, -1]], [1, 4])
    assert len(line(figure, "scratch")) == 2
    assert len(line(figure, "mode 0, 10k")) == 3
    shares = {one.get_gid(): one for one in figure.axes[2].lines}
    assert "scratch" not in shares
    np.testing.assert_allclose(shares["mode 0, 10k"].get_ydata()[[0, -1]], [0.5, 0.5])
    heights = [patch.get_height() for patch in figure.axes[3].patches if isinstance(patch, Rectangle)]
    np.testing.assert_allclose(heights, [0.25, 1.5])
    assert all(drawn(path) for path in write(tmp_path, "f", figure) if path.suffix == ".png")
    with pytest.raises(SpecError, match="curves"):
        return_history({}, {})


def acted(x, *, touch=(), solid=()):
    """A goal at 20 m, an obstacle and two agents, at `x` (S, T, 2) and 5 m beside; contacts at (scene, row, agent)."""
    x = np.asarray(x, float)
    position = np.zeros((*x.shape[:2], 4, 2))
    position[:, :, 0], position[:, :, 1] = (20, 0), (0, 50)
    position[:, :, 2:, 0], position[:, :, 3, 1] = x, 5
    t = blank(position, np.zeros_like(position), [GOAL, OBSTACLE, AGENT, AGENT])
    for places, names in ((touch, ("agent_contact", "agent_events")), (solid, ("solid_contact", "solid_events"))):
        for scene, row, agent in places:
            for name in names:
                getattr(t, name)[scene, row, 2 + agent] = 1
    return t


def test_what_is_measured_of_a_policy():
    """Three scenes, four steps of 0.1 s: both arrive untouched; both arrive and meet once; one stays 30 m away."""
    there, away = np.linspace([0, 0], [20, 20], 5), np.linspace([0, -10], [20, -10], 5)
    t = acted([there, there, away], touch=[(1, 2, 0), (1, 2, 1)], solid=[(1, 2, 0), (1, 4, 1)])
    found = figures_5.measured(t)
    assert found["contact steps [%]"] == pytest.approx(100 * 2 / 12)
    assert found["contact events"] == pytest.approx(4 / 3)
    assert found["contact events per agent and minute"] == pytest.approx(4 / (24 * 0.1 / 60))
    assert found["trajectories with a contact [%]"] == pytest.approx(100 / 3)
    assert found["success [%]"] == pytest.approx(100 / 3)
    assert found["goal distance [m]"] == pytest.approx((0 + 5 + 0 + 5 + 0 + np.hypot(30, 5)) / 6)
    for name in figures_5.MEASURED:
        assert found[f"{name}, low"] <= found[name] <= found[f"{name}, high"]


def test_policies_are_compared_from_the_same_starts():
    """One agent 3 m off in the last two of four steps: (9 + 9) / 8. No ratio to a policy that hardly touches."""
    x = np.zeros((1, 5, 2))
    off = x.copy()
    off[:, 3:, 0] = 3
    one, other = acted(off, touch=[(0, 1, 0)]), acted(x, touch=[(0, 1, 0), (0, 1, 1)])
    assert figures_5.apart(one, other) == pytest.approx(18 / 8)
    found = figures_5.compared(one, other)
    assert found["contact events / imitation"] == 0.5
    assert found["MSE to imitation [m^2]"] == pytest.approx(18 / 8)
    assert "contact events / imitation" not in figures_5.compared(one, acted(x))


def test_the_scene_that_is_drawn_and_where_the_imitation_policy_ends():
    x = np.zeros((4, 5, 2))
    t = acted(x, touch=[(1, 2, 0), (3, 2, 0)], solid=[(0, 1, 0), (2, 3, 1)])
    t.mask[0, :, 3] = False  # an agent is missing where the first contact is
    assert figures_5.telling(t) == 2
    assert figures_5.telling(acted(x, touch=[(1, 2, 0)])) == 1
    assert figures_5.telling(acted(x)) == 0
    ended = figures_5.until_contact(t.take([2]))
    np.testing.assert_array_equal(ended.mask[0].all(axis=1), [True, True, True, True, False])
    whole = acted(x[:1])
    np.testing.assert_array_equal(figures_5.until_contact(whole).mask, whole.mask)


def test_policies_are_drawn_over_the_imitation_policy(tmp_path):
    x = np.linspace([0, 0], [20, 10], 5)[None]
    one, other = acted(x), acted(0.8 * x, touch=[(0, 3, 0)])
    panel = Panel(one, "mode 0", figures_5.until_contact(other), "imitation")
    files = write(tmp_path, "f", policy_sheet([panel], columns=1, width="column", note="seed 0"))
    assert [path.suffix for path in files] == [".png", ".pdf"]
    assert drawn(files[0])


def test_where_a_mode_reaches_scratch_is_told_when_scratch_is_finished(tmp_path):
    effort = Effort(profile="cpu", demonstrations=1, test_scenes=1, minutes=2.0, data=tmp_path)
    policies = figures_5.Policies("1k", 3, effort, tmp_path, silent)

    def have(row: str, rows: list[dict]) -> None:
        policies.place(row).mkdir(parents=True, exist_ok=True)
        (policies.place(row) / "metrics.jsonl").write_text("".join(json.dumps(one) + "\n" for one in rows))

    have("mode 0", rows_of(np.arange(0, 40.0)))
    assert figures_5.learned(policies, "mode 0") == {"final return": 37.5, "env-steps": 4000}
    have("scratch", rows_of(np.full(10, 4.6), seconds=11.9))
    assert "share of scratch's env-steps" not in figures_5.learned(policies, "mode 0")  # 119 s of 120
    have("scratch", rows_of(np.full(10, 4.6), seconds=12.0))
    assert figures_5.learned(policies, "mode 0") == {
        "final return": 37.5,
        "env-steps": 4000,
        "env-steps to scratch's return": 1100,
        "share of scratch's env-steps": 1.1,
    }
    assert figures_5.learned(policies, "scratch") == {"final return": pytest.approx(4.6), "env-steps": 1000}
    assert replace(policies, data="10k").place("scratch") == policies.place("scratch")


def test_all_three_spend_the_same_on_a_policy():
    for experiment in (FIGURE_5_3, FIGURE_5_4):
        assert find(experiment.name) is experiment
        for profile in ("quick", "cpu"):
            assert experiment.effort(profile, Path("x")) == FIGURE_5_2.effort(profile, Path("x"))
    assert not [cell for cell in FIGURE_5_2.cells((0,)) if cell.data != "1k" and cell.row in ("expert", "scratch")]
    # Imitation, random weights and three modes share the quick minutes.
    assert FIGURE_5_2.effort("quick", Path("x")).minutes == pytest.approx(QUICK_MINUTES / 5)


@pytest.fixture
def small(monkeypatch):
    """Everything with two agents, few weights and few scenes."""
    curriculum = TrainConfig(model="thesis-ch5", horizons=(1,), stage_steps=(4,), chunk=2, batch=4)
    monkeypatch.setattr(figures_5, "WORLD", SimulateConfig(preset="clear", num_agents=2, mixed=True))
    monkeypatch.setattr(
        figures_5, "IMITATION", {"1k": (6, curriculum), "1k longer": (6, curriculum), "10k": (8, curriculum)}
    )
    monkeypatch.setattr(figures_5, "PPO", PPOConfig(scenes=4, steps=6, epochs=1, minibatches=2, warmup=1))
    monkeypatch.setattr(figures_5, "STEPS", 5)
    with quick_training():
        yield


def test_a_cell_from_demonstrations_to_the_figure(tmp_path, small):
    """One iteration of PPO, in which the value alone learns: mode 0 still is the imitation policy."""
    effort = Effort(profile="cpu", demonstrations=5000, test_scenes=3, minutes=1e-6, data=tmp_path / "data")
    folder = tmp_path / "cpu" / "figure-5.2"
    place = Cell("mode 0", "1k", 0).path(folder)

    def values() -> dict:
        outcome = run_cells(FIGURE_5_2, [Cell("mode 0", "1k", 0)], effort, folder)
        assert not outcome.failed, read_record(place)
        return (read_record(place) or {})["values"]

    first = values()
    metrics = Cell("mode 0", "1k", 0).path(tmp_path / "cpu" / "policies") / "metrics.jsonl"
    trained = metrics.read_text()
    (place / "cell.json").unlink()
    assert values() == first
    assert metrics.read_text() == trained
    assert set(first) <= set(FIGURE_5_2.columns)
    assert first["1k: MSE to imitation [m^2]"] == 0
    assert first["1k: goal distance / imitation"] == 1
    assert first["1k: env-steps"] == 24
    assert first["1k: final return"] is not None
    done = [(cell, record) for cell, record in records(FIGURE_5_2, folder) if "values" in record]
    assert [path.name for path in figures_5.draw_5_2(folder, done)] == ["figure-5.2.png", "figure-5.2.pdf"]
    assert drawn(folder / "figure-5.2.png")


def test_what_the_rows_are_trained_with(tmp_path, small, monkeypatch):
    asked, ends = {}, {}

    def improve(config, task, model, folder, **how):
        asked[folder.parts[-3]] = (config.freeze, config.seed, how["scratch"], how["minutes"], task.env.horizon)
        ends[folder.parts[-3]] = task.env.terminate_on_contact and config.terminations
        how["progress"](1, 2, {"spent": 30.0})
        return model

    monkeypatch.setattr(figures_5, "improve", improve)
    monkeypatch.setattr(figures_5, "PPO", replace(figures_5.PPO, terminations=400))
    monkeypatch.setattr(figures_5.rl_command, "note", lambda row: "")
    model = random_model("thesis-ch5")
    monkeypatch.setattr(figures_5.Policies, "imitated", lambda self: replace(model, about={"from": self.data}))
    effort, told = Effort(profile="cpu", demonstrations=1, test_scenes=1, minutes=2.0, data=tmp_path), []

    def tell(done: int, total: int, note: str = "") -> None:
        told.append((done, total))

    policies = figures_5.Policies("10k", 3, effort, tmp_path, tell)
    began = {row: policies.improved(row).about["from"] for row in figures_5.TRAINED}
    always, never = "mode 0, always to contact", "mode 0, always past contact"
    assert began == {"scratch": "1k"} | dict.fromkeys(("mode 0", "mode 1", "mode 2", always, never), "10k")
    assert (ends["mode 0"], ends["scratch"], ends[always], ends[never]) == (400, 400, None, 0)
    assert asked.pop(always) == asked.pop(never) == asked["mode 0"]
    assert asked["scratch"] == ((), 3, True, 2.0, 5)
    assert {row: how[0] for row, how in asked.items()} == {"scratch": ()} | {f"mode {k}": MODES[k] for k in range(3)}
    assert told[0] == (30, 120)


def test_scenes_are_drawn_from_what_cells_have_kept(tmp_path):
    x = np.linspace([0, 0], [20, 10], 5)[None]
    modes = [Cell(f"mode {mode}", "1k longer", seed) for seed in (0, 1) for mode in range(3)][
        1:
    ]  # mode 0 of seed 0 fails
    record = {"profile": "quick", "minutes": 2.0, "dt": 0.3, "seed": 1}
    done = [(cell, record | {"values": {"1k longer: MSE in the scene shown [m^2]": 1.5}}) for cell in modes]
    tens = Cell("mode 0", "10 agents", 0)
    for cell in (*modes, tens):
        keep(cell.path(tmp_path), "scene", acted(x, solid=[(0, 2, 1)]), acted(0.9 * x))
    for files in (figures_5.draw_5_4(tmp_path, done), figures_5.draw_5_3(tmp_path, [(tens, record)])):
        assert len(files) == 2
        assert drawn(files[0])
    assert figures_5.draw_5_4(tmp_path, done[:2]) == figures_5.draw_5_3(tmp_path, done) == []


ABOUT = {
    "preset": "thesis-ch5",
    "train": {"model": "thesis-ch5", "horizons": [1], "stage_steps": [3000]},
    "data": {"scenes": 950, "expert": "boids", "simulate": {"preset": "clear", "scenes": 1000, "seed": 3}},
    "model": {"window": 1},
}


def add_run(run: Path, **changes) -> None:
    """A run of 40 iterations in mode 1, with its curve."""
    ppo = PPOConfig(freeze=MODES[1], learning_rate=1e-3, scenes=64)
    settings = {k: list(v) if isinstance(v, tuple) else v for k, v in vars(ppo).items()}
    about = ABOUT | {
        "initial": {"weights": "0123456789abcdef", **ABOUT, "step": 3000},
        "rl": settings | {"iterations": None, "checkpoint_seconds": None},
        "reward": {"goal_gain": 20.0, "collision": 30.0},
        "task": {"horizon": 60, "terminate_on_contact": True, "engine": "native", "scene": {}, "spawn": {}},
    }
    checkpoints = Checkpoints(run / "checkpoints")
    checkpoints.save(40, {"step": np.zeros(())}, about | changes)
    checkpoints.close()
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows_of(np.arange(0, 40.0))))


def test_the_report_tells_of_ppo(tmp_path):
    run, init = tmp_path / "better", tmp_path / "few"
    add_run(run)
    (init / "checkpoints").mkdir(parents=True)
    document = {"prediction": {}, "collisions": {}, "given": {"policy": str(run), "reference": str(init)}}
    document |= {"contacts": True, "dt": 0.3, "scenes": 7, "steps": 5, "seed": 99}
    (run / "evaluation.json").write_text(json.dumps(document))
    page = write_report(run).read_text()
    for words in (
        "watched 950 scenes of the Boids expert in the world <code>clear</code> and was trained for 3000 gradient",
        "PPO then improved it in 40 iterations, 4000 env-steps (4.0 minutes) (mode 1)",
        f"Started from the imitation policy in <code>{init}</code>: weights <code>0123456789abcdef</code>",
        "Mode 1: <code>*/goal*</code> stay as they were.",
        "Mean return of an episode: 4.50 in the first 10 iterations, 37.5 in the last tenth of 40.",
        "<th>learning_rate</th><td>0.001</td>",
        "Reinforcement learning",
        "<summary>Imitation</summary>",
        "<dt>collision</dt><dd>30</dd>",
    ):
        assert words in page, words
    assert "Training is not finished" not in page
    lines = [row.split("  <i>")[0] for row in page.partition("<pre>")[2].partition("</pre>")[0].splitlines()]
    assert [shlex.split(row)[1] for row in lines[:3]] == ["simulate", "train", "rl"]
    config = parse(shlex.split(lines[2])[1:])
    assert isinstance(config, RL)
    assert (config.init, config.run, config.mode, config.iterations) == (init, run, 1, 40)
    assert (config.scenes, config.learning_rate, config.reward.collision) == (64, 1e-3, 30.0)
    assert config.terminate_on_contact
    assert not config.scratch
    assert str(init) in lines[1]


def test_the_report_of_random_weights_and_of_other_frozen_parts(tmp_path):
    ppo = {"freeze": ["edge/*"], "iterations": None, "scenes": 64}
    add_run(tmp_path / "run", initial=None, rl=ppo)
    page = write_report(tmp_path / "run").read_text()
    for words in (
        "began with random weights.",
        "Started from random weights. No mode: <code>edge/*</code> stay as they were.",
        f"swarmnet rl {tmp_path / 'run-imitation'} --run {tmp_path / 'run'} --iterations 40 --scratch --freeze",
    ):
        assert words in page, words
