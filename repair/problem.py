"""What is asked of a network: which situations, which targets, which conditions; and how far weights are from it."""

from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Float, Int

from envs.dynamics import Kinematics
from envs.record import record
from gnn.family import Params
from gnn.features import Scales
from repair.bounds import chain_of, pre_activations
from repair.constraints.constraint import Constraint, HalfPlanes
from repair.encounters import Bodies, encounters
from repair.errors import RepairError
from repair.limits import as_executed
from repair.network import Situations
from swarm_mjcf.errors import SpecError


@record
class Output:
    """What the readout means: `unit * readout` is compared with targets, and `matrix @ (unit * readout) + offset` is
    the constant acceleration [m/s^2] that constraints are put on, hence the next position."""

    unit: Float[np.ndarray, " O"]
    matrix: Float[np.ndarray, "2 O"]
    offset: Float[np.ndarray, "R 2"]


def acceleration(situations: Situations, scales: Scales, *, normalise: bool = True) -> Output:
    """The readout of chapter 5: an acceleration (eq. 5.25)."""
    unit = float(scales.acceleration) if normalise else 1.0
    return Output(unit=np.full(2, unit), matrix=np.eye(2), offset=np.zeros((len(situations), 2)))


def state_change(situations: Situations, kinematics: Kinematics, unit: Float[np.ndarray, "4"] | None = None) -> Output:
    """The readout of the author's code: the change of the state, of which the first two are the displacement; its next
    position p + y is that of the acceleration (y - v dt) / (dt^2 (k + 1) / (2 k))."""
    dt, k = kinematics.dt, kinematics.substeps
    push = dt * dt * (k + 1) / (2 * k)
    velocity = np.asarray(situations.own, np.float64)[:, 2:]
    return Output(unit=np.ones(4) if unit is None else unit, matrix=np.eye(2, 4) / push, offset=-velocity * (dt / push))


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What is asked of the network, whichever of its layers is free."""

    scales: Scales
    situations: Situations
    targets: Float[np.ndarray, "R O"]
    """What the outputs should stay near, in their units: the original policy's or the ground truth (eq. 6.10)."""
    constraint: Constraint | None = None
    bodies: Bodies | None = None
    """Radii; needed with a constraint."""
    agents: bool = True
    """Whether agents are kept from each other too; the thesis keeps them from obstacles alone."""
    output: Output | None = None
    """None: an acceleration."""
    normalise: bool = True
    limit: float = float("inf")
    """Norm to which actions are clipped when executed [m/s^2]; if finite, conditions are those on the clipped one."""
    margin: float = 1e-4
    """Kept beyond each condition in the program [m/s^2]: what float32 weights and a solver's tolerance may take."""
    price: float | None = None
    """Of a violation, per m/s^2, beside the mean deviation; None: conditions are hard."""

    def __post_init__(self) -> None:
        if (self.constraint is None) != (self.bodies is None):
            raise SpecError("bodies", self.bodies, "given with a constraint, and only with one")
        if self.price is not None and not 0 < self.price < float("inf"):
            raise SpecError("price", self.price, "a finite number above 0, or None for hard conditions")
        if not 0 <= self.margin < float("inf"):
            raise SpecError("margin", self.margin, "a finite number of at least 0 [m/s^2]")
        if not self.limit > 0:
            raise SpecError("limit", self.limit, "above 0 [m/s^2]")
        if not np.isfinite(self.targets).all():
            raise RepairError("targets are not all finite")
        if self.targets.shape != (len(self.situations), len(self.meaning.unit)):
            allowed = f"shape {(len(self.situations), len(self.meaning.unit))}"
            raise SpecError("targets", f"shape {self.targets.shape}", allowed)

    @cached_property
    def meaning(self) -> Output:
        """`output`, or that of an acceleration."""
        return self.output or acceleration(self.situations, self.scales, normalise=self.normalise)

    @cached_property
    def conditions(self) -> "Conditions":
        """All conditions on the actions."""
        return _conditions(self)


@record
class Conditions:
    """K conditions, each on one agent's action: on one of D sides, all G of its half-planes normal . u >= offset."""

    row: Int[np.ndarray, " K"]
    body: Int[np.ndarray, " K"]
    """Which of the agent's encounters."""
    normal: Float[np.ndarray, "K D G 2"]
    offset: Float[np.ndarray, "K D G"]
    """[m/s^2], -inf where there is no half-plane."""

    def take(self, which: np.ndarray) -> "Conditions":
        """Some of the conditions."""
        return jax.tree.map(lambda x: x[which], self)

    def short(self, action: Float[np.ndarray, "R 2"]) -> Float[np.ndarray, "K D"]:
        """What each side is short of [m/s^2]; at most 0 where it holds."""
        along = np.sum(self.normal * action[self.row, None, None], axis=-1)
        return np.max(self.offset - along, axis=-1)


def _conditions(problem: Problem) -> Conditions:
    if problem.constraint is None or problem.bodies is None:
        none = np.zeros(0, int)
        return Conditions(row=none, body=none, normal=np.zeros((0, 1, 1, 2)), offset=np.zeros((0, 1, 1)))
    e = encounters(problem.situations, problem.bodies)
    sides = problem.constraint.sides(e)
    if sides is None:
        raise RepairError(
            "no finite number of half-planes makes up this constraint; use polygon, diamond or barrier",
            constraint=problem.constraint.name,
        )
    rows, bodies, choices = sides.offset.shape
    flat = HalfPlanes(normal=sides.normal.reshape(rows, -1, 2), offset=sides.offset.reshape(rows, -1))
    flat = as_executed(flat, problem.limit)
    normal = np.moveaxis(np.asarray(flat.normal).reshape(rows, -1, bodies, choices, 2), 1, 3)
    offset = np.moveaxis(np.asarray(flat.offset).reshape(rows, -1, bodies, choices), 1, 3)
    asked = ~np.isneginf(offset).all(axis=3).any(axis=2)
    row, body = np.nonzero(asked if problem.agents else asked & ~np.asarray(e.steers))
    return Conditions(row=row, body=body, normal=normal[row, body], offset=offset[row, body])


def outputs(problem: Problem, params: Params) -> Float[np.ndarray, "R O"]:
    """The network's outputs in their units, by a float64 forward pass."""
    chain = chain_of(params, problem.scales, problem.situations, None, normalise=problem.normalise)
    return pre_activations(chain)["readout/layer0"] * problem.meaning.unit


def actions_of(problem: Problem, out: Float[np.ndarray, "R O"]) -> Float[np.ndarray, "R 2"]:
    """The accelerations that outputs amount to [m/s^2]."""
    return out @ problem.meaning.matrix.T + problem.meaning.offset


def violations(problem: Problem, out: Float[np.ndarray, "R O"]) -> Float[np.ndarray, " K"]:
    """By how much each condition is violated by the outputs [m/s^2], 0 where it holds; without the margin."""
    short = problem.conditions.short(actions_of(problem, out))
    return np.maximum(short.min(axis=1, initial=np.inf), 0)


def deviation(problem: Problem, out: Float[np.ndarray, "R O"]) -> float:
    """Mean over rows of the L1 distance to the targets (eq. 6.8)."""
    return float(np.abs(out - problem.targets).sum(axis=1).mean())
