"""Checkpoints through orbax: the full state of training, atomic, and what a model needs to be used without it."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from envs.plain import completed, from_plain, plain
from gnn.config import AnyModelConfig, config_kinds
from gnn.decode import Integrator
from gnn.family import Params, Predict
from gnn.features import Scales
from gnn.ranges import joined
from gnn.registry import make_family
from swarm_mjcf.errors import SwarmError

_LOG = logging.getLogger(__name__)
logging.getLogger("absl").setLevel(logging.CRITICAL)  # orbax reports every save, and traces what it raises anyway


class CheckpointError(SwarmError):
    """A checkpoint is missing, unreadable, of other settings, or cannot be written."""


@dataclass(frozen=True)
class Model:
    """A trained model: weights and all that decoding needs."""

    config: AnyModelConfig
    scales: Scales
    integrator: Integrator
    params: Params
    about: dict
    """Plain JSON: preset, step, training settings and data it was made with."""

    @property
    def trained_on(self) -> list[dict]:
        """Provenance of all data that it has learned from: every part of a mix, and what was there before tuning."""

        def parts(about: dict) -> list[dict]:
            before = about.get("initial")
            return [*about["data"].get("mixed", [about["data"]]), *(parts(before) if before else [])]

        return parts(self.about)

    @property
    def seen(self) -> dict[str, list[float]] | None:
        """Range of all data that it has learned from (`gnn.ranges`), also before tuning; None where none is stored."""
        ranges, about = [], self.about
        while about:
            ranges += [about["range"]] if about.get("range") else []
            about = about.get("initial")
        return joined(ranges) if ranges else None

    @cached_property
    def predict(self) -> Predict:
        """`predict(params, history (B, W, V, 4), graph, horizon=h) -> (B, h, V, 4)`."""
        return make_family(self.config, self.scales, self.integrator).predict


class Checkpoints:
    """The checkpoints of one run in `folder`, newest two kept. A save is complete or absent; leftovers are removed."""

    def __init__(self, folder: str | Path, *, read_only: bool = False) -> None:
        self.folder = Path(folder).absolute()
        # Read-only leaves the unfinished save of a training that runs beside us alone.
        options = ocp.CheckpointManagerOptions(
            max_to_keep=None if read_only else 2,
            cleanup_tmp_directories=not read_only,
            read_only=read_only,
            enable_async_checkpointing=False,
        )
        with _explained(self.folder, "opened"):
            self._manager = ocp.CheckpointManager(self.folder, options=options)

    def latest(self) -> int | None:
        """Step of the newest whole checkpoint."""
        return self._manager.latest_step()

    def save(self, step: int, state: dict, about: dict) -> None:
        """Writes the full state and the description."""
        with _explained(self.folder, "written"):
            self._manager.save(
                step,
                args=ocp.args.Composite(state=ocp.args.StandardSave(state), about=ocp.args.JsonSave(about)),
                force=True,
            )
            self._manager.wait_until_finished()

    def about(self, step: int) -> dict:
        """The description saved with a checkpoint."""
        with _explained(self.folder / str(step), "read"):
            return self._manager.restore(step, args=ocp.args.Composite(about=ocp.args.JsonRestore()))["about"]

    def restore(self, step: int, like: dict | None = None) -> dict:
        """The state of a checkpoint, in the structure and dtypes of `like`, or as it was saved."""
        with _explained(self.folder / str(step), "read"):
            template = None if like is None else jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
            # A checkpoint may come from other devices than there are here.
            here = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
            args = ocp.args.Composite(state=ocp.args.StandardRestore(template, fallback_sharding=here))
            state = self._manager.restore(step, args=args)["state"]
        # Bound to no device, like the state of a run that begins: for arrays that are, JAX compiles everything anew.
        return jax.tree.map(jnp.asarray, jax.device_get(state))

    def newest(self, like: dict | None = None) -> tuple[int, dict, dict] | None:
        """`(step, about, state)` of the newest checkpoint that can be read, None where there is none.

        A damaged one is passed over with a warning in the log. Raises CheckpointError when all are damaged.
        """
        damaged: list[CheckpointError] = []
        for step in sorted(self._manager.all_steps(), reverse=True):
            try:
                found = step, self.about(step), self.restore(step, like)
            except CheckpointError as error:
                damaged.append(error)
                continue
            for error in damaged:
                _LOG.warning("%s; step %d is taken instead", error, step)
            return found
        if damaged:
            raise damaged[0]
        return None

    def drop_after(self, step: int) -> None:
        """Removes checkpoints newer than `step`: the damaged ones that `newest` passed over."""
        with _explained(self.folder, "removed"):
            for newer in self._manager.all_steps():
                if newer > step:
                    self._manager.delete(newer)

    def close(self) -> None:
        """Releases the folder."""
        self._manager.close()


def describe(config: AnyModelConfig, scales: Scales, integrator: Integrator) -> dict:
    """What `load_model` needs besides the weights, as plain JSON (floats survive exactly)."""
    return {
        "family": type(config).__name__,
        "model": plain(config),
        "scales": {name: np.asarray(value, np.float64).tolist() for name, value in vars(scales).items()},
        "integrator": plain(integrator),
    }


def check_same(folder: Path, had: dict, about: dict, **kinds: type) -> None:
    """Raises CheckpointError where a run that is gone on with was of other settings. A setting that did not exist when
    `had` was stored counts as its default where `kinds` names the type of an entry, also of the initial model."""

    def now(had: dict) -> dict:
        known = {name: completed(kind, had[name]) for name, kind in kinds.items() if name in had}
        return had | known | ({"initial": now(had["initial"])} if had.get("initial") else {})

    had, about = now(had), now(about)
    different = [key for key in about if had.get(key) != about[key]]
    if different:
        raise CheckpointError(
            f"{folder}: holds a run with other settings ({', '.join(different)} differ); take another run name"
        )


def load_model(folder: str | Path) -> Model:
    """The newest model in a checkpoint folder (`runs/NAME/checkpoints`). Raises CheckpointError."""
    folder = Path(folder)
    if not folder.is_dir():
        raise CheckpointError(f"{folder}: no such checkpoint folder; `swarmnet train` makes one")
    checkpoints = Checkpoints(folder, read_only=True)
    found = checkpoints.newest()
    checkpoints.close()
    if found is None:
        raise CheckpointError(f"{folder}: holds no whole checkpoint")
    step, about, state = found
    with _explained(folder, "read"):
        kind = config_kinds()[about.get("family", "ModelConfig")]  # older checkpoints knew one family
        config = from_plain(kind, about["model"])
        scales = Scales(**{name: jnp.asarray(value, jnp.float32) for name, value in about["scales"].items()})
        integrator = from_plain(Integrator, about["integrator"])
    return Model(config, scales, integrator, state["params"], about | {"step": step})


@contextmanager
def _explained(folder: Path, what: str) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{folder}: checkpoint cannot be {what} ({reason})") from error
