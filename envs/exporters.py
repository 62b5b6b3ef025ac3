"""Trajectories in other people's formats: long tables, the thesis author's arrays, and those of NRI and GNS.

Nothing is written half: every file appears under its name only when it is whole.
"""

import contextlib
import io
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from jaxtyping import Bool, Float, Int

from envs.importers.config import KINDS
from envs.importers.parquet_file import UNITS_KEY
from envs.trajectories import AGENT, GOAL, NO_EDGE, OBSTACLE, Trajectories
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.whole import WholeFile

FORMATS = ("csv", "parquet", "published", "nri", "gns")
UNITS = {"t": "s", "x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}
"""Of the long table's columns, as `swarmnet import` reads them from a Parquet file."""
PARTICLES = {AGENT: 5, OBSTACLE: 3, GOAL: 0}
"""GNS's particle types: 3 is kinematic (moved by nobody's force), the others are free."""


class ExportError(SwarmError):
    """These trajectories do not fit into that format, or it cannot be written."""


def export(
    trajectories: Trajectories,
    out: Path,
    format: str,
    *,
    partial: str = "refuse",
    split: str = "train",
    suffix: str = "",
    connectivity_radius: float | int | None = None,
) -> list[Path]:
    """Writes trajectories in a format and returns the files.

    Args:
      out: csv, parquet: the file; published: beginning of the names; nri, gns: a folder.
      partial: the formats without masks: `refuse` nodes that come and go, or `drop` them.
      split: nri, gns: train, valid or test, part of the names.
      suffix: nri: end of the names.
      connectivity_radius: gns: who sees whom [m]; None for everybody.

    Raises:
      SpecError: an option that does not exist. ExportError: trajectories that the format cannot hold.
    """
    if format not in FORMATS:
        raise SpecError("format", format, "one of " + ", ".join(FORMATS))
    if partial not in ("refuse", "drop"):
        raise SpecError("partial", partial, "refuse or drop")
    if split not in ("train", "valid", "test"):
        raise SpecError("split", split, "train, valid or test")
    if connectivity_radius is not None and not 0 < connectivity_radius < np.inf:
        raise SpecError("connectivity_radius", connectivity_radius, "a finite number above 0 [m]")
    if format == "csv":
        return _write({out: lambda file: pyarrow.csv.write_csv(long_table(trajectories), file)})
    if format == "parquet":
        return _write({out: lambda file: pyarrow.parquet.write_table(long_table(trajectories), file)})
    whole = without_partial(trajectories, drop=partial == "drop")
    if format == "published":
        arrays = published_arrays(whole)
        return _write({out.with_name(f"{out.name}_{name}.npy"): _npy(array) for name, array in arrays.items()})
    if format == "nri":
        arrays = nri_arrays(whole)
        return _write({out / f"{name}_{split}{suffix}.npy": _npy(array) for name, array in arrays.items()})
    if whole.position.shape[1] < 3:
        raise ExportError(f"gns: accelerations need 3 rows of a scene, there are {whole.position.shape[1]}")
    simulations = gns_simulations(whole)
    about = gns_metadata(whole, connectivity_radius)
    return _write(
        {
            out / f"{split}.npz": lambda file: _npz(file, simulations),
            out / "metadata.json": lambda file: file.write(json.dumps(about, indent=1).encode()),
        }
    )


def long_table(trajectories: Trajectories) -> pa.Table:
    """A row per scene, time and present node: run, t [s], id (number of the node), type, x, y [m], vx, vy [m/s].

    Read back with `--velocity file` it gives the same states, without rows at both ends in which nobody is. Units are
    in the schema's metadata.
    """
    t = trajectories
    run, row, node = (index.astype(np.int32) for index in np.nonzero(t.mask))
    cells = (run, row, node)
    kinds = pa.DictionaryArray.from_arrays(pa.array(t.kind[run, node].astype(np.int8)), pa.array(KINDS)).cast("string")
    return pa.table(
        {
            "run": run,
            "t": row * t.dt,
            "id": node,
            "type": kinds,
            "x": t.position[cells][:, 0],
            "y": t.position[cells][:, 1],
            "vx": t.velocity[cells][:, 0],
            "vy": t.velocity[cells][:, 1],
        }
    ).replace_schema_metadata({UNITS_KEY: json.dumps(UNITS).encode()})


def without_partial(trajectories: Trajectories, *, drop: bool) -> Trajectories:
    """The same with every node there all the time or never, and only scenes that have an agent.

    Raises ExportError when nodes come and go and may not be dropped, or when nobody stays.
    """
    t = trajectories
    always, ever = t.mask.all(axis=1), t.mask.any(axis=1)
    partial = ever & ~always
    if partial.any() and not drop:
        scene, node = (int(i) for i in np.argwhere(partial)[0])
        raise ExportError(
            f"{int(partial.sum())} nodes are there for part of their scene, first node {node} of scene {scene}, and "
            "this format has no masks; --partial drop leaves them out, a shorter --segment at import keeps more"
        )
    here = always[:, None, :]
    t = replace(
        t,
        position=np.where(here[..., None], t.position, 0),
        velocity=np.where(here[..., None], t.velocity, 0),
        mask=np.broadcast_to(here, t.mask.shape).copy(),
        edges=np.where(always[:, :, None] & always[:, None, :], t.edges, NO_EDGE).astype(t.edges.dtype),
    )
    kept = (always & (t.kind == AGENT)).any(axis=1)
    if not kept.any():
        raise ExportError("no scene has an agent that is there all the time; import with a shorter --segment")
    return t.take(np.flatnonzero(kept))


def published_arrays(
    trajectories: Trajectories,
) -> dict[str, Float[np.ndarray, "S T V 4"] | Int[np.ndarray, "S V V"] | Float[np.ndarray, "S T"]]:
    """`timeseries` (x, y, vx, vy), `edge` (types, source by target) and `time` [s] as the thesis's code reads them.

    Nodes are in the order goals, obstacles, agents; one that is never there is its padding: zeros without edges.
    """
    t = trajectories
    times = np.broadcast_to(np.arange(t.position.shape[1]) * t.dt, t.mask.shape[:2])
    states = np.concatenate([t.position, t.velocity], axis=-1)
    return {"timeseries": states, "edge": t.edges.astype(np.int64), "time": np.ascontiguousarray(times)}


def nri_arrays(trajectories: Trajectories) -> dict[str, np.ndarray]:
    """`loc`, `vel` (simulations, rows, 2, nodes) and `edges` (simulations, sender, receiver) of 0 and 1.

    Kipf et al. 2018, github.com/ethanfetaya/NRI: all simulations have the same atoms, and its loader maps edges by
    `int((e + 1) / 2)`, which leaves 0 and 1 as they are. Its train.py reads rows as senders; its own are symmetric.

    Raises ExportError for scenes of different nodes.
    """
    t = trajectories
    there = t.mask[:, 0]
    if not (there == there[0]).all():
        raise ExportError("scenes have different numbers of nodes; NRI needs the same atoms in every simulation")
    nodes = np.flatnonzero(there[0])
    position, velocity = (np.moveaxis(x[:, :, nodes], 2, 3) for x in (t.position, t.velocity))
    edges = (t.edges[:, nodes][:, :, nodes] != NO_EDGE).astype(np.float32)
    return {"loc": np.ascontiguousarray(position), "vel": np.ascontiguousarray(velocity), "edges": edges}


def gns_simulations(trajectories: Trajectories) -> list[tuple[Float[np.ndarray, "T n 2"], Int[np.ndarray, " n"]]]:
    """Per scene the positions of those present and their particle types (`PARTICLES`); velocities are differences."""
    t = trajectories
    kinds = np.vectorize(PARTICLES.__getitem__, otypes=[np.int64])(t.kind)
    there = t.mask[:, 0]
    return [(t.position[s][:, there[s]], kinds[s][there[s]]) for s in range(len(t))]


def gns_metadata(trajectories: Trajectories, connectivity_radius: float | int | None = None) -> dict:
    """GNS's metadata.json. Velocities and accelerations are per step there: differences [m] of positions, and of those.

    Statistics are over agents. `sequence_length` is the number of steps, one less than the rows, as in Sanchez-Gonzalez
    et al. 2020.
    """
    t = trajectories
    inside = t.position[t.mask]
    low, high = inside.min(axis=0), inside.max(axis=0)
    steps = np.diff(t.position.astype(np.float64), axis=1)
    turns = np.diff(steps, axis=1)
    moving = _moving(t)
    step, turn = (np.swapaxes(x, 1, 2)[moving].reshape(-1, 2) for x in (steps, turns))
    if connectivity_radius is None:
        connectivity_radius = float(np.linalg.norm(high.astype(np.float64) - low))
    return {
        "bounds": [[float(a), float(b)] for a, b in zip(low, high, strict=True)],
        "sequence_length": t.position.shape[1] - 1,
        "default_connectivity_radius": float(connectivity_radius),
        "dim": 2,
        "dt": t.dt,
        "vel_mean": _list(step.mean(axis=0)),
        "vel_std": _list(step.std(axis=0)),
        "acc_mean": _list(turn.mean(axis=0)),
        "acc_std": _list(turn.std(axis=0)),
    }


def _moving(t: Trajectories) -> Bool[np.ndarray, "S V"]:
    return t.mask[:, 0] & (t.kind == AGENT)


def _list(values: np.ndarray) -> list[float]:
    return [float(value) for value in values]


def _npy(array: np.ndarray) -> Callable[[io.BufferedWriter], None]:
    return lambda file: np.save(file, array, allow_pickle=False)


def _npz(file: io.BufferedWriter, simulations: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    """GNS's loader takes every entry apart as (positions, types), so an entry is an array of two objects.

    Such arrays are pickled by NumPy; that is the format's own definition. We write it and never read it.
    """
    pairs = {}
    for number, (positions, types) in enumerate(simulations):
        pair = np.empty(2, object)
        pair[0], pair[1] = positions, types
        pairs[f"simulation_trajectory_{number}"] = pair
    np.savez_compressed(file, **pairs)


def _write(files: dict[Path, Callable[[io.BufferedWriter], object]]) -> list[Path]:
    """Writes all files under other names and renames them when the last is done."""
    try:
        with contextlib.ExitStack() as stack:
            for path, write in files.items():
                with stack.enter_context(WholeFile(path)).open("wb") as file:
                    write(file)
                    file.flush()
                    os.fsync(file.fileno())
    except OSError as error:
        raise ExportError(f"{next(iter(files))}: cannot be written ({error.strerror or error})") from error
    return list(files)
