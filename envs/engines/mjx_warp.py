"""MJX-Warp: MuJoCo Warp's kernels inside XLA, for NVIDIA GPUs (on a CPU they run one scene after another).

It finds contacts by a broad phase, so that buffers need not hold every pair. All scenes of a batch share one buffer of
contacts; states at which it, or a scene's rows for the solver, were too small are counted in `Contacts.saturated` (for
the whole batch where the shared buffer was full: nobody knows whose contact was lost).
"""

import contextlib
import functools
import importlib.util
import io
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Float

from envs.engines.engine import EngineError
from envs.engines.in_xla import Seen, can_touch, step_in_xla
from envs.record import Array
from envs.state import Contacts, State
from swarm_mjcf.build import compile_physics
from swarm_mjcf.errors import SpecError
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.names import WALLS
from swarm_mjcf.spec import SceneSpec

if importlib.util.find_spec("warp") is None:
    raise EngineError(
        "the engine mjx-warp is not installed: .venv/bin/pip install 'mujoco-mjx[warp]<4' (390 MB "
        "on disk; for machines with an NVIDIA GPU, on others it runs slowly)"
    )
with contextlib.redirect_stdout(io.StringIO()):  # it greets where a program's output belongs
    from mujoco import mjx
    from mujoco.mjx.third_party.mujoco_warp import OverflowType

    warp: Any = importlib.import_module("warp")  # types are checked without the extra, too

    warp.config.log_level = warp.LOG_WARNING
    warp.init()

_LOST = OverflowType.NEFC | OverflowType.BROADPHASE | OverflowType.NARROWPHASE | OverflowType.CONTACT_MATCH
"""What can cost contacts."""


class MjxWarpEngine:
    """See `envs.engines.engine.Engine`. `max_contact_points` is the room for contacts per scene; None for 4N + 16.

    Raises SpecError for a room below 1. Results of a scene do not depend on its batch while nothing is saturated.
    """

    name = "mjx-warp"

    def __init__(self, spec: SceneSpec, *, max_contact_points: int | None = None) -> None:
        room = 4 * spec.num_agents + 16 if max_contact_points is None else max_contact_points
        if room < 1:
            raise SpecError("max_contact_points", max_contact_points, "None or at least 1")
        self.spec, self.max_contact_points = spec, room
        self._mujoco_model = compile_physics(spec)
        self._mujoco_model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self._index = SceneIndex.of(self._mujoco_model, spec)
        model = mjx.put_model(self._mujoco_model, impl="warp")
        self._model = model.tree_replace({"opt._impl.warn_overflow": 0})  # it is counted, not printed by a kernel

    def step(self, state: State, acceleration: Float[Array, "S N 2"]) -> tuple[State, Contacts]:
        """One control step of `substeps` physics steps; contacts of states 1..k."""
        advance = functools.partial(self._advance, self._data(len(state.position)))
        return step_in_xla(advance, state, acceleration, index=self._index, spec=self.spec)

    @functools.cache  # noqa: B019  (an engine lives as long as the program)
    def _data(self, scenes: int) -> mjx.Data:
        # Spheres and walls that are close but do not touch take room in the broad phase, too: a wall's is vast.
        walls = len(WALLS) * self.spec.num_agents if self.spec.walls else 0
        room = self.max_contact_points
        with jax.ensure_compile_time_eval():
            return mjx.make_data(self._mujoco_model, impl="warp", naconmax=scenes * (room + walls), njmax=room)

    def _advance(self, data: mjx.Data, position: Array, velocity: Array, path: Array, acceleration: Array) -> Seen:
        index, shape, k = self._index, position.shape, self.spec.substeps
        data = data.replace(
            qpos=data.qpos.at[index.qpos].set(position.reshape(-1)),
            qvel=data.qvel.at[index.dof].set(velocity.reshape(-1)),
            ctrl=data.ctrl.at[index.control].set(acceleration.reshape(-1)),
        )

        def substep(data: mjx.Data, obstacle: Array):
            now = data.qpos[index.qpos].reshape(shape), data.qvel[index.dof].reshape(shape)
            data = data.replace(mocap_pos=data.mocap_pos.at[index.obstacle_mocap, :2].set(obstacle))
            data = data.tree_replace({"_impl.overflow": jnp.zeros_like(data._impl.overflow)})  # pyright: ignore
            data = mjx.step(self._model, data)
            full = (data._impl.overflow & int(_LOST)) > 0  # pyright: ignore
            return data, (*now, data.sensordata, full)

        # A step tells positions, sensors and overflow of the state before it: k + 1 steps tell those of states 0..k.
        _, (positions, velocities, sensors, full) = jax.lax.scan(substep, data, path)
        return Seen(
            position=positions[1:],
            velocity=velocities[k],
            sensors=sensors[1:],
            full=full[1:].reshape(k) & can_touch(self.spec),
        )
