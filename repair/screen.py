"""Which states violate a constraint, which of these an admissible action could have avoided, and what to hold on to."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from envs.dynamics import Kinematics
from envs.record import Array, record
from gnn.family import Params
from gnn.graph import Graph
from repair.constraints.constraint import Constraint
from repair.encounters import Bodies, Encounters, encounters, gap
from repair.filter import safe_actions
from repair.limits import executed
from repair.network import Situations, situations_of

TOLERANCE = 1e-4
"""A condition missed by less holds, in the unit of the constraint's slack."""


@record
class Acted:
    """What came of a policy in physics: rows 0..T of S scenes, and contacts of the T control steps between them."""

    nodes: Float[Array, "S T1 V 4"]
    """Positions [m] and velocities [m/s] in the order goals, obstacles, agents."""
    graph: Graph
    """Of each scene."""
    touching_agent: Bool[Array, "S T N"]
    """Whether the agent touches another one in the control step that begins in a row."""
    touching_obstacle: Bool[Array, "S T N"]


Perform = Callable[[Params, int], Acted]
"""`perform(weights, round)`: a policy with these weights in physics, in scenes that no other round has."""


def decisions(acted: Acted) -> tuple[Situations, Int[np.ndarray, "R 3"]]:
    """Every decision of a present agent in a finite state, with its (scene, row, agent)."""
    scenes, rows, nodes, _ = acted.nodes.shape
    agents = acted.graph.counts[2]
    flat = np.asarray(acted.nodes[:, :-1]).reshape(-1, nodes, 4)
    graph = Graph(**{name: np.repeat(np.asarray(x), rows - 1, axis=0) for name, x in vars(acted.graph).items()})
    everyone = situations_of(flat, graph)
    here = np.asarray(graph.present)[:, -agents:].reshape(-1) & np.isfinite(flat).all((1, 2)).repeat(agents)
    where = np.stack(np.meshgrid(range(scenes), range(rows - 1), range(agents), indexing="ij"), axis=-1).reshape(-1, 3)
    return everyone.take(here), where[here]


@record
class Screened:
    """R decisions under a constraint."""

    slack: Float[Array, " R"]
    """Least slack of the executed action, in the constraint's unit; infinite for who meets nobody."""
    before_clip: Float[Array, " R"]
    """The same for the network's own output."""
    possible: Bool[Array, " R"]
    """Whether some admissible action was found that satisfies all conditions."""
    apart: Bool[Array, " R"]
    """Whether the agent touches nothing yet."""

    @property
    def violated(self) -> Bool[Array, " R"]:
        """Whether the executed action breaks a condition."""
        return self.slack < -TOLERANCE

    @property
    def avoidable(self) -> Bool[Array, " R"]:
        """Whether it breaks one that it need not have broken."""
        return self.violated & self.possible & self.apart


def screen(
    constraint: Constraint,
    situations: Situations,
    action: Float[Array, "R 2"],
    bodies: Bodies,
    kinematics: Kinematics,
) -> Screened:
    """Judges decisions by the action that is executed. Unavoidable is who is inside already (its surfaces overlap), or
    for whom no action within the limits was found that satisfies all conditions: neither the allowed one nearest to
    the policy's nor any of a grid. An action that is not finite breaks every condition:
    its slack is -inf."""
    e = encounters(situations, bodies)
    sound = np.isfinite(action).all(axis=1)
    action = np.where(sound[:, None], action, 0)
    done = executed(situations.own[:, 2:], action, kinematics)
    slack = np.where(sound, least(constraint, e, done), -np.inf)
    possible = np.ones(len(situations), bool)
    asked = np.flatnonzero(slack < -TOLERANCE)
    if len(asked):
        found, fits = safe_actions(constraint, situations.take(asked), done[asked], bodies, kinematics)
        # What is executed of it may differ from it by the speed limit.
        found = executed(situations.own[asked, 2:], found, kinematics)
        near = e_take(e, asked)
        possible[asked] = fits & (least(constraint, near, found) >= -TOLERANCE)
        # The nearest allowed action is not all there is: the speed limit may bend it, and a convex part of what is
        # allowed may be empty where the rest is not.
        left = np.flatnonzero(~possible[asked])
        for other in _around(kinematics.max_acceleration):
            if not len(left):
                break
            tried = executed(situations.own[asked[left], 2:], np.tile(other, (len(left), 1)), kinematics)
            holds = least(constraint, e_take(near, left), tried) >= -TOLERANCE
            possible[asked[left[holds]]] = True
            left = left[~holds]
    return Screened(
        slack=slack,
        before_clip=np.where(sound, least(constraint, e, action), -np.inf),
        possible=possible,
        apart=(gap(e) > 0).all(axis=1) if e.present.shape[1] else np.ones(len(situations), bool),
    )


def _around(limit: float) -> Float[np.ndarray, "A 2"]:
    """Actions all over the disc of the limit: 24 directions at its rim and at two thirds and one third, and none."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    size = limit if np.isfinite(limit) else 1.0
    return np.concatenate([rim * size, rim * size * 2 / 3, rim * size / 3, np.zeros((1, 2))])


def least(constraint: Constraint, e: Encounters, action: Float[Array, "R 2"]) -> Float[Array, " R"]:
    """The least slack of every row."""
    slack = np.asarray(constraint.slack(e, action))
    return slack.min(axis=1, initial=np.inf)


def e_take(e: Encounters, rows: Int[np.ndarray, " r"]) -> Encounters:
    """Some of the rows."""
    return Encounters(**{name: np.asarray(value)[rows] for name, value in vars(e).items()})
