"""Training that was stopped goes on to the bit: by hand, by damage, and killed at random moments as a process."""

import json
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import assert_same
from learning import environment, quick_training, spring

from gnn.checkpoint import Checkpoints, load_model
from gnn.config import TrainConfig
from gnn.metrics import read_metrics
from gnn.train import train

CONFIG = TrainConfig(model="thesis-ch5", horizons=(1, 2), stage_steps=(8, 8), chunk=2, batch=4, checkpoint_seconds=1e-9)
"""Eight chunks, a checkpoint after each."""


class Stopped(Exception):
    pass


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_training():
        yield


def state_of(folder: Path) -> tuple[int, dict]:
    """The full state of the newest checkpoint: weights, optimizer, step."""
    checkpoints = Checkpoints(folder / "checkpoints", read_only=True)
    step, _, state = checkpoints.newest()
    checkpoints.close()
    return step, state


def losses(folder: Path) -> list[tuple[int, float, float]]:
    rows = read_metrics(folder / "metrics.jsonl")
    return [(row["step"], row["loss"], row["validation_error"]) for row in rows]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The run that nobody interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    train(CONFIG, spring(), folder)
    return folder


def stop_at(step: int):
    def progress(done: int, total: int, row: dict) -> None:
        if done == step:
            raise Stopped

    return progress


def same_run(one: Path, two: Path) -> None:
    (step, first), (other, second) = state_of(one), state_of(two)
    assert step == other == CONFIG.steps
    assert_same(first, second)
    assert losses(one) == losses(two)


def test_stopped_and_resumed_is_as_if_nothing_had_happened(tmp_path: Path, whole: Path):
    for step in (2, 8, 14):  # within a stage, between two, and again within one
        with pytest.raises(Stopped):
            train(CONFIG, spring(), tmp_path, progress=stop_at(step))
        assert state_of(tmp_path)[0] == step
    model = train(CONFIG, spring(), tmp_path)
    same_run(tmp_path, whole)
    jax.tree.map(np.testing.assert_array_equal, model.params, load_model(whole / "checkpoints").params)


def test_what_no_checkpoint_holds_is_done_again(tmp_path: Path, whole: Path):
    """Checkpoints at the ends of stages alone: a stop at step 12 goes back to 8, and its rows come once."""
    rare = replace(CONFIG, checkpoint_seconds=1e9)
    with pytest.raises(Stopped):
        train(rare, spring(), tmp_path, progress=stop_at(12))
    assert state_of(tmp_path)[0] == 8
    seen = []
    train(rare, spring(), tmp_path, progress=lambda done, total, row: seen.append(done))
    assert seen == [10, 12, 14, 16]
    same_run(tmp_path, whole)


def test_a_finished_run_is_not_touched_again(tmp_path: Path):
    first = train(CONFIG, spring(), tmp_path)
    seen = []
    again = train(CONFIG, spring(), tmp_path, progress=lambda *done: seen.append(done))
    assert not seen
    assert_same(again.params, first.params)
    assert again.about == first.about
    assert [step for step, _, _ in losses(tmp_path)] == list(range(2, 17, 2))


def test_a_damaged_newest_checkpoint_costs_its_steps_and_no_more(tmp_path: Path, whole: Path, caplog):
    with pytest.raises(Stopped):
        train(CONFIG, spring(), tmp_path, progress=stop_at(10))
    for file in (tmp_path / "checkpoints" / "10").rglob("*"):
        if file.is_file():
            file.write_bytes(b"")
    seen = []
    train(CONFIG, spring(), tmp_path, progress=lambda done, total, row: seen.append(done))
    assert seen == [10, 12, 14, 16]
    assert "step 8 is taken instead" in caplog.text
    same_run(tmp_path, whole)


# --- killed ---

WORKER = """
import os, signal, sys, threading, time
from gnn.checkpoint import Checkpoints
from gnn.config import PRESETS, TrainConfig
from gnn.train import train
from learning import spring, tiny

PRESETS["thesis-ch5"] = tiny("thesis-ch5")
steps = {"horizons": (1, 2), "stage_steps": (14, 14), "chunk": 2}
config = TrainConfig(model="thesis-ch5", batch=4, checkpoint_seconds=1e-9, **steps)
saves, share = int(sys.argv[2]), float(sys.argv[3])
save, took = Checkpoints.save, 0.0

def dying(self, *args):
    global saves, took
    saves -= 1
    if saves == 0:  # dies this share of a save's duration into it
        threading.Timer(share * took, os.kill, (os.getpid(), signal.SIGKILL)).start()
    began = time.monotonic()
    save(self, *args)
    took = time.monotonic() - began

Checkpoints.save = dying
train(config, spring(), sys.argv[1])
"""


def worker(folder: Path, cache: Path, *, die_in_save: int = 0, share: float = 0.0) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", WORKER, str(folder), str(die_in_save), str(share)],
        env=environment(str(cache)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def newest(folder: Path) -> int:
    steps = [int(path.name) for path in (folder / "checkpoints").glob("*") if path.name.isdigit()]
    return max(steps, default=0)


def test_a_process_killed_at_random_moments_ends_with_the_same_weights(tmp_path: Path):
    """SIGKILL, again and again, in the middle of saves and between them; each time the same command goes on."""
    cache, uninterrupted, killed = (tmp_path / name for name in ("cache", "uninterrupted", "killed"))
    output, _ = (process := worker(uninterrupted, cache)).communicate()
    assert process.returncode == 0, output
    moments = random.Random(0)
    deaths = 0
    for attempt in range(3):
        if attempt < 2:  # by itself, somewhere within its second or third save
            process = worker(killed, cache, die_in_save=moments.randint(2, 3), share=moments.random())
        else:  # by us, a moment after it got on
            process, before = worker(killed, cache), newest(killed)
            while newest(killed) == before and process.poll() is None:
                time.sleep(0.005)
            time.sleep(moments.uniform(0, 0.1))
            process.send_signal(signal.SIGKILL)
        output, _ = process.communicate()
        assert process.returncode in (0, -signal.SIGKILL), output
        deaths += process.returncode != 0
    assert deaths >= 2
    assert newest(killed) > 0
    output, _ = (process := worker(killed, cache)).communicate()
    assert process.returncode == 0, output
    (step, first), (other, second) = state_of(uninterrupted), state_of(killed)
    assert step == other == 28
    assert_same(first, second)
    assert losses(uninterrupted) == losses(killed)
    lines = (killed / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == list(range(2, 29, 2))
    assert sorted(path.name for path in (killed / "checkpoints").iterdir()) == ["26", "28"]
