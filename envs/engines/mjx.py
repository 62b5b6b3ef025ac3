"""MJX-JAX: the whole batch inside XLA. The default on GPU and TPU; on a CPU it is slower than `native`.

Its buffers hold every pair of bodies, N (N - 1) / 2 of them, touching or not, unless two caps bound them (custom
numbers of the model that MJX reads). `max_geom_pairs` keeps the closest pairs and drops the rest before geometry;
`max_contact_points` keeps the deepest contacts and drops the rest before the solver. Nothing that touches is lost until
a cap is full of touching pairs; states where one is full are counted in `Contacts.saturated`.
"""

import contextlib
import io
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Float

from envs.engines.in_xla import Seen, can_touch, step_in_xla
from envs.record import Array
from envs.state import Contacts, State
from swarm_mjcf.build import compile_physics
from swarm_mjcf.errors import SpecError
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.names import WALLS
from swarm_mjcf.spec import SceneSpec

with contextlib.redirect_stdout(io.StringIO()):  # it prints "Failed to import warp" where a program's output belongs
    from mujoco import mjx

CAPPED_AGENTS = 16
"""Up to this many agents, all pairs are kept: cheaper than sorting them (`swarmnet bench engines`)."""

Cap = int | Literal["auto"] | None


class MjxEngine:
    """See `envs.engines.engine.Engine`. Caps per scene: a number, None for no cap, or `auto`.

    `auto` is no cap up to `CAPPED_AGENTS` agents and beyond that 4N contacts from 8N pairs: discs of equal size have at
    most six neighbours each, so 3N pairs, unless they are pressed far into each other.
    Raises SpecError for a cap below 1, and for fewer pairs than agents have with the walls, which MJX cannot sort.
    """

    name = "mjx"

    def __init__(self, spec: SceneSpec, *, max_contact_points: Cap = "auto", max_geom_pairs: Cap = "auto") -> None:
        self.spec = spec
        self.max_contact_points = _cap("max_contact_points", max_contact_points, 4, 1, spec)
        least = len(WALLS) * spec.num_agents if spec.walls else 1
        self.max_geom_pairs = _cap("max_geom_pairs", max_geom_pairs, 8, least, spec)
        caps = {"max_contact_points": self.max_contact_points, "max_geom_pairs": self.max_geom_pairs}
        model = compile_physics(spec, {name: float(cap) for name, cap in caps.items() if cap is not None})
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self._index = SceneIndex.of(model, spec)
        self._sphere = jnp.asarray(model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
        self._model = mjx.put_model(model, impl="jax")
        self._data = mjx.make_data(self._model, impl="jax")

    def step(self, state: State, acceleration: Float[Array, "S N 2"]) -> tuple[State, Contacts]:
        """One control step of `substeps` physics steps; contacts of states 1..k."""
        return step_in_xla(self._advance, state, acceleration, index=self._index, spec=self.spec)

    def _advance(self, position: Array, velocity: Array, path: Array, acceleration: Array) -> Seen:
        index, shape = self._index, position.shape
        data = self._data.replace(
            qpos=self._data.qpos.at[index.qpos].set(position.reshape(-1)),
            qvel=self._data.qvel.at[index.dof].set(velocity.reshape(-1)),
            ctrl=self._data.ctrl.at[index.control].set(acceleration.reshape(-1)),
        )

        def placed(data: mjx.Data, obstacle: Array) -> mjx.Data:
            return data.replace(mocap_pos=data.mocap_pos.at[index.obstacle_mocap, :2].set(obstacle))

        def substep(data: mjx.Data, obstacle: Array):
            data = mjx.step(self._model, placed(data, obstacle))
            return data, (data.qpos[index.qpos], data.sensordata, self._full(data))

        data, (positions, sensors, full) = jax.lax.scan(substep, data, path[:-1])
        if can_touch(self.spec):
            # A step's sensors describe the state before it: shift by one and read the sensors of state k.
            last = mjx.kinematics(self._model, placed(data, path[-1]))
            last = mjx.sensor_pos(self._model, mjx.collision(self._model, mjx.com_pos(self._model, last)))
            sensors = jnp.concatenate([sensors[1:], last.sensordata[None]])
            full = jnp.concatenate([full[1:], self._full(last)[None]])
        velocity = data.qvel[index.dof].reshape(shape)
        return Seen(position=positions.reshape(-1, *shape), velocity=velocity, sensors=sensors, full=full)

    def _full(self, data: mjx.Data) -> Array:
        """Whether a cap holds nothing but touching pairs: one more would have been dropped."""
        agents, solids = self.spec.num_agents, self.spec.num_obstacles
        pairs = agents * (agents - 1) // 2 + agents * solids
        kept, full = pairs if self.max_geom_pairs is None else min(pairs, self.max_geom_pairs), jnp.asarray(False)
        if not can_touch(self.spec):
            return full
        contact = data._impl.contact  # pyright: ignore
        touching = contact.dist < 0
        if kept < pairs:
            full |= (touching & self._sphere[contact.geom].all(axis=1)).sum() >= kept
        if self.max_contact_points is not None and self.max_contact_points < kept + self._at_walls:
            full |= touching.sum() >= self.max_contact_points
        return full

    @property
    def _at_walls(self) -> int:
        return len(WALLS) * self.spec.num_agents if self.spec.walls else 0


def _cap(field: str, given: Cap, per_agent: int, least: int, spec: SceneSpec) -> int | None:
    if given == "auto":
        return per_agent * spec.num_agents if spec.num_agents > CAPPED_AGENTS else None
    if given is None or (isinstance(given, int) and not isinstance(given, bool) and given >= least):
        return given
    raise SpecError(field, given, f"auto, None for no cap, or a whole number of at least {least}")
