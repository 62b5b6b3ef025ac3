"""Judging a batch of rollouts by its contacts: counted by physics, summarised here, each figure with an interval."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from envs.estimates import Bootstrap, Estimate
from envs.trajectories import AGENT, GOAL, Trajectories

NEAR_GOAL = 15.0
"""Contacts closer to the goal than this [m] are reported apart from those en route."""


def collision_report(trajectories: Trajectories, *, reach: float = NEAR_GOAL, seed: int = 0) -> dict[str, Estimate]:
    """Figures over all scenes, by name; `docs/definitions.md` defines each in formulas.

    A contact step is a control step in which something touches at any of its substep states. Shares of steps are per
    scene ("any agent of the scene touches") unless the name says `agent_`. An event is an onset of contact of an agent;
    two agents that meet are two events. `ever_*` are shares of trajectories, and of agents, that touch at least once.
    `minimum_clearance` is the smallest distance between surfaces at control steps [m], or minus the deepest penetration
    at any substep. `time_to_goal` is the first time within `reach` of the goal [s], over agents that get there.
    """
    t = trajectories
    agents = t.kind == AGENT
    present = t.mask & agents[:, None]  # (S, T, V)
    steps = present[:, 1:]
    with_agent, with_solid = (t.agent_contact[:, 1:] > 0) & steps, (t.solid_contact[:, 1:] > 0) & steps
    either = with_agent | with_solid
    bootstrap = Bootstrap(len(t), seed)
    report: dict[str, Estimate] = {}

    def share(name: str, hits: np.ndarray, among: np.ndarray) -> None:
        axes = tuple(range(1, hits.ndim))
        report[name] = bootstrap.ratio((hits & among).sum(axes), among.sum(axes), "share")

    in_scene = steps.any(axis=2)
    for name, touching in (("any", either), ("agent", with_agent), ("obstacle", with_solid)):
        share(f"contact_steps_{name}", touching.any(axis=2), in_scene)
    share("agent_contact_steps_any", either, steps)
    for name, touching in (("any", either), ("agent", with_agent), ("obstacle", with_solid)):
        share(f"ever_touching_trajectories_{name}", touching.any(axis=(1, 2)), in_scene.any(axis=1))
    share("ever_touching_agents_any", either.any(axis=1), steps.any(axis=1))
    for name, events in (("agent", t.agent_events), ("obstacle", t.solid_events)):
        counts = (events[:, 1:] * steps).sum(axis=(1, 2))
        report[f"events_per_trajectory_{name}"] = bootstrap.ratio(counts, np.ones(len(t)), "")
    deepest = float((t.depth * present).max(initial=0))
    report["deepest_penetration"] = Estimate(deepest, None, None, "m")
    clearance = float(_clearance(t).min(initial=np.inf))
    report["minimum_clearance"] = Estimate(-deepest if deepest > 0 else clearance, None, None, "m")
    if (t.kind == GOAL).any():
        distance, known = goal_distances(t)
        present, steps = present & known, steps & known[:, 1:]
        there = present[:, -1]
        report["final_goal_distance"] = bootstrap.ratio((distance[:, -1] * there).sum(1), there.sum(1), "m")
        arrived = (distance <= reach) & present
        share("reached_goal", arrived.any(axis=1), present.any(axis=1))
        first = np.argmax(arrived, axis=1) * t.dt * arrived.any(axis=1)
        report["time_to_goal"] = bootstrap.ratio(first.sum(1), arrived.any(axis=1).sum(1), "s")
        near = distance[:, 1:] <= reach
        share("agent_contact_steps_en_route", either, steps & ~near)
        share("agent_contact_steps_near_goal", either, steps & near)
    return report


def goal_distances(t: Trajectories) -> tuple[Float[np.ndarray, "S T V"], Bool[np.ndarray, "S T 1"]]:
    """Distance [m] of every node to its scene's goal, the first of several; and whether there is one in that row."""
    scene, node = np.arange(len(t)), np.argmax(t.kind == GOAL, axis=1)
    known = (t.mask[scene, :, node] & (t.kind[scene, node] == GOAL)[:, None])[..., None]
    return np.linalg.norm(t.position - t.position[scene, :, node][:, :, None], axis=-1), known


@dataclass(frozen=True)
class WorstScene:
    """A scene worth a look, and why."""

    scene: int
    contact_steps: int
    """Control steps in which any of its agents touches something."""
    deepest_penetration: float
    """[m]"""
    minimum_clearance: float
    """Smallest distance between surfaces at control steps [m]; below 0 where they overlap at one."""


def worst_scenes(trajectories: Trajectories, count: int) -> list[WorstScene]:
    """Scenes with the most contact steps first; among equals the deepest penetration, then the smallest clearance."""
    t = trajectories
    present = t.mask & (t.kind == AGENT)[:, None]
    touching = (((t.agent_contact > 0) | (t.solid_contact > 0)) & present)[:, 1:]
    steps, deepest = touching.any(axis=2).sum(axis=1), (t.depth * present).max(axis=(1, 2), initial=0)
    clearance = _clearance(t)
    order = np.lexsort([clearance, -deepest, -steps])[:count]
    return [WorstScene(int(i), int(steps[i]), float(deepest[i]), float(clearance[i])) for i in order]


def _clearance(t: Trajectories) -> Float[np.ndarray, " S"]:
    """Smallest surface distance [m] of each scene at control steps between an agent and another agent or an obstacle;
    infinite where an agent is alone."""
    bodies, present = t.mask & (t.kind != GOAL)[:, None], t.mask & (t.kind == AGENT)[:, None]
    smallest = np.full(len(t), np.inf)
    for node in range(t.position.shape[2]):
        if not (t.kind[:, node] == AGENT).any():
            continue
        apart = np.linalg.norm(t.position - t.position[:, :, node : node + 1], axis=-1)
        apart -= (t.radius + t.radius[:, node : node + 1])[:, None]
        other = bodies & present[:, :, node : node + 1]
        other[:, :, node] = False
        smallest = np.minimum(smallest, np.min(apart, axis=(1, 2), where=other, initial=np.inf))
    return smallest
