"""MuJoCo's C engine on a thread pool (`mujoco.batch`), called from compiled functions: the default on a CPU."""

import collections
import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Bool, Float
from mujoco.batch import Batch, SimulationError

from envs.dynamics import free_flight
from envs.engines.engine import EngineError, obstacle_path, read_sensors, with_obstacles_moved
from envs.engines.host import filled
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


def _like(tree: Any) -> Any:
    """Shapes of arrays."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)


@dataclass
class _Worker:
    """Two batches of the same scenes, one that moves and one that looks, and recording buffers: what a call holds."""

    batch: Batch
    look: Batch
    records: dict = field(default_factory=dict)


def _columns(model: mujoco.MjModel, spec: SceneSpec) -> tuple[slice, slice, slice, slice]:
    """Columns of a batch's state rows that hold qpos, qvel, qacc_warmstart and ctrl."""

    def start(component: mujoco.mjtState) -> int:
        # A row has the components in the order of their bits.
        before = int(mujoco.mjtState.mjSTATE_INTEGRATION) & (int(component) - 1)
        return mujoco.mj_stateSize(model, before)

    state, n = mujoco.mjtState, 2 * spec.num_agents
    order = (state.mjSTATE_QPOS, state.mjSTATE_QVEL, state.mjSTATE_WARMSTART, state.mjSTATE_CTRL)
    if any(mujoco.mj_stateSize(model, int(part)) != n for part in order):
        raise RuntimeError("this MuJoCo lays out the state of a batch otherwise than 3.17 does")
    qpos, qvel, warmstart, ctrl = (slice(start(part), start(part) + n) for part in order)
    return qpos, qvel, warmstart, ctrl


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
        self._qpos, self._qvel, self._warmstart, self._ctrl = _columns(self._model, spec)
        self._pool: dict[int, collections.deque[_Worker]] = collections.defaultdict(collections.deque)

    def step(self, state: State, acceleration: Float[Array, "S N 2"]) -> tuple[State, Contacts]:
        """One control step of `substeps` physics steps; contacts of states 1..k."""
        spec = self.spec
        path = obstacle_path(state, spec)
        after = with_obstacles_moved(state, path, spec)
        bodies = (state.position, state.velocity, acceleration)
        if not spec.contacts:
            moved = filled(self._advance, _like(bodies[:2]), *bodies, state.obstacle)
            after = replace(after, position=moved[0], velocity=moved[1])
            return after, no_contacts(*state.position.shape[:2])
        if not spec.moving_obstacles:
            path = path[:, :1]  # placed once, for all substeps
        flags = (state.touching_agent, state.touching_wall, state.touching_obstacle)
        contacts = no_contacts(*state.position.shape[:2])
        seen = {name: getattr(contacts, name) for name in _COUNTS + _DEPTHS}
        moved, flags, seen = filled(
            self._advance_with_contacts, _like((bodies[:2], flags, seen)), *bodies, path,
            self._near(after, acceleration), *flags,
        )  # fmt: skip
        agent, wall, obstacle = flags
        after = replace(
            after,
            position=moved[0],
            velocity=moved[1],
            touching_agent=agent,
            touching_wall=wall,
            touching_obstacle=obstacle,
        )
        return after, replace(contacts, **seen)

    @contextlib.contextmanager
    def _loaded(
        self, position: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray, obstacle: np.ndarray
    ) -> Iterator[_Worker]:
        """A worker whose batch holds the given states and controls (S, N, 2); back in the pool afterwards."""
        scenes = len(position)
        pool, index = self._pool[scenes], self._index
        try:
            worker = pool.popleft()  # atomic: a deque is safe between threads
        except IndexError:
            mover, looker = (Batch(model, scenes, self._threads) for model in (self._mover, self._model))
            worker = _Worker(mover, looker)
            worker.batch.bind("ncon")
            worker.look.bind("sensordata")
        batch = worker.batch
        state = batch.state
        for columns, values in ((self._qpos, position), (self._qvel, velocity), (self._ctrl, acceleration)):
            state[:, columns] = values.reshape(scenes, -1)
        state[:, self._warmstart] = 0
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

    def _give(self, batch: Batch, moved: tuple[np.ndarray, np.ndarray]) -> None:
        for columns, values in zip((self._qpos, self._qvel), moved, strict=True):
            values.reshape(len(values), -1)[:] = batch.state[:, columns]

    def _advance(
        self,
        out: tuple[np.ndarray, np.ndarray],
        position: np.ndarray,
        velocity: np.ndarray,
        acceleration: np.ndarray,
        obstacle: np.ndarray,
    ) -> None:
        with self._loaded(position, velocity, acceleration, obstacle) as worker:
            worker.batch.step(nstep=self.spec.substeps)
            self._give(worker.batch, out)

    def _advance_with_contacts(
        self,
        out: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, ...], dict[str, np.ndarray]],
        position: np.ndarray,
        velocity: np.ndarray,
        acceleration: np.ndarray,
        path: np.ndarray,
        near: np.ndarray,
        *before: np.ndarray,
    ) -> None:
        k, index, spec = self.spec.substeps, self._index, self.spec
        scenes = len(position)
        moved, flags, seen = out
        with self._loaded(position, velocity, acceleration, path[:, 0]) as worker:
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
            self._give(batch, moved)
            # Scenes where nothing touches, most of them, are done: zeros.
            for values in (*flags, *seen.values()):
                values.fill(0)
            if spec.moving_obstacles:
                batch.mocap_pos[:, index.obstacle_mocap, :2] = path[:, k]
            chosen = np.flatnonzero(touched | near)
            if len(chosen):
                look.state[chosen] = batch.state[chosen]
                look.forward(ids=chosen, stage=mujoco.mjtStage.mjSTAGE_POS.value)  # state k
                sensors = np.concatenate([recorded[chosen], look.sensordata[chosen, None]], axis=1)
                agent, wall, obstacle = (flag[chosen] for flag in before)
                now, on_agent, found = read_sensors(np, sensors, (agent, obstacle, wall), index, spec)
                found["agent_depth"] = self._agent_depth(on_agent, positions, chosen)
                agent, obstacle, wall = now
                for values, there in zip(flags, (agent, wall, obstacle), strict=True):
                    values[chosen] = there
                for name, values in seen.items():
                    values[chosen] = found[name]

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
