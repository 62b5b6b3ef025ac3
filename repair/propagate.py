"""Bounds on what a ReLU SwarmNet does, for many sets of states at once: affine forms forward, linear bounds backward.

A set is an affine image of a cube: x = centre + z . generators with z in [-1, 1]^K, where x are the states of the agent
and of its senders side by side. So what an agent's edge functions and its node function share stays one variable.

Forward, every neuron is an affine form in z with an error of its own, beside an interval; that bounds what enters each
ReLU. Backward from the output, each ReLU is replaced by a line above or below it (Zhang et al. 2018, CROWN). Bounding
every layer backward as well takes 30 times as long on preset thesis-ch5 and gains 10% for sets of 0.2 m and m/s.
"""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float

from gnn.family import Params
from gnn.features import Scales
from repair.errors import NotEncodable, RepairError
from repair.network import layers

Values = np.ndarray

ROUNDING = 1e-9
"""Share by which bounds of what enters a ReLU are widened: far above what float64 rounds off."""


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One affine layer of E functions side by side."""

    kernel: Float[Values, "E I O"]
    bias: Float[Values, "E O"]


@dataclass(frozen=True, kw_only=True)
class Chain:
    """The network for an agent with E senders of given kinds: ReLU after every layer of `edges` and `nodes` but the
    last. Scales and the edge functions' last layers, which are linear, are multiplied into their neighbours."""

    edges: tuple[Layer, ...]
    """The first takes all inputs x (I = 4 + 4 E), the others the layer before of the same function."""
    join: Float[Values, "E O H"]
    """From the last of `edges` to the sum that the first of `nodes` holds."""
    direct: Float[Values, "I H"]
    """From x to that sum."""
    nodes: tuple[Layer, ...]
    """The first has no kernel of its own: `join` and `direct` are it. The last gives the accelerations [m/s^2]."""


@dataclass(frozen=True, kw_only=True)
class Forms:
    """Linear forms `constant + coefficients . z` over the cube, one for each of B sets and M functionals."""

    coefficients: Float[Values, "B M K"]
    constant: Float[Values, "B M"]
    blame: Float[Values, "B K"]
    """What the lines miss of the ReLUs, at most and at the output, shared among the coordinates by what they move in
    each ReLU's input: a guess at which of them to cut."""

    @property
    def least(self) -> Float[Values, "B M"]:
        """Their minima over the cube."""
        return self.constant - np.abs(self.coefficients).sum(axis=-1)


def chain_of(params: Params, scales: Scales, kinds: tuple[str, ...], *, normalise: bool = True) -> Chain:
    """The network for senders of these kinds (names of edge functions; some may be there twice).

    Raises:
      RepairError: a weight is NaN or infinite.
      NotEncodable: it has no edge function of a kind, or one without hidden layers.
    """
    params = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if not np.isfinite(leaf).all():
            name = "/".join(str(key.key) for key in path)
            raise RepairError("weights that are not finite cannot be bounded", weights=name)
    for kind in kinds:
        if kind not in params["edge"] or len(params["edge"][kind]) < 2:
            raise NotEncodable(f"no edge function {kind} with a hidden layer; it has {', '.join(params['edge'])}")
    parts = [layers(params["edge"][kind]) for kind in kinds]
    centre = np.asarray(scales.centre, np.float64) if normalise else np.zeros(2)
    size = np.array([scales.position, scales.position, scales.velocity, scales.velocity], np.float64)
    size = size if normalise else np.ones(4)
    shift = np.concatenate([centre, [0.0, 0.0]]) / size
    inputs = 4 + 4 * len(kinds)

    first = np.zeros((len(kinds), inputs, parts[0][0]["bias"].size))
    bias = np.zeros((len(kinds), first.shape[2]))
    for e, part in enumerate(parts):
        kernel = part[0]["kernel"]
        first[e, :4] = kernel[:4] / size[:, None]
        first[e, 4 + 4 * e : 8 + 4 * e] = kernel[4:] / size[:, None]
        bias[e] = part[0]["bias"] - shift @ (kernel[:4] + kernel[4:])
    edges = [Layer(kernel=first, bias=bias)]
    for depth in range(1, len(parts[0]) - 1):
        edges.append(
            Layer(
                kernel=np.stack([part[depth]["kernel"] for part in parts]),
                bias=np.stack([part[depth]["bias"] for part in parts]),
            )
        )
    head, *rest = [*layers(params["node"]), params["readout"]["layer0"]]
    own, total = head["kernel"][:4], head["kernel"][4:]
    join = np.stack([part[-1]["kernel"] @ total for part in parts])
    direct = np.zeros((inputs, own.shape[1]))
    direct[:4] = own / size[:, None]
    at = head["bias"] - shift @ own + sum(part[-1]["bias"] for part in parts) @ total
    nodes = [Layer(kernel=np.zeros((1, 0, at.size)), bias=at[None])]
    nodes += [Layer(kernel=layer["kernel"][None], bias=layer["bias"][None]) for layer in rest]
    if normalise:
        factor = float(scales.acceleration)
        nodes[-1] = Layer(kernel=nodes[-1].kernel * factor, bias=nodes[-1].bias * factor)
        if len(nodes) == 1:
            join, direct = join * factor, direct * factor
    return Chain(
        edges=tuple(edges),
        join=join,
        direct=direct,
        nodes=tuple(nodes),
    )


@dataclass(frozen=True, kw_only=True)
class _Relu:
    """Lines around max(z, 0) for z in known intervals: `lower z` below, `upper z + offset` above. Arrays (E, B, I)."""

    lower: Values
    upper: Values
    offset: Values
    low: Values
    high: Values
    """Of max(z, 0) itself."""
    moved: Values
    """(E, B, K, I): by how much each coordinate moves z."""

    def missed(self, rows: Values) -> Values:
        """Of rows (E, B, M, I) on max(z, 0): see `Forms.blame`; (B, K)."""
        gap = np.where(self.lower == self.upper, 0, self.offset) * np.abs(rows).max(axis=2)
        parts = gap / np.maximum(self.moved.sum(axis=2), 1e-300)
        return (self.moved @ parts[..., None])[..., 0].sum(axis=0)


def _relaxed(low: Values, high: Values, moved: Values) -> _Relu:
    low, high = low - ROUNDING * (1 + np.abs(low)), high + ROUNDING * (1 + np.abs(high))
    under, over = np.minimum(low, 0), np.maximum(high, 0)
    upper = over / np.maximum(over - under, 1e-300)
    # Below an unstable one lies 0 or z, whichever leaves the smaller triangle.
    lower = np.where((low >= 0) | (over > -under), 1.0, 0.0)
    return _Relu(lower=lower, upper=upper, offset=-upper * under, low=np.maximum(low, 0), high=over, moved=moved)


@dataclass(frozen=True, kw_only=True)
class _Affine:
    """Values within `error` of affine forms in z, and within an interval: arrays (E, B, 1 + K, I) and (E, B, I)."""

    form: Values
    error: Values
    low: Values
    high: Values

    def after(self, kernel: Values, bias: Values, extra: Values | None = None) -> "_Affine":
        """Of `x kernel + bias` (E, I, O); one sum over all E where there is `extra`, an exact form that is added."""
        form, error = np.matmul(self.form, kernel[:, None]), np.matmul(self.error, np.abs(kernel))
        middle = np.matmul((self.low + self.high) / 2, kernel)
        spread = np.matmul((self.high - self.low) / 2, np.abs(kernel))
        if extra is not None:
            form, error = form.sum(axis=0, keepdims=True) + extra, error.sum(axis=0, keepdims=True)
            middle = middle.sum(axis=0, keepdims=True) + extra[..., 0, :]
            spread = spread.sum(axis=0, keepdims=True) + np.abs(extra[..., 1:, :]).sum(axis=-2)
        form[:, :, 0] += bias[:, None]
        middle = middle + bias[:, None]
        radius = np.abs(form[:, :, 1:]).sum(axis=2) + error
        low, high = form[:, :, 0] - radius, form[:, :, 0] + radius
        return _Affine(
            form=form, error=error, low=np.maximum(low, middle - spread), high=np.minimum(high, middle + spread)
        )

    def rectified(self) -> tuple[_Relu, "_Affine"]:
        """max(., 0) between two parallel lines."""
        relu = _relaxed(self.low, self.high, np.abs(self.form[:, :, 1:]))
        half = relu.offset / 2
        form = self.form * relu.upper[:, :, None]
        form[:, :, 0] += half
        return relu, _Affine(form=form, error=self.error * relu.upper + half, low=relu.low, high=relu.high)


def _forward(chain: Chain, sets: Float[Values, "B P I"]) -> tuple[list[_Relu], list[_Relu]]:
    """The ReLUs of the edge functions and of the node function."""
    edges, nodes = [], []
    form = np.matmul(sets, chain.edges[0].kernel[:, None])
    form[:, :, 0] += chain.edges[0].bias[:, None]
    radius = np.abs(form[:, :, 1:]).sum(axis=2)
    state = _Affine(form=form, error=np.zeros_like(radius), low=form[:, :, 0] - radius, high=form[:, :, 0] + radius)
    for layer in chain.edges[1:]:
        relu, state = state.rectified()
        edges.append(relu)
        state = state.after(layer.kernel, layer.bias)
    relu, state = state.rectified()
    edges.append(relu)
    state = state.after(chain.join, chain.nodes[0].bias, extra=np.matmul(sets, chain.direct)[None])
    for layer in chain.nodes[1:]:
        relu, state = state.rectified()
        nodes.append(relu)
        state = state.after(layer.kernel, layer.bias)
    return edges, nodes


def _through(rows: Values, relu: _Relu) -> tuple[Values, Values]:
    """Rows (E, B, M, I) on max(z, 0) -> rows on z that are never above them, and constants (E, B, M)."""
    negative = np.minimum(rows, 0)
    constant = np.matmul(negative, relu.offset[..., None])[..., 0]
    return rows * relu.lower[:, :, None] + negative * (relu.upper - relu.lower)[:, :, None], constant


def _backward(chain: Chain, sets: Float[Values, "B P I"], rows: Float[Values, "B M 2"]) -> Forms:
    """Lower bounds of rows on the output."""
    edges, nodes = _forward(chain, sets)

    def against(rows: Values, layer: Layer) -> tuple[Values, Values]:
        return rows @ layer.kernel.swapaxes(1, 2)[:, None], (rows @ layer.bias[:, None, :, None])[..., 0]

    rows = rows[None]
    total: Values = np.zeros(rows.shape[:-1])
    blame: Values = np.zeros((len(sets), sets.shape[1] - 1))
    for layer, relu in zip(chain.nodes[:0:-1], nodes[::-1], strict=True):
        rows, constant = against(rows, layer)
        blame = blame + relu.missed(rows)
        rows, more = _through(rows, relu)
        total = total + constant + more
    total = (total + (rows @ chain.nodes[0].bias[:, None, :, None])[..., 0])[0]
    direct = rows[0] @ chain.direct.T
    rows = rows @ chain.join.swapaxes(1, 2)[:, None]
    for layer, relu in zip(chain.edges[::-1], edges[::-1], strict=True):
        blame = blame + relu.missed(rows)
        rows, more = _through(rows, relu)
        rows, constant = against(rows, layer)
        total = total + (constant + more).sum(axis=0)
    on_cube = (rows.sum(axis=0) + direct) @ sets.swapaxes(1, 2)
    return Forms(coefficients=on_cube[..., 1:], constant=total + on_cube[..., 0], blame=blame)


def lower_forms(
    chain: Chain,
    centre: Float[Values, "B I"],
    generators: Float[Values, "B K I"],
    functionals: Float[Values, "B M 2"],
    *,
    chunk: int = 48,
) -> Forms:
    """Linear forms that are nowhere above `functional . u` on the sets x = centre + z . generators, z in [-1, 1]^K.

    u is the network's acceleration [m/s^2], before the limits. Sound in exact arithmetic; float64 rounds off about
    1e-12 of the sums it takes, so use a tolerance above that. `chunk` sets go through together: what fits a cache.
    """
    sets = np.concatenate([centre[:, None], generators], axis=1)
    starts = range(0, max(len(sets), 1), chunk)
    found = [_backward(chain, sets[i : i + chunk], functionals[i : i + chunk]) for i in starts]
    return Forms(**{name: np.concatenate([vars(one)[name] for one in found]) for name in vars(found[0])})
