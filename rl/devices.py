"""Scenes spread over devices: the weights on all of them, a part of the scenes on each, sums over all.

The devices may be those of several processes, on one machine or on many: each runs the same program (`initialise`).
"""

import contextlib
import logging
import os
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int

from envs.record import Array
from swarm_mjcf.errors import SpecError, SwarmError

_LOG = logging.getLogger(__name__)
AXIS = "scenes"
SHARED = "runner"
"""The entry of a learner's state that is spread; all others are on every device."""
PATIENCE, SILENCE, FAREWELL = 300, 60, 30
"""Longest time [s] until all processes have met, without a sign of life of one, and between the ends of two."""


class ProcessError(SwarmError):
    """The processes of a run do not meet, or one of them has ended before the others."""


@dataclass(frozen=True)
class Split:
    """What one device knows of the others."""

    slots: Int[Array, " S"]
    """Global numbers of the scenes that it has."""
    total: Callable[[Array], Array]
    """Sum over devices."""


def initialise(
    coordinator: str | None = None,
    processes: int | None = None,
    process: int | None = None,
    *,
    patience: int = PATIENCE,
    silence: int = SILENCE,
) -> None:
    """Joins the processes of a run; before anything else that uses JAX's devices. A run of one process needs none.

    Args:
      coordinator: HOST:PORT of process 0, as the others reach it; processes: how many there are; process: which this
        is, from 0. Without all three SLURM's are taken where `srun` started several tasks, each with the GPU of its
        number on the machine; else there is one process.
      patience: longest time until all have met [s]; silence: time without a sign of life of a process after which all
        others end [s]. Where one of the two has passed JAX ends this process and writes the reason to stderr.

    Raises SpecError for half of an address, ProcessError where process 0 cannot listen or JAX has been used already.
    """
    given = {"coordinator": coordinator, "processes": processes, "process": process}
    missing = [name for name, value in given.items() if value is None]
    address: dict[str, Any]
    if len(missing) == len(given):
        if int(os.environ.get("SLURM_STEP_NUM_TASKS", "1")) == 1:
            return
        where, address = "the address that SLURM gives", {"cluster_detection_method": "slurm"}
    elif coordinator is None or processes is None or process is None:
        raise SpecError(missing[0], None, f"a value: {', '.join(given)} are given together or not at all")
    else:
        host, port = _checked(coordinator, processes, process)
        if processes == 1:
            return
        where = coordinator
        address = {
            "coordinator_address": coordinator,
            "num_processes": processes,
            "process_id": process,
            "cluster_detection_method": "deactivate",
        }
        if host == "127.0.0.1":  # nobody else is to reach it
            address["coordinator_bind_address"] = coordinator
        if process == 0:
            _must_be_free(host, port)
    # JAX's watch for notices of an end would swallow SIGTERM.
    jax.config.update("jax_enable_preemption_service", False)
    _LOG.warning("waiting for all processes to meet at %s, at most %d s", where, patience)
    try:
        jax.distributed.initialize(
            **address,
            initialization_timeout=patience,
            heartbeat_timeout_seconds=silence,
            shutdown_timeout_seconds=FAREWELL,
        )
    except (RuntimeError, ValueError) as error:
        raise ProcessError(f"processes cannot meet at {where}: {_first_line(error)}") from error


def _checked(coordinator: str, processes: int, process: int) -> tuple[str, int]:
    """Host and port."""
    host, _, port = coordinator.rpartition(":")
    if not (host and port.isdigit() and 0 < int(port) < 2**16):
        raise SpecError("coordinator", coordinator, "HOST:PORT with a port from 1 to 65535, as 10.0.0.1:1234")
    if processes < 1:
        raise SpecError("processes", processes, "at least 1")
    if not 0 <= process < processes:
        raise SpecError("process", process, f"from 0 to {processes - 1}: which of the {processes} processes this is")
    return host, int(port)


def _must_be_free(host: str, port: int) -> None:
    """JAX would write that the port is taken and wait for the others all the same."""
    try:
        socket.create_server(("127.0.0.1" if host == "127.0.0.1" else "", port)).close()
    except OSError as error:
        raise ProcessError(f"process 0 cannot listen at port {port} ({error.strerror}); take another") from error


def leads() -> bool:
    """Whether this is the process that writes and reports: the first."""
    return jax.process_index() == 0


def agreed(*flags: bool) -> tuple[bool, ...]:
    """The first process's flags, in all: what depends on a clock must not differ. All processes must call it."""
    if jax.process_count() == 1:
        return flags
    return tuple(bool(flag) for flag in multihost_utils.broadcast_one_to_all(np.array(flags)))


@contextlib.contextmanager
def together() -> Iterator[None]:
    """Around work that needs all processes. Raises ProcessError where another one has ended."""
    try:
        yield
    except (RuntimeError, ValueError) as error:  # JAX raises either
        if jax.process_count() == 1 or isinstance(error, SwarmError):
            raise
        raise ProcessError(
            f"process {jax.process_index()} of {jax.process_count()} cannot go on without the others, of which one has "
            f"probably ended ({_first_line(error)}); start all of them again, they go on from the newest checkpoint"
        ) from error


def device_mesh(devices: int | None = None) -> Mesh | None:
    """A mesh of that many devices of every process (all by default); None where that is one in all.

    Raises SpecError for more than there are.
    """
    each = [jax.local_devices(process_index=process) for process in range(jax.process_count())]
    least = min(map(len, each))
    if devices is not None and not 1 <= devices <= least:
        raise SpecError("devices", devices, f"from 1 to {least}, the devices that JAX sees in every process")
    chosen = [device for own in each for device in own[:devices]]
    return Mesh(np.array(chosen), (AXIS,)) if len(chosen) > 1 else None


def compiled(function: Callable[..., Any], mesh: Mesh | None, scenes: int, out: Any) -> Callable[..., Any]:
    """`function(split, *states)` as one compiled function of states, dicts whose `runner` has the scenes first.

    `out`: how the results are spread, a prefix of their tree. Raises SpecError for scenes that devices cannot share.
    """
    if mesh is None:
        return jax.jit(lambda *states: function(Split(jnp.arange(scenes), lambda x: x), *states))
    devices = mesh.devices.size
    if scenes % devices:
        raise SpecError("scenes", scenes, f"a multiple of the number of devices, {devices}")
    here = scenes // devices

    def part(*states: dict) -> Any:
        first = jax.lax.axis_index(AXIS) * here
        return function(Split(first + jnp.arange(here), lambda x: jax.lax.psum(x, AXIS)), *states)

    def spread(*states: dict) -> Any:
        entering = tuple(_specs(state) for state in states)
        # Sums over devices are ours (`total`): JAX is not to add its own to gradients.
        mapped = jax.shard_map(part, mesh=mesh, in_specs=entering, out_specs=out, check_vma=False)
        return mapped(*states)

    return jax.jit(spread)


def _specs(state: dict) -> dict:
    return {name: PartitionSpec(AXIS) if name == SHARED else PartitionSpec() for name in state}


def gathered(state: Any, mesh: Mesh | None) -> Any:
    """The state as NumPy arrays, whole in every process: it knows of no devices. All processes must call it."""
    if mesh is not None:
        state = jax.jit(_same, out_shardings=NamedSharding(mesh, PartitionSpec()))(state)
    return jax.device_get(state)


def placed(state: Any, like: Any, mesh: Mesh | None) -> Any:
    """The inverse: arrays spread as those of `like` are. On one device bound to none, like those of a run that begins:
    for arrays that are, JAX compiles once more."""
    if mesh is None:
        return jax.tree.map(jnp.asarray, state)

    def place(x: Any, there: jax.Array) -> jax.Array:
        return jax.make_array_from_callback(there.shape, there.sharding, lambda part: np.asarray(x)[part])

    return jax.tree.map(place, state, like)


def _same(x: Any) -> Any:
    return x


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
