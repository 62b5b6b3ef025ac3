"""Swarms of several sizes in one batch by ghosts: nodes with zero states, no edges, in no mask (chapter 4)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from envs.trajectories import AGENT, ARRAYS, GOAL, OBSTACLE, Trajectories, TrajectoryError, concatenate

_PER_SCENE = {"saturated"}
"""Arrays without a node axis."""


def pad(trajectories: Trajectories, counts: tuple[int, int, int]) -> Trajectories:
    """The same scenes with room for `counts` goals, obstacles and agents; every new place holds a ghost.

    Ghosts are masked, have zero states and radii and no edges; the edges among the others stay as they are. Raises
    TrajectoryError for counts smaller than those of the trajectories.
    """
    have = trajectories.counts
    if any(few < many for few, many in zip(counts, have, strict=True)):
        raise TrajectoryError(f"{have} goals, obstacles and agents do not fit {counts}")
    if counts == have:
        return trajectories
    starts = np.cumsum([0, *counts[:2]])
    places = np.concatenate([start + np.arange(number) for start, number in zip(starts, have, strict=True)])
    nodes = sum(counts)

    def padded(name: str) -> np.ndarray:
        given = getattr(trajectories, name)
        if name in _PER_SCENE:
            return given
        if name == "kind":
            kinds = np.repeat([GOAL, OBSTACLE, AGENT], counts).astype(given.dtype)
            return np.broadcast_to(kinds, (len(trajectories), nodes)).copy()
        if name == "edges":
            full = np.zeros((len(trajectories), nodes, nodes), given.dtype)
            full[:, places[:, None], places] = given
            return full
        axis = 1 if name == "radius" else 2
        shape = list(given.shape)
        shape[axis] = nodes
        full = np.zeros(shape, given.dtype)
        full[(slice(None),) * axis + (places,)] = given
        return full

    return replace(trajectories, **{name: padded(name) for name in ARRAYS})


def mix(parts: Sequence[Trajectories]) -> Trajectories:
    """Scenes of all parts, in their order, padded to the most goals, obstacles and agents of any.

    Longer parts are cut to the rows of the shortest. The provenance lists that of every part with its number of scenes,
    under `mixed`. One part is returned as it is. Raises TrajectoryError for no parts, and for parts of another dt,
    number of substeps or limits: one model cannot decode both.
    """
    if not parts:
        raise TrajectoryError("nothing to mix: no trajectories were given")
    first = parts[0]
    if len(parts) == 1:
        return first
    for part in parts[1:]:
        for name in ("dt", "substeps", "max_speed", "max_acceleration"):
            if getattr(part, name) != getattr(first, name):
                raise TrajectoryError(
                    f"trajectories with {name} {getattr(first, name)} and {getattr(part, name)} cannot be mixed"
                )
    goals, obstacles, agents = (max(numbers) for numbers in zip(*(part.counts for part in parts), strict=True))
    rows = min(part.position.shape[1] for part in parts)
    fitting = [pad(part, (goals, obstacles, agents)).rows(0, rows) for part in parts]
    about = {"mixed": [{"scenes": len(part), **part.provenance} for part in parts]}
    return replace(concatenate(fitting), provenance=about)
