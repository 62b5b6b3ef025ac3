"""Training for a wall time: the arithmetic, what is measured, and that an interrupted run keeps its plan."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import assert_same
from learning import quick_training, spring

import gnn.budget
from gnn.budget import Pace, fitted, measured, train_for
from gnn.checkpoint import CheckpointError
from gnn.config import TrainConfig
from gnn.train import prepare, train
from gnn.windows import Dataset
from swarm_mjcf.errors import SpecError

CONFIG = TrainConfig(
    model="thesis-ch5", horizons=(1, 3), stage_steps=(40, 20), chunk=2, batch=4, average=0.99, checkpoint_seconds=1e-9
)
"""20 and 10 chunks, with a running mean of the weights."""


class Stopped(Exception):
    pass


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_training():
        yield


def test_the_curriculum_is_scaled_to_the_time():
    """20 chunks of 0.5 s and 10 of 1 s take 20 s; of 41 s 2% are left for saving, and 40.18 s hold twice as many."""
    assert fitted(CONFIG, (0.5, 1.0), 41.0).stage_steps == (80, 40)
    assert fitted(CONFIG, (0.5, 1.0), 20.0).stage_steps == (38, 18)  # 19.6 and 9.8 chunks
    assert fitted(CONFIG, (0.5, 1.0), 0.1).stage_steps == (2, 2)
    assert fitted(CONFIG, (0.5, 1.0), -5.0).stage_steps == (2, 2)
    assert replace(fitted(CONFIG, (0.5, 1.0), 41.0), stage_steps=CONFIG.stage_steps) == CONFIG


class Clock:
    """Time passes only in what is run."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


def test_compiling_is_told_from_running(monkeypatch):
    """A machine that compiles for 7 s at each horizon, and runs a chunk in 1 s per predicted step and 0.5 s besides."""
    clock, compiled = Clock(), set()

    def run_chunk(state: dict, data: Dataset, steps: int, *, horizon: int):
        clock.now += horizon + (0 if horizon in compiled else 7)
        compiled.add(horizon)
        return state, 0.0, 0.0

    def measure(params: dict) -> float:
        clock.now += 0.5
        return 0.0

    def start() -> dict:
        clock.now += 2
        return {"params": {}}

    monkeypatch.setattr(gnn.budget, "time", clock)
    prepared = replace(prepare(CONFIG, spring()), start=start, run_chunk=run_chunk, measure=measure)
    assert measured(prepared, 10.0) == Pace(2.0 + 7.0 + 7.0, (1.5, 3.5))
    with pytest.raises(SpecError, match="minutes"):
        measured(prepared, 0.0)


def test_an_interrupted_run_keeps_its_plan(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(gnn.budget, "measured", lambda prepared, minutes: Pace(0.0, (1.0, 5.0)))
    monkeypatch.setattr(gnn.budget, "time", Clock())
    minutes = 22.5 / 60  # 98% of 22.5 s are 0.315 of the curriculum's 70 s: 6.3 and 3.15 chunks
    expected = replace(CONFIG, stage_steps=(12, 6))

    def stop(done: int, total: int, row: dict) -> None:
        assert total == expected.steps
        if done == 8:
            raise Stopped

    with pytest.raises(Stopped):
        train_for(minutes, CONFIG, spring(), tmp_path / "run", progress=stop)
    plan = json.loads((tmp_path / "run" / "plan.json").read_text())
    assert plan["stage_steps"] == [12, 6]
    assert plan["pace"] == {"compile_seconds": 0.0, "chunk_seconds": [1.0, 5.0]}
    monkeypatch.setattr(gnn.budget, "measured", None)  # nobody asks again
    del plan["given"]["noise"]  # a setting that did not exist then
    (tmp_path / "run" / "plan.json").write_text(json.dumps(plan))
    model = train_for(minutes, CONFIG, spring(), tmp_path / "run")
    assert model.about["train"]["stage_steps"] == [12, 6]
    assert_same(model.params, train(expected, spring(), tmp_path / "whole").params)
    for other, config in ((1.0, CONFIG), (minutes, replace(CONFIG, seed=1))):
        with pytest.raises(CheckpointError, match="other settings or minutes"):
            train_for(other, config, spring(), tmp_path / "run")
    (tmp_path / "run" / "plan.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"plan\.json: no plan"):
        train_for(minutes, CONFIG, spring(), tmp_path / "run")


def test_the_functions_do_not_depend_on_the_number_of_steps(tmp_path: Path):
    """What measuring compiled is what training runs: another number of steps compiles nothing."""
    prepared = prepare(replace(CONFIG, horizons=(1,), stage_steps=(4,)), spring())
    state = prepared.start()
    prepared.run_chunk(state, prepared.data, 4, horizon=1)
    compiled = prepared.run_chunk.func._cache_size()
    prepared.run_chunk(state, prepared.data, 400, horizon=1)
    assert prepared.run_chunk.func._cache_size() == compiled
