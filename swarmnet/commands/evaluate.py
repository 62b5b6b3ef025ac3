"""`swarmnet evaluate`."""

import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from envs.config import SimulateConfig
from repair.config import ConstraintConfig
from swarm_mjcf.errors import SpecError, SwarmError
from swarmnet.closed_loop import Stage, stage_of_recording
from swarmnet.config import Evaluate
from swarmnet.figures_recorded import show_windows
from swarmnet.judge import Judgement, judge_policy, judge_recorded, tables, training_world
from swarmnet.policies import EXPERT, Source, find_policy, model_source, with_shield, with_sight
from swarmnet.progress import progress
from swarmnet.report import write_report
from swarmnet.results import Results, Row, write_results
from swarmnet.videos import make_video, make_videos

NONE = "none"
"""As a reference: there is none."""


def run(config: Evaluate) -> int:
    """Judges and prints; records everything in the run folder."""
    for field, least in (("scenes", 1), ("steps", 1), ("seed", 0), ("videos", 0)):
        if getattr(config, field) < least:
            raise SpecError(field, getattr(config, field), f"at least {least}")
    if config.policy is None and config.run is None:
        raise SwarmError("nothing to judge: give a run folder with a trained model, or --policy")
    source = find_policy(config.policy) if config.policy is not None else model_source(config.run or Path())
    folder = config.run or source.folder or Path("runs") / f"evaluate-{_slug(source.name)}"
    if config.data is not None:
        _check_alone(config)
        judgement = judge_recorded(source, config.data, folder)
    else:
        source = with_sight(source, nearest=config.nearest, radius=config.radius)
        source = with_shield(source, shield_of(config))
        reference = None if config.reference == NONE else find_policy(config.reference)
        stage, reference = _stage(config, source, reference)
        judgement = judge_policy(source, reference, stage, folder, log=config.log)
        judgement = replace(judgement, asked=_asked(config))
    conclude(judgement, folder, videos=config.videos, json=config.json)
    return 0


def _asked(config: Evaluate) -> dict[str, Any]:
    """What a judgement does not say by itself, where it is not as usual: for the command that makes it again."""
    names = ("num_agents", "num_obstacles", "filter", "filter_margin", "filter_share", "perception_noise")
    usual = {field.name: field.default for field in fields(Evaluate)}
    values = {name: getattr(config, name) for name in (*names, "actuation_noise", "log")}
    return {name: value for name, value in values.items() if value != usual[name]}


def shield_of(config: Evaluate) -> ConstraintConfig | None:
    """The constraint that --filter names. Raises SpecError for its options without it."""
    if config.filter is None:
        default = ConstraintConfig()
        for field, value in (("filter_margin", default.margin), ("filter_share", default.share)):
            if getattr(config, field) != value:
                raise SpecError(field, getattr(config, field), "nothing without --filter")
        return None
    return ConstraintConfig(name=config.filter, margin=config.filter_margin, share=config.filter_share)


def conclude(judgement: Judgement, folder: Path, *, videos: int, json: Path | None = None) -> None:
    """Records a judgement in a run folder, prints it, makes videos and writes the report."""
    judgement.write(folder)
    print(tables(judgement))
    if json:
        write_results(json, as_results(judgement))
    if judgement.data:
        show_windows(folder, videos)
    elif videos:
        _videos(folder, judgement, videos)
    if judgement.contact_log:
        print(f"contact log: {folder / judgement.contact_log}")
    print(f"report: {write_report(folder)}")


def _check_alone(config: Evaluate) -> None:
    """Raises SpecError for an option that says something of scenes, where those of a file are predicted."""
    for field in fields(config):
        if field.name not in ("run", "policy", "data", "videos", "json"):
            value = getattr(config, field.name)
            if value != field.default:
                raise SpecError(field.name, value, "nothing beside --data: recorded scenes are predicted as they are")


def _stage(config: Evaluate, source: Source, reference: Source | None) -> tuple[Stage, Source | None]:
    """The scenes for both. A recording is judged alone where its world is not known and no reference was asked for."""
    both = [one for one in (source, reference) if one is not None]
    recording = next((one.recording for one in both if one.recording is not None), None)
    if recording is not None:
        for field in ("num_agents", "num_obstacles", "perception_noise", "actuation_noise"):
            if getattr(config, field) is not None:
                raise SpecError(
                    field, getattr(config, field), "nothing beside recorded trajectories: they have their own"
                )
        options = {"preset": config.preset, "engine": config.engine, "seed": config.seed}
        if any(one.make is not None or one.model is not None for one in both):
            try:
                return stage_of_recording(recording, **options), reference
            except SwarmError as error:
                if source.recording is None or config.reference != EXPERT or config.preset is not None:
                    raise
                print(f"judged without a reference: {error}")
                reference = None
        # Nothing is simulated; a world is still what a stage consists of.
        stage = Stage.of(SimulateConfig(scenes=len(recording), steps=max(1, recording.position.shape[1] - 1)))
        return replace(stage, simulate=None), reference
    world = SimulateConfig(preset=config.preset) if config.preset else SimulateConfig()
    model = next((one.model for one in both if one.model is not None), None)
    if model is not None and config.preset is None:
        world = training_world(model)
    own = ("num_agents", "num_obstacles", "perception_noise", "actuation_noise")
    asked = {name: getattr(config, name) for name in own if getattr(config, name) is not None}
    world = replace(world, scenes=config.scenes, steps=config.steps, seed=config.seed, engine=config.engine, **asked)
    return Stage.of(world), reference


def _slug(name: str) -> str:
    return re.sub(r"[^\w.-]+", "-", name).strip("-")


def _videos(folder: Path, judgement: Judgement, count: int) -> None:
    """Of the worst scenes: reference and policy side by side, or the policy alone."""
    with progress("videos") as update:
        if judgement.reference is not None:
            make_videos(folder, count, progress=update)
            return
        for number, worst in enumerate(judgement.worst[:count]):
            out = folder / "videos" / f"worst-{number + 1}-scene-{worst.scene:04d}.mp4"
            make_video([folder / "rollouts" / "learned.h5"], out, scenes=[worst.scene], titles=[judgement.policy])
            update(number + 1, count)


def as_results(judgement: Judgement) -> Results:
    """The judgement in the common format."""
    rows = []
    for name, error in judgement.prediction.items():
        for kind in ("published_mean", "published_median", "agents_mean", "agents_median"):
            for horizon, value in zip(error.horizons, getattr(error, kind), strict=True):
                rows.append(Row(name, f"{kind} {horizon} steps", value, unit="normalized MSE"))
        for kind in ("ade", "fde"):
            for horizon, value in zip(error.horizons, getattr(error, kind), strict=True):
                rows.append(Row(name, f"{kind} {horizon} steps", value, unit="m"))
    for reports in (judgement.collisions, judgement.collective):
        for name, report in reports.items():
            for figure, estimate in report.items():
                rows.append(Row(name, figure, estimate.value, unit=estimate.unit))
                for end in ("low", "high"):
                    if (bound := getattr(estimate, end)) is not None:
                        rows.append(Row(name, f"{figure} {end}", bound, unit=estimate.unit))
    return Results(
        name="evaluate", rows=rows, dt=judgement.dt, seeds=[] if judgement.seed is None else [judgement.seed]
    )
