"""MuJoCo's C engine on a thread pool (`mujoco.batch`) behind `jax.pure_callback`: the default on a CPU."""

import collections
import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco.batch import Batch

from envs.engines.engine import read_sensors
from envs.record import Array
from envs.state import Contacts, State, no_contacts
from swarm_mjcf.build import compile_scene
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.spec import SceneSpec

_BROADPHASE_AGENTS = 32
"""Up to this many agents, all pairs in NumPy are faster than MuJoCo's visit to every scene."""

_SLACK = 0.01
"""Added to distances there [m]: far above what float32 rounds off in an arena."""
_COUNTS = ("agent_states", "obstacle_states", "wall_states", "agent_events", "obstacle_events", "wall_events")
_DEPTHS = ("agent_depth", "obstacle_depth", "wall_depth")


@dataclass
class _Worker:
    """A batch and its recording buffers: what one call holds while it runs."""

    batch: Batch
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
        self._model = compile_scene(spec)
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
        if not self.spec.contacts:
            out = jax.pure_callback(self._advance, moved, bodies, state.obstacle, vmap_method="sequential")
            return replace(state, **_unpacked(out)), no_contacts(scenes, agents)
        flags = jnp.concatenate(
            [state.touching_agent[..., None], state.touching_wall[..., None], state.touching_obstacle], axis=-1
        )
        shapes = (
            moved,
            jax.ShapeDtypeStruct(flags.shape, flags.dtype),
            jax.ShapeDtypeStruct((len(_COUNTS), scenes, agents), np.int32),
            jax.ShapeDtypeStruct((len(_DEPTHS), scenes, agents), np.float32),
        )
        out, flags, counts, depths = jax.pure_callback(
            self._advance_with_contacts, shapes, bodies, state.obstacle, flags, vmap_method="sequential"
        )
        state = replace(
            state,
            **_unpacked(out),
            touching_agent=flags[..., 0],
            touching_wall=flags[..., 1],
            touching_obstacle=flags[..., 2:],
        )
        fields = dict(zip(_COUNTS + _DEPTHS, [*counts, *depths], strict=True))
        return state, Contacts(**fields)

    @contextlib.contextmanager
    def _loaded(self, bodies: np.ndarray, obstacle: np.ndarray) -> Iterator[_Worker]:
        """A worker whose batch holds the given states and controls (S, 8N); back in the pool afterwards."""
        scenes = bodies.shape[0]
        pool, index = self._pool[scenes], self._index
        try:
            worker = pool.popleft()  # atomic: a deque is safe between threads
        except IndexError:
            worker = _Worker(Batch(self._model, scenes, self._threads))
            worker.batch.bind("sensordata")
        batch = worker.batch
        batch.state[:, self._bodies] = bodies
        batch.mocap_pos[:, index.obstacle_mocap, :2] = obstacle
        yield worker
        pool.append(worker)  # a worker of a call that raised is dropped

    def _moved(self, batch: Batch, bodies: np.ndarray) -> Float[np.ndarray, "S M"]:
        """Positions and velocities of all agents, (S, 4N)."""
        return batch.state[:, self._bodies.start : self._bodies.start + bodies.shape[1] // 2].astype(bodies.dtype)

    def _advance(self, bodies: Array, obstacle: Array) -> np.ndarray:
        bodies = np.asarray(bodies)
        with self._loaded(bodies, np.asarray(obstacle)) as worker:
            worker.batch.step(nstep=self.spec.substeps)
            return self._moved(worker.batch, bodies)

    def _advance_with_contacts(self, bodies: Array, obstacle: Array, flags: Array) -> tuple[np.ndarray, ...]:
        bodies, obstacle, flags = np.asarray(bodies), np.asarray(obstacle), np.asarray(flags)
        k, index = self.spec.substeps, self._index
        scenes, agents = len(bodies), self.spec.num_agents
        with self._loaded(bodies, obstacle) as worker:
            batch = worker.batch
            if k == 1:
                batch.step()
                recorded, positions = batch.sensordata[:, None][:, :0], batch.qpos[:, None]
                touched = np.zeros(scenes, bool)
            else:
                worker.records = batch.rollout(k, record=("sensordata", "qpos"), out=worker.records)
                # A sensor record describes the state before its substep: records 1.. are states 1..k-1.
                recorded, positions = worker.records["sensordata"][:, 1:], worker.records["qpos"]
                touched = recorded[..., index.touch].any(axis=(1, 2))
            moved = self._moved(batch, bodies)
            near = self._near(moved, obstacle)
            batch.forward(ids=np.flatnonzero(near), stage=mujoco.mjtStage.mjSTAGE_VEL.value)  # state k

            # Scenes where nothing touches, most of them, are done: zeros.
            now = np.zeros_like(flags)
            counts = np.zeros((len(_COUNTS), scenes, agents), np.int32)
            depths = np.zeros((len(_DEPTHS), scenes, agents), np.float32)
            rows = np.flatnonzero(touched | near)
            if len(rows):
                last = np.where(near[rows, None, None], batch.sensordata[rows, None], 0)
                sensors = np.concatenate([recorded[rows], last], axis=1)
                before = (flags[rows, :, 0], flags[rows, :, 2:], flags[rows, :, 1])
                (agent, solid, wall), on_agent, fields = read_sensors(np, sensors, before, index, self.spec)
                fields["agent_depth"] = self._agent_depth(on_agent, positions[rows])
                now[rows] = np.concatenate([agent[..., None], wall[..., None], solid], axis=-1)
                counts[:, rows] = [fields[name] for name in _COUNTS]
                depths[:, rows] = [fields[name] for name in _DEPTHS]
        return moved, now, counts, depths

    def _near(self, moved: np.ndarray, obstacle: np.ndarray) -> np.ndarray:
        """(S,) whether two bodies may touch; where not, all sensors of this state are zero for sure."""
        spec = self.spec
        if spec.num_agents > _BROADPHASE_AGENTS:
            return np.ones(len(moved), bool)
        columns = np.ascontiguousarray(moved[:, : 2 * spec.num_agents].T)  # whole rows of scenes at a time
        x, y = columns[0::2], columns[1::2]  # (N, S) each
        near = np.zeros(len(moved), bool)

        def add(dx: np.ndarray, dy: np.ndarray, reach: float) -> None:
            np.logical_or(near, (dx * dx + dy * dy < np.float32(reach + _SLACK) ** 2).any(axis=0), out=near)

        for shift in range(1, spec.num_agents):
            add(x[shift:] - x[:-shift], y[shift:] - y[:-shift], 2 * spec.agent_radius)
        for k in range(spec.num_obstacles):
            add(x - obstacle[:, k, 0], y - obstacle[:, k, 1], spec.agent_radius + spec.obstacle_radius)
        if spec.walls:
            border = spec.arena - spec.agent_radius - _SLACK
            near |= (np.maximum(np.abs(x), np.abs(y)) > border).any(axis=0)
        return near

    def _agent_depth(self, on_agent: np.ndarray, recorded: np.ndarray) -> np.ndarray:
        """Deepest agent-agent penetration [m], (S, N), from sphere geometry at the flagged states (S, k, nq) alone."""
        scenes, _, agents = on_agent.shape
        depth = np.zeros((scenes, agents), np.float32)
        scene, substep, agent = np.nonzero(on_agent)
        if not len(scene):
            return depth
        positions = recorded[scene, substep][:, self._index.qpos].reshape(-1, agents, 2)
        row = np.arange(len(agent))
        apart = positions - positions[row, agent][:, None]
        distance = np.hypot(apart[..., 0], apart[..., 1])
        distance[row, agent] = np.inf
        np.maximum.at(depth, (scene, agent), np.maximum(2 * self.spec.agent_radius - distance.min(axis=1), 0))
        return depth
