"""MuJoCo's C engine on a thread pool (`mujoco.batch`) behind `jax.pure_callback`: the default on a CPU."""

import collections
import contextlib
import math
from collections.abc import Callable, Iterator
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


def _rows(*parts: Array) -> Array:
    """Arrays (S, ...) as one (S, W) of the first one's dtype."""
    return jnp.concatenate([part.reshape(len(part), -1).astype(parts[0].dtype) for part in parts], axis=1)


def _parts(rows: Array, *shapes: tuple[int, ...]) -> list:
    """The arrays (S, *shape) that make up (S, W); all of them views where `rows` is of NumPy."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    columns = [rows[:, end - math.prod(shape) : end] for end, shape in zip(ends, shapes, strict=True)]
    return [part.reshape(len(rows), *shape) for part, shape in zip(columns, shapes, strict=True)]


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
        agents = spec.num_agents
        # Columns of a state that hold qpos and qvel.
        self._moved = slice(self._bodies.start, self._bodies.start + 4 * agents)
        # What a control step gives: position, velocity, touching flags (agent, wall, obstacle), counts, depths.
        flags = ((agents,), (agents,), (agents, spec.num_obstacles))
        self._seen = ((agents, 2), (agents, 2), *flags, (len(_COUNTS), agents), (len(_DEPTHS), agents))
        self._pool: dict[int, collections.deque[_Worker]] = collections.defaultdict(collections.deque)

    def step(self, state: State, acceleration: Float[Array, "S N 2"]) -> tuple[State, Contacts]:
        """One control step of `substeps` physics steps; contacts of states 1..k."""
        scenes, agents, _ = state.position.shape
        spec = self.spec
        # One array crosses the border each way: what an array costs there is more than its copy. First the bodies as
        # MuJoCo lays them out (qpos, qvel, warm start, ctrl).
        bodies = (state.position, state.velocity, jnp.zeros_like(state.position), acceleration)
        path = obstacle_path(state, spec)
        after = with_obstacles_moved(state, path, spec)

        def called(function: Callable[[Array], np.ndarray], rows: Array, width: int) -> Array:
            shape = jax.ShapeDtypeStruct((scenes, width), rows.dtype)
            return jax.pure_callback(function, shape, rows, vmap_method="sequential")

        if not spec.contacts:
            out = called(self._advance, _rows(*bodies, state.obstacle), 4 * agents)
            position, velocity = _parts(out, (agents, 2), (agents, 2))
            return replace(after, position=position, velocity=velocity), no_contacts(scenes, agents)
        if not spec.moving_obstacles:
            path = path[:, :1]  # placed once, for all substeps
        flags = (state.touching_agent, state.touching_wall, state.touching_obstacle)
        rows = _rows(*bodies, path, self._near(after, acceleration), *flags)
        out = called(self._advance_with_contacts, rows, sum(math.prod(shape) for shape in self._seen))
        position, velocity, agent, wall, obstacle, counts, depths = _parts(out, *self._seen)
        after = replace(
            after,
            position=position,
            velocity=velocity,
            touching_agent=agent > 0,
            touching_wall=wall > 0,
            touching_obstacle=obstacle > 0,
        )
        fields = {name: counts[:, i].astype(jnp.int32) for i, name in enumerate(_COUNTS)}
        fields |= {name: depths[:, i].astype(jnp.float32) for i, name in enumerate(_DEPTHS)}
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

    def _advance(self, rows: Array) -> np.ndarray:
        agents, obstacles = self.spec.num_agents, self.spec.num_obstacles
        bodies, obstacle = _parts(np.asarray(rows), (8 * agents,), (obstacles, 2))
        with self._loaded(bodies, obstacle) as worker:
            worker.batch.step(nstep=self.spec.substeps)
            return worker.batch.state[:, self._moved].astype(rows.dtype)

    def _advance_with_contacts(self, rows: Array) -> np.ndarray:
        k, index, spec = self.spec.substeps, self._index, self.spec
        agents, obstacles = spec.num_agents, spec.num_obstacles
        instants = k + 1 if spec.moving_obstacles else 1
        flags = ((agents,), (agents,), (agents, obstacles))
        bodies, path, near, *before = _parts(np.asarray(rows), (8 * agents,), (instants, obstacles, 2), (), *flags)
        scenes = len(bodies)
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
            # Scenes where nothing touches, most of them, are done: zeros.
            out = np.zeros((scenes, sum(math.prod(shape) for shape in self._seen)), rows.dtype)
            out[:, : 4 * agents] = batch.state[:, self._moved]
            if spec.moving_obstacles:
                batch.mocap_pos[:, index.obstacle_mocap, :2] = path[:, k]
            chosen = np.flatnonzero(touched | (near > 0))
            if len(chosen):
                look.state[chosen] = batch.state[chosen]
                look.forward(ids=chosen, stage=mujoco.mjtStage.mjSTAGE_POS.value)  # state k
                sensors = np.concatenate([recorded[chosen], look.sensordata[chosen, None]], axis=1)
                agent, wall, obstacle = (flag[chosen] > 0 for flag in before)
                now, on_agent, fields = read_sensors(np, sensors, (agent, obstacle, wall), index, spec)
                fields["agent_depth"] = self._agent_depth(on_agent, positions, chosen)
                agent, obstacle, wall = now
                seen = [agent, wall, obstacle, *(fields[name] for name in _COUNTS + _DEPTHS)]
                out[chosen, 4 * agents :] = np.concatenate([x.reshape(len(chosen), -1) for x in seen], axis=1)
        return out

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
