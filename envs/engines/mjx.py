"""MJX-JAX: the whole batch inside XLA. The default on GPU and TPU; on a CPU it holds every pair and is slower."""

import contextlib
import io
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Float

from envs.engines.engine import read_sensors
from envs.record import Array
from envs.state import Contacts, State, no_contacts
from swarm_mjcf.build import compile_scene
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.spec import SceneSpec

with contextlib.redirect_stdout(io.StringIO()):  # it prints "Failed to import warp" where a program's output belongs
    from mujoco import mjx


class MjxEngine:
    """See `envs.engines.engine.Engine`. All pairs are kept: no cap, so no contact can be dropped."""

    name = "mjx"

    def __init__(self, spec: SceneSpec) -> None:
        self.spec = spec
        model = compile_scene(spec)
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self._index = SceneIndex.of(model, spec)
        self._pairs = spec.num_agents > 1 or spec.num_obstacles > 0 or spec.walls
        self._model = mjx.put_model(model)
        self._data = mjx.make_data(self._model)

    def step(self, state: State, acceleration: Float[Array, "S N 2"]) -> tuple[State, Contacts]:
        """One control step of `substeps` physics steps; contacts of states 1..k."""
        scenes, agents, _ = state.position.shape
        qpos, qvel, positions, sensors = jax.vmap(self._advance)(
            state.position.reshape(scenes, -1), state.velocity.reshape(scenes, -1), state.obstacle, acceleration
        )
        state = replace(state, position=qpos.reshape(scenes, agents, 2), velocity=qvel.reshape(scenes, agents, 2))
        if not self.spec.contacts or not self._pairs:
            return state, no_contacts(scenes, agents)
        before = (state.touching_agent, state.touching_obstacle, state.touching_wall)
        (agent, obstacle, wall), on_agent, fields = read_sensors(jnp, sensors, before, self._index, self.spec)
        state = replace(state, touching_agent=agent, touching_obstacle=obstacle, touching_wall=wall)
        return state, Contacts(**fields, agent_depth=self._agent_depth(on_agent, positions))

    def _advance(self, qpos: Array, qvel: Array, obstacle: Array, acceleration: Array):
        """One scene: final qpos, qvel; qpos (k, 2N) and sensors (k, M) of states 1..k."""
        index = self._index
        data = self._data.replace(
            qpos=self._data.qpos.at[index.qpos].set(qpos),
            qvel=self._data.qvel.at[index.dof].set(qvel),
            ctrl=self._data.ctrl.at[index.control].set(acceleration.reshape(-1)),
            mocap_pos=self._data.mocap_pos.at[index.obstacle_mocap, :2].set(obstacle),
        )

        def substep(data: mjx.Data, _: None):
            data = mjx.step(self._model, data)
            return data, (data.qpos[index.qpos], data.sensordata)

        data, (positions, sensors) = jax.lax.scan(substep, data, None, self.spec.substeps)
        if self.spec.contacts and self._pairs:
            # A step's sensors describe the state before it: shift by one and read the sensors of state k.
            data = mjx.kinematics(self._model, data)
            data = mjx.sensor_pos(self._model, mjx.collision(self._model, mjx.com_pos(self._model, data)))
            sensors = jnp.concatenate([sensors[1:], data.sensordata[None]])
        return data.qpos[index.qpos], data.qvel[index.dof], positions, sensors

    def _agent_depth(self, on_agent: Array, positions: Array) -> Array:
        """Deepest agent-agent penetration [m], (S, N), from geometry at the flagged states, one at a time."""
        agents = on_agent.shape[-1]
        itself = jnp.where(jnp.eye(agents, dtype=bool), jnp.inf, 0)

        def deeper(depth: Array, now: tuple[Array, Array]):
            flag, position = now
            apart = position[:, :, None] - position[:, None]
            distance = (jnp.sqrt(jnp.sum(apart * apart, axis=-1)) + itself).min(axis=-1)
            return jnp.maximum(depth, jnp.where(flag, 2 * self.spec.agent_radius - distance, 0)), None

        positions = positions.reshape(*on_agent.shape, 2)
        start = jnp.zeros((on_agent.shape[0], agents), jnp.float32)
        return jax.lax.scan(deeper, start, (jnp.moveaxis(on_agent, 1, 0), jnp.moveaxis(positions, 1, 0)))[0]
