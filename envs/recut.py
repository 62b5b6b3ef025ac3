"""Trajectories cut into shorter scenes, each with only the nodes that are there: smaller graphs where people come and
go."""

from dataclasses import replace

import numpy as np

from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, TrajectoryError

_PER_NODE = (
    "position", "velocity", "mask", "agent_contact", "solid_contact", "agent_events", "solid_events", "depth",
)  # fmt: skip


def recut(trajectories: Trajectories, rows: int, *, stride: int) -> Trajectories:
    """Scenes of `rows` rows that begin every `stride` rows of each scene; nodes are those present in them, padded to
    the largest. Scenes without an agent in two rows are left out.

    Raises TrajectoryError when the scenes are shorter than `rows`, or no scene is left.
    """
    t = trajectories
    if t.position.shape[1] < rows:
        raise TrajectoryError(f"trajectories have {t.position.shape[1]} rows, scenes of {rows} do not fit")
    agents = t.mask & (t.kind == AGENT)[:, None]
    starts = [
        (scene, row, np.flatnonzero(t.mask[scene, row : row + rows].any(axis=0)))
        for scene in range(len(t))
        for row in range(0, t.position.shape[1] - rows + 1, stride)
        if agents[scene, row : row + rows].any(axis=1).sum() > 1
    ]
    if not starts:
        raise TrajectoryError(f"no scene of {rows} rows has an agent in two of them")
    sizes = np.stack([np.bincount(t.kind[scene, nodes], minlength=3) for scene, _, nodes in starts]).max(axis=0)
    kinds = np.repeat(np.asarray([GOAL, OBSTACLE, AGENT], np.int8), sizes)
    shape = (len(starts), rows, len(kinds))
    out = {name: np.zeros(shape + (value := getattr(t, name)).shape[3:], value.dtype) for name in _PER_NODE}
    radius = np.zeros((len(starts), len(kinds)), t.radius.dtype)
    edges = np.zeros((len(starts), len(kinds), len(kinds)), t.edges.dtype)
    saturated = np.zeros(shape[:2], t.saturated.dtype)
    first = np.concatenate([[0], np.cumsum(sizes)])
    for at, (scene, row, nodes) in enumerate(starts):
        kind = t.kind[scene, nodes]
        slots = np.concatenate([first[k] + np.arange((kind == k).sum()) for k in (GOAL, OBSTACLE, AGENT)])
        for name, values in out.items():
            values[at][:, slots] = getattr(t, name)[scene, row : row + rows][:, nodes]
        radius[at, slots] = t.radius[scene, nodes]
        edges[at][np.ix_(slots, slots)] = t.edges[scene][np.ix_(nodes, nodes)]
        saturated[at] = t.saturated[scene, row : row + rows]
    kind = np.broadcast_to(kinds, (len(starts), len(kinds))).copy()
    return replace(t, kind=kind, radius=radius, edges=edges, saturated=saturated, **out)
