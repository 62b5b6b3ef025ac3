"""What `--policy X` names: an expert, a trained model, a Python function, or recorded trajectories."""

import importlib
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Key

from envs.config import World
from envs.experts.config import EXPERTS, Interaction, VicsekConfig
from envs.experts.registry import make_expert
from envs.policy import Policy
from envs.record import Array
from envs.state import State
from envs.storage import load
from envs.trajectories import Trajectories
from gnn.checkpoint import Model, load_model
from gnn.decentral import make_decentralised
from gnn.decode import make_policy
from repair.config import ConstraintConfig
from repair.constraints.registry import make_constraint
from repair.filter import make_filtered
from swarm_mjcf.errors import SpecError, SwarmError

EXPERT = "expert"
"""The name of a preset's own expert."""


class PolicyError(SwarmError):
    """A policy cannot be found, imported or used; the message says which, why, and what would do."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A policy, or what one has done.

    One of `make`, `model` and `recording` says what it is; `folder` is the run folder of a model.
    """

    given: str
    """As it was named."""
    name: str
    """For tables and figures."""
    make: Callable[[World], Policy] | None = None
    """The policy for a world, with `params` None."""
    model: Model | None = None
    recording: Trajectories | None = None
    folder: Path | None = None
    nearest: int | None = None
    """Each agent runs the model on its own and perceives only this many others, the nearest (`gnn.decentral`)."""
    radius: float | None = None
    """The same for others and obstacles closer than this [m]."""
    shield: ConstraintConfig | None = None
    """A run-time filter lets through what this constraint allows, else the nearest action that it does."""

    @property
    def decentralised(self) -> bool:
        """Whether each agent runs the model on what it perceives; else one pass sees the whole scene."""
        return self.nearest is not None or self.radius is not None

    @property
    def foreign(self) -> bool:
        """Whether it is a function of the user's."""
        return self.make is not None and self.given != EXPERT and self.given not in EXPERTS

    @property
    def acts(self) -> bool:
        """Whether it can steer agents; a model that predicts changes of state cannot, nor can a recording."""
        return self.recording is None and (self.model is None or self.model.config.acts)

    def policy(self, world: World) -> tuple[Policy, object]:
        """The policy for a world, and its parameters. Raises SwarmError for what cannot act."""
        policy, params = self._bare(world)
        if self.shield is not None:
            constraint = make_constraint(self.shield, world.scene)
            policy = make_filtered(policy, constraint, world.scene, world.scene, goal=world.scene.goal)
        return policy, params

    def _bare(self, world: World) -> tuple[Policy, object]:
        if self.model is not None:
            sight = {"nearest": self.nearest, "radius": self.radius} if self.decentralised else {}
            make = make_decentralised if sight else make_policy
            return make(self.model.config, self.model.scales, goal=world.scene.goal, **sight), self.model.params
        if self.make is None:
            raise PolicyError(f"{self.given}: recorded trajectories cannot steer agents")
        return self.make(world), None


def find_policy(given: str) -> Source:
    """What a word names: `expert` or an expert's name; a run folder or its checkpoints; a file of trajectories ending
    in .h5; or `module:function`, imported from the working folder or from what is installed.

    A function is `function(state, params, key) -> acceleration (S, N, 2) [m/s^2]`: `state` is an `envs.state.State`,
    `params` is None, and `key` holds one random key per scene. With parentheses, `module:make()`, it is called without
    arguments first, and what it returns is the policy. Functions that need NumPy arrays work too (see `checked`).

    Raises:
      PolicyError: there is nothing of that name, or it cannot be imported.
      SwarmError: a checkpoint or file cannot be read.
    """
    if given == EXPERT or given in EXPERTS:
        return Source(given=given, name=given, make=lambda world: _expert(given, world))
    path = Path(given)
    if path.suffix == ".h5":
        return Source(given=given, name=path.stem, recording=load(path))
    if path.is_dir():
        return model_source(path)
    if ":" in given:
        function = _imported(given)
        return Source(given=given, name=given, make=lambda world: function)
    raise PolicyError(
        f"policy {given!r}: not found; it can be expert (the world's own), {', '.join(EXPERTS)}, a run folder with a "
        "trained model, a file of trajectories ending in .h5, or a Python function as module:function"
    )


def model_source(folder: Path) -> Source:
    """The newest model of a run folder, or of a folder of checkpoints."""
    run = folder if (folder / "checkpoints").is_dir() or folder.name != "checkpoints" else folder.parent
    model = load_model(run / "checkpoints")
    return Source(given=str(folder), name=f"swarmnet {model.about['preset']}", model=model, folder=run)


def with_sight(source: Source, *, nearest: int | None = None, radius: float | None = None) -> Source:
    """The same model, run by each agent on the `nearest` others and on whatever is closer than `radius` [m].

    Raises SpecError for anything but a trained model that acts, and for numbers that are no limit.
    """
    given = {"nearest": nearest, "radius": radius}
    limits = {field: value for field, value in given.items() if value is not None}
    if not limits:
        return source
    if source.model is None or not source.acts:
        field, value = next(iter(limits.items()))
        raise SpecError(field, value, f"nothing beside {source.given}: it limits what agents with a trained model see")
    Interaction(**limits)
    words = {"nearest": f"{nearest} nearest", "radius": f"within {radius} m"}
    return replace(source, name=", ".join([source.name, *(words[field] for field in limits)]), **limits)


def with_shield(source: Source, shield: ConstraintConfig | None) -> Source:
    """The same policy behind a run-time filter. Raises SpecError for what does not act."""
    if shield is None:
        return source
    if not source.acts:
        raise SpecError("filter", shield.name, f"nothing beside {source.given}: it does not act")
    return replace(source, name=f"{source.name}, filtered", shield=shield)


def _expert(name: str, world: World) -> Policy:
    """The world's own expert where it is of that kind, else one with that kind's default parameters."""
    config = world.expert if name == EXPERT or type(world.expert) is EXPERTS[name] else EXPERTS[name]()
    if isinstance(config, VicsekConfig) and config.dt != world.scene.dt:
        config = replace(config, dt=world.scene.dt)
    return make_expert(config)


def _imported(given: str) -> Policy:
    module_name, _, attribute = given.partition(":")
    makes = attribute.endswith("()")
    attribute = attribute.removesuffix("()")
    module = _module(given, module_name)
    found: Any = getattr(module, attribute, None)
    if found is None:
        public = [name for name, value in vars(module).items() if callable(value) and not name.startswith("_")]
        raise PolicyError(
            f"policy {given!r}: {module_name} has no {attribute!r}; it has {', '.join(public) or 'no functions'}"
        )
    if makes:
        found = _called(given, found)
    if not callable(found):
        raise PolicyError(f"policy {given!r}: is of type {type(found).__name__}, not a function")
    return cast(Policy, found)


def _module(given: str, name: str) -> ModuleType:
    # As `python -m` does: the working folder comes first.
    sys.path.insert(0, os.getcwd())
    try:
        importlib.invalidate_caches()
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = f"there is no module {error.name!r}"
        where = f" in {os.getcwd()} or among what is installed" if error.name == name.split(".")[0] else ""
        raise PolicyError(f"policy {given!r}: {missing}{where}") from error
    except Exception as error:
        raise PolicyError(f"policy {given!r}: {name} cannot be imported ({_said(error)})") from error
    finally:
        sys.path.remove(os.getcwd())


def _called(given: str, make: Callable) -> Any:
    try:
        return make()
    except Exception as error:
        raise PolicyError(f"policy {given!r}: the call failed ({_said(error)})") from error


def checked(name: str, policy: Policy, params: object, state: State, keys: Key[Array, " S"]) -> Policy:
    """The policy, tried on real states; one that cannot be traced by JAX is wrapped to be called with NumPy arrays.

    A wrapped function is called once per control step for all scenes of a batch, gets the keys as plain integers
    (S, 2), and must not call JAX itself.

    Raises:
      PolicyError: it fails, or returns another shape than (S, N, 2), no real numbers, or NaN.
    """
    try:
        jax.eval_shape(policy, state, params, keys)
    except Exception as error:
        policy, found = _untraced(name, policy, params, state, keys, error)
    else:
        found = _tried(name, policy, state, params, keys)
    wanted = tuple(np.shape(state.position))
    if found.shape != wanted:
        raise PolicyError(
            f"policy {name!r}: returned shape {found.shape} for {_states(state)}, allowed is {wanted}: an acceleration "
            "[m/s^2] for each agent of each scene"
        )
    if not np.issubdtype(found.dtype, np.floating):
        raise PolicyError(f"policy {name!r}: returned {found.dtype}, allowed are floating-point accelerations [m/s^2]")
    bad = ~np.isfinite(found).all(axis=-1) & np.asarray(state.agent_present)
    if bad.any():
        scene, agent = (int(i) for i in np.argwhere(bad)[0])
        raise PolicyError(
            f"policy {name!r}: returned {found[scene, agent].tolist()} for agent {agent} of scene {scene} at the start "
            f"({int(bad.any(axis=1).sum())} of {len(bad)} scenes have such), allowed are finite accelerations [m/s^2]"
        )
    return policy


def _untraced(
    name: str, policy: Policy, params: object, state: State, keys: Key[Array, " S"], error: Exception
) -> tuple[Policy, np.ndarray]:
    """The wrapped policy and its answer, where NumPy arrays help; PolicyError with JAX's `error` where they do not."""
    try:
        found = policy(jax.tree.map(np.asarray, state), params, np.asarray(jax.random.key_data(keys)))
    except Exception:
        found = None
    if found is None or isinstance(found, jax.Array):  # what calls JAX must not be called back from it
        raise PolicyError(f"policy {name!r}: failed on {_states(state)} ({_said(error)})") from error
    return _hosted(policy), np.asarray(found)


def _tried(name: str, policy: Policy, state: State, params: object, keys: Key[Array, " S"]) -> np.ndarray:
    try:
        return np.asarray(policy(state, params, keys))
    except Exception as error:
        raise PolicyError(f"policy {name!r}: failed on {_states(state)} ({_said(error)})") from error


def _hosted(function: Policy) -> Policy:
    """A NumPy function as a policy that JAX can trace."""

    def policy(state: State, params: object, key: Key[Array, " S"]) -> Array:
        def call(state: State, data: Array) -> np.ndarray:
            found = function(jax.tree.map(np.asarray, state), params, np.asarray(data))
            return np.asarray(found, state.position.dtype)

        shape = jax.ShapeDtypeStruct(state.position.shape, state.position.dtype)
        return jax.pure_callback(call, shape, state, jax.random.key_data(key), vmap_method="sequential")

    return policy


def _states(state: State) -> str:
    scenes, agents, _ = np.shape(state.position)
    return f"{scenes} starting states of {agents} agents"


def _said(error: Exception) -> str:
    first = str(error).strip().splitlines()
    return f"{type(error).__name__}: {first[0]}" if first else type(error).__name__
