"""The environment: `reset(keys)`, `step(state, acceleration)`. Holds constants only; all that changes is in `State`."""

from dataclasses import replace
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key

from envs.config import SpawnConfig
from envs.dynamics import limited
from envs.engines import make_engine
from envs.engines.engine import Engine
from envs.record import Array, record
from envs.spawn import check_spawn, spawn, too_dense
from envs.state import Contacts, State
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec


@record
class Transition:
    """What one control step brought."""

    state: State
    contacts: Contacts
    terminated: Bool[Array, " S"]
    """The scene ended by what happened in it: a contact, when `terminate_on_contact` is set."""
    truncated: Bool[Array, " S"]
    """The scene ended because `horizon` steps are over."""


def scene_keys(seed: int, scenes: Int[Array, " S"] | range) -> Key[Array, " S"]:
    """One key per scene from a seed and global scene numbers: scene 7 of seed 0 is the same in every batch."""
    return jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(jnp.asarray(np.asarray(scenes), jnp.uint32))


def check_obstacles(state: State, spec: SceneSpec) -> None:
    """Raises SpecError where an obstacle of a state made by hand outruns `max_speed`: it could cross a body unseen."""
    if np.asarray(_outrun(state, spec)).any():
        speed = np.linalg.norm(np.asarray(state.obstacle_velocity), axis=-1).max()
        raise SpecError("obstacle_velocity", float(speed), f"at most max_speed = {spec.max_speed} m/s with contacts on")


def _outrun(state: State, spec: SceneSpec) -> Bool[Array, " S"]:
    """Whether a moving obstacle of the scene is faster than contacts allow, or not finite."""
    if not (spec.moving_obstacles and spec.contacts):
        return jnp.zeros(len(state.position), bool)
    square = jnp.sum(jnp.asarray(state.obstacle_velocity) ** 2, axis=-1)
    within = square <= spec.max_speed**2 * (1 + 1e-5)  # float32 may round a speed at the limit up
    return (~within & state.obstacle_present).any(axis=1)


@lru_cache(maxsize=16)
def _compiled_spawn(spec: SceneSpec, config: SpawnConfig):
    """Shared by all environments of equal scenes; the latest are kept, as programs take room in a process."""
    return jax.jit(partial(spawn, spec=spec, config=config))


class SwarmEnv:
    """S scenes at once. `step` is callable inside `jit` and `lax.scan`; so is `spawn`; `reset` checks and may raise.

    Args:
      spec: the scene. engine: a name (`auto`, `native`, `mjx`) or an engine made for the same spec.
      spawn: where scenes start. horizon: control steps per episode. terminate_on_contact: end a scene at any contact.
    """

    def __init__(
        self,
        spec: SceneSpec,
        *,
        engine: str | Engine = "auto",
        spawn: SpawnConfig | None = None,
        horizon: int = 50,
        terminate_on_contact: bool = False,
    ) -> None:
        if horizon < 1:
            raise SpecError("horizon", horizon, "at least 1 control step")
        self.spec = spec
        self.spawn_config = SpawnConfig() if spawn is None else spawn
        check_spawn(spec, self.spawn_config)
        self.engine = make_engine(spec, engine) if isinstance(engine, str) else engine
        if self.engine.spec != spec:
            raise SpecError("engine", self.engine.spec, "an engine made for the environment's spec")
        self.horizon = horizon
        self.terminate_on_contact = terminate_on_contact

    def spawn(self, keys: Key[Array, " S"]) -> tuple[State, Bool[Array, " S"]]:
        """Starting states and whether each scene found room for its bodies."""
        return spawn(keys, self.spec, self.spawn_config)

    def reset(self, keys: Key[Array, " S"]) -> State:
        """Starting states. Raises SpawnError when a scene has no room; inside `jit` use `spawn`."""
        state, ok = _compiled_spawn(self.spec, self.spawn_config)(keys)
        failed = int(np.sum(~np.asarray(ok)))
        if failed:
            raise too_dense(self.spec, self.spawn_config, failed, len(ok))
        check_obstacles(state, self.spec)
        return state

    def step(self, state: State, acceleration: Float[Array, "S N 2"]) -> Transition:
        """One control step. `acceleration` [m/s^2] is clipped to the limits, and absent agents do nothing.

        A scene with a non-finite state or acceleration, or with an obstacle that outruns the speed limit (see
        `check_obstacles`), never reaches the engine: its bodies become NaN and stay so.
        """
        finite = jnp.isfinite(acceleration).all((1, 2)) & jnp.isfinite(state.position).all((1, 2))
        finite &= jnp.isfinite(state.velocity).all((1, 2)) & jnp.isfinite(state.obstacle).all((1, 2))
        finite &= ~_outrun(state, self.spec)

        def safe(x: Array, instead: Array | int = 0) -> Array:
            return jnp.where(finite[:, None, None], x, instead)

        wanted = jnp.where(state.agent_present[..., None], safe(acceleration), 0)
        # A sick scene's bodies wait where absent ones do: in one place they would fill the engine's contacts.
        agents, obstacles = (jnp.asarray(p, state.position.dtype).reshape(-1, 2) for p in self.spec.parking())
        sound = replace(
            state,
            position=safe(state.position, agents),
            velocity=safe(state.velocity),
            obstacle=safe(state.obstacle, obstacles),
            obstacle_velocity=safe(state.obstacle_velocity),
        )
        executed = limited(sound.velocity, wanted, self.spec)
        after, contacts = self.engine.step(sound, executed)
        contacts = jax.tree.map(lambda x: jnp.where(finite.reshape(-1, *[1] * (x.ndim - 1)), x, 0), contacts)

        def sick(x: Array) -> Array:
            return jnp.where(finite[:, None, None], x, jnp.nan).astype(x.dtype)

        step = state.step + 1
        after = replace(
            after,
            position=sick(after.position),
            velocity=sick(after.velocity),
            obstacle=jnp.where(finite[:, None, None], after.obstacle, state.obstacle),
            obstacle_velocity=state.obstacle_velocity,
            step=step,
        )
        touched = (contacts.agent_states + contacts.obstacle_states + contacts.wall_states).any(axis=1)
        return Transition(
            state=after,
            contacts=contacts,
            terminated=touched & self.terminate_on_contact,
            truncated=step >= self.horizon,
        )
