"""What an agent sees of others, in one form for every interaction, and sums over it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from envs.experts.config import Interaction
from envs.neighbours import FEW, all_pairs, fold_cells, make_cells, neighbours, take
from envs.record import Array, record


@record
class Pairs:
    """M candidates of each agent, as planes (S, N, M), which XLA turns into vector instructions."""

    seen: Bool[Array, "S N M"]
    """Which candidates are seen; the other planes mean something only there."""
    dx: Float[Array, "S N M"]
    """Position of the other minus own [m]."""
    dy: Float[Array, "S N M"]
    du: Float[Array, "S N M"]
    """Velocity of the other minus own [m/s]; or whatever vector `sum_over` was given in its place."""
    dw: Float[Array, "S N M"]

    @property
    def distance(self) -> Float[Array, "S N M"]:
        """Distance to the other [m]."""
        return jnp.sqrt(self.dx * self.dx + self.dy * self.dy)

    def total(self, plane: Array | float | int, where: Array | bool = True) -> Float[Array, "S N"]:
        """Sum of a plane over the others seen, those only for which `where` holds."""
        return jnp.where(self.seen & where, plane, jnp.zeros((), self.dx.dtype)).sum(axis=2)


Law = Callable[[Pairs], dict[str, Array]]
"""Named sums (S, N) over the others seen, each made by `Pairs.total`: laws are added up block by block."""


def sum_over(
    interaction: Interaction,
    law: Law,
    *,
    position: Float[Array, "S N 2"],
    velocity: Float[Array, "S N 2"],
    present: Bool[Array, "S N"],
) -> dict[str, Float[Array, "S N"]]:
    """Sums of a law over the others that each agent sees. Exact for every interaction and number of agents."""
    agents = position.shape[1]
    planes = (position[..., 0], position[..., 1], velocity[..., 0], velocity[..., 1])
    if interaction.nearest is not None:
        index, seen = neighbours(position, present, radius=interaction.radius, nearest=interaction.nearest)
        return law(_pairs(planes, index, seen))
    if interaction.radius is None or agents <= FEW:
        dx, dy, du, dw = (plane[:, None] - plane[:, :, None] for plane in planes)
        return law(Pairs(seen=all_pairs(position, present, interaction.radius), dx=dx, dy=dy, du=du, dw=dw))
    radius = interaction.radius
    cells = make_cells(position, present, jnp.full(len(position), radius, position.dtype))
    planes = tuple(jnp.take_along_axis(plane, cells.order, axis=1) for plane in planes)

    def block(places: Array, valid: Array) -> dict[str, Array]:
        pairs = _pairs(planes, places, valid)
        near = pairs.dx * pairs.dx + pairs.dy * pairs.dy < radius**2
        return law(Pairs(seen=valid & near, dx=pairs.dx, dy=pairs.dy, du=pairs.du, dw=pairs.dw))

    def add(sums: dict[str, Array], places: Array, valid: Array) -> dict[str, Array]:
        return jax.tree.map(jnp.add, sums, block(places, valid))

    nobody = jnp.zeros((*present.shape, 1), jnp.int32), jnp.zeros((*present.shape, 1), bool)
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(block, *nobody))
    sums = fold_cells(cells, none, add)
    return {name: jnp.take_along_axis(plane, cells.place, axis=1) for name, plane in sums.items()}


def _pairs(planes: tuple[Array, ...], index: Array, seen: Array) -> Pairs:
    dx, dy, du, dw = (take(plane, index) - plane[..., None] for plane in planes)
    return Pairs(seen=seen, dx=dx, dy=dy, du=du, dw=dw)
