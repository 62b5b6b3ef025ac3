"""Contacts with their forces: control steps in which something touched are run again in plain MuJoCo, state by state.

The batched engine tells which control steps touch and nothing of forces. Each of these steps is repeated from its
recorded start with the acceleration that the policy gives there, as the `native` engine runs it, so only what touches
costs time.
"""

from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float, Key

from envs.dynamics import limited
from envs.engines.engine import obstacle_path
from envs.policy import Policy
from envs.record import Array
from envs.rollout import Recording, step_keys
from envs.state import State
from envs.swarm_env import SwarmEnv
from envs.touching import BY_AGENT, BY_OBSTACLE, BY_WALL, Touches
from swarm_mjcf import names
from swarm_mjcf.build import compile_physics
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.spec import SceneSpec

BATCH = 128
"""Control steps whose accelerations are computed together: one compile, whatever their number."""
_MISSED = 1e-3
"""A step that ends farther from its recording than this [m] was not this policy's."""
Pair = tuple[int, int, int]
"""(agent, kind, partner) as in `Touches`."""


class ContactForceError(SwarmError):
    """The recording cannot be repeated: another policy, engine or scene made it."""


def physics_touches(
    env: SwarmEnv, policy: Policy, params: object, recording: Recording, keys: Key[Array, " S"]
) -> Touches:
    """Every pair at every state at which it touches, with impulses, of a rollout by the `native` engine.

    `env`, `policy`, `params` and `keys` are those of `envs.rollout.rollout`. The impulse of a state is its normal force
    times the physics step that begins there; 0 at the very last state, from which no step begins.

    Raises:
      ContactForceError: a repeated step ends elsewhere than the recorded one.
    """
    recording = jax.device_get(recording)
    contacts = recording.contacts
    touched = (contacts.agent_states + contacts.obstacle_states + contacts.wall_states).any(axis=2)  # (S, T)
    # What acts from a step's last state on is told by the step after it.
    again = touched.copy()
    again[:, 1:] |= touched[:, :-1]
    scenes, steps = np.nonzero(again)
    physics = _Physics(env.spec)
    entries: list[tuple] = []
    last: dict[Pair, int] = {}
    before = (-1, -1)
    for (scene, step), (bodies, drift, path) in zip(
        zip(scenes.tolist(), steps.tolist(), strict=True),
        _starts(env, policy, params, recording, keys, scenes, steps),
        strict=True,
    ):
        if (scene, step - 1) != before:
            last = {}
        before = (scene, step)
        physics.load(bodies, drift)
        whole = bool(touched[scene, step])
        for j in range(env.spec.substeps if whole else 1):
            found = physics.step(path[j])
            for pair, (depth, relative, closing, impulse) in found.items():
                if j:
                    entries.append((scene, step * env.spec.substeps + j, *pair, depth, relative, closing, impulse))
                elif pair in last:
                    entries[last[pair]] = (*entries[last[pair]][:-1], impulse)
        last = {}
        if not whole:
            continue
        for pair, told in physics.look(path[-1]).items():
            last[pair] = len(entries)
            entries.append((scene, (step + 1) * env.spec.substeps, *pair, *told[:3], 0.0))
        _check(physics.position(), recording, scene, step)
    columns = np.array(entries, np.float64).reshape(-1, 9).T
    whole_numbers = [column.astype(np.int64) for column in columns[:5]]
    return Touches.concatenate(
        [
            Touches(
                scene=whole_numbers[0],
                state=whole_numbers[1],
                agent=whole_numbers[2],
                kind=whole_numbers[3],
                partner=whole_numbers[4],
                depth=columns[5],
                relative_speed=columns[6],
                closing_speed=columns[7],
                impulse=columns[8],
            )
        ]
    )


def _check(reached: np.ndarray, recording: Recording, scene: int, step: int) -> None:
    here = np.asarray(recording.start.agent_present)[scene]
    apart = np.abs(reached - np.asarray(recording.position)[scene, step + 1])[here].max()
    if not apart <= _MISSED:
        raise ContactForceError(
            f"control step {step} of scene {scene}, run again, ends {apart:.3g} m from where it was recorded: contact "
            "forces need the policy, parameters and keys of the recording, made by the native engine, and a policy "
            "that depends on positions, velocities and its key alone"
        )


def _starts(
    env: SwarmEnv,
    policy: Policy,
    params: object,
    recording: Recording,
    keys: Key[Array, " S"],
    scenes: np.ndarray,
    steps: np.ndarray,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each control step: positions, velocities at its start and the executed accelerations of agents (3, N, 2);
    velocities (K, 2) and places (k + 1, K, 2) of obstacles."""

    @jax.jit
    def accelerate(state: State, keys: Key[Array, " S"]) -> tuple[Array, Array]:
        wanted = policy(state, params, step_keys(keys, state.step))
        wanted = jnp.where(state.agent_present[..., None], wanted, 0)
        return limited(state.velocity, wanted, env.spec), obstacle_path(state, env.spec)

    for first in range(0, len(scenes), BATCH):
        chosen = np.arange(first, first + BATCH).clip(max=len(scenes) - 1)
        scene, step = scenes[chosen], steps[chosen]
        state = jax.tree.map(lambda leaf, scene=scene: np.asarray(leaf)[scene], recording.start)
        obstacle = state.obstacle if recording.obstacle is None else recording.obstacle[scene, step]
        state = replace(
            state,
            position=recording.position[scene, step],
            velocity=recording.velocity[scene, step],
            obstacle=obstacle,
            step=step.astype(np.int32),
        )
        accelerations, paths = jax.device_get(accelerate(state, keys[scene]))
        for row in range(min(BATCH, len(scenes) - first)):
            drift = np.where(state.obstacle_present[row][:, None], state.obstacle_velocity[row], 0)
            yield np.stack([state.position[row], state.velocity[row], accelerations[row]]), drift, paths[row]


class _Physics:
    """One scene of the native engine's model, stepped from Python, its contacts read."""

    def __init__(self, spec: SceneSpec) -> None:
        self._model = compile_physics(spec)
        self._data = mujoco.MjData(self._model)
        self._index = SceneIndex.of(self._model, spec)
        self._drift = np.zeros((spec.num_obstacles, 2))
        self._moving = spec.moving_obstacles
        solids = {BY_AGENT: [names.agent(i) for i in range(spec.num_agents)]}
        solids[BY_OBSTACLE] = [names.obstacle(k) for k in range(spec.num_obstacles)]
        solids[BY_WALL] = list(names.WALLS) if spec.walls else []
        self._who = {
            int(self._model.geom(name).id): (kind, number)
            for kind, found in solids.items()
            for number, name in enumerate(found)
        }

    def load(self, bodies: Float[np.ndarray, "3 N 2"], drift: Float[np.ndarray, "K 2"]) -> None:
        """Sets the whole state as the engine's callback does, warm start included; obstacles move by `drift` [m/s]."""
        data, index = self._data, self._index
        data.qpos[index.qpos], data.qvel[index.dof], data.ctrl[index.control] = bodies.reshape(3, -1)
        data.qacc_warmstart[:] = 0
        self._drift = drift * self._moving

    def step(self, obstacle: Float[np.ndarray, "K 2"]) -> dict[Pair, tuple[float, float, float, float]]:
        """One physics step; what touched at the state that it began at: depth, relative and closing speed, impulse."""
        data = self._data
        data.mocap_pos[self._index.obstacle_mocap, :2] = obstacle
        position, velocity = data.qpos.copy(), data.qvel.copy()
        mujoco.mj_step(self._model, data)
        return self._contacts(position, velocity, obstacle) if data.ncon else {}

    def look(self, obstacle: Float[np.ndarray, "K 2"]) -> dict[Pair, tuple[float, float, float, float]]:
        """What touches at the present state; no step follows, so impulses mean nothing."""
        data = self._data
        data.mocap_pos[self._index.obstacle_mocap, :2] = obstacle
        mujoco.mj_fwdPosition(self._model, data)
        return self._contacts(data.qpos, data.qvel, obstacle) if data.ncon else {}

    def position(self) -> Float[np.ndarray, "N 2"]:
        """Agents' positions [m]."""
        return self._data.qpos[self._index.qpos].reshape(-1, 2)

    def _contacts(
        self, qpos: np.ndarray, qvel: np.ndarray, obstacle: np.ndarray
    ) -> dict[Pair, tuple[float, float, float, float]]:
        position = qpos[self._index.qpos].reshape(-1, 2)
        velocity = qvel[self._index.dof].reshape(-1, 2)
        found, contact, force = {}, self._data.contact, self._data.efc_force
        # As arrays: a contact object takes longer to make than a physics step.
        rows = zip(contact.geom.tolist(), contact.dist.tolist(), contact.efc_address.tolist(), strict=True)
        for geoms, distance, address in rows:
            # In this order an agent comes before what is none, and the lower of two agents first.
            (_, agent), (kind, partner) = sorted(self._who[geom] for geom in geoms)
            if kind == BY_AGENT:
                away, other_velocity = position[partner] - position[agent], velocity[partner]
            elif kind == BY_OBSTACLE:
                away, other_velocity = obstacle[partner] - position[agent], self._drift[partner]
            else:
                away, other_velocity = np.array(_OUTWARD[partner]), np.zeros(2)
            relative = other_velocity - velocity[agent]
            closing = -float(relative @ away) / max(float(np.hypot(*away)), 1e-12)
            # Without friction (condim 1) a contact is one row of constraint forces, its normal force.
            impulse = float(force[address]) * self._model.opt.timestep if address >= 0 else 0.0
            found[agent, kind, partner] = (-distance, float(np.hypot(*relative)), closing, impulse)
        return found


_OUTWARD = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
"""From the arena to its walls, in the order of their names."""
