"""The thesis author's arrays: NAME_timeseries.npy (runs, rows, nodes, 4), NAME_edge.npy, NAME_time.npy."""

from dataclasses import replace
from pathlib import Path
from tokenize import TokenError
from zipfile import BadZipFile

import numpy as np

from envs.importers.config import ImportConfig
from envs.importers.tracks import ImportFailed, Tracks, Update, length, readable, tracks_of
from envs.trajectories import AGENT, AGENT_EDGE, GOAL, GOAL_EDGE, NO_EDGE, OBSTACLE, OBSTACLE_EDGE

ENDING = "_timeseries.npy"


def read(path: Path, config: ImportConfig, update: Update) -> list[Tracks]:
    """Runs of nodes that are there all the time. Nodes without edges whose state is 0 throughout are padding.

    Edge types (source, target) are 1 from goals, 2 from obstacles, 3 between agents. A file with type 1 alone, whose
    sources receive as well, is one of chasers: all nodes are agents and the edges are theirs.
    """
    if not path.name.endswith(ENDING):
        raise ImportFailed(
            f"{path}: name the file that ends in {ENDING}; _edge.npy and _time.npy are looked for beside"
        )
    states = _array(path, 4, "(runs, rows, nodes, 4): x, y, vx, vy")
    if states.shape[-1] != 4:
        raise ImportFailed(f"{path}: nodes have {states.shape[-1]} numbers, expected are 4: x, y, vx, vy")
    runs, rows, nodes, _ = states.shape
    if not states.size:
        raise ImportFailed(f"{path}: no rows of data")
    beside = path.name.removesuffix(ENDING)
    edges_path, time_path = (path.with_name(f"{beside}_{what}.npy") for what in ("edge", "time"))
    edges = _array(edges_path, 3, f"(runs, nodes, nodes) = {(runs, nodes, nodes)}")
    if edges.shape != (runs, nodes, nodes):
        raise ImportFailed(f"{edges_path}: has the shape {edges.shape}, the time series ask for {(runs, nodes, nodes)}")
    if not np.isin(edges, range(9)).all():
        raise ImportFailed(f"{edges_path}: holds edge types that are none of 0 to 3")
    if (edges > AGENT_EDGE).any():
        raise ImportFailed(f"{edges_path}: has edge types above 3, of a second species; one species can be imported")
    times, clock = _times(time_path, config, runs, rows)
    scale, unit = length(str(path), config, "m", where="format")
    facts = {"format": "published arrays", "unit": unit, "times": clock}
    tracks = []
    for run in range(runs):
        types, kind, there = _graph(edges_path, run, edges[run].astype(np.int8), states[run])
        position, velocity = _columns(states[run][:, there] * scale)
        made = tracks_of(
            f"{path.name} run {run}",
            time=np.tile(times[run], len(there)),
            id=np.repeat(there, rows),
            position=position,
            velocity=velocity,
            kind=np.repeat(kind, rows),
            facts=facts,
        )
        tracks.append(replace(made, edges=types))
        if not run % 500:
            update(run, runs, f"read {path.name}")
    update(runs, runs, f"read {path.name}")
    return tracks


def _columns(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (nodes * rows, 2), node by node."""
    flat = np.swapaxes(states, 0, 1).reshape(-1, 4).astype(np.float64)
    return flat[:, :2], flat[:, 2:]


def _graph(path: Path, run: int, edges: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edge types and kinds of the nodes that are there, and their numbers."""
    there = np.flatnonzero(edges.any(axis=0) | edges.any(axis=1) | states.any(axis=(0, 2)))
    if not len(there):
        raise ImportFailed(f"{path}: run {run} has no nodes (all states and edges are 0)")
    edges = edges[np.ix_(there, there)]
    goals, obstacles = ((edges == kind).any(axis=1) for kind in (GOAL_EDGE, OBSTACLE_EDGE))
    receives = edges.any(axis=0)
    if (goals & receives).any() and not np.isin(edges, (NO_EDGE, GOAL_EDGE)).all():
        raise ImportFailed(f"{path}: run {run} has a node that sends as a goal and receives like an agent")
    if (goals & receives).any():
        return np.where(edges != NO_EDGE, AGENT_EDGE, NO_EDGE).astype(np.int8), np.full(len(there), AGENT), there
    if (obstacles & (receives | goals)).any():
        raise ImportFailed(f"{path}: run {run} has a node that sends as an obstacle and as something else")
    return edges, np.select([goals, obstacles], [GOAL, OBSTACLE], AGENT), there


def _times(path: Path, config: ImportConfig, runs: int, rows: int) -> tuple[np.ndarray, str]:
    """Times (runs, rows) [s] from the file, or from --fps or --dt where there is none. Raises ImportFailed where file
    and --fps disagree."""
    if not path.exists():
        step = 1 / config.fps if config.fps is not None else config.dt
        if step is None:
            raise ImportFailed(f"{path}: does not exist; give --dt [s], the time between rows")
        return np.broadcast_to(np.arange(rows) * step, (runs, rows)), f"{step:g} s between rows (declared)"
    times = _array(path, 2, f"(runs, rows) = {(runs, rows)}").astype(np.float64)
    if times.shape != (runs, rows):
        raise ImportFailed(f"{path}: has the shape {times.shape}, the time series ask for {(runs, rows)}")
    steps = np.diff(times, axis=1)
    if config.fps is not None and steps.size and not np.isclose(np.median(steps), 1 / config.fps, rtol=1e-3):
        raise ImportFailed(
            f"{path}: rows are {np.median(steps):.4g} s apart, --fps says {config.fps:g} a second; leave --fps "
            "out, --dt resamples"
        )
    return times, "s (time file)"


def _array(path: Path, dimensions: int, shape: str) -> np.ndarray:
    readable(path)
    try:
        with path.open("rb") as file:  # of a damaged one, np.load leaves its own open
            array = np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError, TokenError, BadZipFile) as error:
        raise ImportFailed(
            f"{path}: is no array of numbers in NumPy's format ({str(error).splitlines()[0]})"
        ) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iufb" or array.ndim != dimensions:
        what = f"{array.ndim} axes of {array.dtype}" if isinstance(array, np.ndarray) else "an archive"
        raise ImportFailed(f"{path}: holds {what}, expected are numbers {shape}")
    return array
