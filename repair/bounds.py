"""What every neuron can be while one layer's weights move in a box: intervals, and linear programs that tighten them.

For fixed inputs, all before the free layer is constant and the free layer is affine in its weights, so that the
intervals there are exact; they widen from layer to layer after it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from envs.record import record
from gnn.family import Params
from gnn.features import Scales
from repair.errors import RepairError, Unbounded
from repair.network import Situations, layers, mlp, scaled
from repair.program import Linear, Program
from repair.solve import highs_of
from swarm_mjcf.errors import SpecError

MESSAGES = "messages"
"""The summed messages, among the pre-activations."""


@record
class Interval:
    """Lower and upper bounds of n items' features."""

    low: Float[np.ndarray, "n F"]
    high: Float[np.ndarray, "n F"]


@dataclass(frozen=True)
class Layer:
    """One affine layer, with or without ReLU."""

    path: str
    """As `edge/obstacle/layer2`."""
    kernel: Float[np.ndarray, "I O"]
    bias: Float[np.ndarray, " O"]
    relu: bool
    free: bool = False
    """Whether its weights move."""


@dataclass(frozen=True)
class Sum:
    """Messages summed into their receivers, beside the receivers' own states: the node function's input (eq. 5.23)."""

    into: sparse.csr_array
    """(R, items), 1 where the row receives the item."""
    rest: Float[np.ndarray, "R F"]
    """Messages of the edge types that do not move."""
    own: Float[np.ndarray, "R 4"]


@dataclass(frozen=True)
class Chain:
    """The network from its first moving layer on, with what goes into it."""

    inputs: Float[np.ndarray, "n I"]
    """Of the free layer, one item for each copy of it: a pair of agent and sender, or an agent."""
    steps: tuple[Layer | Sum, ...]


def paths(params: Params) -> list[str]:
    """All layers from the last to the first: readout, node function, edge functions."""
    parts = [("readout", params["readout"]), ("node", params["node"])]
    parts += [(f"edge/{name}", part) for name, part in reversed(params["edge"].items())]
    return [f"{name}/layer{i}" for name, part in parts for i in reversed(range(len(part)))]


def layer_at(params: Params, path: str) -> Params:
    """`kernel` and `bias` of a layer. Raises SpecError, with all paths, for one that does not exist."""
    if path not in paths(params):
        raise SpecError("layer", path, "one of " + ", ".join(paths(params)))
    part: Params = params
    for name in path.split("/"):
        part = part[name]
    return part


def chain_of(
    params: Params, scales: Scales, situations: Situations, free: str | None, *, normalise: bool = True
) -> Chain:
    """The network as a chain that starts at layer `free`; for None at the readout, with nothing free.

    All before it is evaluated in float64. The last step gives the readout without its unit. Raises SpecError for a
    path that does not exist, RepairError for weights that are not finite, Unbounded for such situations.
    """
    start = free or "readout/layer0"
    layer_at(params, start)
    for path in paths(params):
        if not all(np.isfinite(np.asarray(leaf)).all() for leaf in layer_at(params, path).values()):
            raise RepairError("the weights are not all finite", layer=path)
    own = np.asarray(scaled(np.asarray(situations.own, np.float64), scales, normalise))
    if not np.isfinite(own).all():
        raise Unbounded("states are not all finite", of="agents")
    part, _, depth = start.rpartition("/layer")
    before = int(depth)
    rest, edge = np.zeros((len(own), params["node"]["layer0"]["kernel"].shape[0] - 4)), None
    for name, senders in situations.senders.items():
        if not senders.shape[1] or name not in params["edge"]:
            continue
        of = np.asarray(scaled(np.asarray(senders, np.float64), scales, normalise))
        row, place = np.nonzero(situations.present[name])
        pairs = np.concatenate([own[row], of[row, place]], axis=1)
        if not np.isfinite(pairs).all():
            raise Unbounded("states are not all finite", of=name)
        into = sparse.csr_array((np.ones(len(row)), (row, np.arange(len(row)))), shape=(len(own), len(row)))
        if part != f"edge/{name}":
            rest = rest + into @ mlp(params["edge"][name], pairs)
        elif len(pairs):
            steps = _steps(params, part, free)
            edge = _through(steps[:before], pairs), steps[before:], into
    node, readout = _steps(params, "node", free), _steps(params, "readout", free)
    if not part.startswith("edge/"):
        steps = (*node, *readout)
        before += 0 if part == "node" else len(node)
        return Chain(_through(steps[:before], np.concatenate([own, rest], axis=1)), steps[before:])
    if edge is None:
        raise RepairError("nobody sends through this layer in these situations", layer=start)
    inputs, steps, into = edge
    return Chain(inputs, (*steps, Sum(into, rest, own), *node, *readout))


def _steps(params: Params, part: str, free: str | None) -> tuple[Layer, ...]:
    """The layers of a part: ReLU after each but the last of an edge function and the readout."""
    tree = params
    for name in part.split("/"):
        tree = tree[name]
    made = []
    for depth, weights in enumerate(layers(tree)):
        kernel, bias = (np.asarray(weights[name], np.float64) for name in ("kernel", "bias"))
        path = f"{part}/layer{depth}"
        made.append(Layer(path, kernel, bias, part == "node" or depth < len(tree) - 1, path == free))
    return tuple(made)


def _through(steps: tuple[Layer, ...], x: np.ndarray) -> np.ndarray:
    for step in steps:
        x = x @ step.kernel + step.bias
        x = np.maximum(x, 0) if step.relu else x
    return x


def pre_activations(chain: Chain) -> dict[str, Float[np.ndarray, "n F"]]:
    """What each layer of the chain gives before its ReLU, by path, and the `messages` summed, at its own weights."""
    found, x = {}, chain.inputs
    for step in chain.steps:
        if isinstance(step, Sum):
            found[MESSAGES] = step.into @ x + step.rest
            x = np.concatenate([step.own, found[MESSAGES]], axis=1)
            continue
        found[step.path] = x @ step.kernel + step.bias
        x = np.maximum(found[step.path], 0) if step.relu else found[step.path]
    return found


def intervals(chain: Chain, radius: float) -> dict[str, Interval]:
    """Bounds of every layer's pre-activations, by path, for free weights within +-`radius` of their values.

    Raises Unbounded where they are not finite.
    """
    found, x = {}, Interval(low=chain.inputs, high=chain.inputs)
    for step in chain.steps:
        x = after(step, x, radius)
        if isinstance(step, Layer):
            found[step.path] = x
            x = activated(step, x)
    return found


def after(step: Layer | Sum, x: Interval, radius: float) -> Interval:
    """Bounds after one step, before its ReLU; rounded outward. A free layer needs constant inputs."""
    if isinstance(step, Sum):
        total = _affine(x, step.into, step.rest)
        return Interval(
            low=np.concatenate([step.own, total.low], axis=1), high=np.concatenate([step.own, total.high], axis=1)
        )
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused below
        middle, half = (x.low + x.high) / 2, (x.high - x.low) / 2
        centre = middle @ step.kernel + step.bias
        spread = half @ np.abs(step.kernel)
        moved = radius * (np.abs(middle).sum(axis=1, keepdims=True) + 1) if step.free else 0.0
        size = (np.abs(middle) + half) @ np.abs(step.kernel) + np.abs(step.bias) + moved
        return _outward(centre - spread - moved, centre + spread + moved, size, len(step.kernel), step.path)


def activated(step: Layer, x: Interval) -> Interval:
    """Bounds after the step's ReLU."""
    return Interval(low=np.maximum(x.low, 0), high=np.maximum(x.high, 0)) if step.relu else x


def _affine(x: Interval, into: sparse.csr_array, rest: np.ndarray) -> Interval:
    low, high = into @ x.low + rest, into @ x.high + rest
    size = into @ np.maximum(np.abs(x.low), np.abs(x.high)) + np.abs(rest)
    most = int(np.diff(into.indptr).max(initial=1))
    return _outward(low, high, size, most, "messages")


def _outward(low: np.ndarray, high: np.ndarray, size: np.ndarray, terms: int, where: str) -> Interval:
    """Widened by what float64 may lose in sums of that many terms and that size."""
    lost = 2 * (terms + 4) * np.finfo(float).eps * size
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise Unbounded("no finite bounds: inputs, weights and their box must be finite", layer=where)
    return Interval(low=low - lost, high=high + lost)


def tightened(program: Program, of: Linear, x: Interval, which: Int[np.ndarray, " k"]) -> Interval:
    """The bounds with those of the expressions `which` (flat indices) minimised and maximised over the program's linear
    relaxation: 2 k linear programs, each from the last one's basis.

    Never wider than before. Taken from the dual side and evaluated here (Neumaier & Shcherbina 2004), so that they are
    bounds whatever the solver's tolerance; every column needs finite bounds for that.
    """
    low, high = x.low.ravel().copy(), x.high.ravel().copy()
    highs = highs_of(program, relaxed=True)
    everywhere = np.arange(len(program.cost), dtype=np.int32)
    for j in which:
        expression = of.take(np.array([j]))
        cost = np.zeros(len(program.cost))
        cost[expression.matrix.indices] = expression.matrix.data
        for bounds, sign in ((low, 1.0), (high, -1.0)):
            highs.changeColsCost(len(cost), everywhere, sign * cost)
            highs.run()
            solution = highs.getSolution()
            if not solution.dual_valid:
                continue
            least = sign * (_dual_bound(program, sign * cost, np.array(solution.row_dual)))
            found = least + float(expression.constant[0])
            bounds[j] = sign * max(sign * bounds[j], sign * found)
    return Interval(low=low.reshape(x.low.shape), high=high.reshape(x.high.shape))


def _dual_bound(program: Program, cost: np.ndarray, dual: np.ndarray) -> float:
    """A lower bound of `cost @ x` over the linear relaxation, true for any multipliers of the rows."""
    # A multiplier that leans on an absent side of its row is none.
    dual = np.where((dual > 0) & np.isneginf(program.low) | (dual < 0) & np.isposinf(program.high), 0.0, dual)
    left = cost - program.matrix.T @ dual
    sides = _products(dual, program.low, program.high)
    columns = _products(left, program.lower, program.upper)
    size = np.abs(sides).sum() + np.abs(columns).sum() + (abs(program.matrix.T) @ np.abs(dual)) @ _reach(program)
    return float(sides.sum() + columns.sum() - 1e-15 * len(cost) * size)


def _products(factor: np.ndarray, if_positive: np.ndarray, if_negative: np.ndarray) -> np.ndarray:
    return factor * np.where(factor > 0, if_positive, np.where(factor < 0, if_negative, 0.0))


def _reach(program: Program) -> np.ndarray:
    return np.maximum(np.abs(program.lower), np.abs(program.upper))
