"""Repairs of one step: the states are taken once, a program is solved, and nothing is tried in between.

The thesis's own (chapter 6) and the last layer with true discs, as the loop's neighbours to compare with.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gnn.checkpoint import Model
from gnn.family import Params
from repair.branch import branch_readout
from repair.config import LoopConfig
from repair.constraints.constraint import Constraint
from repair.constraints.disc import Disc
from repair.encounters import Bodies, encounters
from repair.errors import Status
from repair.layerwise import layerwise
from repair.network import Situations, actions
from repair.problem import Problem
from repair.screen import screen
from repair.solve import Limits
from swarm_mjcf.errors import SpecError


def mendable(model: Model, normalise: bool, constraint: Constraint, states: Situations, bodies: Bodies) -> Situations:
    """Without those that break the constraint whatever they do within the limits: no weights can help them."""
    now = actions(model.params, model.scales, states, normalise=normalise)
    judged = screen(constraint, states, now, bodies, model.integrator)
    return states.take(~judged.violated | judged.avoidable)


class Mended(NamedTuple):
    """What a method of one step found."""

    params: Params
    """Those given where it found none."""
    gap: float | None
    status: Status
    """In the method's own words; without values where it found none."""


def by_programs(
    model: Model,
    normalise: bool,
    config: LoopConfig,
    constraint: Constraint,
    states: Situations,
    bodies: Bodies,
) -> Mended:
    """The thesis's layer-wise mixed-integer programs (`repair.layerwise`) on the layers of `config.layers`, conditions
    elastic; the gap is that of the last program that was accepted.

    The targets are the original actions, deviations count in L1 (eq. 6.9-6.12), conditions are of the raw action.
    """
    targets = np.asarray(actions(model.params, model.scales, states, normalise=normalise))
    problem = Problem(
        scales=model.scales, situations=states, targets=targets, constraint=constraint, bodies=bodies,
        agents=config.agents, normalise=normalise,
    )  # fmt: skip
    limits = Limits(seconds=config.solver_seconds)
    found = layerwise(
        model.params, problem, radius=config.box, layers=config.layers, rounds=max(config.rounds, 1), limits=limits,
        solver=config.solver,
    )  # fmt: skip
    taken = [step.gap for step in found.history if step.accepted]
    solved = [step.status for step in found.history if step.status.solved]
    return Mended(found.params, taken[-1] if taken else None, solved[-1] if solved else found.history[-1].status)


def by_branches(
    model: Model,
    normalise: bool,
    config: LoopConfig,
    constraint: Constraint,
    states: Situations,
    bodies: Bodies,
) -> Mended:
    """The last layer with the least mean squared change of actions that keeps true discs (`repair.branch`).

    Raises SpecError for another constraint than disc.
    """
    if not isinstance(constraint, Disc):
        raise SpecError("constraint", config.constraint.name, "disc with method last-layer")
    e = encounters(states, bodies)
    if not config.agents:
        e = replace(e, present=e.present & ~np.asarray(e.steers))
    found = branch_readout(
        model.params, model.scales, states, states, e, constraint, normalise=normalise, price=1e4,
        seconds=config.solver_seconds, ceiling=np.inf,
    )  # fmt: skip
    if found.kernel is None or found.bias is None:
        return Mended(model.params, None, found.status)
    params = model.params | {"readout": {"layer0": {"kernel": found.kernel, "bias": found.bias}}}
    return Mended(params, found.gap, found.status)
