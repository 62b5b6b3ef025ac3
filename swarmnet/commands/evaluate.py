"""`swarmnet evaluate`."""

import json
from dataclasses import replace

from envs.config import SimulateConfig
from gnn.checkpoint import load_model
from swarmnet.config import Evaluate
from swarmnet.judge import Judgement, judge, tables, training_world
from swarmnet.progress import progress
from swarmnet.report import write_report
from swarmnet.results import Results, Row, write_results, write_whole
from swarmnet.videos import make_videos

VIDEOS = 3
"""Scenes to make videos of."""


def run(config: Evaluate) -> int:
    """Judges and prints; records everything in the run folder."""
    model = load_model(config.run / "checkpoints")
    world = training_world(model) if config.preset is None else SimulateConfig(preset=config.preset)
    world = replace(world, scenes=config.scenes, steps=config.steps, seed=config.seed, engine=config.engine)
    name = f"swarmnet {model.about['preset']}"
    judgement = judge(model, world, config.run, name=name)
    write_whole(config.run / "evaluation.json", json.dumps(judgement.plain(), indent=1))
    print(tables(judgement))
    if config.json:
        write_results(config.json, as_results(judgement))
    with progress("videos") as update:
        make_videos(config.run, VIDEOS, progress=update)
    print(f"report: {write_report(config.run)}")
    return 0


def as_results(judgement: Judgement) -> Results:
    """The judgement in the common format."""
    rows = []
    for name, error in judgement.prediction.items():
        for kind in ("published_mean", "published_median", "agents_mean", "agents_median"):
            for horizon, value in zip(error.horizons, getattr(error, kind), strict=True):
                rows.append(Row(name, f"{kind} {horizon} steps", value, unit="normalized MSE"))
    for name, report in judgement.collisions.items():
        for figure, estimate in report.items():
            rows.append(Row(name, figure, estimate.value, unit=estimate.unit))
            for end in ("low", "high"):
                if (bound := getattr(estimate, end)) is not None:
                    rows.append(Row(name, f"{figure} {end}", bound, unit=estimate.unit))
    return Results(name="evaluate", rows=rows, dt=judgement.dt, seeds=[judgement.seed])
