"""SwarmNet: typed edge functions, aggregation, node function, readout. One Flax module; presets choose its parts.

Parameters are a nested dict whose paths name the parts: `edge/goal`, `edge/obstacle`, `edge/agent`, `psi`, `node`,
`readout`, `conv`; each holds `layer0`, `layer1`, ... with `kernel` and `bias`.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Bool, Float

from envs.record import Array
from gnn.config import ModelConfig
from gnn.features import Scales
from gnn.graph import EDGE_TYPES, Graph


class MLP(nn.Module):
    """ReLU layers, then a linear one `out` wide (none for `out=0`: the last hidden layer is the output)."""

    hidden: Sequence[int]
    out: int

    @nn.compact
    def __call__(self, x: Float[Array, "*n inputs"]) -> Float[Array, "*n outputs"]:
        for depth, width in enumerate(self.hidden):
            x = nn.relu(nn.Dense(width, name=f"layer{depth}")(x))
        return nn.Dense(self.out, name=f"layer{len(self.hidden)}")(x) if self.out else x


class EdgeFunctions(nn.Module):
    """phi_e, one for each edge type (eq. 3.1, 5.22): messages of (receiver, sender) pairs."""

    config: ModelConfig

    @nn.compact
    def __call__(self, pairs: dict[str, Array]) -> dict[str, Array]:
        config = self.config
        return {name: MLP(config.edge_hidden, config.message, name=name)(x) for name, x in pairs.items()}


class Convolutions(nn.Module):
    """1D convolutions over the history of each node, kernel 3, no padding, ReLU (figure 3.3)."""

    filters: Sequence[int]

    @nn.compact
    def __call__(self, history: Float[Array, "B V W F"]) -> Float[Array, "B V C"]:
        for depth, width in enumerate(self.filters):
            history = nn.relu(nn.Conv(width, (3,), padding="VALID", name=f"layer{depth}")(history))
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
        receivers = nodes[:, first:]

        senders = {"goal": nodes[:, :goals], "obstacle": nodes[:, goals:first], "agent": receivers}
        masks = {"goal": graph.goal, "obstacle": graph.obstacle, "agent": graph.agent}
        kinds = [name for name in EDGE_TYPES if senders[name].shape[1]]
        pairs = {name: self._pairs(receivers, senders[name]) for name in kinds}
        messages = EdgeFunctions(config, name="edge")(pairs)
        aggregate = jnp.concatenate(
            [_aggregate([(messages[name], masks[name]) for name in kinds], how) for how in config.aggregate], axis=-1
        )
        if everyone:
            nothing = jnp.zeros((aggregate.shape[0], first, aggregate.shape[-1]), aggregate.dtype)
            aggregate = jnp.concatenate([nothing, aggregate], axis=1)
        if config.psi:
            aggregate = MLP((config.message,), config.message, name="psi")(aggregate)
        # An older version of the author's code gave the node function the last raw state; the convolution's output
        # is what equation 3.3 says.
        own = nodes if everyone else receivers
        hidden = MLP(config.node_hidden, 0, name="node")(jnp.concatenate([own, aggregate], axis=-1))
        out = MLP((), 4 if everyone else 2, name="readout")(hidden)
        if config.normalise:
            out = out * scales.acceleration
        alive = graph.present if everyone else graph.present[:, first:]
        return jnp.where(alive[..., None], out, 0)

    def _pairs(self, receivers: Float[Array, "B N F"], senders: Float[Array, "B M F"]) -> Float[Array, "B N M G"]:
        shape = (*receivers.shape[:2], senders.shape[1], receivers.shape[-1])
        to, of = jnp.broadcast_to(receivers[:, :, None], shape), jnp.broadcast_to(senders[:, None], shape)
        parts = [to, of]
        if self.config.relative:
            parts.append(of - to)
            apart = (of - to)[..., :2]
            # Laws change fastest at short range, where the plain difference is a small number: add it on a log scale.
            distance = jnp.sqrt(jnp.sum(apart * apart, axis=-1, keepdims=True) + 1e-8)
            parts += [apart / distance, jnp.log(distance + 0.02)]
        return jnp.concatenate(parts, axis=-1)


def _aggregate(typed: list[tuple[Array, Bool[Array, "B N _"]]], how: str) -> Float[Array, "B N F"]:
    """Messages joined over senders; `sum` over all types together (eq. 5.23), `mean` and `max` side by side by type."""
    if how == "sum":
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
