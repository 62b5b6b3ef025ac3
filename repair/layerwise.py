"""The thesis's layer-wise tuning: one layer free at a time, in rotation, until a common merit no longer falls."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from gnn.family import Params
from repair.bounds import paths
from repair.encode import encode
from repair.errors import Status
from repair.problem import Problem, deviation, outputs, violations
from repair.solve import Limits, Solver, solve
from swarm_mjcf.errors import SpecError

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Step:
    """One program of the rotation."""

    round: int
    layer: str
    status: Status
    before: float
    """Merit that the step started from."""
    after: float
    """Merit of what the solver found, by a forward pass of its float32 weights; `before` where it found nothing."""
    accepted: bool
    """Whether that was lower."""
    seconds: float
    gap: float | None
    size: dict[str, int]
    """Rows, columns, binaries and coefficients of the program."""


@dataclass(frozen=True)
class Layerwise:
    """What the rotation ends with."""

    params: Params
    """float32 leaves; those given where nothing was better."""
    merit: float
    history: tuple[Step, ...]


def merit(problem: Problem, params: Params, price: float) -> float:
    """Mean L1 deviation from the targets + price * sum of violations [m/s^2], by a float64 forward pass."""
    out = outputs(problem, params)
    return deviation(problem, out) + price * float(violations(problem, out).sum())


def layerwise(
    params: Params,
    problem: Problem,
    *,
    radius: float,
    price: float = 1.0,
    layers: Sequence[str] | None = None,
    rounds: int = 10,
    elastic: bool = True,
    solver: Solver = "highspy",
    limits: Limits | None = None,
    tighten: int = 0,
    progress: Callable[[Step], None] | None = None,
) -> Layerwise:
    """Rotates over `layers` (all, from the last to the first), each free within +-`radius` of its present weights.

    A step is taken only if it lowers `merit`; the rotation ends after a round that took none, or after `rounds`. With
    `elastic` conditions may be violated at `price`, which makes the program's objective the merit (but for the
    problem's margin); otherwise they are hard, as in the thesis, and where no weights in the box satisfy them the step
    says so and is not taken. Solver `highspy` starts from the present weights, so that it always has an incumbent that
    is elastic. `problem.price` is replaced. `params` are not changed.
    """
    known = paths(params)
    layers = known if layers is None else list(layers)
    for path in layers:
        if path not in known:
            raise SpecError("layers", path, "of " + ", ".join(known))
    if rounds < 1:
        raise SpecError("rounds", rounds, "at least 1")
    problem = replace(problem, price=price if elastic else None)
    params = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), params)
    best, history = merit(problem, params, price), []
    for number in range(rounds):
        taken = False
        for path in layers:
            encoded = encode(params, problem, free=path, radius=radius, tighten=tighten)
            start = encoded.values_of(params) if solver == "highspy" else None
            solution = solve(encoded.program, solver=solver, limits=limits, start=start)
            found = None if solution.values is None else encoded.params_of(solution.values)
            after = best if found is None else merit(problem, found, price)
            step = Step(
                round=number,
                layer=path,
                status=solution.status,
                before=best,
                after=after,
                accepted=after < best,
                seconds=solution.seconds,
                gap=solution.gap,
                size=encoded.program.size,
            )
            if found is not None and step.accepted:
                params, best, taken = found, after, True
            history.append(step)
            _LOG.info("round %d, %s: %s, merit %.6g -> %.6g", number, path, step.status, step.before, after)
            if progress is not None:
                progress(step)
        if not taken:
            break
    return Layerwise(params, best, tuple(history))
