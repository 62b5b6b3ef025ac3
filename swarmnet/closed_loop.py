"""A policy in physics, or a recording replayed, over many scenes in batches of one shape, with its contact log."""

import logging
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Key

from envs.config import SimulateConfig, World, make_world
from envs.contact_forces import ContactForceError, physics_touches
from envs.contact_log import ContactLogWriter, contact_log
from envs.plain import from_plain, plain
from envs.record import Array
from envs.replay import replay, touching_pairs
from envs.rollout import Recording, make_rollout
from envs.simulate import with_noise
from envs.state import State, make_state, park
from envs.swarm_env import SwarmEnv, scene_keys
from envs.touching import Touches
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, concatenate, from_recording
from swarm_mjcf.errors import SwarmError
from swarmnet.policies import PolicyError, Source, checked
from swarmnet.progress import progress

CHUNK = 256
"""Scenes per batch."""
TRIED = 8
"""Scenes that a user's function is tried on before anything runs."""
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Where policies are judged, the same for all: scenes 0 .. scenes-1 of a seed, or given starting states."""

    world: World
    engine: str
    scenes: int
    steps: int
    """Control steps."""
    seed: int
    simulate: SimulateConfig | None = None
    """The configuration that the world is of; its noise is on every policy that is judged."""
    starts: State | None = None
    """Starting states of all scenes; None: drawn from the seed."""

    @classmethod
    def of(cls, config: SimulateConfig) -> "Stage":
        """The world, scenes, steps and seed of a configuration."""
        return cls(
            world=config.world(),
            engine=config.engine,
            scenes=config.scenes,
            steps=config.steps,
            seed=config.seed,
            simulate=config,
        )


def stage_of_recording(recording: Trajectories, *, preset: str | None, engine: str, seed: int) -> Stage:
    """Where a recording's scenes can be run again from their first row: in the world that it names, or in a preset.

    Raises:
      SwarmError: it names no world and no preset is given, dt differs, or agents enter after the start.
    """
    t = recording
    config = None
    try:
        if preset is None:
            config = from_plain(SimulateConfig, t.provenance["simulate"])
            world = config.world()
        else:
            world = make_world(preset, num_agents=t.counts[2], num_obstacles=t.counts[1])
    except KeyError as error:
        raise SwarmError(
            "the recording does not say in which world it was made; name one to run the reference in (--preset)"
        ) from error
    if abs(world.scene.dt - t.dt) > 1e-9:
        raise SwarmError(f"the recording has a row every {t.dt:g} s, the world a control step of {world.scene.dt:g} s")
    if world.spawn.targets:
        raise SwarmError("recordings do not hold who chases whom, so no chaser can be run from their first row")
    if (t.mask != t.mask[:, :1]).any():
        raise SwarmError("agents enter or leave during the recording, so no policy can be run from its first row")
    goals, obstacles, agents = (np.flatnonzero(t.kind[0] == kind) for kind in (GOAL, OBSTACLE, AGENT))
    if len(goals) and not t.mask[:, 0, goals[0]].all():
        raise SwarmError("some of its scenes have a goal and some have none, so no policy can be run from all of them")
    first = t.position[:, 0]
    start = make_state(
        position=first[:, agents],
        velocity=t.velocity[:, 0, agents],
        goal=first[:, goals[0]] if len(goals) else np.zeros((len(t), 2), np.float32),
        obstacle=first[:, obstacles],
        obstacle_velocity=t.velocity[:, 0, obstacles],
        agent_present=t.mask[:, 0, agents],
        obstacle_present=t.mask[:, 0, obstacles],
    )
    steps = t.position.shape[1] - 1
    return Stage(
        world=world, engine=engine, scenes=len(t), steps=steps, seed=seed, simulate=config,
        starts=park(start, world.scene),
    )  # fmt: skip


def roll_out(stage: Stage, source: Source, *, title: str, log: ContactLogWriter | None = None) -> Trajectories:
    """Trajectories of a policy in physics; its contacts are appended to `log`.

    Raises:
      SwarmError: the policy cannot be used, or drives a scene to states that are not finite.
    """
    scene, size = stage.world.scene, min(CHUNK, stage.scenes)
    env = SwarmEnv(scene, engine=stage.engine, spawn=stage.world.spawn, horizon=stage.steps)
    policy, params = source.policy(stage.world)
    run, parts = None, []
    about = {"policy": source.name, "seed": stage.seed, "engine": env.engine.name, "world": plain(stage.world)}
    about |= {"simulate": plain(stage.simulate)} if stage.simulate else {}
    with progress(title) as update:
        for first in range(0, stage.scenes, size):
            # The last scene fills up a short batch: another one might not find room for its bodies.
            numbers = np.minimum(np.arange(first, first + size), stage.scenes - 1)
            keys, left = scene_keys(stage.seed, numbers), stage.scenes - first
            starts = stage.starts
            start = env.reset(keys) if starts is None else jax.tree.map(lambda x, n=numbers: np.asarray(x)[n], starts)
            if run is None:
                if source.foreign:
                    policy = checked(
                        source.name, policy, params, jax.tree.map(lambda x: x[:TRIED], start), keys[:TRIED]
                    )
                if stage.simulate is not None:
                    policy = with_noise(policy, stage.simulate)
                run = make_rollout(env, policy, steps=stage.steps)
            try:
                recording = jax.device_get(run(params, start, keys))
            except jax.errors.JaxRuntimeError as error:
                if not source.foreign:
                    raise
                last = str(error).strip().splitlines()[-1]
                raise PolicyError(f"policy {source.name!r}: failed on the way ({last})") from error
            part = from_recording(recording, scene, about)
            parts.append(part.take(slice(0, left)))
            if log is not None:
                touches = _touches(env, policy, params, recording, keys, part)
                touches = touches.take(touches.scene < left)
                log.append(contact_log(touches, scene.timestep, first_scene=first))
            update(min(first + size, stage.scenes), stage.scenes)
    return concatenate(parts)


def _touches(
    env: SwarmEnv, policy: object, params: object, recording: Recording, keys: Key[Array, " S"], part: Trajectories
) -> Touches:
    """With impulses where the native engine can tell them; from the recorded positions elsewhere."""
    if not env.spec.contacts:
        return Touches.concatenate([])
    if env.engine.name == "native":
        try:
            return physics_touches(env, policy, params, recording, keys)  # type: ignore[arg-type]
        except ContactForceError as error:
            _LOG.warning("the contact log has no impulses: %s", error)
    return touching_pairs(part, arena=_arena(part))[0]


def replayed(recording: Trajectories, *, log: ContactLogWriter | None = None) -> Trajectories:
    """A recording with contacts computed from its positions; they are appended to `log`."""
    if log is not None:
        touches, _ = touching_pairs(recording, arena=_arena(recording))
        log.append(contact_log(touches, recording.dt / recording.substeps))
    return replay(recording, arena=_arena(recording))


def _arena(t: Trajectories) -> float | None:
    """Half-width of the recorded world's solid walls [m], None without."""
    scene = t.provenance.get("world", {}).get("scene", {})
    return float(scene["arena"]) if scene.get("walls") and scene.get("contacts") else None
