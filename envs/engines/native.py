"""MuJoCo's C engine on a thread pool (`mujoco.batch`) behind `jax.pure_callback`: the default on a CPU."""

import collections
import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import jax
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


@dataclass
class _Worker:
    """A batch and its recording buffers: what one call holds while it runs."""

    batch: Batch
    records: dict = field(default_factory=dict)


def _like(array: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(array.shape, array.dtype)


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
        self._pool: dict[int, collections.deque[_Worker]] = collections.defaultdict(collections.deque)

    def step(self, state: State, acceleration: Float[Array, "S N 2"]) -> tuple[State, Contacts]:
        """One control step of `substeps` physics steps; contacts of states 1..k."""
        scenes, agents, _ = state.position.shape
        empty = no_contacts(scenes, agents)
        bodies = {"position": _like(state.position), "velocity": _like(state.velocity)}
        if not self.spec.contacts:
            position, velocity = jax.pure_callback(
                self._advance, tuple(bodies.values()), state, acceleration, vmap_method="sequential"
            )
            return replace(state, position=position, velocity=velocity), empty
        flags = {name: _like(getattr(state, name)) for name in ("touching_agent", "touching_obstacle", "touching_wall")}
        counts = {name: _like(value) for name, value in vars(empty).items()}
        *changed, contacts = jax.pure_callback(
            self._advance_with_contacts,
            (*bodies.values(), *flags.values(), counts),
            state,
            acceleration,
            vmap_method="sequential",
        )
        return replace(state, **dict(zip([*bodies, *flags], changed, strict=True))), Contacts(**contacts)

    @contextlib.contextmanager
    def _loaded(self, state: State, acceleration: Array) -> Iterator[_Worker]:
        """A worker whose batch holds the given state and controls; back in the pool afterwards."""
        scenes = state.position.shape[0]
        pool, index = self._pool[scenes], self._index
        try:
            worker = pool.popleft()  # atomic: a deque is safe between threads
        except IndexError:
            worker = _Worker(Batch(self._model, scenes, self._threads))
            worker.batch.bind("sensordata")
        batch = worker.batch
        batch.qpos[:, index.qpos] = np.asarray(state.position).reshape(scenes, -1)
        batch.qvel[:, index.dof] = np.asarray(state.velocity).reshape(scenes, -1)
        batch.ctrl[:, index.control] = np.asarray(acceleration).reshape(scenes, -1)
        batch.mocap_pos[:, index.obstacle_mocap, :2] = np.asarray(state.obstacle)
        batch.qacc_warmstart[:] = 0
        yield worker
        pool.append(worker)  # a worker of a call that raised is dropped

    def _bodies(self, batch: Batch, like: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        position = batch.qpos[:, self._index.qpos].astype(like.dtype).reshape(like.shape)
        return position, batch.qvel[:, self._index.dof].astype(like.dtype).reshape(like.shape)

    def _advance(self, state: State, acceleration: Array):
        with self._loaded(state, acceleration) as worker:
            worker.batch.step(nstep=self.spec.substeps)
            return self._bodies(worker.batch, np.asarray(state.position))

    def _advance_with_contacts(self, state: State, acceleration: Array):
        k, index = self.spec.substeps, self._index
        scenes = state.position.shape[0]
        with self._loaded(state, acceleration) as worker:
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
            near = self._near(batch, np.asarray(state.obstacle))
            batch.forward(ids=np.flatnonzero(near), stage=mujoco.mjtStage.mjSTAGE_VEL.value)  # state k
            position, velocity = self._bodies(batch, np.asarray(state.position))

            # Scenes where nothing touches, most of them, are done: zeros.
            rows = np.flatnonzero(touched | near)
            last = np.where(near[rows, None, None], batch.sensordata[rows, None], 0)
            sensors = np.concatenate([recorded[rows], last], axis=1)
            before = (state.touching_agent, state.touching_obstacle, state.touching_wall)
            before = (np.asarray(before[0])[rows], np.asarray(before[1])[rows], np.asarray(before[2])[rows])
            flags, on_agent, fields = read_sensors(np, sensors, before, index, self.spec)
            fields["agent_depth"] = self._agent_depth(on_agent, positions[rows])

        def spread(part: np.ndarray) -> np.ndarray:
            whole = np.zeros((scenes, *part.shape[1:]), part.dtype)
            whole[rows] = part
            return whole

        return position, velocity, *map(spread, flags), {name: spread(part) for name, part in fields.items()}

    def _near(self, batch: Batch, obstacle: np.ndarray) -> np.ndarray:
        """(S,) whether two bodies may touch; where not, all sensors of this state are zero for sure."""
        spec = self.spec
        if spec.num_agents > _BROADPHASE_AGENTS:
            return np.ones(batch.nsim, bool)
        position = batch.qpos[:, self._index.qpos].astype(np.float32).reshape(batch.nsim, spec.num_agents, 2)
        slack = 0.01  # far above float32's rounding of a distance in an arena
        reach = np.float32((2 * spec.agent_radius + slack) ** 2)
        near = np.zeros(batch.nsim, bool)
        for shift in range(1, spec.num_agents):
            apart = position[:, shift:] - position[:, :-shift]
            near |= (np.einsum("snd,snd->sn", apart, apart) < reach).any(axis=1)
        reach = np.float32((spec.agent_radius + spec.obstacle_radius + slack) ** 2)
        for k in range(spec.num_obstacles):
            apart = position - obstacle[:, k : k + 1].astype(np.float32)
            near |= (np.einsum("snd,snd->sn", apart, apart) < reach).any(axis=1)
        if spec.walls:
            near |= (np.abs(position) > spec.arena - spec.agent_radius - slack).any(axis=(1, 2))
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
