"""Judging a policy beside a reference: contacts, collective motion, worst scenes, and prediction error for a model; or
a model's prediction alone, on recorded trajectories."""

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from envs.collective import collective_measures, collective_report
from envs.collisions import WorstScene, collision_report, worst_scenes
from envs.config import SimulateConfig, World
from envs.contact_log import ContactLogWriter
from envs.estimates import Estimate
from envs.experts.registry import make_expert
from envs.plain import from_plain, plain
from envs.rollout import make_rollout
from envs.state import make_state
from envs.storage import save
from envs.swarm_env import SwarmEnv, scene_keys
from envs.trajectories import Trajectories, from_recording, versions
from gnn.checkpoint import Model
from gnn.evaluate import PredictionError
from gnn.forecast import forecast
from gnn.graph import graph_of_state
from swarm_mjcf.errors import SwarmError
from swarmnet.closed_loop import Stage, replayed, roll_out
from swarmnet.out_of_range import out_of_range
from swarmnet.policies import EXPERT, Source, find_policy
from swarmnet.recorded import check_nodes, holdout_of, predictions, sample_windows
from swarmnet.results import commit, hardware, write_whole
from swarmnet.selection import difference

WORST = 5
"""Worst scenes that are listed."""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """All that was measured. Keys are row names as printed; the reference comes first."""

    policy: str
    reference: str | None
    given: dict[str, str | None]
    """`policy` and `reference` as they were named."""
    prediction: dict[str, PredictionError]
    """Of a model, beside baselines; empty for anything else."""
    collisions: dict[str, dict[str, Estimate]]
    """Collision report of reference and policy on the same scenes; empty for a model that cannot act."""
    collective: dict[str, dict[str, Estimate]]
    """Collective-motion report of the same."""
    worst: list[WorstScene]
    """The policy's worst scenes."""
    contact_log: str | None
    """File name of the policy's contact log in the run folder."""
    contacts: bool
    """Whether bodies collide, or contacts come from recorded positions."""
    nearest: int | None = None
    """Others that each agent of a decentralised model perceived."""
    radius: float | None = None
    """How far each agent of a decentralised model perceived [m]."""
    by_geometry: bool = False
    """Whether contacts come from positions, because policy or reference is a recording."""
    data: str | None = None
    """File of the recorded trajectories that were predicted, where nothing was steered."""
    asked: dict[str, Any] = field(default_factory=dict)
    """Options of `swarmnet evaluate` beside those above that were not the usual ones."""
    said: tuple[str, ...] = ()
    """Warnings: what is out of the range of a model's training data."""
    dt: float
    preset: str | None
    engine: str
    scenes: int
    steps: int
    seed: int | None
    """Of the scenes; None for recorded ones."""

    def plain(self) -> dict:
        """Plain JSON values, with what is needed to measure again. What is not finite is None."""
        return _finite(
            {
                "policy": self.policy, "reference": self.reference, "given": self.given, "data": self.data,
                "nearest": self.nearest, "radius": self.radius, "asked": self.asked,
                "preset": self.preset, "engine": self.engine, "hardware": hardware(), "versions": versions(),
                "commit": commit(), "said": self.said,
                "prediction": {
                    name: {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(error).items()}
                    for name, error in self.prediction.items()
                },
                "collisions": _plain(self.collisions), "collective": _plain(self.collective),
                "worst": [asdict(scene) for scene in self.worst],
                "contact_log": self.contact_log, "contacts": self.contacts, "by_geometry": self.by_geometry,
                "dt": self.dt, "scenes": self.scenes, "steps": self.steps, "seed": self.seed,
            }
        )  # fmt: skip

    def write(self, folder: Path) -> None:
        """Writes FOLDER/evaluation.json."""
        write_whole(folder / "evaluation.json", json.dumps(self.plain(), indent=1))


def _finite(value: Any) -> Any:
    """The same with None in place of every number that is not finite: JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _plain(reports: dict[str, dict[str, Estimate]]) -> dict:
    return {name: {figure: asdict(found) for figure, found in report.items()} for name, report in reports.items()}


def training_world(model: Model) -> SimulateConfig:
    """The settings of the data a model was trained on; of several worlds, the first of those with the most agents.

    Raises SwarmError if it was trained on something else.
    """
    worlds = [from_plain(SimulateConfig, about["simulate"]) for about in model.trained_on if "simulate" in about]
    if not worlds:
        raise SwarmError(
            "the model was not trained on simulated data: judge its prediction on recorded trajectories that it has "
            "not seen (--data HOLDOUT.h5), or name a world to let it steer in (--preset)"
        )
    return max(worlds, key=lambda world: world.num_agents)


def judge(model: Model, config: SimulateConfig, folder: Path, *, name: str, label: str = "") -> Judgement:
    """Judges a model beside the expert on the scenes of `config`; see `judge_policy`."""
    source = Source(given=str(folder), name=name, model=model, folder=folder)
    return judge_policy(source, find_policy(EXPERT), Stage.of(config), folder, label=label)


def judge_policy(
    source: Source,
    reference: Source | None,
    stage: Stage,
    folder: Path,
    *,
    label: str = "",
    log: Literal["csv", "parquet"] = "csv",
) -> Judgement:
    """Rolls out or replays reference and policy on the same scenes, measures both, and records them in `folder`.

    rollouts/expert.h5 is the reference's recording and rollouts/learned.h5 the policy's; contacts.csv or .parquet is
    the policy's contact log. Where one of both is a recording, contacts of both come from their positions. `label`
    stands before the titles of the progress bars.

    Raises:
      SwarmError: the scenes are those of a model's training data, its dt is not the world's, recordings do not hold the
        same number of scenes, rows and nodes, or a policy cannot be used.
    """
    if reference is None and source.model is not None and not source.acts:
        raise SwarmError(f"{source.given}: predicts changes of state, so there is nothing to judge without a reference")
    for one in (source, reference):
        if one is not None and one.model is not None:
            _check_model(one.model, stage)
    if reference is not None and not reference.acts and reference.recording is None:
        raise SwarmError(f"{reference.given}: predicts changes of state, so it cannot be a reference in closed loop")
    if reference is not None and reference.name == source.name:
        reference = replace(reference, name=f"{reference.name} (reference)")
    done: dict[str, Trajectories] = {}
    by_geometry = any(one is not None and one.recording is not None for one in (source, reference))

    def perform(one: Source, writer: ContactLogWriter | None = None) -> Trajectories:
        if one.recording is not None:
            return replayed(one.recording, log=writer)
        found = roll_out(stage, one, title=f"{label}{one.name} in physics", log=None if by_geometry else writer)
        return replayed(found, log=writer) if by_geometry else found

    log_path = folder / f"contacts.{log}"
    if source.model is None or source.acts:
        with ContactLogWriter(log_path) as writer:  # an error in here leaves the old log
            acted = perform(source, writer)
            if reference is not None:
                done[reference.name] = perform(reference)
            done[source.name] = acted
            _check_same_scenes(done)
    elif reference is not None:
        done[reference.name] = perform(reference)
    _record(folder, done.get(reference.name) if reference else None, done.get(source.name), log_path.name)
    acted = done.get(source.name)
    truth = next(iter(done.values()))
    model = None if source.decentralised else source.model  # what predicts the whole scene at once
    if model is not None and source.acts and stage.starts is None:
        sweep(stage.world, model, folder, engine=stage.engine, steps=stage.steps, seed=stage.seed)
    return Judgement(
        policy=source.name,
        reference=reference.name if reference else None,
        given={"policy": source.given, "reference": reference.given if reference else None},
        prediction=predictions(source, truth, label) if model is not None and reference is not None else {},
        collisions={name: collision_report(found) for name, found in done.items()} if acted else {},
        collective={name: collective_report(collective_measures(found)) for name, found in done.items()}
        if acted
        else {},
        worst=worst_scenes(acted, WORST) if acted else [],
        contact_log=log_path.name if acted else None,
        contacts=by_geometry or stage.world.scene.contacts,
        nearest=source.nearest,
        radius=source.radius,
        by_geometry=by_geometry,
        said=_said(source, truth),
        dt=truth.dt,
        preset=stage.simulate.preset if stage.simulate else None,
        engine=str((acted or truth).provenance.get("engine", "none")),
        scenes=len(truth),
        steps=truth.position.shape[1] - 1,
        seed=stage.seed,
    )


def judge_recorded(source: Source, data: Path, folder: Path, *, label: str = "") -> Judgement:
    """Judges a model's prediction on recorded trajectories and records in `folder` what is drawn of it.

    rollouts/truth.h5 and rollouts/predicted.h5 hold some windows (`swarmnet.recorded.sample_windows`). Raises what
    `swarmnet.recorded.holdout_of` raises.
    """
    trajectories, said = holdout_of(source, data)
    assert source.model is not None
    errors = predictions(source, trajectories, label)
    _record(folder, None, None, "")
    sample_windows(source.model, trajectories, folder)
    return Judgement(
        policy=source.name,
        reference=None,
        given={"policy": source.given, "reference": None},
        prediction=errors,
        collisions={},
        collective={},
        worst=[],
        contact_log=None,
        contacts=False,
        data=str(data),
        said=tuple(said),
        dt=trajectories.dt,
        preset=None,
        engine="none",
        scenes=len(trajectories),
        steps=trajectories.position.shape[1] - 1,
        seed=None,
    )


def _said(source: Source, truth: Trajectories) -> tuple[str, ...]:
    line = out_of_range(source.model.seen, truth) if source.model is not None else None
    return (line,) if line else ()


def _check_same_scenes(done: dict[str, Trajectories]) -> None:
    """Raises SwarmError when policy and reference differ in size, in dt, or in where anybody starts."""
    shapes = {name: found.position.shape[:3] for name, found in done.items()}
    if len(set(shapes.values())) > 1:
        told = ", ".join(f"{name} has {s} scenes of {t} rows and {v} nodes" for name, (s, t, v) in shapes.items())
        raise SwarmError(f"policy and reference cannot be compared: {told}")
    if len(done) == 2 and (different := difference(*done.values())):
        raise SwarmError(f"policy and reference cannot be compared: they have {different}")


def _record(folder: Path, reference: Trajectories | None, acted: Trajectories | None, log: str) -> None:
    """Writes rollouts/, and removes what an earlier judgement left that this one does not write."""
    for name, found in (("expert.h5", reference), ("learned.h5", acted)):
        if found is None:
            (folder / "rollouts" / name).unlink(missing_ok=True)
        else:
            save(folder / "rollouts" / name, found)
    for name in ("sweep_truth.h5", "sweep_predicted.h5", "truth.h5", "predicted.h5"):
        (folder / "rollouts" / name).unlink(missing_ok=True)
    for name in ("contacts.csv", "contacts.parquet"):
        if acted is None or name != log:
            (folder / name).unlink(missing_ok=True)


def _check_model(model: Model, stage: Stage) -> None:
    here, scene = stage.simulate, stage.world.scene
    if here and stage.starts is None and (here.seed, here.preset) in scenes_seen(model):
        raise SwarmError(
            f"seed {stage.seed} is that of scenes that the model learned in; unseen ones need another seed"
        )
    if (scene.dt, scene.substeps) != (model.integrator.dt, model.integrator.substeps):
        raise SwarmError(
            f"the model was trained at dt {model.integrator.dt} s with {model.integrator.substeps} substeps, this "
            f"world has {scene.dt} s with {scene.substeps}"
        )
    state = stage.starts or make_state(
        position=np.zeros((1, scene.num_agents, 2), np.float32),
        velocity=np.zeros((1, scene.num_agents, 2), np.float32),
        goal=np.zeros((1, 2), np.float32),
        obstacle=np.zeros((1, scene.num_obstacles, 2), np.float32),
    )
    nodes, graph = graph_of_state(jax.tree.map(lambda x: x[:1], state), goal=scene.goal)
    check_nodes(model, np.repeat(nodes[:, None], model.config.window, axis=1), graph, "this world")


def scenes_seen(model: Model) -> set[tuple[int, str]]:
    """Seed and preset of the scenes that a model has learned in: of its data, of PPO, of rounds of repair."""
    simulated = [part["simulate"] for part in model.trained_on if part.get("simulate")]
    seeds, about = [], model.about
    while about:
        seeds += [about.get("rl", {}).get("seed"), about.get("repair", {}).get("scene_seed")]
        about = about.get("initial")
    presets = {one["preset"] for one in simulated}
    acted = {(seed, preset) for seed in seeds if seed is not None for preset in presets}
    return acted | {(one["seed"], one["preset"]) for one in simulated}


def sweep(world: World, model: Model, folder: Path, *, engine: str, steps: int, seed: int) -> None:
    """Figure 3.5: one start, the obstacle in four places across the way; truth from physics, prediction beside it.

    Writes rollouts/sweep_truth.h5 and rollouts/sweep_predicted.h5, four scenes each.
    """
    if not world.scene.num_obstacles:
        return
    env = SwarmEnv(world.scene, engine=engine, spawn=world.spawn, horizon=steps)
    keys = scene_keys(seed, np.zeros(4, np.int64))
    start = env.reset(keys)
    goal, agents = start.goal[0], start.position[0][np.asarray(start.agent_present[0])].mean(axis=0)
    across = jnp.stack([-(agents - goal)[1], (agents - goal)[0]]) / jnp.linalg.norm(agents - goal)
    shift = world.scene.obstacle_radius * jnp.asarray([-1.5, -0.5, 0.5, 1.5])
    places = (goal + agents) / 2 + shift[:, None] * across
    start = replace(
        start,
        obstacle=jnp.asarray(start.obstacle).at[:, 0].set(places),
        obstacle_present=jnp.asarray(start.obstacle_present).at[:, 0].set(True),
    )
    recording = jax.device_get(make_rollout(env, make_expert(world.expert), steps=steps)(None, start, keys))
    truth = from_recording(recording, world.scene, {"policy": "expert", "seed": seed, "world": plain(world)})
    save(folder / "rollouts" / "sweep_truth.h5", truth)
    save(folder / "rollouts" / "sweep_predicted.h5", forecast(model, truth))


def tables(judgement: Judgement) -> str:
    """What was measured, as text."""
    lines = [f"warning: {line}" for line in judgement.said]
    if judgement.prediction:
        lines += _prediction_lines(judgement)
    if not judgement.collisions:
        return "\n".join(lines)
    how = "contacts from positions" if judgement.by_geometry else "closed loop in physics"
    scenes = f"{judgement.scenes} scenes, {judgement.steps} steps of {judgement.dt:g} s"
    lines.append(f"{how}, {scenes}" + ("" if judgement.contacts else " (contacts are off here)"))
    lines += _side_by_side(judgement.collisions)
    lines.append("collective motion on the same scenes")
    lines += _side_by_side(judgement.collective)
    lines.append(f"worst scenes of {judgement.policy}")
    lines += [
        f"  scene {w.scene:5}   {w.contact_steps:3} contact steps   deepest {w.deepest_penetration:.3g} m   "
        f"least clearance {w.minimum_clearance:.3g} m"
        for w in judgement.worst
    ]
    return "\n".join(lines)


def _prediction_lines(judgement: Judgement) -> list[str]:
    errors = judgement.prediction
    first = next(iter(errors.values()))
    what = f"{judgement.scenes} scenes of {judgement.data}" if judgement.data else f"{judgement.scenes} unseen scenes"

    def cells(pairs: Iterable[tuple[float, float]]) -> str:
        return "".join(f"{one:14.4g} / {other:<9.4g}" for one, other in pairs)

    head = "  " + " " * 20 + "".join(f"{h:>4} steps {{}}" for h in first.horizons)
    lines = [
        f"normalized prediction error (published metric), dt {judgement.dt:g} s, {what}",
        head.replace("{}", "mean / median   "),
    ]
    for row, e in errors.items():
        lines.append(f"  {row:20}" + cells(zip(e.published_mean, e.published_median, strict=True)))
    counts = ", ".join(map(str, first.paths))
    lines += [f"displacement of agents [m], {counts} paths", head.replace("{}", " ADE / FDE      ")]
    lines += [f"  {row:20}" + cells(zip(e.ade, e.fde, strict=True)) for row, e in errors.items()]
    return lines


def _side_by_side(reports: dict[str, dict[str, Estimate]]) -> list[str]:
    names = list(reports)
    lines = ["  " + " " * 38 + "".join(f"{name:>32}" for name in names)]
    for figure in reports[names[-1]]:  # a reference in a world with a goal may have more
        cells = "".join(f"{reports[name].get(figure, '')!s:>32}" for name in names)
        lines.append(f"  {figure:38}" + cells)
    return lines
