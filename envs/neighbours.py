"""Who is near whom: exact neighbour search by sorted cells, at a cost per agent that stays flat with their number.

A square grid of cells at least as wide as the radius lies over the agents of a scene. Agents are sorted by cell, row
after row, so all that can be near an agent stands in three runs of that order: its own and the two adjacent cells, in
its own and the two adjacent rows. The runs are read in blocks until the longest of the batch ends: nothing has a
capacity that could overflow, and a crowded scene costs more but loses nobody. Blocks beyond a run's end are masked, so
what a scene gets does not depend on the others in the batch. Everything is pure and callable inside `jit`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from envs.record import Array, record
from swarm_mjcf.errors import SpecError

FEW = 32
"""Up to this many agents all pairs are compared: sorting would cost more."""
MANY = 256
"""Up to this many agents all pairs are compared to find the nearest at any distance, which takes several searches."""
BLOCK = 8
"""Agents read at a time from each of the three runs."""


@record
class Cells:
    """Agents in the order of their cells; absent ones come last and stand in no run."""

    order: Int[Array, "S N"]
    """The agent at each place."""
    first: Int[Array, "S N 3"]
    """Where the three runs around the agent at each place begin."""
    last: Int[Array, "S N 3"]
    """Where they end (exclusive)."""

    @property
    def place(self) -> Int[Array, "S N"]:
        """The place of each agent: the inverse of `order`."""
        scenes, agents = self.order.shape
        places = jnp.broadcast_to(jnp.arange(agents, dtype=jnp.int32), (scenes, agents))
        return jnp.zeros_like(self.order).at[jnp.arange(scenes)[:, None], self.order].set(places)


def make_cells(position: Float[Array, "S N 2"], present: Bool[Array, "S N"], radius: Float[Array, " S"]) -> Cells:
    """Sorts agents into cells at least `radius` [m] wide, about one agent per cell when they are spread out.

    Raises SpecError for more agents than 32-bit numbers can tell apart in their cells (about 46,000).
    """
    scenes, agents, _ = position.shape
    side = max(1, round(agents**0.5))
    columns = side + 2
    if (columns**2 + 1) * agents >= 2**31:
        raise SpecError("num_agents", agents, "at most 46,000 where agents see only others nearby")
    here = present[..., None]
    low = jnp.where(here, position, jnp.inf).min(axis=1, keepdims=True)
    high = jnp.where(here, position, -jnp.inf).max(axis=1, keepdims=True)
    # A little wider than needed, or rounding could put two agents within the radius two cells apart.
    width = 1.001 * jnp.maximum(radius, (high - low).max((1, 2)) / side)[:, None, None]
    # Clipped for the sake of positions that are not finite. An empty border around the grid spares all special cases.
    cell = jnp.clip(jnp.floor((position - low) / width).astype(jnp.int32), 0, side - 1) + 1
    number = jnp.where(present, cell[..., 1] * columns + cell[..., 0], columns**2)
    # One integer holds cell and agent: sorting single numbers is fast, and ties keep their order.
    tagged = jnp.sort(number * agents + jnp.arange(agents, dtype=jnp.int32), axis=1)
    order, number = tagged % agents, tagged // agents
    counts = jnp.zeros((scenes, columns**2 + 2), jnp.int32).at[jnp.arange(scenes)[:, None], number + 1].add(1)
    begins = jnp.cumsum(counts, axis=1)  # begins[c]: agents in cells before c
    start = number[..., None] + columns * jnp.arange(-1, 2) - 1
    start = jnp.where(number[..., None] < columns**2, start, 0)

    def at(where: Array) -> Array:
        return jnp.take_along_axis(begins[:, None], where, axis=2)

    first = at(start)
    return Cells(order=order, first=first, last=jnp.where(number[..., None] < columns**2, at(start + 3), first))


def fold_cells[C](cells: Cells, carry: C, update: Callable[[C, Int[Array, "S N M"], Bool[Array, "S N M"]], C]) -> C:
    """Folds `update(carry, places, valid)` over blocks of candidates of the agent at each place, itself left out."""
    scenes, agents, _ = cells.first.shape
    blocks = (jnp.max(cells.last - cells.first) + BLOCK - 1) // BLOCK
    own = jnp.arange(agents, dtype=jnp.int32)[:, None]

    def body(block: Array, carry: C) -> C:
        places = cells.first[..., None] + block * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)
        valid = (places < cells.last[..., None]).reshape(scenes, agents, 3 * BLOCK)
        places = jnp.minimum(places, agents - 1).reshape(scenes, agents, 3 * BLOCK)
        return update(carry, places, valid & (places != own))

    return jax.lax.fori_loop(0, blocks, body, carry)


def take(values: Array, index: Int[Array, "S N M"]) -> Array:
    """Values (S, N) of the agents at `index`: (S, N, M)."""
    return jnp.take_along_axis(values[:, None], index, axis=2)


def neighbours(
    position: Float[Array, "S N 2"],
    present: Bool[Array, "S N"],
    *,
    radius: float | int | None = None,
    nearest: int | None = None,
) -> tuple[Int[Array, "S N M"], Bool[Array, "S N M"]]:
    """Other present agents closer than `radius` [m], the `nearest` of them, or both: (index, valid).

    M is `nearest` (at most N - 1), in the order of distance, or N where only a radius is given. Absent agents neither
    have neighbours nor are any. Which of equally distant agents counts as nearer is not defined.
    """
    scenes, agents, _ = position.shape
    if nearest is None:
        everyone = jnp.broadcast_to(jnp.arange(agents, dtype=jnp.int32), (scenes, agents, agents))
        return everyone, all_pairs(position, present, radius)
    nearest = min(nearest, agents - 1)
    if nearest == 0:
        return jnp.zeros((scenes, agents, 0), jnp.int32), jnp.zeros((scenes, agents, 0), bool)
    if agents <= (FEW if radius is not None else MANY):
        square = jnp.where(all_pairs(position, present, radius), _square(position), jnp.inf)
        least, index = jax.lax.top_k(-square, nearest)
        return index, least > -jnp.inf
    if radius is not None:
        return _nearest_within(position, present, jnp.full(scenes, radius, position.dtype), nearest)
    return _nearest(position, present, nearest)


def all_pairs(
    position: Float[Array, "S N 2"], present: Bool[Array, "S N"], radius: float | int | None
) -> Bool[Array, "S N N"]:
    """Pairs (agent, other) of present agents closer than `radius` [m]; None: at any distance."""
    pairs = present[:, :, None] & present[:, None] & ~jnp.eye(position.shape[1], dtype=bool)
    return pairs if radius is None else pairs & (_square(position) < radius**2)


def _square(position: Array) -> Array:
    # x and y as planes: a trailing axis of 2 would keep XLA from using vector instructions.
    x, y = position[..., 0], position[..., 1]
    dx, dy = x[:, None] - x[:, :, None], y[:, None] - y[:, :, None]
    return dx * dx + dy * dy


def _nearest_within(position: Array, present: Array, radius: Array, nearest: int) -> tuple[Array, Array]:
    """The nearest of the others closer than a radius of each scene (S,), by cells."""
    cells = make_cells(position, present, radius)
    x, y = (jnp.take_along_axis(position[..., axis], cells.order, axis=1) for axis in (0, 1))
    reach = (radius * radius)[:, None, None]

    def update(best: tuple[Array, Array], places: Array, valid: Array) -> tuple[Array, Array]:
        dx, dy = take(x, places) - x[..., None], take(y, places) - y[..., None]
        square = dx * dx + dy * dy
        closeness = jnp.where(valid & (square < reach), -square, -jnp.inf)
        closeness, chosen = jax.lax.top_k(jnp.concatenate([best[0], closeness], axis=2), nearest)
        return closeness, jnp.take_along_axis(jnp.concatenate([best[1], places], axis=2), chosen, axis=2)

    shape = (*x.shape, nearest)
    none = (jnp.full(shape, -jnp.inf, x.dtype), jnp.zeros(shape, jnp.int32))
    closeness, places = fold_cells(cells, none, update)
    index, back = take(cells.order, places), cells.place[..., None]
    return jnp.take_along_axis(index, back, axis=1), jnp.take_along_axis(closeness > -jnp.inf, back, axis=1)


def _nearest(position: Array, present: Array, nearest: int) -> tuple[Array, Array]:
    """The nearest others at any distance: within a radius that doubles until everyone has found enough.

    Whoever has `nearest` others within a radius has its nearest ones, so every result is exact.
    """
    here = present[..., None]
    low = jnp.where(here, position, jnp.inf).min(axis=1)
    high = jnp.where(here, position, -jnp.inf).max(axis=1)
    extent = (high - low).max(axis=1)
    count = present.sum(axis=1)
    wanted = jnp.minimum(nearest, count - 1)
    # Twice as many as wanted are expected within the first radius if agents are spread evenly over a square.
    radius = jnp.maximum(extent, 1e-6) * jnp.sqrt(2 * nearest / (jnp.pi * jnp.maximum(count, 1)))

    def missing(radius: Array, valid: Array) -> Array:
        lacking = (valid.sum(axis=2) < wanted[:, None]) & present
        return lacking.any(axis=1) & (radius <= 2 * extent)

    def widen(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        radius, _, valid = carry
        radius = jnp.where(missing(radius, valid), 2 * radius, radius)
        return radius, *_nearest_within(position, present, radius, nearest)

    first = (radius.astype(position.dtype), *_nearest_within(position, present, radius.astype(position.dtype), nearest))
    _, index, valid = jax.lax.while_loop(lambda c: missing(c[0], c[2]).any(), widen, first)
    return index, valid
