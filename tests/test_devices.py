"""PPO on several devices and in several processes does what it does on one; lost partners and bad addresses are told.

All happens in processes of their own, because JAX counts its devices once; they are killed in the end.
"""

import contextlib
import re
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import assert_same
from learning import environment

from gnn.checkpoint import Checkpoints, load_model
from gnn.metrics import read_metrics
from rl.devices import ProcessError, agreed, device_mesh, initialise
from swarm_mjcf.errors import SpecError
from swarmnet.cli import parse

LEARN = [str(Path(__file__).parent / "two_processes.py")]
ADD = [
    "-c",
    """
import logging, os, signal, sys
import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from rl.devices import AXIS, device_mesh, initialise, together

logging.basicConfig(format="%(message)s")
patience, *address = sys.argv[1:]
initialise(*address[:1], *map(int, address[1:]), patience=int(patience), silence=5)
spec = PartitionSpec(AXIS)
total = jax.jit(jax.shard_map(lambda: jax.lax.psum(jnp.ones(1), AXIS), mesh=device_mesh(), in_specs=(), out_specs=spec))
with together():
    for _ in range(2):
        print("sum:", total().addressable_data(0)[0], flush=True)
        if jax.process_index() == 1:
            os.kill(os.getpid(), signal.SIGKILL)
""",
]
"""Sums over all devices, until process 1 dies."""
LONGEST = 240
"""Any process may take [s]; compiling takes a tenth of it on a core of its own."""
CLOCKS = {"seconds", "spent", "env_steps_per_second"}


@contextlib.contextmanager
def started(what: list[str], *arguments: object, **variables: str) -> Iterator[subprocess.Popen]:
    """A Python process on the CPU, with one device if `variables` do not say otherwise; killed at the end."""
    with subprocess.Popen(
        [sys.executable, *what, *map(str, arguments)],
        env=environment()
        | {"JAX_PLATFORMS": "cpu", "JAX_CPU_COLLECTIVES_IMPLEMENTATION": "gloo", "XLA_FLAGS": "", **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def finished(process: subprocess.Popen) -> tuple[int, str]:
    """Exit code and output. Raises TimeoutExpired."""
    output, _ = process.communicate(timeout=LONGEST)
    return process.returncode, output


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Folder with runs on 1 and 4 devices of one process; what the script wrote is in `output`."""
    folder = tmp_path_factory.mktemp("devices")
    with started(LEARN, "devices", folder, XLA_FLAGS="--xla_force_host_platform_device_count=4") as process:
        code, output = finished(process)
    assert code == 0, output
    (folder / "output").write_text(output)
    return folder


def result(run: Path) -> tuple[dict, list[dict]]:
    """The full state after the last of two iterations, and the metrics of both without what the clock says."""
    checkpoints = Checkpoints(run / "checkpoints", read_only=True)
    step, _, state = checkpoints.newest()
    checkpoints.close()
    assert step == 2
    rows = read_metrics(run / "metrics.jsonl")
    return state, [{name: value for name, value in row.items() if name not in CLOCKS} for row in rows]


def assert_close(run: Path, other: Path) -> None:
    """Sums over scenes are made in another order: a relative 1e-7 of gradients of about 1 with an Adam that moves a
    weight by at most 3e-4 in each of 8 steps, and by (3e-4 / 1e-5) times the error where the gradient is nearly 0.
    """
    (state, rows), (expected, expected_rows) = result(run), result(other)
    close = {"rtol": 1e-4, "atol": 1e-5}
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **close), state, expected)
    assert [row["step"] for row in rows] == [1, 2]
    for row, wanted in zip(rows, expected_rows, strict=True):
        assert row.keys() == wanted.keys()
        np.testing.assert_allclose(list(row.values()), list(wanted.values()), **close)


def test_the_number_of_devices_changes_rounding_alone(runs: Path):
    _, rows = result(runs / "1")
    assert all(row["contact_events"] > 0 and row["experience"] < 8 * 4 and row["updates"] == 1 for row in rows)
    assert_close(runs / "4", runs / "1")


def test_a_run_goes_on_to_the_bit_on_as_many_devices_and_nearly_so_on_fewer(runs: Path):
    (state, rows), (expected, expected_rows) = result(runs / "stopped"), result(runs / "4")
    assert_same(state, expected)
    assert rows == expected_rows
    assert_close(runs / "moved", runs / "1")


def test_a_model_of_four_devices_is_one_like_any_other(runs: Path):
    """Here is one device: checkpoints know of no devices."""
    model, alone = (load_model(runs / devices / "checkpoints") for devices in ("4", "1"))
    assert model.about == alone.about
    assert jax.tree.structure(model.params) == jax.tree.structure(alone.params)


def test_what_devices_cannot_share_is_refused(runs: Path):
    said = (runs / "output").read_text()
    assert "SpecError: scenes: 6 was given, allowed is a multiple of the number of devices, 4" in said
    assert "SpecError: devices: 5 was given, allowed is from 1 to 4" in said
    assert "ProcessError: processes cannot meet at 127.0.0.1:1: jax.distributed.initialize() must be called" in said
    for devices in (0, jax.local_device_count() + 1):
        with pytest.raises(SpecError, match="devices"):
            device_mesh(devices)


def test_two_processes_are_as_one(runs: Path):
    """Each is stopped after the first iteration and goes on; one of them writes."""
    address = f"127.0.0.1:{free_port()}"
    given = (LEARN, "pair", runs / "pair", address)
    with started(*given, 0) as first, started(*given, 1) as second:
        for process in (first, second):
            code, output = finished(process)
            assert code == 0, output
    assert_close(runs / "pair", runs / "1")
    assert load_model(runs / "pair" / "checkpoints").about == load_model(runs / "1" / "checkpoints").about
    assert sorted(path.name for path in (runs / "pair" / "checkpoints").iterdir()) == ["1", "2"]


def test_a_process_that_has_lost_its_partner_says_so_and_ends():
    """Both find each other through the variables that SLURM sets."""
    slurm = {
        "SLURM_JOB_ID": "7",
        "SLURM_STEP_NODELIST": "127.0.0.1",
        "SLURM_STEP_NUM_TASKS": "2",
        "SLURM_NTASKS": "2",
        "JAX_COORDINATOR_PORT": str(free_port()),
    }
    first, second = ({**slurm, "SLURM_PROCID": number, "SLURM_LOCALID": number} for number in "01")
    with started(ADD, 60, **first) as survivor, started(ADD, 60, **second) as victim:
        assert finished(victim)[0] == -signal.SIGKILL
        _, output = finished(survivor)
    assert output.count("sum: 2") == 1
    assert "ProcessError: process 0 of 2 cannot go on without the others" in output


def test_a_process_to_which_nobody_comes_gives_up():
    address = f"127.0.0.1:{free_port()}"
    with started(ADD, 3, address, 2, 0) as process:
        code, output = finished(process)
    assert code != 0
    assert f"waiting for all processes to meet at {address}, at most 3 s" in output
    assert "DEADLINE_EXCEEDED" in output


@pytest.mark.parametrize(
    ("given", "field"),
    [
        (("127.0.0.1:1234", 2, None), "process"),
        ((None, 2, 0), "coordinator"),
        (("127.0.0.1", 2, 0), "coordinator"),
        (("127.0.0.1:70000", 2, 0), "coordinator"),
        ((":1234", 2, 0), "coordinator"),
        (("127.0.0.1:1234", 0, 0), "processes"),
        (("127.0.0.1:1234", 2, 2), "process"),
        (("127.0.0.1:1234", 2, -1), "process"),
    ],
)
def test_half_an_address_and_absurd_ones_are_refused_by_name(given: tuple, field: str):
    with pytest.raises(SpecError) as caught:
        initialise(*given)
    assert caught.value.field == field


def test_a_port_that_is_taken_is_named():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(ProcessError, match=f"port {port}"):
            initialise(f"127.0.0.1:{port}", 2, 0)


def test_one_process_needs_nobody(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("SLURM_STEP_NUM_TASKS", raising=False)
    initialise()
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "1")
    initialise()
    initialise("127.0.0.1:1234", 1, 0)
    assert not jax.distributed.is_initialized()
    assert agreed(True, False) == (True, False)


def test_the_commands_of_the_documents_page_exist():
    page = (Path(__file__).parent.parent / "docs/scaling.md").read_text()
    commands = re.findall(r"^    .*?swarmnet (.*)$", page, re.MULTILINE)
    assert len(commands) == 5
    for command in commands:
        parse(shlex.split(command))
