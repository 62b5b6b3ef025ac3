"""Schedules of swarm sizes: `5->5-10` trains on 5 agents and then tunes on a mix of 5 and 10 (chapter 4, table 4.3)."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from envs.trajectories import Trajectories
from gnn.budget import train_for
from gnn.checkpoint import Model
from gnn.config import TrainConfig
from gnn.padding import mix
from gnn.train import split, train
from swarm_mjcf.errors import SpecError

Stages = tuple[tuple[int, ...], ...]
"""Sizes of the swarms in each stage, in the order of the training."""
EDGES = ("edge/*",)
"""What the thesis locks while it tunes: the edge functions, equation 3.1."""
StageProgress = Callable[[str, int, int, dict], None]
"""Called with (the schedule so far, steps done, steps in all, metrics of the chunk)."""


def parse_schedule(text: str) -> Stages:
    """`5->5-10` as ((5,), (5, 10)): stages joined by `->`, the sizes of a stage by `-`; spaces may stand anywhere.

    Raises SpecError for anything else, for sizes below 1 and for one that a stage has twice.
    """
    stages = []
    for stage in text.split("->"):
        if not re.fullmatch(r"\s*\d+\s*(-\s*\d+\s*)*", stage):
            raise SpecError("schedule", text, "sizes joined by - within a stage and stages by ->, as in 5->5-10")
        sizes = tuple(int(size) for size in stage.split("-"))
        if min(sizes) < 1 or len(set(sizes)) < len(sizes):
            raise SpecError("schedule", text, "sizes of at least 1, each once in a stage")
        stages.append(sizes)
    return tuple(stages)


def schedule_name(stages: Stages) -> str:
    """The text that `parse_schedule` reads, without spaces."""
    return "->".join("-".join(map(str, sizes)) for sizes in stages)


def beginnings(stages: Stages) -> list[Stages]:
    """The schedule up to its first stage, up to its second, and so on: one trained model each."""
    return [stages[:count] for count in range(1, len(stages) + 1)]


def run_schedule(
    stages: Stages,
    data: Callable[[int], Trajectories],
    config: TrainConfig,
    folder: str | Path,
    *,
    minutes: float | None = None,
    freeze: Sequence[str] = EDGES,
    validation: float = 0.05,
    progress: StageProgress | None = None,
) -> list[Model]:
    """The models of all stages: the first trained from scratch on `data(size)`, every later one tuned from the last.

    A stage of several sizes learns from all of them, mixed by ghost padding. Tuning starts Adam afresh, keeps the
    weights that match `freeze`, and the scales. Every stage is a run folder in `folder`, named by the schedule so far
    (`5`, `5_5-10`), so that an interrupted schedule goes on and schedules that begin alike share their beginnings.
    `minutes`: wall time of each stage instead of the steps of `config`. `validation`: share of the scenes of each size
    kept out of training. Raises what `gnn.train.train` raises.
    """
    models: list[Model] = []
    for beginning in beginnings(stages):
        name = schedule_name(beginning)
        parts = [split(data(size), validation) for size in beginning[-1]]
        learning, unseen = (mix(side) for side in zip(*parts, strict=True))
        arguments = {
            "validation": unseen,
            "progress": progress and _named(progress, name),
            "initial": models[-1] if models else None,
            "freeze": freeze if models else (),
        }
        place = Path(folder) / name.replace("->", "_")
        if minutes is None:
            models.append(train(config, learning, place, **arguments))
        else:
            models.append(train_for(minutes, config, learning, place, **arguments))
    return models


def _named(progress: StageProgress, name: str) -> Callable[[int, int, dict], None]:
    return lambda done, total, row: progress(name, done, total, row)
