"""The best weights of a layer in a box around weights found before: a certificate for them, and a polish.

Sequential programs (`repair.relax`) find weights and cannot say how good they are. Here the network with that layer
free is a mixed-integer program (`repair.encode`) over the box around them; HiGHS starts from them and proves a bound.
Such programs have weak relaxations, so groups g of 1, 2, 4.. rows are bounded first, over the same box,

    d_g <= min sum_{r in g} cost_r(w)   over w in the box that keep the conditions of g

which are small programs, and sum_{r in g} cost_r >= d_g are rows of the programs of larger groups, at last of all rows.
Rows whose inputs of the free layer are linearly independent hardly compete for its weights: there the sum over single
rows is nearly the whole bound. What rows that are alike cost together is found in groups, so like joins like.
"""

import time
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float
from scipy import sparse

from gnn.family import Params
from repair.bounds import Sum, chain_of
from repair.encode import Encoded, encode
from repair.errors import Status
from repair.problem import Problem, deviation, outputs, violations
from repair.program import SLACK, Program
from repair.solve import Limits, Solution, solve
from swarm_mjcf.errors import SpecError

SAFETY = 1e-6
"""Taken off a group's bound, relative to 1 + itself: what the solver's tolerance may have added."""
NOTHING = 1e-9
"""Costs below this count as none [m/s^2]."""
FINER = 0.2
"""Gap asked of groups, relative to that of the whole."""
SHARE = 0.5
"""Of the time limit, at most, for groups."""


@dataclass(frozen=True, kw_only=True)
class Polished:
    """What is known of a layer's weights in a box. Costs are mean L1 deviations [m/s^2] plus the price of violations,
    by a float64 forward pass of float32 weights."""

    params: Params
    """float32, those given where nothing better was found; the free layer's differ from them by the radius at most."""
    status: Status
    """OPTIMAL within the gap asked for, FEASIBLE with another one, ELASTIC with violations at a price. Without an
    incumbent INFEASIBLE, NO_INCUMBENT or NUMERICAL."""
    start: float | None
    """Cost of the weights given; None where they break a hard condition."""
    incumbent: float | None
    """Cost of `params`; None where they break a hard condition."""
    bound: float | None
    """Proven by the solver within its tolerance: no weights in the box that keep the problem's margin cost less. None
    where it proved that there are none."""
    gap: float | None
    """(incumbent - bound) / incumbent."""
    violated: int
    """Conditions that `params` break, by the forward pass."""
    seconds: float
    """Wall time of everything."""
    nodes: int
    """Of the whole program."""
    size: dict[str, int]
    """Rows, columns, binaries and coefficients of the whole program: binaries are neurons that the box leaves open."""


def polish(
    params: Params,
    problem: Problem,
    *,
    free: str = "edge/obstacle/layer2",
    radius: float,
    limits: Limits | None = None,
    tighten: int = 10_000,
    largest: int = 4,
) -> Polished:
    """The best weights of layer `free` within +-`radius` of `params`, which are not changed.

    `params` are the box's centre and the start; where they keep all conditions they are an incumbent, whatever becomes
    of the solver. `limits` are a gap of 1% and a minute by default; nodes are those of each program. `tighten`: neurons
    of a program, at most, whose bounds linear programs tighten; their time is not limited. `largest`: rows of the
    largest groups; 0 for none.

    Raises SpecError for a radius, layer or group that is none; RepairError, Unbounded as `repair.encode.encode`.
    """
    if not 0 < radius < float("inf"):
        raise SpecError("radius", radius, "a finite number above 0")
    if largest < 0:
        raise SpecError("largest", largest, "at least 0")
    began = time.perf_counter()
    limits = limits or Limits(gap=0.01)
    given = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), params)
    work = _Work(given, problem, free, radius, tighten, limits)
    if largest and limits.seconds:
        work.bound_groups(largest, began + SHARE * limits.seconds)
    found, encoded = work.solve(tuple(range(len(problem.situations))), began + limits.seconds, limits.gap)
    start, best = _cost(problem, given), given
    incumbent = start
    if found.values is not None:
        tried = encoded.params_of(found.values)
        cost = _cost(problem, tried)
        if cost is not None and (incumbent is None or cost < incumbent):
            best, incumbent = tried, cost
    bound = None if found.status == Status.INFEASIBLE else max(found.bound or 0.0, work.proven)
    if bound is not None and problem.price is not None:
        # The program charges for missing the margin too, which the cost does not ask for.
        count = len(violations(problem, outputs(problem, best)))
        bound = max(bound - problem.price * problem.margin * count, 0.0)
    gap = None
    if incumbent is not None and bound is not None:
        bound = min(bound, incumbent)  # a start may do without the margin that the bound is of
        gap = (incumbent - bound) / max(incumbent, NOTHING)
    violated = int((violations(problem, outputs(problem, best)) > 0).sum())
    return Polished(
        params=best,
        status=_status(found, incumbent, gap, violated, limits),
        start=start,
        incumbent=incumbent,
        bound=bound,
        gap=gap,
        violated=violated,
        seconds=time.perf_counter() - began,
        nodes=found.nodes,
        size=encoded.program.size,
    )


def _status(found: Solution, incumbent: float | None, gap: float | None, violated: int, limits: Limits) -> Status:
    if incumbent is None:
        return Status.NUMERICAL if found.status.solved else found.status
    if violated:
        return Status.ELASTIC
    return Status.OPTIMAL if gap is not None and gap <= limits.gap else Status.FEASIBLE


def _cost(problem: Problem, params: Params) -> float | None:
    out = outputs(problem, params)
    missed = float(violations(problem, out).sum())
    if missed and problem.price is None:
        return None
    return deviation(problem, out) + (missed * problem.price if problem.price else 0.0)


Group = tuple[int, ...]
"""Rows of the problem."""


class _Work:
    """One box, and what is known of groups of rows in it."""

    def __init__(
        self, params: Params, problem: Problem, free: str, radius: float, tighten: int, limits: Limits
    ) -> None:
        self.params, self.problem, self.free, self.radius = params, problem, free, radius
        self.tighten, self.limits = tighten, limits
        self.known: dict[Group, float] = {}
        """Proven parts of the whole cost."""
        self.proven = 0.0
        """The best sum of such parts."""

    def bound_groups(self, largest: int, until: float) -> None:
        """Bounds groups of 1, 2, 4.. rows, smaller ones than all rows; stops when time is up or a group is infeasible,
        as all rows are then. Rows that the free layer does not reach are in none."""
        every = len(self.problem.situations)
        features = _features(self.params, self.problem, self.free)
        groups: list[Group] = [(int(row),) for row in np.flatnonzero(features.any(axis=1))]
        while max(map(len, groups), default=every) <= min(largest, every - 1):
            for number, group in enumerate(groups):
                if group in self.known:
                    continue
                now = time.perf_counter()
                if now >= until:
                    return
                share = now + (until - now) / (len(groups) - number)
                found, _ = self.solve(group, share, FINER * self.limits.gap)
                if found.status == Status.INFEASIBLE:
                    return
                part = (found.bound or 0.0) * len(group) / every
                self.known[group] = max(part - SAFETY * (1 + abs(part)), 0.0)
            self.proven = max(self.proven, sum(self.known[group] for group in groups))
            if len(groups) == 1:
                return
            groups = _joined(groups, features)

    def solve(self, group: Group, until: float, gap: float) -> tuple[Solution, Encoded]:
        """The program of some rows alone, with all that is known of groups among them."""
        encoded = encode(
            self.params, _part(self.problem, group), free=self.free, radius=self.radius, tighten=self.tighten
        )
        place = {row: number for number, row in enumerate(group)}
        factor = len(self.problem.situations) / max(len(group), 1)
        known = {
            tuple(place[row] for row in inner): factor * part
            for inner, part in self.known.items()
            if part > 0 and place.keys() >= set(inner)
        }
        limits = replace(self.limits, seconds=max(until - time.perf_counter(), 0.0), gap=gap)
        start = encoded.values_of(self.params)
        return solve(_with(encoded, known), solver="highspy", limits=limits, start=start), encoded


def _part(problem: Problem, group: Group) -> Problem:
    """Some rows; the price is such that a row's share in deviation and violations stays what it was."""
    if len(group) == len(problem.situations):
        return problem
    rows = np.array(group)
    price = None if problem.price is None else problem.price * len(problem.situations) / len(group)
    output = problem.output and replace(problem.output, offset=problem.output.offset[rows])
    return replace(
        problem, situations=problem.situations.take(rows), targets=problem.targets[rows], price=price, output=output
    )


def _with(encoded: Encoded, known: dict[Group, float]) -> Program:
    """The program with what groups of its rows cost at least."""
    program, blocks = encoded.program, encoded.program.blocks
    if not known:
        return program
    owner = np.full(len(program.cost), -1)
    for name in ("above", "below"):
        owner[blocks[name]] = np.arange(len(blocks[name]))[:, None]
    if SLACK in blocks:
        owner[blocks[SLACK]] = encoded.problem.conditions.row[encoded.kept]
    costs = sparse.csr_array(np.stack([np.where(np.isin(owner, group), program.cost, 0.0) for group in known]))
    return replace(
        program,
        matrix=sparse.csr_array(sparse.vstack([program.matrix, costs])),
        low=np.append(program.low, list(known.values())),
        high=np.append(program.high, np.full(len(known), np.inf)),
    )


def _features(params: Params, problem: Problem, free: str) -> Float[np.ndarray, "R I"]:
    """What goes into the free layer of each row, its bias included, as unit vectors; zeros where nothing does."""
    chain = chain_of(params, problem.scales, problem.situations, free, normalise=problem.normalise)
    sums = [step for step in chain.steps if isinstance(step, Sum)]
    inputs = np.concatenate([chain.inputs, np.ones((len(chain.inputs), 1))], axis=1)
    rows = sums[0].into @ inputs if sums else inputs
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)


def _joined(groups: list[Group], features: Float[np.ndarray, "R I"]) -> list[Group]:
    """Pairs of groups, each with the one most like it of those left; an odd one stays alone."""
    left, pairs = list(groups), []
    while len(left) > 1:
        first = left.pop(0)
        alike = [np.abs(features[list(first)] @ features[list(other)].T).mean() for other in left]
        pairs.append(first + left.pop(int(np.argmax(alike))))
    return pairs + left
