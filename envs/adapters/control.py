"""The scene in dm_control's own physics: a `Physics` from our MJCF and a `Task`, for `control.Environment`."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from dm_control import mujoco
from dm_control.rl import control
from dm_env import specs

from envs.adapters.core import SwarmCore
from envs.adapters.deepmind import observation_spec
from envs.adapters.scene import mean_reward
from envs.config import SEEDS
from envs.dynamics import limited
from envs.engines.engine import obstacle_path, read_sensors
from envs.state import Contacts, State, no_contacts
from envs.swarm_env import scene_keys
from swarm_mjcf.build import to_xml
from swarm_mjcf.errors import SpecError
from swarm_mjcf.index import Address, SceneIndex
from swarm_mjcf.spec import SceneSpec


class SwarmPhysics(mujoco.Physics):
    """dm_control's physics of a scene; it keeps the sensors of every substep of the last control step.

    Contacts that come and go between two control steps would be lost otherwise.
    """

    sensors: np.ndarray
    """(k, M): at states 1..k of the last control step."""
    path: np.ndarray | None = None
    """Where the mocap bodies `moving` are at states 1..k of the control step to come [m], (k, K, 2); None: at rest."""
    moving: Address

    @classmethod
    def of(cls, spec: SceneSpec) -> "SwarmPhysics":
        """The physics of a scene, from the MJCF that `to_xml` writes."""
        return cls.from_xml_string(to_xml(spec))

    def step(self, nstep: int = 1) -> None:
        """Advances by `nstep` physics steps."""
        self.sensors = np.empty((nstep, self.model.nsensordata))
        for substep in range(nstep):
            if self.path is not None:  # what is known at state j acts from there on
                self.data.mocap_pos[self.moving, :2] = self.path[substep]
            super().step(1)
            self.sensors[substep] = self.data.sensordata


class SwarmTask(control.Task):
    """Start, actions, observation and reward of a `SwarmCore`; physics is dm_control's. Use `legacy_step=True`.

    Episodes are scenes 0, 1, 2, ... of `seed`. Observation `{"agents": (N, D)}`, action (N, 2) in [-1, 1] times
    `max_acceleration` [m/s^2], reward the agents' mean.
    """

    state: State
    """What the project knows of the scene now, a batch of one."""
    contacts: Contacts
    """Of the last control step; `agent_depth` is left 0."""

    def __init__(self, core: SwarmCore, *, seed: int = 0) -> None:
        if not 0 <= seed < SEEDS:
            raise SpecError("seed", seed, f"a whole number in 0..{SEEDS - 1}")
        self.core, self.spec = core, core.spec
        self._seed, self._next = seed, 0
        self._nothing = jax.device_get(no_contacts(1, self.spec.num_agents))
        self._limited = jax.jit(lambda velocity, wanted: limited(velocity, wanted, core.spec))
        self._path = jax.jit(lambda state: obstacle_path(state, core.spec))

    def initialize_episode(self, physics: SwarmPhysics) -> None:
        """Puts the bodies of the next scene in their places."""
        state = self.core.env.reset(scene_keys(self._seed, range(self._next, self._next + 1)))
        self._next += 1
        self.state = jax.device_get(state)
        self.contacts = self._nothing
        index = self._index = SceneIndex.of(physics.model.ptr, self.spec)
        data = physics.data
        data.qpos[index.qpos] = np.asarray(self.state.position[0]).reshape(-1)
        data.qvel[index.dof] = np.asarray(self.state.velocity[0]).reshape(-1)
        data.mocap_pos[index.obstacle_mocap, :2] = self.state.obstacle[0]
        if index.goal_mocap is not None:
            data.mocap_pos[index.goal_mocap, :2] = self.state.goal[0]
        self._judge()

    def before_step(self, action: Any, physics: SwarmPhysics) -> None:
        """Sets the motors: the acceleration within the scene's limits; absent agents do nothing."""
        state = self.state
        wanted = self.core.action(action, (self.spec.num_agents, 2)) * self.spec.max_acceleration
        wanted = np.where(state.agent_present[..., None], wanted[None], np.float32(0))
        executed = self._limited(jnp.asarray(state.velocity), jnp.asarray(wanted))
        physics.data.ctrl[self._index.control] = np.asarray(executed).reshape(-1)
        if self.spec.moving_obstacles:
            physics.path = np.asarray(self._path(state))[0, 1:]
            physics.moving = self._index.obstacle_mocap

    def after_step(self, physics: SwarmPhysics) -> None:
        """Reads where the bodies are and, from the sensors of all substeps, what touched."""
        before, index = self.state, self._index
        flags = (before.touching_agent, before.touching_obstacle, before.touching_wall)
        after, _, fields = read_sensors(np, physics.sensors[None], flags, index, self.spec)
        shape = before.position.shape
        self.contacts = replace(self._nothing, **fields)
        before = before if physics.path is None else replace(before, obstacle=physics.path[None, -1])
        self.state = replace(
            before,
            position=physics.data.qpos[index.qpos].reshape(shape).astype(np.float32),
            velocity=physics.data.qvel[index.dof].reshape(shape).astype(np.float32),
            touching_agent=after[0],
            touching_obstacle=after[1],
            touching_wall=after[2],
            step=before.step + 1,
        )
        self._judge()

    def get_observation(self, physics: SwarmPhysics) -> dict[str, np.ndarray]:  # type: ignore[override]
        """What the agents see, (N, D)."""
        return {"agents": self._seen}

    def get_reward(self, physics: SwarmPhysics) -> float:  # type: ignore[override]
        """Mean over the agents that are there."""
        return self._earned

    def get_termination(self, physics: SwarmPhysics) -> float | None:  # type: ignore[override]
        """Discount 0 where a contact ends the scene, if `terminate_on_contact` is set, 1 at the horizon, else None."""
        touched = (self.contacts.agent_states, self.contacts.obstacle_states, self.contacts.wall_states)
        if self.core.env.terminate_on_contact and any(map(np.any, touched)):
            return 0.0
        return 1.0 if int(self.state.step[0]) >= self.core.env.horizon else None

    def action_spec(self, physics: SwarmPhysics) -> specs.BoundedArray:  # type: ignore[override]
        """(N, 2) float32 in [-1, 1]."""
        return specs.BoundedArray((self.spec.num_agents, 2), np.float32, -1.0, 1.0, name="acceleration")

    def observation_spec(self, physics: SwarmPhysics) -> dict[str, specs.BoundedArray]:
        """Bounds in the units of the labels."""
        return {"agents": observation_spec(self.core)}

    def _judge(self) -> None:
        seen, earned = self.core.judged(self.state, self.contacts)
        self._seen = np.array(seen[0])
        self._earned = float(mean_reward(earned, self.state.agent_present)[0])


def control_environment(core: SwarmCore, *, seed: int = 0) -> control.Environment:
    """The core's scene as a `dm_control.rl.control.Environment`; the task counts the steps of the horizon.

    (dm_control's time limit is a division of floats, a step too long at some horizons, and hides a contact in the last
    step.)
    """
    physics, task = SwarmPhysics.of(core.spec), SwarmTask(core, seed=seed)
    return control.Environment(physics, task, control_timestep=core.spec.dt)
