"""Data generation: scenes in chunks through one compiled rollout, each saved when done, resumed, then joined."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax

from envs.config import SimulateConfig
from envs.engines import make_engine
from envs.experts.registry import make_expert
from envs.plain import plain
from envs.rollout import make_rollout
from envs.storage import Header, TrajectoryWriter, read_header, save, stream
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


def simulate_chunks(config: SimulateConfig, skip: frozenset[int] = frozenset()):
    """Yields (chunk number, Trajectories) for all chunks not in `skip`. One compile: a short last chunk is padded."""
    world = config.world()
    engine = make_engine(world.scene, config.engine, threads=config.threads)
    env = SwarmEnv(world.scene, engine=engine, spawn=world.spawn, horizon=config.steps)
    run = make_rollout(env, make_expert(world.expert), steps=config.steps)
    size = min(config.chunk, config.scenes)
    about = provenance(config, env.engine.name)
    for number, first in enumerate(range(0, config.scenes, size)):
        if number in skip:
            continue
        keys = scene_keys(config.seed, range(first, first + size))
        recording = jax.device_get(run(None, env.reset(keys), keys))
        chunk = from_recording(recording, world.scene, about)
        yield number, chunk.take(slice(0, min(size, config.scenes - first)))


def simulate(config: SimulateConfig, path: str | Path, *, progress: Progress | None = None) -> Header:
    """Writes the trajectories that `config` describes to `path` and returns the file's header.

    Finished chunks lie beside the file in `NAME.parts/` until all are there, so an interrupted call goes on where it
    was. A file that already holds exactly this is kept. Raises TrajectoryError if the file holds something else.
    """
    path = Path(path)
    if path.exists():
        header = read_header(path)
        if header.provenance.get("fingerprint") != fingerprint(config):
            raise TrajectoryError(
                f"{path}: exists and was made with other settings; choose another name or delete it first"
            )
        return header
    parts = path.with_name(path.name + ".parts")
    size = min(config.chunk, config.scenes)
    # Chunks of another size hold other scenes under the same number.
    names = [f"{fingerprint(config)}-{size}-{number:06d}.h5" for number in range(-(-config.scenes // size))]
    have = {number: parts / name for number, name in enumerate(names) if _sound(parts / name)}
    done = sum(read_header(part).scenes for part in have.values())
    if progress:
        progress(done, config.scenes)
    for number, chunk in simulate_chunks(config, frozenset(have)):
        have[number] = parts / names[number]
        save(have[number], chunk)
        done += len(chunk)
        if progress:
            progress(done, config.scenes)
    with TrajectoryWriter(path) as writer:
        for number in sorted(have):
            for slab in stream(have[number]):
                writer.append(slab)
    shutil.rmtree(parts, ignore_errors=True)
    return read_header(path)


def fingerprint(config: SimulateConfig) -> str:
    """What the trajectories depend on, as a short hash: not the chunk and not the threads."""
    # "auto" means a device's default engine, so it is resolved: two engines agree to tolerance, not to the bit.
    engine = config.engine
    if engine == "auto":
        engine = "native" if jax.default_backend() == "cpu" else "mjx"
    same = replace(config, chunk=1, threads=0, engine=engine)
    about = {"simulate": plain(same), "world": plain(config.world()), "versions": versions()}
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]


def provenance(config: SimulateConfig, engine: str) -> dict:
    """Where the numbers come from, as plain JSON."""
    return {
        "fingerprint": fingerprint(config),
        "expert": "boids",
        "engine": engine,
        "simulate": plain(config),
        "world": plain(config.world()),
        "versions": versions(),
    }


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
