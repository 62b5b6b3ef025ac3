"""`swarmnet learn`: anybody's trajectories from the imported file to the report."""

from dataclasses import replace

import numpy as np

from envs.importers.importing import holdout_path
from envs.recut import recut
from envs.storage import load
from envs.trajectories import AGENT, Trajectories
from gnn.config import TrainConfig, model_preset
from gnn.train import train
from swarm_mjcf.errors import SwarmError
from swarmnet.commands.evaluate import conclude
from swarmnet.commands.train import note
from swarmnet.config import Learn
from swarmnet.judge import judge_recorded
from swarmnet.policies import model_source
from swarmnet.progress import progress

AGENTS = 256
"""Agents that one gradient step sees, about: a batch has fewer windows where they are crowded."""
STRIDE = 2
"""Rows between the beginnings of the short scenes."""
VALIDATION = 0.05
"""Share of the short scenes kept out of training, for the validation error in the metrics."""


def run(config: Learn) -> int:
    """Trains, or goes on; judges; writes the report."""
    holdout = config.holdout or holdout_path(config.data)
    if not holdout.exists():
        raise SwarmError(
            f"{holdout}: does not exist; import with --holdout 0.2, or name a file to judge on (--holdout)"
        )
    recorded = limited(load(config.data))
    recorded = replace(recorded, provenance=recorded.provenance | {"learn": {"data": str(config.data)}})
    training = TrainConfig(
        model=config.model, seed=config.seed, horizons=config.horizons, stage_steps=config.stage_steps
    ).scaled(config.scale)
    window, rows = model_preset(config.model).window, recorded.position.shape[1]
    training = fitting(training, rows - window)
    if training.horizons != config.horizons:
        print(f"scenes of {rows} rows: predictions are learned up to {max(training.horizons)} steps")
    needed = window + max(training.horizons)
    learned, checked = apart(recut(recorded, needed, stride=STRIDE), -(-needed // STRIDE))
    present = (learned.mask & (learned.kind == AGENT)[:, None]).sum(axis=2)
    training = replace(training, batch=int(np.clip(round(AGENTS / present[present > 0].mean()), 4, 128)))
    with progress(f"train {config.model}") as update:
        train(
            training,
            learned,
            config.run,
            validation=checked,
            progress=lambda done, total, row: update(done, total, note(row)),
        )
    judgement = judge_recorded(model_source(config.run), holdout, config.run)
    conclude(judgement, config.run, videos=config.videos, json=config.json)
    return 0


def fitting(training: TrainConfig, rows: int) -> TrainConfig:
    """Without the stages that predict more than `rows` steps; with all of them where none would be left."""
    stages = [stage for stage in zip(training.horizons, training.stage_steps, strict=True) if stage[0] <= rows]
    if not stages:
        return training
    horizons, steps = zip(*stages, strict=True)
    return replace(training, horizons=horizons, stage_steps=steps)


def apart(scenes: Trajectories, gap: int) -> tuple[Trajectories, Trajectories]:
    """What to train on and the last scenes, to validate with; the `gap` scenes between, which share rows with both, are
    left out. Too few scenes for that are used for both."""
    kept = max(1, round(VALIDATION * len(scenes)))
    if kept + gap >= len(scenes):
        return scenes, scenes
    return scenes.take(slice(0, len(scenes) - kept - gap)), scenes.take(slice(len(scenes) - kept, None))


def limited(recorded: Trajectories) -> Trajectories:
    """With limits of speed and acceleration where none is declared: half more than 99.9% of what was recorded, so that
    a prediction cannot run away."""
    agents = recorded.mask & (recorded.kind == AGENT)[:, None]
    follow = agents[:, 1:] & agents[:, :-1]
    turn = np.linalg.norm(np.diff(recorded.velocity, axis=1)[follow], axis=1) / recorded.dt
    limits = {}
    for name, values in (("max_speed", np.linalg.norm(recorded.velocity[agents], axis=1)), ("max_acceleration", turn)):
        if getattr(recorded, name) == float("inf") and values.any():
            limits[name] = float(f"{1.5 * np.quantile(values, 0.999):.3g}")
    return replace(recorded, **limits)
