"""Training on problems with known answers, the curriculum, and what happens when it cannot go on."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from learning import quick_training, spring, tiny

import gnn.train
from envs.trajectories import TrajectoryError
from gnn.checkpoint import CheckpointError, Checkpoints, load_model
from gnn.config import TrainConfig
from gnn.decode import make_predict
from gnn.evaluate import persistence, prediction_error
from gnn.metrics import read_metrics
from gnn.train import TrainError, prepare, train
from swarm_mjcf.errors import SpecError
from swarmnet.bench_train import bench_loop, windows_of

SHORT = TrainConfig(
    model="thesis-ch5",
    horizons=(1, 3),
    stage_steps=(6, 4),
    chunk=2,
    batch=4,
    learning_rate=1e-3,
    checkpoint_seconds=1e-9,
)

SHORTEST = replace(SHORT, horizons=(1,), stage_steps=(4,))


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_training():
        yield


def steps_of(folder: Path) -> list[int]:
    return [row["step"] for row in read_metrics(folder / "metrics.jsonl")]


def test_a_linear_law_is_learned(tmp_path: Path):
    """Springs to the goal with damping: after seconds the error on unseen scenes is a fiftieth of persistence's."""
    config = TrainConfig(
        model="thesis-ch5", horizons=(1, 4), stage_steps=(600, 300), chunk=100, batch=64, learning_rate=1e-2
    )
    model = train(config, spring(48), tmp_path, validation=spring(8, seed=1))
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert rows[5]["loss"] < rows[0]["loss"] / 10
    assert rows[-1]["validation_error"] < rows[0]["validation_error"] / 5
    unseen = spring(16, seed=2)
    predict = make_predict(model.config, model.scales, model.integrator)
    learned = prediction_error(predict, model.params, unseen, window=1, horizons=(1, 4))
    nothing = prediction_error(persistence, {}, unseen, window=1, horizons=(1, 4))
    assert learned.agents_mean[0] < 0.02 * nothing.agents_mean[0]
    assert learned.agents_mean[1] < 0.02 * nothing.agents_mean[1]


def test_the_validation_error_of_the_metrics_is_the_error_on_the_scenes_kept_out(tmp_path: Path):
    """Validation scenes with one window each, so that the fixed sample of windows is all of them."""
    unseen = spring(1, rows=4, seed=5)
    model = train(SHORT, spring(), tmp_path, validation=unseen)
    found = prediction_error(
        make_predict(model.config, model.scales, model.integrator), model.params, unseen, window=1, horizons=(3,)
    )
    last = read_metrics(tmp_path / "metrics.jsonl")[-1]
    np.testing.assert_allclose(last["validation_error"], found.agents_mean[0], rtol=1e-4)


def test_horizons_come_in_the_order_of_the_curriculum_with_one_compile_each(tmp_path: Path):
    """None for another seed, other scales and other stages of the same horizons."""
    seen, own = [], replace(SHORT, learning_rate=1.7e-3)  # which no other test has compiled
    run_chunk = prepare(own, spring()).run_chunk.func
    model = train(own, spring(), tmp_path / "one", progress=lambda done, total, row: seen.append((done, total, row)))
    assert run_chunk._cache_size() == 2
    other = replace(own, seed=1, stage_steps=(2, 2))
    again = train(other, spring(seed=3), tmp_path / "other")
    assert prepare(other, spring(seed=3)).run_chunk.func is run_chunk
    assert run_chunk._cache_size() == 2
    assert not np.array_equal(again.scales.position, model.scales.position)
    gnn.train.compiled.cache_clear()  # alone, it gives the same
    alone = train(other, spring(seed=3), tmp_path / "alone")
    jax.tree.map(np.testing.assert_array_equal, alone.params, again.params)
    assert [(done, total) for done, total, _ in seen] == [(2, 10), (4, 10), (6, 10), (8, 10), (10, 10)]
    rows = read_metrics(tmp_path / "one" / "metrics.jsonl")
    assert [(row["step"], row["stage"], row["horizon"]) for row in rows] == [
        (2, 0, 1), (4, 0, 1), (6, 0, 1), (8, 1, 3), (10, 1, 3),
    ]  # fmt: skip
    assert [{k: v for k, v in row.items() if k != "step"} for row in rows] == [row for _, _, row in seen]
    assert model.about["step"] == 10


@pytest.mark.parametrize("name", ["best", "thesis-ch3"])
def test_the_other_presets_train_too(tmp_path: Path, name: str):
    config = TrainConfig(model=name, horizons=(2,), stage_steps=(40,), chunk=20, batch=16, learning_rate=3e-3)
    model = train(config, spring(), tmp_path)
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert rows[-1]["loss"] < rows[0]["loss"]
    assert load_model(tmp_path / "checkpoints").config == model.config == tiny(name)


def test_what_train_returns_is_what_load_model_finds(tmp_path: Path):
    model = train(SHORT, spring(), tmp_path)
    found = load_model(tmp_path / "checkpoints")
    jax.tree.map(np.testing.assert_array_equal, found.params, model.params)
    assert found.about == model.about
    assert found.about["data"] == {"scenes": 16, "law": "given"}
    assert found.about["train"]["horizons"] == [1, 3]
    assert found.integrator == model.integrator


def test_the_same_seed_gives_the_same_weights_and_another_seed_or_noise_others(tmp_path: Path):
    one, two = (train(SHORTEST, spring(), tmp_path / name).params for name in "ab")
    jax.tree.map(np.testing.assert_array_equal, one, two)
    for change in ({"seed": 1}, {"noise": 0.5}, {"average": 0.0}):
        other = train(replace(SHORTEST, **change), spring(), tmp_path / str(change)).params
        assert not np.array_equal(one["readout"]["layer0"]["kernel"], other["readout"]["layer0"]["kernel"])


def test_the_weights_are_the_running_mean_of_those_that_learn(tmp_path: Path):
    """By hand from the weights after every step: the decay is (1 + n) / (10 + n) until it reaches the one given."""
    config = replace(SHORTEST, stage_steps=(6,), chunk=1, average=0.3)
    raw, plain = [], prepare(replace(config, average=0.0), spring())
    state = plain.start()
    for _ in range(7):
        raw.append(state["params"]["readout"]["layer0"]["kernel"])
        state, _, _ = plain.run_chunk(state, plain.data, config.steps, horizon=1)
    mean = np.asarray(raw[0], np.float64)
    for n, now in enumerate(raw[1:]):
        keep = min(0.3, (1 + n) / (10 + n))
        mean = keep * mean + (1 - keep) * now
    model = train(config, spring(), tmp_path)
    np.testing.assert_allclose(model.params["readout"]["layer0"]["kernel"], mean, rtol=1e-5, atol=1e-7)
    checkpoints = Checkpoints(tmp_path / "checkpoints", read_only=True)
    saved = checkpoints.newest()[2]
    np.testing.assert_allclose(saved["raw"]["readout"]["layer0"]["kernel"], raw[-1], rtol=1e-5, atol=1e-7)
    jax.tree.map(np.testing.assert_array_equal, load_model(tmp_path / "checkpoints").params, saved["params"])


def test_a_loss_that_is_not_finite_stops_and_leaves_the_last_checkpoint(tmp_path: Path):
    config = TrainConfig(
        model="thesis-ch5",
        horizons=(1,),
        stage_steps=(8,),
        chunk=1,
        batch=4,
        learning_rate=1e30,
        checkpoint_seconds=1e-9,
    )
    with pytest.raises(TrainError, match=r"the loss is (nan|inf) .*smaller learning_rate than 1e\+30") as error:
        train(config, spring(), tmp_path)
    assert str(tmp_path) in str(error.value)
    latest = Checkpoints(tmp_path / "checkpoints").latest()
    assert f"the checkpoint of step {latest} stays" in str(error.value)
    assert steps_of(tmp_path) == list(range(1, latest + 1))
    assert load_model(tmp_path / "checkpoints").about["step"] == latest


@pytest.mark.parametrize(
    ("change", "named"),
    [({"batch": 8}, "train differ"), ({"seed": 3}, "train differ"), ({"model": "best"}, "preset, train, model")],
)
def test_a_folder_of_other_settings_is_refused_and_kept(tmp_path: Path, change: dict, named: str):
    first = train(SHORT, spring(), tmp_path)
    with pytest.raises(CheckpointError, match=named) as error:
        train(replace(SHORT, **change), spring(), tmp_path)
    assert str(tmp_path) in str(error.value)
    found = load_model(tmp_path / "checkpoints")
    jax.tree.map(np.testing.assert_array_equal, found.params, first.params)
    assert steps_of(tmp_path) == [2, 4, 6, 8, 10]


def test_a_folder_of_other_data_is_refused(tmp_path: Path):
    train(SHORT, spring(), tmp_path)
    with pytest.raises(CheckpointError, match="data, range, scales differ"):
        train(SHORT, spring(12), tmp_path)


def test_trajectories_shorter_than_the_longest_horizon_are_refused_before_anything_is_written(tmp_path: Path):
    with pytest.raises(TrajectoryError, match=r"have 3 rows.*needs at least 4"):
        train(SHORT, spring(rows=3), tmp_path / "run")
    with pytest.raises(TrajectoryError, match=r"have 3 rows.*needs at least 4"):
        train(SHORT, spring(), tmp_path / "run", validation=spring(rows=3))
    assert not (tmp_path / "run").exists()


def test_bad_settings_are_named():
    for field, value in [
        ("model", "gat"), ("horizons", (1, 2, 3)), ("stage_steps", (5, 4)), ("stage_steps", (0, 4)), ("batch", 0),
        ("chunk", 0), ("learning_rate", 0.0), ("learning_rate", float("nan")), ("clip_norm", -1.0), ("noise", -0.1),
        ("average", 1.0), ("average", -0.1), ("checkpoint_seconds", 0.0),
    ]:  # fmt: skip
        with pytest.raises(SpecError):
            replace(SHORT, **{field: value})
    with pytest.raises(SpecError, match="horizons"):
        replace(SHORT, horizons=(0, 3))


def test_scaling_a_curriculum_keeps_whole_chunks():
    config = TrainConfig(horizons=(1, 5), stage_steps=(6000, 2000), chunk=100)
    assert config.scaled(1.0) == config
    assert config.scaled(0.4).stage_steps == (2400, 800)
    assert config.scaled(0.01).stage_steps == (100, 100)
    assert config.scaled(0.4).steps == 3200


# --- speed ---


def test_the_bench_counts_windows_and_the_share_of_time_in_the_compiled_step():
    rate = bench_loop(SHORTEST, spring())
    assert rate.case == "thesis-ch5"
    assert rate.windows_per_second > 0
    assert 0 < rate.compiled_share < 1


def test_what_keras_learns_from_is_every_window_and_the_row_after_it():
    data = spring(3, rows=7)
    history, after = windows_of(data)
    assert history.shape == (6, 5, 3, 4)
    states = np.concatenate([data.position, data.velocity], axis=-1)
    np.testing.assert_array_equal(history[4], states[1, 1:6])
    np.testing.assert_array_equal(after[4], states[1, 6])
