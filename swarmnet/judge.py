"""Judging a model on unseen scenes: prediction error by horizon, and closed loop in physics beside the expert."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from envs.collisions import Estimate, collision_report
from envs.config import SimulateConfig, World
from envs.experts.registry import make_expert
from envs.plain import from_plain, plain
from envs.policy import Policy
from envs.rollout import make_rollout
from envs.storage import save
from envs.swarm_env import SwarmEnv, scene_keys
from envs.trajectories import Trajectories, concatenate, from_recording, versions
from gnn.checkpoint import Model
from gnn.decode import make_policy, make_predict
from gnn.evaluate import PredictionError, constant_velocity, persistence, prediction_error
from gnn.windows import Dataset, windows
from swarm_mjcf.errors import SwarmError
from swarmnet.progress import progress
from swarmnet.results import commit, hardware

CHUNK = 256
"""Scenes per batch in closed loop."""


@dataclass(frozen=True)
class Judgement:
    """All that was measured. Keys are row names as printed."""

    prediction: dict[str, PredictionError]
    collisions: dict[str, dict[str, Estimate]]
    """Collision report of the expert and of the model on the same scenes; empty for a model that cannot act."""
    contacts: bool
    """Whether bodies collide in this world."""
    dt: float
    preset: str
    engine: str
    scenes: int
    steps: int
    seed: int

    def plain(self) -> dict:
        """Plain JSON values, with what is needed to measure again."""
        return {
            "preset": self.preset, "engine": self.engine, "hardware": hardware(), "versions": versions(),
            "commit": commit(),
            "prediction": {
                name: {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(error).items()}
                for name, error in self.prediction.items()
            },
            "collisions": {
                name: {figure: asdict(estimate) for figure, estimate in report.items()}
                for name, report in self.collisions.items()
            },
            "contacts": self.contacts, "dt": self.dt, "scenes": self.scenes, "steps": self.steps, "seed": self.seed,
        }  # fmt: skip


def training_world(model: Model) -> SimulateConfig:
    """The settings of the data a model was trained on. Raises SwarmError if it was trained on something else."""
    settings = model.about["data"].get("simulate")
    if settings is None:
        raise SwarmError("the model was not trained on simulated data; name the world to judge it in (--preset)")
    return from_plain(SimulateConfig, settings)


def roll_out(
    world: World, policy: Policy, params: object, *, engine: str, scenes: int, steps: int, seed: int, title: str
) -> Trajectories:
    """Trajectories of a policy in physics, scenes 0..n-1 of a seed, in batches of one shape."""
    env = SwarmEnv(world.scene, engine=engine, spawn=world.spawn, horizon=steps)
    run = make_rollout(env, policy, steps=steps)
    size = min(CHUNK, scenes)
    parts = []
    with progress(title) as update:
        for first in range(0, scenes, size):
            keys = scene_keys(seed, range(first, first + size))
            recording = jax.device_get(run(params, env.reset(keys), keys))
            about = {"policy": title, "seed": seed, "engine": env.engine.name, "world": plain(world)}
            parts.append(from_recording(recording, world.scene, about))
            update(min(first + size, scenes), scenes)
    return concatenate(parts).take(slice(0, scenes))


def judge(model: Model, config: SimulateConfig, folder: Path, *, name: str, label: str = "") -> Judgement:
    """Rolls out expert and model on the scenes of `config`, measures both, and records them in `folder`/rollouts.

    `label` stands before the titles of the progress bars.

    Raises SwarmError when the scenes are those of the training data.
    """
    trained = model.about["data"].get("simulate", {})
    if trained.get("seed") == config.seed and trained.get("preset") == config.preset:
        raise SwarmError(f"seed {config.seed} is the training data's own; unseen scenes need another seed")
    world = config.world()
    if (world.scene.dt, world.scene.substeps) != (model.integrator.dt, model.integrator.substeps):
        raise SwarmError(
            f"the model was trained at dt {model.integrator.dt} s with {model.integrator.substeps} substeps, this "
            f"world has {world.scene.dt} s with {world.scene.substeps}"
        )
    shared = {"engine": config.engine, "scenes": config.scenes, "steps": config.steps, "seed": config.seed}
    expert = roll_out(world, make_expert(world.expert), None, title=f"{label}expert in physics", **shared)
    save(folder / "rollouts" / "expert.h5", expert)
    collisions = {}
    for stale in ("learned.h5", "sweep_truth.h5", "sweep_predicted.h5"):  # of an earlier model that could steer
        (folder / "rollouts" / stale).unlink(missing_ok=True)
    if model.config.output == "acceleration":
        policy = make_policy(model.config, model.scales, goal=world.scene.goal)
        learned = roll_out(world, policy, model.params, title=f"{label}{name} in physics", **shared)
        save(folder / "rollouts" / "learned.h5", learned)
        collisions = {"expert": collision_report(expert), name: collision_report(learned)}
        sweep(world, model, folder, engine=config.engine, steps=config.steps, seed=config.seed)
    predictors = {
        name: (make_predict(model.config, model.scales, model.integrator), model.params),
        "constant velocity": (constant_velocity(world.scene.dt), {}),
        "persistence": (persistence, {}),
    }
    prediction = {}
    for row, (predict, params) in predictors.items():
        with progress(f"{label}predict, {row}") as update:
            prediction[row] = prediction_error(
                predict, params, expert, window=model.config.window, progress=lambda a, b, update=update: update(a, b)
            )
    return Judgement(
        prediction=prediction,
        collisions=collisions,
        contacts=world.scene.contacts,
        dt=world.scene.dt,
        preset=config.preset,
        engine=expert.provenance["engine"],
        scenes=config.scenes,
        steps=config.steps,
        seed=config.seed,
    )


def sweep(world: World, model: Model, folder: Path, *, engine: str, steps: int, seed: int) -> None:
    """Figure 3.5: one start, the obstacle in four places across the way; truth from physics, prediction beside it.

    Writes rollouts/sweep_truth.h5 and rollouts/sweep_predicted.h5, four scenes each.
    """
    if not world.scene.num_obstacles:
        return
    env = SwarmEnv(world.scene, engine=engine, spawn=world.spawn, horizon=steps)
    keys = scene_keys(seed, np.zeros(4, np.int64))
    start = env.reset(keys)
    goal, agents = start.goal[0], start.position[0].mean(axis=0)
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
    predict = make_predict(model.config, model.scales, model.integrator)
    first = model.config.window
    scene, zero = jnp.arange(4), jnp.zeros(4, jnp.int32)
    history, future, _, graph = windows(
        Dataset.of(truth), scene, zero, window=first, horizon=steps + 1 - first, counts=truth.counts
    )
    states = np.concatenate([history, predict(model.params, history, graph, horizon=future.shape[1])], axis=1)
    states = np.where(truth.mask[..., None], states, 0).astype(np.float32)
    predicted = replace(
        truth,
        position=states[..., :2],
        velocity=states[..., 2:],
        provenance=truth.provenance | {"policy": "prediction"},
    )
    save(folder / "rollouts" / "sweep_truth.h5", truth)
    save(folder / "rollouts" / "sweep_predicted.h5", predicted)


def tables(judgement: Judgement) -> str:
    """What was measured, as text."""
    lines = [
        f"normalized prediction error (published metric), dt {judgement.dt} s, {judgement.scenes} unseen scenes",
        "  "
        + " " * 20
        + "".join(f"{h:>4} steps mean / median   " for h in next(iter(judgement.prediction.values())).horizons),
    ]
    for row, e in judgement.prediction.items():
        cells = (
            f"{mean:14.4g} / {median:<9.4g}" for mean, median in zip(e.published_mean, e.published_median, strict=True)
        )
        lines.append(f"  {row:20}" + "".join(cells))
    if judgement.collisions:
        lines.append(
            "closed loop in physics on the same scenes" + ("" if judgement.contacts else " (contacts are off here)")
        )
        names = list(judgement.collisions)
        lines.append("  " + " " * 38 + "".join(f"{name:>32}" for name in names))
        for figure in judgement.collisions[names[0]]:
            lines.append(f"  {figure:38}" + "".join(f"{judgement.collisions[n][figure]!s:>32}" for n in names))
    return "\n".join(lines)
