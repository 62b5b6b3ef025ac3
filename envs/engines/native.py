"""MuJoCo's C engine on a thread pool (`mujoco.batch`) behind `jax.pure_callback`: the default on a CPU."""

import collections
import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Bool, Float
from mujoco.batch import Batch, SimulationError

from envs.dynamics import free_flight
from envs.engines.engine import EngineError, obstacle_path, read_sensors, with_obstacles_moved
from envs.record import Array
from envs.state import Contacts, State, no_contacts
from swarm_mjcf.build import compile_physics
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.spec import SceneSpec

_BROADPHASE_AGENTS = 32
"""Up to this many agents, looking at all pairs is faster than MuJoCo's second visit to every scene."""

_SLACK = 0.01
"""Added to distances there [m]: far above what float32 rounds off in an arena."""
_COUNTS = ("agent_states", "obstacle_states", "wall_states", "agent_events", "obstacle_events", "wall_events")
_DEPTHS = ("agent_depth", "obstacle_depth", "wall_depth")


@dataclass
class _Worker:
    """Two batches of the same scenes, one that moves and one that looks, and recording buffers: what a call holds."""

    batch: Batch
    look: Batch
    records: dict = field(default_factory=dict)


def _bodies_of(model: mujoco.MjModel, spec: SceneSpec) -> slice:
    """Columns of a batch's state rows that hold qpos, qvel, qacc_warmstart and ctrl, one after the other."""

    def start(component: mujoco.mjtState) -> int:
        # A row has the components in the order of their bits.
        before = int(mujoco.mjtState.mjSTATE_INTEGRATION) & (int(component) - 1)
        return mujoco.mj_stateSize(model, before)

    state, n = mujoco.mjtState, 2 * spec.num_agents
    first = start(state.mjSTATE_QPOS)
    order = (state.mjSTATE_QPOS, state.mjSTATE_QVEL, state.mjSTATE_WARMSTART, state.mjSTATE_CTRL)
    if [start(part) for part in order] != [first, first + n, first + 2 * n, first + 3 * n]:
        raise RuntimeError("this MuJoCo lays out the state of a batch in another order than 3.17 does")
    return slice(first, first + 4 * n)


def _unpacked(bodies: Array) -> dict[str, Array]:
    """Fields of the state from (S, 4N)."""
    halves = bodies.reshape(bodies.shape[0], 2, -1, 2)
    return {"position": halves[:, 0], "velocity": halves[:, 1]}


class NativeEngine:
    """See `envs.engines.engine.Engine`. `threads=0` takes every CPU.

    The callback is pure: it sets the whole state (warm start included), so results depend neither on the batch size nor
    on the position in it nor on the number of threads. A `Batch` is never shared: each call takes one from a pool and
    puts it back. (No `threading.local`: XLA's threads lose theirs after every callback.)
    """

    name = "native"

    def __init__(self, spec: SceneSpec, *, threads: int = 0) -> None:
        self.spec = spec
        self._threads = threads
        self._model = compile_physics(spec)
        # A single substep needs no sensors on the way: those before it belong to the control step before.
        self._mover = compile_physics(spec)
        if spec.substeps == 1:
            self._mover.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._index = SceneIndex.of(self._model, spec)
        self._bodies = _bodies_of(self._model, spec)
        self._pool: dict[int, collections.deque[_Worker]] = collections.defaultdict(collections.deque)

    def step(self, state: State, acceleration: Float[Array, "S N 2"]) -> tuple[State, Contacts]:
        """One control step of `substeps` physics steps; contacts of states 1..k."""
        scenes, agents, _ = state.position.shape
        dtype = state.position.dtype
        # Few arrays cross the border, the bodies as MuJoCo lays them out (qpos, qvel, warm start, ctrl): one copy in,
        # one copy out.
        still = jnp.zeros_like(state.position)
        parts = (state.position, state.velocity, still, acceleration.astype(dtype))
        bodies = jnp.concatenate([part.reshape(scenes, -1) for part in parts], axis=1)
        moved = jax.ShapeDtypeStruct((scenes, 4 * agents), dtype)
        path = obstacle_path(state, self.spec)
        after = with_obstacles_moved(state, path, self.spec)
        if not self.spec.contacts:
            out = jax.pure_callback(self._advance, moved, bodies, state.obstacle, vmap_method="sequential")
            return replace(after, **_unpacked(out)), no_contacts(scenes, agents)
        if not self.spec.moving_obstacles:
            path = path[:, :1]  # placed once, for all substeps
        flags = jnp.concatenate(
            [state.touching_agent[..., None], state.touching_wall[..., None], state.touching_obstacle], axis=-1
        )
        shapes = (
            moved,
            jax.ShapeDtypeStruct(flags.shape, flags.dtype),
            jax.ShapeDtypeStruct((len(_COUNTS), scenes, agents), np.int32),
            jax.ShapeDtypeStruct((len(_DEPTHS), scenes, agents), np.float32),
        )
        arguments = (bodies, path, flags, self._near(after, acceleration))
        out, flags, counts, depths = jax.pure_callback(
            self._advance_with_contacts, shapes, *arguments, vmap_method="sequential"
        )
        after = replace(
            after,
            **_unpacked(out),
            touching_agent=flags[..., 0],
            touching_wall=flags[..., 1],
            touching_obstacle=flags[..., 2:],
        )
        fields = dict(zip(_COUNTS + _DEPTHS, [*counts, *depths], strict=True))
        return after, Contacts(**fields, saturated=jnp.zeros(scenes, jnp.int32))

    @contextlib.contextmanager
    def _loaded(self, bodies: np.ndarray, obstacle: np.ndarray) -> Iterator[_Worker]:
        """A worker whose batch holds the given states and controls (S, 8N); back in the pool afterwards."""
        scenes = bodies.shape[0]
        pool, index = self._pool[scenes], self._index
        try:
            worker = pool.popleft()  # atomic: a deque is safe between threads
        except IndexError:
            mover, looker = (Batch(model, scenes, self._threads) for model in (self._mover, self._model))
            worker = _Worker(mover, looker)
            worker.batch.bind("ncon")
            worker.look.bind("sensordata")
        batch = worker.batch
        batch.state[:, self._bodies] = bodies
        batch.mocap_pos[:, index.obstacle_mocap, :2] = obstacle
        try:
            yield worker
        except SimulationError as error:
            raise EngineError(f"native: {error}") from error
        self._check_warnings(worker)
        pool.append(worker)  # a worker of a call that raised is dropped

    def _check_warnings(self, worker: _Worker) -> None:
        """Raises EngineError where MuJoCo only counts a warning: it has dropped contacts, or reset the scene."""
        counts = worker.batch.warning[..., 1] + worker.look.warning[..., 1]
        if not counts.any():
            return
        scene, kind = (int(i) for i in np.argwhere(counts)[0])
        raise EngineError(
            f"native: MuJoCo warned of {mujoco.mjtWarning(kind).name} in {np.count_nonzero(counts.any(axis=1))} of "
            f"{len(counts)} scenes, first in scene {scene}; CONTACTFULL and CNSTRFULL: more bodies pressed into each "
            f"other than the {self._model.narena // 1024} KB that hold a scene's contacts have room for"
        )

    def _places(self, batch: Batch, path: np.ndarray) -> np.ndarray | None:
        """Where all mocap bodies are at states 0..k-1, (S, k, 3 * bodies); None where they stand still."""
        if not self.spec.moving_obstacles:
            return None
        places = np.repeat(batch.mocap_pos[:, None], self.spec.substeps, axis=1)
        places[:, :, self._index.obstacle_mocap, :2] = path[:, :-1]
        return places.reshape(*places.shape[:2], -1)

    def _moved(self, batch: Batch, bodies: np.ndarray) -> Float[np.ndarray, "S M"]:
        """Positions and velocities of all agents, (S, 4N)."""
        return batch.state[:, self._bodies.start : self._bodies.start + bodies.shape[1] // 2].astype(bodies.dtype)

    def _advance(self, bodies: Array, obstacle: Array) -> np.ndarray:
        bodies = np.asarray(bodies)
        with self._loaded(bodies, np.asarray(obstacle)) as worker:
            worker.batch.step(nstep=self.spec.substeps)
            return self._moved(worker.batch, bodies)

    def _advance_with_contacts(self, bodies: Array, path: Array, flags: Array, near: Array) -> tuple:
        bodies, path, flags, near = (np.asarray(x) for x in (bodies, path, flags, near))
        k, index = self.spec.substeps, self._index
        scenes, agents = len(bodies), self.spec.num_agents
        with self._loaded(bodies, path[:, 0]) as worker:
            batch, look = worker.batch, worker.look
            if k == 1:
                batch.step()
                touched, positions = worker.batch.ncon > 0, batch.qpos[:, None]
                recorded = np.empty((scenes, 0, look.sensordata.shape[1]))
            else:
                record, place = ("sensordata", "qpos", "ncon"), int(mujoco.mjtState.mjSTATE_MOCAP_POS)
                worker.records = batch.rollout(k, self._places(batch, path), place, record, out=worker.records)
                # A record describes the state before its substep: sensors 1.. are those of states 1..k-1.
                recorded, positions = worker.records["sensordata"][:, 1:], worker.records["qpos"]
                touched = worker.records["ncon"].reshape(scenes, k).any(axis=1)
            moved = self._moved(batch, bodies)
            if self.spec.moving_obstacles:
                batch.mocap_pos[:, index.obstacle_mocap, :2] = path[:, k]

            # Scenes where nothing touches, most of them, are done: zeros.
            now = np.zeros_like(flags)
            counts = np.zeros((len(_COUNTS), scenes, agents), np.int32)
            depths = np.zeros((len(_DEPTHS), scenes, agents), np.float32)
            rows = np.flatnonzero(touched | near)
            if len(rows):
                look.state[rows] = batch.state[rows]
                look.forward(ids=rows, stage=mujoco.mjtStage.mjSTAGE_POS.value)  # state k
                sensors = np.concatenate([recorded[rows], look.sensordata[rows, None]], axis=1)
                before = (flags[rows, :, 0], flags[rows, :, 2:], flags[rows, :, 1])
                (agent, solid, wall), on_agent, fields = read_sensors(np, sensors, before, index, self.spec)
                now[rows] = np.concatenate([agent[..., None], wall[..., None], solid], axis=-1)
                counts[:, rows] = [fields[name] for name in _COUNTS]
                fields["agent_depth"] = self._agent_depth(on_agent, positions, rows)
                depths[:, rows] = [fields[name] for name in _DEPTHS]
        return moved, now, counts, depths

    def _near(self, state: State, acceleration: Float[Array, "S N 2"]) -> Bool[Array, " S"]:
        """Whether two bodies may touch at state k if none does before; where not, all its sensors are zero for sure."""
        spec = self.spec
        if spec.num_agents > _BROADPHASE_AGENTS:
            return jnp.ones(len(state.position), bool)
        # Scenes on the last axis: many to a vector.
        agents = free_flight(state.position, state.velocity, acceleration, spec)[0].transpose(2, 1, 0)
        obstacles = state.obstacle.transpose(2, 1, 0)

        def within(one: Array, other: Array, reach: float) -> Array:
            square = ((one[:, :, None] - other[:, None]) ** 2).sum(axis=0)
            if one is other:
                square = jnp.where(jnp.eye(spec.num_agents, dtype=bool)[..., None], jnp.inf, square)
            return square.min(axis=(0, 1), initial=jnp.inf) < (reach + _SLACK) ** 2

        near = within(agents, agents, 2 * spec.agent_radius)
        near |= within(agents, obstacles, spec.agent_radius + spec.obstacle_radius)
        if spec.walls:
            near |= (jnp.abs(agents) > spec.arena - spec.agent_radius - _SLACK).any(axis=(0, 1))
        return near

    def _agent_depth(self, on_agent: np.ndarray, recorded: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Deepest agent-agent penetration [m] of scenes `rows`, from sphere geometry at their flagged states alone."""
        scenes, _, agents = on_agent.shape
        depth = np.zeros((scenes, agents), np.float32)
        scene, substep, agent = np.nonzero(on_agent)
        if not len(scene):
            return depth
        positions = recorded[rows[scene], substep][:, self._index.qpos].reshape(-1, agents, 2)
        row = np.arange(len(agent))
        apart = positions - positions[row, agent][:, None]
        square = apart[..., 0] ** 2 + apart[..., 1] ** 2
        square[row, agent] = np.inf
        np.maximum.at(depth, (scene, agent), np.maximum(2 * self.spec.agent_radius - np.sqrt(square.min(axis=1)), 0))
        return depth
