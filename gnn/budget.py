"""A training that fits a wall time: how fast every stage runs here is measured, and the curriculum scaled to fit.

Stages keep the proportions of the given curriculum in gradient steps, and with them their shares of the time.
"""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax

from envs.plain import completed, plain
from envs.trajectories import Trajectories
from gnn.checkpoint import CheckpointError, Model
from gnn.config import TrainConfig
from gnn.train import Prepared, Progress, prepare, train_prepared
from swarm_mjcf.errors import SpecError
from swarm_mjcf.whole import WholeFile

CHUNKS = 3
"""Chunks of each stage that are measured at most; their median counts."""
MEASURING = 0.02
"""Share of the wall time that measuring one stage may take, beyond two chunks."""
SAVING = 0.02
"""Share of the wall time that is left for checkpoints and for writing metrics."""


@dataclass(frozen=True)
class Pace:
    """How fast a training runs on this machine."""

    compile_seconds: float
    """Until the first chunk of every stage and the validation can run [s]."""
    chunk_seconds: tuple[float, ...]
    """One chunk of each stage with its validation [s]."""


def train_for(
    minutes: float,
    config: TrainConfig,
    trajectories: Trajectories,
    folder: str | Path,
    *,
    validation: Trajectories | None = None,
    progress: Progress | None = None,
    initial: Model | None = None,
    freeze: Sequence[str] = (),
) -> Model:
    """`train` for `minutes` of wall time, measuring included, or the rest of such a training that was interrupted.

    The plan lies in the folder (plan.json), so that the run goes on with the same number of steps. What was compiled
    for measuring is used. Raises CheckpointError where the plan is of other settings, and what `train` raises.
    """
    begun = time.monotonic()
    prepared = prepare(config, trajectories, validation=validation, initial=initial, freeze=freeze)
    path = Path(folder) / "plan.json"
    asked = {"minutes": minutes, "given": plain(config) | {"checkpoint_seconds": None}}
    if path.exists():
        stage_steps = _read(path, asked)
    else:
        pace = measured(prepared, minutes)
        stage_steps = fitted(config, pace.chunk_seconds, 60 * minutes - (time.monotonic() - begun)).stage_steps
        _write(path, asked | {"stage_steps": list(stage_steps), "pace": plain(pace)})
    return train_prepared(replace(prepared, config=replace(config, stage_steps=stage_steps)), folder, progress=progress)


def measured(prepared: Prepared, minutes: float) -> Pace:
    """Runs a few chunks of every stage and throws them away. Raises SpecError for minutes that are not above 0."""
    if not 0 < minutes < math.inf:
        raise SpecError("minutes", minutes, "a finite number above 0")
    config = prepared.config

    def chunk(state: dict, horizon: int) -> float:
        begun = time.monotonic()
        new, _, _ = prepared.run_chunk(state, prepared.data, config.steps, horizon=horizon)
        jax.block_until_ready((new, prepared.measure(new["params"])))
        return time.monotonic() - begun

    begun = time.monotonic()
    state = jax.block_until_ready(prepared.start())
    compile_seconds, seconds = time.monotonic() - begun, {}
    for horizon in dict.fromkeys(config.horizons):
        first, runs = chunk(state, horizon), [chunk(state, horizon)]
        while len(runs) < CHUNKS and sum(runs) + runs[-1] < MEASURING * 60 * minutes:
            runs.append(chunk(state, horizon))
        seconds[horizon] = sorted(runs)[len(runs) // 2]
        compile_seconds += max(0.0, first - seconds[horizon])
    return Pace(compile_seconds, tuple(seconds[horizon] for horizon in config.horizons))


def fitted(config: TrainConfig, chunk_seconds: Sequence[float], seconds: float) -> TrainConfig:
    """The curriculum scaled to take `seconds`: whole chunks, rounded down, at least one in each stage."""
    chunks = [steps / config.chunk for steps in config.stage_steps]
    whole = sum(count * each for count, each in zip(chunks, chunk_seconds, strict=True))
    factor = max(0.0, (1 - SAVING) * seconds) / whole
    return replace(config, stage_steps=tuple(max(1, int(count * factor)) * config.chunk for count in chunks))


def _read(path: Path, asked: dict) -> tuple[int, ...]:
    """The steps of every stage. Raises CheckpointError for a plan that is damaged or of something else."""
    try:
        plan = json.loads(path.read_text())
        had, stage_steps = {key: plan[key] for key in asked}, tuple(int(steps) for steps in plan["stage_steps"])
        had["given"] = completed(TrainConfig, had["given"])
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path}: no plan of a training ({error}); take another run name") from error
    if had != asked:
        raise CheckpointError(f"{path}: the plan of a training with other settings or minutes; take another run name")
    return stage_steps


def _write(path: Path, plan: dict) -> None:
    with WholeFile(path) as part:
        part.write_text(json.dumps(plan, indent=1) + "\n")
