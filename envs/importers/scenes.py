"""Runs cut into scenes whose nodes are those present in them, padded to the largest scene, as `Trajectories`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from envs.importers.config import ImportConfig
from envs.importers.samples import Samples
from envs.importers.tracks import ImportFailed
from envs.storage import SLAB
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, edge_types

_CELLS = 4_000_000
"""Rows times nodes that are built together: bounds the memory."""


@dataclass(frozen=True)
class Scene:
    """A part of a run: `which` of its samples lie in rows `first` and following."""

    run: Samples
    first: int
    which: np.ndarray

    @property
    def people(self) -> np.ndarray:
        """Those present in it, in the order goals, obstacles, agents."""
        found = np.unique(self.run.person[self.which])
        return found[np.argsort(self.run.tracks.kind[found], kind="stable")]


def rows_per_scene(runs: Sequence[Samples], dt: float, config: ImportConfig) -> int:
    """Rows of every scene: the segment's, or the longest run's where runs stay whole."""
    longest = max((run.rows for run in runs), default=0)
    segment = config.segment
    if segment is None:
        segment = 0.0 if all(run.tracks.edges is not None for run in runs) else 10.0
    return longest if not segment else min(longest, max(2, round(segment / dt)))


def cut(runs: Sequence[Samples], rows: int) -> list[Scene]:
    """Scenes of `rows` rows one after the other; the last of a run may end early. Those with agents in fewer than two
    rows are left out."""
    scenes = []
    for run in runs:
        number = run.row // rows
        order = np.argsort(number, kind="stable")
        bounds = np.flatnonzero(np.diff(number[order])) + 1
        for which in np.split(order, bounds):
            agents = which[run.agents[which]]
            if len(agents) and run.row[agents].max() > run.row[agents].min():
                scenes.append(Scene(run, int(number[which[0]]) * rows, which))
    return scenes


def assembled(
    scenes: Sequence[Scene], *, rows: int, dt: float, config: ImportConfig, provenance: dict
) -> Iterator[Trajectories]:
    """Scenes as trajectories, some at a time. Contacts are not judged: they are zero.

    Raises ImportFailed when there is no scene.
    """
    if not scenes:
        raise ImportFailed("no scene is left in which an agent has two rows")
    sizes = np.stack([np.bincount(s.run.tracks.kind[s.people], minlength=3) for s in scenes]).max(axis=0)
    nodes = int(sizes.sum())
    places = np.concatenate([[0], np.cumsum(sizes)])  # where the goals, the obstacles and the agents begin
    kinds = np.repeat(np.asarray([GOAL, OBSTACLE, AGENT], np.int8), sizes)
    size = int(np.clip(_CELLS // (rows * nodes + nodes * nodes), 1, SLAB))
    for start in range(0, len(scenes), size):
        part = scenes[start : start + size]
        shape = (len(part), rows, nodes)
        position, velocity = (np.zeros((*shape, 2), np.float32) for _ in range(2))
        mask = np.zeros(shape, bool)
        kind = np.broadcast_to(kinds, (len(part), nodes)).copy()
        slots = [_slots(scene, places) for scene in part]
        for at, (scene, slot) in enumerate(zip(part, slots, strict=True)):
            run, which = scene.run, scene.which
            cell = (at, run.row[which] - scene.first, slot[run.person[which]])
            position[cell], velocity[cell], mask[cell] = run.position[which], run.velocity[which], True
        present = mask.any(axis=1)
        edges = edge_types(kind, present)
        for at, (scene, slot) in enumerate(zip(part, slots, strict=True)):
            if (own := scene.run.tracks.edges) is not None:
                people = scene.people
                edges[at][np.ix_(slot[people], slot[people])] = own[np.ix_(people, people)]
        radius = np.select([kind == AGENT, kind == OBSTACLE], [config.radius, config.obstacle_radius], 0.0)
        none = np.zeros(shape, np.int16)
        yield Trajectories(
            position=position,
            velocity=velocity,
            mask=mask,
            kind=kind,
            radius=np.where(present, radius, 0).astype(np.float32),
            edges=edges,
            agent_contact=none,
            solid_contact=none,
            agent_events=none,
            solid_events=none,
            depth=np.zeros(shape, np.float32),
            dt=float(dt),
            substeps=config.substeps,
            max_speed=float(config.max_speed),
            max_acceleration=float(config.max_acceleration),
            provenance=provenance,
        )


def _slots(scene: Scene, places: np.ndarray) -> np.ndarray:
    """Node number of each person of the run; -1 for those who are not in the scene."""
    people = scene.people
    kind = scene.run.tracks.kind[people]
    counts = np.bincount(kind, minlength=3)
    rank = np.arange(len(people)) - np.concatenate([[0], np.cumsum(counts)])[kind]
    slots = np.full(len(scene.run.tracks.labels), -1)
    slots[people] = places[kind] + rank
    return slots
