"""SwarmNet: typed edge functions, aggregation, node function, readout. One Flax module; presets choose its parts.

Parameters are a nested dict whose paths name the parts: `edge/goal`, `edge/obstacle`, `edge/agent`, `psi`, `node`,
`readout`, `conv`; each holds `layer0`, `layer1`, ... with `kernel` and `bias`.
"""

from collections.abc import Sequence
from itertools import accumulate

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from envs.record import Array
from gnn.config import ModelConfig
from gnn.features import Scales
from gnn.graph import EDGE_TYPES, Graph


class Dense(nn.Module):
    """A linear layer of several inputs side by side, each multiplied before it is broadcast to the others.

    Of a pair of nodes, that is one product per node instead of one per pair.
    """

    width: int
    use_bias: bool = True

    @nn.compact
    def __call__(self, *inputs: Float[Array, "*_ inputs"]) -> Float[Array, "*n outputs"]:
        sizes = [x.shape[-1] for x in inputs]
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (sum(sizes), self.width))
        bounds = list(accumulate(sizes))[:-1]
        products = [_product(x, part) for x, part in zip(inputs, jnp.split(kernel, bounds), strict=True)]
        total = sum(products[1:], products[0])
        return total + self.param("bias", nn.initializers.zeros, (self.width,)) if self.use_bias else total


def _product(x: Float[Array, "*n inputs"], kernel: Float[Array, "inputs outputs"]) -> Float[Array, "*n outputs"]:
    """As one matrix by another: of more dimensions XLA's gradient on a CPU is 2 to 6 times as slow."""
    return (x.reshape(-1, x.shape[-1]) @ kernel).reshape(*x.shape[:-1], kernel.shape[-1])


class MLP(nn.Module):
    """ReLU layers, then a linear one `out` wide (none for `out=0`: the last hidden layer is the output).

    Of several inputs, which are broadcast to each other and stand side by side.
    """

    hidden: Sequence[int]
    out: int
    skip: bool = False
    dropout: float = 0.0
    """Of hidden neurons; only where the caller gives a random stream of that name."""
    use_bias: bool = True

    @nn.compact
    def __call__(self, *inputs: Float[Array, "*_ inputs"]) -> Float[Array, "*n outputs"]:
        x = inputs
        for depth, width in enumerate(self.hidden):
            y = nn.relu(Dense(width, self.use_bias, name=f"layer{depth}")(*x))
            if self.dropout:
                y = nn.Dropout(self.dropout, deterministic=not self.has_rng("dropout"))(y)
            x = (y,)
        if self.out:
            x = (Dense(self.out, self.use_bias, name=f"layer{len(self.hidden)}")(*x),)
        (y,) = x
        return y + Dense(y.shape[-1], use_bias=False, name="skip")(*inputs) if self.skip else y


class EdgeFunctions(nn.Module):
    """phi_e, one for each edge type (eq. 3.1, 5.22): messages of (receiver, sender) pairs."""

    config: ModelConfig

    @nn.compact
    def __call__(self, pairs: dict[str, Sequence[Array]]) -> dict[str, Array]:
        config = self.config
        settings = (config.edge_hidden, config.message, config.skip, config.dropout, config.edge_bias)
        return {name: MLP(*settings, name=name)(*inputs) for name, inputs in pairs.items()}


class Nearness(nn.Module):
    """How much of a message counts in the sum over near senders: exp(-d^2 / 2 r^2), with a learned reach r per type.

    Where the number of agents never changes in the data, a sum cannot be told from a multiple of a mean, and a network
    that took the wrong one fails at other sizes. Forces of contact and repulsion add up and are short; tendencies that
    reach across the swarm are averages. So distant senders act through mean and max alone.
    """

    @nn.compact
    def __call__(self, square: dict[str, Array]) -> dict[str, Array]:
        """Of squared distances."""
        weights = {}
        for name, d2 in square.items():
            log_reach = self.param(name, nn.initializers.constant(jnp.log(0.3)), ())
            weights[name] = jnp.exp(-0.5 * d2 * jnp.exp(-2 * log_reach))
        return weights


class Convolutions(nn.Module):
    """1D convolutions over the history of each node, kernel 3, no padding, ReLU (figure 3.3).

    As products with the three states side by side: XLA's convolutions are slow on a CPU, to compile and to run.
    """

    filters: Sequence[int]

    @nn.compact
    def __call__(self, history: Float[Array, "B V W F"]) -> Float[Array, "B V C"]:
        for depth, width in enumerate(self.filters):
            three = jnp.concatenate([history[:, :, :-2], history[:, :, 1:-1], history[:, :, 2:]], axis=-1)
            history = nn.relu(Dense(width, name=f"layer{depth}")(three))
        return history[:, :, 0]


class SwarmNet(nn.Module):
    """Node states of the last `window` rows -> (B, N, 2) accelerations [m/s^2], or (B, V, 4) changes of the states."""

    config: ModelConfig
    scales: Scales

    @nn.compact
    def __call__(self, history: Float[Array, "B W V 4"], graph: Graph) -> Float[Array, "B n out"]:
        config, scales = self.config, self.scales
        goals, obstacles, _ = graph.counts
        first = goals + obstacles
        if config.normalise:
            position = (history[..., :2] - scales.centre) / scales.position
            history = jnp.concatenate([position, history[..., 2:] / scales.velocity], axis=-1)
        last = history[:, -1]
        nodes = (
            Convolutions(config.convolutions, name="conv")(jnp.swapaxes(history, 1, 2)) if config.convolutions else last
        )
        everyone = config.output == "state_change"  # then static nodes are predicted too, as published
        active = slice(first, first + graph.agent.shape[1])
        receivers, current = nodes[:, active], last[:, active]

        masks = {"goal": graph.goal, "obstacle": graph.obstacle, "agent": graph.agent}
        senders, places = (
            {"goal": x[:, None, :goals], "obstacle": x[:, None, goals:first], "agent": x[:, None, first:]}
            for x in (nodes, last)
        )
        if config.nearest is not None and config.nearest < masks["agent"].shape[2]:
            index, masks["agent"] = _nearest(current[..., :2], last[:, first:, :2], masks["agent"], config.nearest)
            for x in (senders, places):
                x["agent"] = jnp.take_along_axis(x["agent"], index[..., None], axis=2)
        kinds = [name for name in EDGE_TYPES if senders[name].shape[2] and (config.context or name == "agent")]
        ahead = heading(current[..., 2:]) if config.frame else None
        pairs = {name: self._pairs(receivers, senders[name], ahead) for name in kinds}
        messages = EdgeFunctions(config, name="edge")(pairs)
        typed = {"any": [(messages[name], masks[name]) for name in kinds]}
        if "near" in config.aggregate:
            square = {name: _squared_distance(current, places[name]) for name in kinds}
            near = Nearness(name="reach")(square)
            typed["near"] = [(messages[name] * near[name][..., None], masks[name]) for name in kinds]
        aggregate = jnp.concatenate(
            [_aggregate(typed.get(how, typed["any"]), how) for how in config.aggregate], axis=-1
        )
        if everyone:
            nothing = jnp.zeros((aggregate.shape[0], first, aggregate.shape[-1]), aggregate.dtype)
            aggregate = jnp.concatenate([nothing, aggregate], axis=1)
        if config.psi:
            aggregate = MLP((config.message,), config.message, config.skip, config.dropout, name="psi")(aggregate)
        # An older version of the author's code gave the node function the last raw state; the convolution's output
        # is what equation 3.3 says.
        own = nodes if everyone else receivers
        node = MLP(config.node_hidden, 0, config.skip, config.dropout, name="node")
        readout = MLP((), 4 if everyone else 2, name="readout")
        if ahead is None:
            out = readout(node(jnp.concatenate([own, aggregate], axis=-1)))
        elif config.additive:
            # Messages are forces. What an agent does by itself is how being elsewhere than in the centre differs from
            # being there, so that a term of every agent alone, -v / 2 say, can only be learned with its edges.
            alone, central = (
                readout(node(jnp.concatenate([p, own[..., 2:], ahead], axis=-1)))
                for p in (own[..., :2], 0 * own[..., :2])
            )
            forces = jnp.sum(aggregate.reshape(*aggregate.shape[:-1], -1, 2), axis=-2)
            out = turned_back(ahead, forces) + alone - central
        else:
            out = turned_back(ahead, readout(node(jnp.concatenate([own, ahead, aggregate], axis=-1))))
        if config.normalise:
            out = out * scales.acceleration
        alive = graph.present if everyone else graph.present[:, active]
        return jnp.where(alive[..., None], out, 0)

    def _pairs(
        self, receivers: Float[Array, "B N F"], senders: Float[Array, "B #N M F"], ahead: Float[Array, "B N 2"] | None
    ) -> Sequence[Float[Array, "B _ _ _"]]:
        if ahead is None:
            return receivers[:, :, None], senders
        shape = (*receivers.shape[:2], *senders.shape[2:])
        to, of = jnp.broadcast_to(receivers[:, :, None], shape), jnp.broadcast_to(senders, shape)
        ahead = ahead[:, :, None]
        apart = turned(ahead, (of - to)[..., :2])
        # Laws change fastest at short range, where the plain difference is a small number: add it on a log scale.
        distance = jnp.sqrt(jnp.sum(apart * apart, axis=-1, keepdims=True) + 1e-8)
        speed = jnp.sum(ahead * to[..., 2:], axis=-1, keepdims=True)
        parts = [apart, apart / distance, jnp.log(distance + 0.02), turned(ahead, of[..., 2:]), speed]
        return (jnp.concatenate(parts, axis=-1),)


def heading(velocity: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """Unit vectors along the velocity; of one who stands, the x axis."""
    square = jnp.sum(velocity * velocity, axis=-1, keepdims=True)
    moves = square > 1e-12
    return jnp.where(moves, velocity / jnp.sqrt(jnp.where(moves, square, 1)), jnp.asarray([1.0, 0.0]))


def turned(ahead: Float[Array, "*#n 2"], vector: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
    """Components ahead and to the left. Written out: XLA's product of many 2 x 2 matrices is slow on a CPU."""
    return jnp.stack([jnp.sum(ahead * vector, axis=-1), _cross(ahead, vector)], axis=-1)


def turned_back(ahead: Float[Array, "*n 2"], vector: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """From components ahead and to the left to the world's."""
    return turned(ahead * jnp.asarray([1.0, -1.0]), vector)


def _cross(a: Float[Array, "*#n 2"], b: Float[Array, "*#n 2"]) -> Float[Array, "*n"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _squared_distance(to: Float[Array, "B N F"], of: Float[Array, "B #N M F"]) -> Float[Array, "B N M"]:
    return jnp.sum((to[:, :, None, :2] - of[..., :2]) ** 2, axis=-1)


def _nearest(
    to: Float[Array, "B N 2"], of: Float[Array, "B M 2"], edges: Bool[Array, "B N M"], count: int
) -> tuple[Int[Array, "B N k"], Bool[Array, "B N k"]]:
    """Of the agents that each has edges from, the `count` nearest, and which of these places are filled."""
    square = _squared_distance(to, of[:, None])
    least, index = jax.lax.top_k(-jnp.where(edges, square, jnp.inf), count)
    return index, least > -jnp.inf


def _aggregate(typed: list[tuple[Array, Bool[Array, "B N _"]]], how: str) -> Float[Array, "B N F"]:
    """Messages joined over senders; sums over all types together (eq. 5.23), `mean` and `max` side by side by type."""
    if how in ("sum", "near"):
        return sum(jnp.sum(jnp.where(mask[..., None], m, 0), axis=2) for m, mask in typed)  # pyright: ignore[reportReturnType]
    if how == "mean":
        joined = [
            jnp.sum(jnp.where(mask[..., None], m, 0), axis=2) / jnp.maximum(mask.sum(axis=2, keepdims=True), 1)
            for m, mask in typed
        ]
    else:
        joined = [
            jnp.where(mask.any(axis=2, keepdims=True), jnp.max(jnp.where(mask[..., None], m, -jnp.inf), axis=2), 0)
            for m, mask in typed
        ]
    return jnp.concatenate(joined, axis=-1)
