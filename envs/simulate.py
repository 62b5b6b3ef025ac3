"""Data generation: scenes in blocks through one compiled rollout, saved in chunks, resumed, then joined."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import jax
import numpy as np

from envs.config import SimulateConfig
from envs.engines import make_engine
from envs.experts.config import expert_name
from envs.experts.registry import make_expert
from envs.noise import ActuationNoise, PerceptionNoise, with_actuation_noise, with_perception_noise
from envs.plain import plain
from envs.policy import Policy
from envs.rollout import make_rollout
from envs.shards import WHOLE, Shard, block_size
from envs.storage import Header, join, read_header, save
from envs.swarm_env import SwarmEnv, scene_keys
from envs.trajectories import (
    Trajectories,
    TrajectoryError,
    concatenate,
    from_recording,
    versions,
)

Progress = Callable[[int, int], None]
"""Called with (scenes done, scenes in all)."""


def simulate_chunks(config: SimulateConfig, skip: frozenset[range] = frozenset(), shard: Shard = WHOLE):
    """Yields (scenes, Trajectories) for all chunks of the shard that are not in `skip`. One compile for all blocks, and
    for all configurations that differ in scenes alone."""
    block = block_of(config)
    env, run = _stage(replace(config, scenes=1, seed=0, chunk=1))
    about = provenance(config, shard)
    for scenes in chunks(config, shard):
        if scenes in skip:
            continue
        blocks = []
        for first in scenes[::block]:
            # Its last scene fills up a short block: another scene might not find room for its bodies.
            keys = scene_keys(config.seed, np.minimum(np.arange(first, first + block), config.scenes - 1))
            recording = jax.device_get(run(None, env.reset(keys), keys))
            blocks.append(from_recording(recording, env.spec, about).take(slice(0, config.scenes - first)))
        yield scenes, concatenate(blocks)


@lru_cache(maxsize=4)
def _stage(config: SimulateConfig):
    """The environment and the compiled rollout of a configuration, of whatever scenes."""
    world = config.world()
    engine = make_engine(world.scene, config.engine, threads=config.threads)
    env = SwarmEnv(world.scene, engine=engine, spawn=world.spawn, horizon=config.steps)
    return env, make_rollout(env, make_policy(config), steps=config.steps)


def make_policy(config: SimulateConfig) -> Policy:
    """The expert of the configuration's world, with its noise."""
    return with_noise(make_expert(config.world().expert), config)


def with_noise(policy: Policy, config: SimulateConfig) -> Policy:
    """Any policy with the configuration's noise on what it perceives and does."""
    seen = PerceptionNoise(position=config.perception_noise, velocity=config.perception_noise)
    done = ActuationNoise(std=config.actuation_noise)
    return with_actuation_noise(with_perception_noise(policy, seen), done)


def block_of(config: SimulateConfig) -> int:
    """Scenes per block (`envs.shards`) of this configuration on this machine."""
    accelerator = engine_name(config) != "native" and jax.default_backend() != "cpu"
    return block_size(config.num_agents, accelerator=accelerator)


def chunks(config: SimulateConfig, shard: Shard = WHOLE) -> list[range]:
    """The scenes of the shard in chunks of whole blocks."""
    block = block_of(config)
    scenes = shard.scenes(config.scenes, block)
    size = -(-config.chunk // block) * block
    return [scenes[start : start + size] for start in range(0, len(scenes), size)]


def simulate(
    config: SimulateConfig, path: str | Path, *, shard: Shard = WHOLE, progress: Progress | None = None
) -> Header:
    """Writes the trajectories that `config` describes, or a shard of them, to `path` and returns the file's header.

    Finished chunks lie beside the file in `NAME.parts/` until all are there, so an interrupted call goes on where it
    was. A file that already holds exactly this is kept. Raises TrajectoryError if the file holds something else.
    """
    path = Path(path)
    folder, about = path.with_name(path.name + ".parts"), provenance(config, shard)
    if path.exists():
        header = read_header(path)
        if [header.provenance.get(key) for key in _IDENTITY] != [about.get(key) for key in _IDENTITY]:
            raise TrajectoryError(
                f"{path}: exists and was made with other settings; choose another name or delete it first"
            )
        shutil.rmtree(folder, ignore_errors=True)  # of a call that was killed once the file was whole
        return header
    names = {
        scenes: folder / f"{about['fingerprint']}-{scenes.start:09d}-{scenes.stop:09d}.h5"
        for scenes in chunks(config, shard)
    }
    have = frozenset(scenes for scenes, part in names.items() if _sound(part))
    done, total = sum(map(len, have)), sum(map(len, names))
    if progress:
        progress(done, total)
    for scenes, chunk in simulate_chunks(config, have, shard):
        save(names[scenes], chunk)
        done += len(chunk)
        if progress:
            progress(done, total)
    join(list(names.values()), path, about)
    shutil.rmtree(folder, ignore_errors=True)
    return read_header(path)


_IDENTITY = ("fingerprint", "shard")
"""Entries of the provenance that say what a file holds."""


def engine_name(config: SimulateConfig) -> str:
    """The engine by name: `auto` means the device's default, and two engines agree to tolerance, not to the bit."""
    if config.engine != "auto":
        return config.engine
    return "native" if jax.default_backend() == "cpu" else "mjx"


def fingerprint(config: SimulateConfig) -> str:
    """What the trajectories depend on, as a short hash: not the chunk, the threads and the shards."""
    about = {
        "simulate": _settings(config) | {"engine": engine_name(config)},
        "world": plain(config.world()),
        "versions": versions(),
        "block": block_of(config),
    }
    if config.world().spawn.targets:
        about["edges"] = "from targets"  # recordings of chasers once said that everybody sees everybody
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]


def provenance(config: SimulateConfig, shard: Shard = WHOLE) -> dict:
    """Where the numbers come from, as plain JSON; of a shard also which scenes it holds."""
    about = {
        "fingerprint": fingerprint(config),
        "expert": expert_name(config.world().expert),
        "engine": engine_name(config),
        "simulate": _settings(config),
        "world": plain(config.world()),
        "versions": versions(),
    }
    if shard == WHOLE:
        return about
    scenes = shard.scenes(config.scenes, block_of(config))
    where = {"number": shard.number, "of": shard.of, "first": scenes.start, "last": scenes.stop - 1}
    return about | {"shard": where}


def _settings(config: SimulateConfig) -> dict:
    """The settings that leave a trace in the trajectories."""
    return {key: value for key, value in plain(config).items() if key not in ("chunk", "threads")}


def _sound(part: Path) -> bool:
    try:
        read_header(part)
    except TrajectoryError:
        part.unlink(missing_ok=True)
        return False
    return True


def simulate_in_memory(config: SimulateConfig) -> Trajectories:
    """Trajectories in memory, for tests and short experiments."""
    return concatenate([chunk for _, chunk in simulate_chunks(config)])
