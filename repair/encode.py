"""A ReLU SwarmNet with one layer free as a mixed-integer program (eq. 6.2-6.19), for fixed situations.

What lies before the free layer is evaluated, not encoded: for fixed inputs it is constant. Every big-M is a bound that
was computed (`repair.bounds`); neurons that cannot change their sign within the box get no binary.
"""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy import sparse

from gnn.family import Params
from repair.bounds import (
    MESSAGES,
    Interval,
    Layer,
    Sum,
    activated,
    after,
    chain_of,
    layer_at,
    pre_activations,
    tightened,
)
from repair.constraints.constraint import drifted
from repair.constraints.diamond import Diamond
from repair.encounters import encounters
from repair.problem import Conditions, Problem, actions_of
from repair.program import SLACK, Builder, Linear, Program, columns, constant, each, eye, kron
from swarm_mjcf.errors import SpecError


@dataclass(frozen=True)
class Encoded:
    """A program, and how to get from it to weights and back."""

    program: Program
    problem: Problem
    params: Params
    """Those in the middle of the box."""
    free: str | None
    bounds: dict[str, Interval]
    """Of every encoded layer's pre-activations."""
    kept: np.ndarray
    """Indices of the conditions that are in the program; the others hold everywhere in the box."""

    def params_of(self, values: Float[np.ndarray, " n"]) -> Params:
        """The repaired weights: float32 leaves, a new tree."""
        params = jax.tree.map(np.asarray, self.params)
        if self.free is None:
            return params
        change = values[self.program.blocks["weights"]]
        return replaced(params, self.free, change[:-1], change[-1])

    def values_of(self, params: Params) -> Float[np.ndarray, " n"]:
        """Every column's value for given weights, which differ from `params` in the free layer alone: a start.

        Where the weights violate a hard condition, no values satisfy the rows, and the binaries are the nearest ones.
        """
        return _values_of(self, params)


def replaced(params: Params, path: str, kernel: Float[np.ndarray, "I O"], bias: Float[np.ndarray, " O"]) -> Params:
    """The parameters with these added to one layer, computed in float64, stored in float32."""
    change = {"kernel": kernel, "bias": bias}

    def new(at: tuple[Any, ...], leaf: np.ndarray) -> np.ndarray:
        *part, name = (str(key.key) for key in at)
        if "/".join(part) != path:
            return leaf
        return (np.asarray(leaf, np.float64) + change[name]).astype(np.float32)

    return jax.tree_util.tree_map_with_path(new, params)


def encode(params: Params, problem: Problem, *, free: str | None, radius: float, tighten: int = 0) -> Encoded:
    """The program over changes of layer `free` (as `edge/obstacle/layer2`, or None) of at most `radius` each.

    Blocks of columns: `weights` (I + 1, O), the changes, the bias last; for each ReLU layer `PATH/on` h, `PATH/off` h_-
    and `PATH/side` theta (eq. 6.4-6.7) of the neurons that may change sign (`on` also of those that are always on);
    `messages` (R, F); `output` (R, O); `above`, `below` (eq. 6.9-6.12); and those of the conditions.
    At most `tighten` neurons' bounds are tightened by linear programs, those nearest to being decided in each layer.
    Raises Unbounded where bounds are not finite, RepairError for weights that are not.
    """
    if not radius >= 0:
        raise SpecError("radius", radius, "at least 0")
    chain = chain_of(params, problem.scales, problem.situations, free, normalise=problem.normalise)
    build = Builder()
    bounds: dict[str, Interval] = {}
    x, value = Interval(low=chain.inputs, high=chain.inputs), constant(chain.inputs.ravel())
    for step in chain.steps:
        before, x = x, after(step, x, radius)
        if isinstance(step, Sum):
            value = _summed(build, step, value, x)
            continue
        value = _affine(build, step, value, before, radius)
        if tighten and not step.free and value.matrix.nnz:
            x, used = _tightened(build.program(), step, value, x, tighten)
            tighten -= used
        bounds[step.path] = x
        if step.relu:
            value = _relu(build, step.path, value, x)
        x = activated(step, x)
    kept = _objective(build, problem, value, x)
    return Encoded(build.program(), problem, params, free, bounds, kept)


def _affine(build: Builder, step: Layer, value: Linear, x: Interval, radius: float) -> Linear:
    """W h + b of every item: linear in h, or for the free layer, whose inputs are constant, in its weights."""
    items = len(x.low)
    if not step.free:
        return value.map(each(items, step.kernel.T), np.tile(step.bias, items))
    inputs, wide = np.concatenate([x.low, np.ones((items, 1))], axis=1), len(step.bias)
    weights = build.variables("weights", (inputs.shape[1], wide), lower=-radius, upper=radius)
    change = columns(weights).map(kron(inputs, eye(wide)))
    return change + constant((x.low @ step.kernel + step.bias).ravel())


def _summed(build: Builder, step: Sum, value: Linear, x: Interval) -> Linear:
    rows, wide = step.rest.shape
    total = value.map(kron(step.into, eye(wide)), step.rest.ravel())
    messages = build.variables(MESSAGES, (rows, wide), lower=x.low[:, 4:], upper=x.high[:, 4:])
    build.rows(total - columns(messages), 0.0, 0.0)
    beside = each(rows, eye(wide + 4, wide, -4))
    states = np.concatenate([step.own, np.zeros((rows, wide))], axis=1)
    return columns(messages).map(beside, states.ravel())


def _tightened(program: Program, step: Layer, value: Linear, x: Interval, most: int) -> tuple[Interval, int]:
    low, high = x.low.ravel(), x.high.ravel()
    unsure = (low < 0) & (high > 0) if step.relu else np.full(len(low), step.path == "readout/layer0")
    open_ = np.flatnonzero(unsure)
    which = open_[np.argsort(np.minimum(-low, high)[open_])][:most]
    return (tightened(program, value, x, which) if len(which) else x), len(which)


def _signs(x: Interval) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of the neurons that can be on, and of those among them that can also be off."""
    on = np.flatnonzero(x.high.ravel() > 0)
    return on, on[x.low.ravel()[on] < 0]


def _relu(build: Builder, path: str, value: Linear, x: Interval) -> Linear:
    """Eq. 6.4-6.7 with the bounds as big-M."""
    low, high = x.low.ravel(), x.high.ravel()
    on, both = _signs(x)
    above = build.variables(f"{path}/on", (len(on),), lower=np.maximum(low[on], 0), upper=high[on])
    below = build.variables(f"{path}/off", (len(both),), upper=-low[both])
    side = build.variables(f"{path}/side", (len(both),), integer=True)
    switching = np.flatnonzero(low[on] < 0)
    place = sparse.csr_array((np.ones(len(both)), (switching, np.arange(len(both)))), shape=(len(on), len(both)))
    build.rows(value.take(on) - columns(above) + columns(below).map(place), 0.0, 0.0)  # (6.4)
    build.rows(columns(above[switching]) - columns(side).times(high[both]), high=0.0)  # (6.7), theta = 0
    build.rows(columns(below) - columns(side).times(low[both]), high=-low[both])  # (6.7), theta = 1
    back = sparse.csr_array((np.ones(len(on)), (on, np.arange(len(on)))), shape=(len(low), len(on)))
    return columns(above).map(back)


def _objective(build: Builder, problem: Problem, readout: Linear, x: Interval) -> np.ndarray:
    """Eq. 6.9-6.12 and the conditions; returns the indices of those that some weights in the box violate."""
    unit, targets = problem.meaning.unit, problem.targets
    rows, wide = targets.shape
    low, high = np.minimum(x.low * unit, x.high * unit), np.maximum(x.low * unit, x.high * unit)
    out = build.variables("output", (rows, wide), lower=low, upper=high)
    build.rows(readout.times(np.tile(unit, rows)) - columns(out), 0.0, 0.0)
    above = build.variables("above", (rows, wide), upper=np.maximum(high - targets, 0), cost=1 / rows)
    below = build.variables("below", (rows, wide), upper=np.maximum(targets - low, 0), cost=1 / rows)
    build.rows(columns(above) - columns(below) - columns(out), -targets.ravel(), -targets.ravel())
    matrix, offset = problem.meaning.matrix, problem.meaning.offset
    up, down = np.maximum(matrix, 0).T, np.minimum(matrix, 0).T
    action = columns(out).map(each(rows, matrix), offset.ravel())
    reach = Interval(low=low @ up + high @ down + offset, high=high @ up + low @ down + offset)
    return _conditional(build, problem, action, reach)


def _conditional(build: Builder, problem: Problem, action: Linear, reach: Interval) -> np.ndarray:
    conditions = problem.conditions
    least = _least(conditions, reach) - problem.margin  # how far beyond each half-plane every action is
    kept = np.flatnonzero(~(least >= 0).all(axis=2).any(axis=1))
    conditions, least = conditions.take(kept), least[kept]
    slack = None
    if problem.price is not None:
        slack = build.variables(SLACK, (len(kept),), cost=problem.price)
    if _by_axes(problem):
        _diamond(build, problem, conditions, action, reach, slack)
    else:
        _sides(build, problem, conditions, least, action, reach, slack)
    return kept


def _by_axes(problem: Problem) -> bool:
    return isinstance(problem.constraint, Diamond) and problem.limit == float("inf")


def _least(conditions: Conditions, reach: Interval) -> np.ndarray:
    """The least of normal . u - offset over the actions within reach, (K, D, G)."""
    low, high = reach.low[conditions.row, None, None], reach.high[conditions.row, None, None]
    n = conditions.normal
    least = np.where(n > 0, n * low, n * high)
    size = np.abs(least).sum(axis=-1) + np.abs(np.where(np.isneginf(conditions.offset), 0, conditions.offset))
    return least.sum(axis=-1) - conditions.offset - 1e-14 * size


def _sides(
    build: Builder,
    problem: Problem,
    conditions: Conditions,
    least: np.ndarray,
    action: Linear,
    reach: Interval,
    slack: np.ndarray | None,
) -> None:
    """A binary for each side, at least one of them 1; none for conditions that have but one side."""
    count, sides, _ = conditions.offset.shape
    at, side, plane = np.nonzero(least < 0)
    normal, offset = conditions.normal[at, side, plane], conditions.offset[at, side, plane] + problem.margin
    where = 2 * conditions.row[at]
    index = np.repeat(np.arange(len(at)), 2), np.stack([where, where + 1], axis=1).ravel()
    along = action.map(sparse.csr_array((normal.ravel(), index), shape=(len(at), len(action))))
    if slack is not None:
        along = along + columns(slack[at])
    if sides == 1:
        build.rows(along, low=offset)
        return
    chosen = build.variables("chosen", (count, sides), upper=_possible(problem, conditions, reach) + 0.0, integer=True)
    build.rows(columns(chosen).map(each(count, np.ones((1, sides)))), low=1.0)
    big = -least[at, side, plane]
    build.rows(along - columns(chosen[at, side]).times(big), low=offset - big)


def _possible(problem: Problem, conditions: Conditions, reach: Interval) -> np.ndarray:
    """Which sides some action within reach is on (K, D); all of them where slack can make up for it."""
    if problem.price is not None:
        return np.ones(conditions.offset.shape[:2], bool)
    turned = Conditions(
        row=conditions.row, body=conditions.body, normal=-conditions.normal, offset=np.zeros(conditions.offset.shape)
    )
    most = -_least(turned, reach)
    return (most >= conditions.offset).all(axis=2)


def _diamond(
    build: Builder,
    problem: Problem,
    conditions: Conditions,
    action: Linear,
    reach: Interval,
    slack: np.ndarray | None,
) -> None:
    """Eq. 6.14-6.19: the next relative position in positive and negative parts, a binary for each axis."""
    row = conditions.row
    drift, radius, push = _next_place(problem, conditions)
    low, high = drift + push * reach.low[row], drift + push * reach.high[row]
    beyond, before = np.maximum(high, 0), np.maximum(-low, 0)
    right = build.variables("diamond/on", drift.shape, upper=beyond)
    left = build.variables("diamond/off", drift.shape, upper=before)
    side = build.variables(
        "diamond/side", drift.shape, lower=(before <= 0) + 0.0, upper=(beyond > 0) + 0.0, integer=True
    )
    place = action.take(np.stack([2 * row, 2 * row + 1], axis=1).ravel()).times(push) + constant(drift.ravel())
    build.rows(place - columns(right) + columns(left), 0.0, 0.0)  # (6.15)
    build.rows(columns(right) - columns(side).times(beyond.ravel()), high=0.0)  # (6.18), xi = 0
    build.rows(columns(left) + columns(side).times(before.ravel()), high=before.ravel())  # (6.18), xi = 1
    both = each(len(row), np.full((1, 2), np.sqrt(0.5)))
    distance = (columns(right) + columns(left)).map(both)
    if slack is not None:
        distance = distance + columns(slack).times(push)
    build.rows(distance, low=radius + push * problem.margin)  # (6.19), divided by sqrt(2)


def _next_place(problem: Problem, conditions: Conditions) -> tuple[np.ndarray, np.ndarray, float]:
    """Relative places after the step without acceleration (K, 2) [m], distances to keep (K,) [m], and the push."""
    assert isinstance(problem.constraint, Diamond)
    assert problem.bodies is not None
    e = encounters(problem.situations, problem.bodies)
    drift, reach = np.asarray(drifted(e, problem.constraint)), np.asarray(e.reach)
    at = conditions.row, conditions.body
    return drift[at], reach[at] + problem.constraint.margin, problem.constraint.push


def _values_of(encoded: Encoded, params: Params) -> np.ndarray:
    problem, blocks = encoded.problem, encoded.program.blocks
    chain = chain_of(params, problem.scales, problem.situations, encoded.free, normalise=problem.normalise)
    values = np.zeros(len(encoded.program.cost))
    found = pre_activations(chain)
    for step in chain.steps:
        if isinstance(step, Sum):
            values[blocks[MESSAGES]] = found[MESSAGES]
            continue
        if step.free:
            was = layer_at(encoded.params, step.path)
            values[blocks["weights"]] = np.concatenate([step.kernel - was["kernel"], (step.bias - was["bias"])[None]])
        if step.relu:
            pre = found[step.path].ravel()
            on, both = _signs(encoded.bounds[step.path])
            values[blocks[f"{step.path}/on"]] = np.maximum(pre[on], 0)
            values[blocks[f"{step.path}/off"]] = np.maximum(-pre[both], 0)
            values[blocks[f"{step.path}/side"]] = pre[both] > 0
    out = found["readout/layer0"] * problem.meaning.unit
    values[blocks["output"]] = out
    values[blocks["above"]] = np.maximum(out - problem.targets, 0)
    values[blocks["below"]] = np.maximum(problem.targets - out, 0)
    _condition_values(encoded, actions_of(problem, out), values)
    return values


def _condition_values(encoded: Encoded, action: np.ndarray, values: np.ndarray) -> None:
    problem, blocks = encoded.problem, encoded.program.blocks
    conditions = problem.conditions.take(encoded.kept)
    short = conditions.short(action) + problem.margin
    if SLACK in blocks:
        values[blocks[SLACK]] = np.maximum(short.min(axis=1, initial=np.inf), 0)
    if "chosen" in blocks:
        open_ = encoded.program.upper[blocks["chosen"]] > 0
        best = np.argmin(np.where(open_, short, np.inf), axis=1)
        values[blocks["chosen"]] = np.eye(short.shape[1])[best]
    if "diamond/side" in blocks:
        drift, _, push = _next_place(problem, conditions)
        place = drift + push * action[conditions.row]
        values[blocks["diamond/on"]], values[blocks["diamond/off"]] = np.maximum(place, 0), np.maximum(-place, 0)
        values[blocks["diamond/side"]] = place > 0
