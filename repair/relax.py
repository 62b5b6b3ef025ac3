"""The work-horse: sequential quadratic programs over chosen weights, with the constraint as linear, elastic rows.

Each step linearises the actions in the weights (Gauss-Newton) and picks a half-plane of allowed actions for every
condition (the convex-concave step), which leaves a convex program in Gram form:

    min  1/2 mean |J d + u(w) - t|^2 + 1/2 lambda |w + d - w_0|^2 + 1/2 tau |d|^2 + price * sum(slack)
    s.t. n . (u(w) + J d) >= b + margin - slack,  slack >= 0

over the change d of the weights. After one Cholesky factor of the Gram matrix only its dual is left, a quadratic
program with a variable in a box for every row. Rows enter when a solution violates them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Float

from envs.dynamics import Kinematics
from envs.record import Array
from gnn.family import Params
from gnn.features import Scales
from repair.constraints.constraint import Constraint, HalfPlanes
from repair.encounters import Bodies, encounters
from repair.errors import RepairError, Status
from repair.limits import as_executed
from repair.linearise import FreeWeights, Linearised
from repair.network import Situations, actions


@dataclass(frozen=True, kw_only=True)
class SequentialProblem:
    """What is to be repaired: rows that must hold, rows whose actions should stay, and by what."""

    scales: Scales
    normalise: bool
    constraint: Constraint
    bodies: Bodies
    kinematics: Kinematics
    constrained: Situations
    """Agents whose executed action must satisfy the constraint."""
    anchors: Situations
    """Agents whose action should stay what it is."""
    targets: Float[Array, "A 2"]
    """What the anchors' actions should be [m/s^2]."""

    def act(self, params: Params, situations: Situations) -> Float[Array, "R 2"]:
        """The network's actions in float64 [m/s^2]."""
        return actions(params, self.scales, situations, normalise=self.normalise)

    def planes(self, action: Float[Array, "R 2"]) -> HalfPlanes:
        """Half-planes of the constrained rows' raw actions that make their executed ones allowed."""
        e = encounters(self.constrained, self.bodies)
        return as_executed(self.constraint.half_planes(e, action), self.kinematics.max_acceleration)

    def shortfall(self, action: Float[Array, "R 2"]) -> Float[Array, "R C"]:
        """By how much the constrained rows' conditions are missed [m/s^2]; 0 where they hold."""
        planes = self.planes(action)
        missed = planes.offset - np.sum(planes.normal * action[:, None], axis=-1)
        return np.maximum(np.where(np.isfinite(planes.offset), missed, 0), 0)


@dataclass(frozen=True, kw_only=True)
class Relaxation:
    """How the sequential program is run."""

    steps: int = 25
    """Linearisations at most."""
    price: float = 10.0
    """Of a condition that is missed by 1 m/s^2, per row, beside mean squares of actions [(m/s^2)^2 / (m/s^2)]; it
    rises where rows are left over."""
    stiffness: float = 1e-4
    """lambda: of the weights' way from where they began."""
    trust: float = 1e-3
    """tau at the first step; it shrinks after a good step and grows after a refused one."""
    margin: float = 0.02
    """Added to every condition, so that rounding and solver tolerance do not undo it [m/s^2]; it shrinks for rows that
    are left over, which may have less room."""
    tolerance: float = 1e-4
    """A condition missed by less holds [m/s^2]."""


@dataclass(frozen=True)
class Relaxed:
    """What a sequential program found."""

    params: Params
    status: Status
    violated: int
    """Constrained rows that still miss a condition."""
    merit: float
    history: list[dict] = field(default_factory=list)
    """Of every step: merit, deviation, rows violated, tight rows, trust, seconds."""


def relax(
    problem: SequentialProblem,
    params: Params,
    free: FreeWeights,
    settings: Relaxation,
    *,
    origin: Params | None = None,
    linearised: Linearised | None = None,
    time_limit: float = np.inf,
    progress: Callable[[int, int, dict], None] | None = None,
) -> Relaxed:
    """Changes the free weights of `params` until all conditions hold and nothing gets better.

    `origin`: the weights that `stiffness` holds on to, those given by default. A step is taken only where it lowers the
    true merit (deviation, way of the weights, price of what is missed) of the float32 weights. Status OPTIMAL is never
    claimed: FEASIBLE, or ELASTIC with rows left over.
    """
    began = time.perf_counter()
    linearised = linearised or Linearised(free, problem.scales, normalise=problem.normalise)
    home = free.vector(params if origin is None else origin)
    price, margin = settings.price, np.full(len(problem.constrained), settings.margin)
    trust, merit, history = settings.trust, _merit(problem, params, free, home, settings), []
    for step in range(settings.steps):
        if time.perf_counter() - began > time_limit:
            break
        model = _linear_model(problem, params, free, home, settings, linearised, margin)
        taken, tight, found = None, 0, merit
        for _ in range(4):
            change, tight = model.solve(trust)
            tried = free.put(params, free.vector(params) + change)
            found = _merit(problem, tried, free, home, settings)
            if found["merit"] < merit["merit"]:
                taken = tried
                break
            trust *= 8
        fell = merit["merit"] - found["merit"] if taken is not None else 0.0
        if taken is not None:
            params, merit, trust = taken, found, max(trust / 4, 1e-7)
        history.append(merit | {"tight": tight, "trust": trust, "seconds": time.perf_counter() - began})
        if progress is not None:
            progress(step + 1, settings.steps, history[-1])
        if fell < 1e-3 * max(merit["merit"], 1e-9):
            if merit["violated"] == 0 or settings.price > 1e4 * price:
                break
            # What is still missed is not worth mending at this price, or has less room than the margin.
            missed = problem.shortfall(problem.act(params, problem.constrained)) > settings.tolerance
            margin = np.where(missed.any(axis=1), margin / 2, margin)
            settings = replace(settings, price=4 * settings.price)
            merit = _merit(problem, params, free, home, settings)
    violated = merit["violated"]
    return Relaxed(params, Status.FEASIBLE if violated == 0 else Status.ELASTIC, violated, merit["merit"], history)


def _merit(
    problem: SequentialProblem, params: Params, free: FreeWeights, home: Float[Array, " P"], settings: Relaxation
) -> dict:
    """The true objective, with what it is made of."""
    deviation = np.mean(np.sum((problem.act(params, problem.anchors) - problem.targets) ** 2, axis=1))
    missed = problem.shortfall(problem.act(params, problem.constrained))
    way = np.sum((free.vector(params) - home) ** 2)
    rows = max(len(missed), 1)
    total = 0.5 * deviation + 0.5 * settings.stiffness * way + settings.price * missed.sum() / rows
    violated = int((missed > settings.tolerance).any(axis=1).sum())
    return {"merit": float(total), "deviation": float(deviation), "missed": float(missed.sum()), "violated": violated}


def _linear_model(
    problem: SequentialProblem,
    params: Params,
    free: FreeWeights,
    home: Float[Array, " P"],
    settings: Relaxation,
    linearised: Linearised,
    margin: Float[Array, " R"],
) -> "_Model":
    anchored = linearised.jacobian(params, problem.anchors)
    count = len(problem.targets)
    flat = anchored.reshape(2 * count, -1)
    gram = (flat.T @ flat).astype(np.float64) / count
    residual = (problem.act(params, problem.anchors) - problem.targets).reshape(-1)
    way = free.vector(params) - home
    gradient = flat.T.astype(np.float64) @ residual / count + settings.stiffness * way
    now = problem.act(params, problem.constrained)
    planes = problem.planes(now)
    missing = planes.offset + margin[:, None] - np.sum(planes.normal * now[:, None], axis=-1)
    return _Model(
        gram, gradient, settings.stiffness, linearised.jacobian(params, problem.constrained), planes.normal, missing,
        settings.price / max(len(now), 1),
    )  # fmt: skip


@dataclass(frozen=True)
class _Model:
    """One linearisation, solved for any trust."""

    gram: Float[Array, "P P"]
    gradient: Float[Array, " P"]
    stiffness: float
    jacobian: Float[Array, "R 2 P"]
    normal: Float[Array, "R C 2"]
    missing: Float[Array, "R C"]
    """What each condition still needs [m/s^2]; -inf for what is absent."""
    price: float

    def solve(self, trust: float) -> tuple[Float[Array, " P"], int]:
        """The change of the weights, and the number of rows that entered."""
        size = len(self.gradient)
        factor = _factor(self.gram, self.stiffness + trust)
        free_change = -scipy.linalg.cho_solve((factor, True), self.gradient, check_finite=False)
        change, chosen = free_change, np.zeros((0, 2), np.int64)
        towards = np.zeros((0, size))
        half = np.zeros((0, size))
        for _ in range(12):
            moved = self.jacobian @ change.astype(np.float32)
            needed = self.missing - np.sum(self.normal * moved[:, None], axis=-1)
            violated = np.argwhere(needed > 1e-3)
            known = set(map(tuple, chosen))
            fresh = np.array([pair for pair in map(tuple, violated) if pair not in known], np.int64).reshape(-1, 2)
            if not len(fresh):
                break
            fresh = fresh[np.argsort(-needed[fresh[:, 0], fresh[:, 1]])][:ENTERING]
            rows = np.einsum(
                "md,mdp->mp", self.normal[fresh[:, 0], fresh[:, 1]], self.jacobian[fresh[:, 0]], dtype=np.float64
            )
            chosen, towards = np.concatenate([chosen, fresh]), np.concatenate([towards, rows])
            # A H^-1 A' = (L^-1 A')' (L^-1 A').
            half = np.concatenate(
                [half, scipy.linalg.solve_triangular(factor, rows.T, lower=True, check_finite=False).T]
            )
            needs = self.missing[chosen[:, 0], chosen[:, 1]] - towards @ free_change
            multipliers = _dual(half @ half.T, needs, self.price)
            step = scipy.linalg.solve_triangular(factor.T, half.T @ multipliers, lower=False, check_finite=False)
            change = free_change + step
        return change, len(chosen)


def _factor(gram: Float[Array, "P P"], ridge: float) -> Float[np.ndarray, "P P"]:
    """Cholesky's lower factor of `gram` + ridge, a larger one where the rounding of float32 products outweighs it."""
    if not np.isfinite(gram).all():
        raise RepairError("derivatives by the weights are not finite")
    while True:
        try:
            return np.linalg.cholesky(gram + ridge * np.eye(len(gram)))
        except np.linalg.LinAlgError:
            ridge = max(8 * ridge, float(np.finfo(np.float32).eps * np.trace(gram)))


ENTERING = 600
"""Rows that may enter at a time: those that are missed most."""


def _dual(quadratic: Float[Array, "M M"], linear: Float[Array, " M"], price: float) -> Float[Array, " M"]:
    """argmin 1/2 m' Q m - q' m over 0 <= m <= price, rows scaled to a unit diagonal. Raises RepairError.

    Q is dense: L-BFGS-B needs products with it alone and takes a tenth of the time that OSQP spends on factors of it.
    """
    size = np.sqrt(np.maximum(np.diag(quadratic), 1e-12))
    scaled, wanted = quadratic / size[:, None] / size, linear / size

    def objective(m: Float[Array, " M"]) -> tuple[float, Float[Array, " M"]]:
        product = scaled @ m
        return float(0.5 * m @ product - wanted @ m), product - wanted

    options = {"maxiter": 3000, "maxfun": 6000, "maxcor": 30, "ftol": 1e-13, "gtol": 1e-7}
    bounds = [(0.0, top) for top in price * size]
    found = scipy.optimize.minimize(
        objective, np.zeros(len(linear)), jac=True, method="L-BFGS-B", bounds=bounds, options=options
    )
    if not np.isfinite(found.x).all():
        raise RepairError("the quadratic program could not be solved", rows=len(linear), said=found.message)
    return found.x / size
