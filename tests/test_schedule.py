"""Schedules of sizes: the grammar, stages that tune, what is shared and gone on with, and the command."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_same
from hypothesis import given
from hypothesis import strategies as st
from learning import blank, quick_training

from envs.trajectories import AGENT, GOAL, Trajectories
from gnn.config import TrainConfig
from gnn.schedule import beginnings, parse_schedule, run_schedule, schedule_name
from swarm_mjcf.errors import SpecError
from swarmnet.commands import schedule as command
from swarmnet.config import Schedule

CONFIG = TrainConfig(
    model="thesis-ch5", horizons=(1,), stage_steps=(4,), chunk=2, batch=4, learning_rate=1e-2, checkpoint_seconds=1e-9
)


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_training():
        yield


def pulled(size: int) -> Trajectories:
    """Agents on damped springs to the goal."""
    rng = np.random.default_rng(size)
    goal, x, v = (rng.uniform(-2, 2, (8, number, 2)) for number in (1, size, size))
    positions, velocities = [], []
    for _ in range(6):
        positions.append(np.concatenate([goal, x], axis=1))
        velocities.append(np.concatenate([0 * goal, v], axis=1))
        v = v + 0.1 * (goal - x - v)
        x = x + 0.1 * v
    return replace(
        blank(np.stack(positions, 1), np.stack(velocities, 1), [GOAL] + [AGENT] * size), provenance={"size": size}
    )


# --- grammar ---


@pytest.mark.parametrize(
    ("text", "stages"),
    [
        ("5", ((5,),)),
        ("5->10", ((5,), (10,))),
        ("5->5-10", ((5,), (5, 10))),
        (" 10 -> 20 ", ((10,), (20,))),
        ("3 -> 3 - 5 -> 20", ((3,), (3, 5), (20,))),
    ],
)
def test_stages_and_sizes(text: str, stages):
    assert parse_schedule(text) == stages
    assert schedule_name(stages) == text.replace(" ", "")
    assert len(beginnings(stages)) == len(stages)
    assert beginnings(stages)[-1] == stages


@given(st.lists(st.lists(st.integers(1, 99), min_size=1, max_size=4, unique=True), min_size=1, max_size=4))
def test_what_is_written_is_read(sizes):
    stages = tuple(tuple(stage) for stage in sizes)
    assert parse_schedule(schedule_name(stages)) == stages


@pytest.mark.parametrize("text", ["", "5->", "->5", "5-", "5,10", "5>10", "a", "5--10", "0", "5-5", "5 10", "1.5"])
def test_anything_else_is_refused(text: str):
    with pytest.raises(SpecError, match="schedule"):
        parse_schedule(text)


# --- stages ---


def test_later_stages_tune_on_the_mix_with_the_edge_functions_locked(tmp_path: Path):
    seen = []
    one, two = run_schedule(
        parse_schedule("2->2-3"), pulled, CONFIG, tmp_path, validation=0.25,
        progress=lambda name, done, total, row: seen.append((name, done, total)),
    )  # fmt: skip
    assert seen == [("2", 2, 4), ("2", 4, 4), ("2->2-3", 2, 4), ("2->2-3", 4, 4)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["2", "2_2-3"]
    assert one.about["freeze"] is None
    assert two.about["freeze"] == ["edge/*"]
    assert two.about["data"] == {"scenes": 12, "mixed": [{"scenes": 6, "size": 2}, {"scenes": 6, "size": 3}]}
    assert_same(two.params["edge"], one.params["edge"])
    assert_same(two.scales, one.scales)
    assert not np.array_equal(two.params["readout"]["layer0"]["kernel"], one.params["readout"]["layer0"]["kernel"])

    # Another schedule with the same beginning trains only what is new, and one that is done trains nothing.
    seen.clear()
    again, tuned = run_schedule(
        parse_schedule("2->3"), pulled, CONFIG, tmp_path, validation=0.25, freeze=(),
        progress=lambda name, done, total, row: seen.append(name),
    )  # fmt: skip
    assert set(seen) == {"2->3"}
    assert_same(again.params, one.params)
    assert tuned.about["range"]["agents"] == [3] * 4
    assert tuned.seen is not None
    assert tuned.seen["agents"] == [2, 3, 3, 3]
    assert not np.array_equal(
        tuned.params["edge"]["goal"]["layer0"]["kernel"], one.params["edge"]["goal"]["layer0"]["kernel"]
    )
    seen.clear()
    run_schedule(
        parse_schedule("2->2-3"), pulled, CONFIG, tmp_path, validation=0.25,
        progress=lambda name, done, total, row: seen.append(name),
    )  # fmt: skip
    assert not seen


# --- command ---


def test_the_command_simulates_trains_tests_and_prints(tmp_path: Path, capsys):
    config = Schedule(
        schedule="2->3", run=tmp_path / "run", scenes=6, steps_per_scene=42, test_scenes=2, test_sizes=(2, 3),
        validation=0.2, engine="native", json=tmp_path / "schedule.json",
        **{name: getattr(CONFIG, name) for name in ("model", "horizons", "stage_steps", "chunk", "batch")},
    )  # fmt: skip
    assert command.run(config) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["schedule", "steps", "2", "3"]
    assert [line.split()[:2] for line in lines[2:]] == [["2", "5"], ["2", "40"], ["2->3", "5"], ["2->3", "40"]]
    rows = json.loads((tmp_path / "schedule.json").read_text())["rows"]
    assert [(row["row"], row["column"]) for row in rows[:4]] == [
        ("2", "N=2 5 steps"), ("2", "N=2 40 steps"), ("2", "N=3 5 steps"), ("2", "N=3 40 steps"),
    ]  # fmt: skip
    assert all(row["value"] > 0 and row["reference"] is None for row in rows)
    assert sorted(path.name for path in (tmp_path / "run" / "data").iterdir()) == [
        "test-2.h5", "test-3.h5", "train-2.h5", "train-3.h5",
    ]  # fmt: skip


def test_the_thesis_stands_beside_its_schedules():
    found = command.Row("5->5-10", "N=20 40 steps", 0.5, reference=1.74)
    text = command.table([found], (20, 30), 0.3).splitlines()
    assert text[2].split() == ["5->5-10", "40", "0.5", "-"]
    assert text[3].split() == ["thesis,", "table", "4.3", "40", "1.74", "-"]


def test_bad_settings_are_named():
    for change in ({"scenes": 0}, {"test_sizes": ()}, {"test_sizes": (0,)}, {"minutes": 0.0}, {"test_scenes": 0}):
        with pytest.raises(SpecError, match=next(iter(change))):
            Schedule(schedule="5", **change)
    with pytest.raises(SpecError, match="scale"):
        Schedule(schedule="5", minutes=1.0, scale=0.5)
