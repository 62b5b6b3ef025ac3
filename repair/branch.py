"""The last layer and the true disc: proven by branch and bound over the sides on which bodies are passed; no big-M.

A smaller problem than its networks: with the embedding h fixed, actions are linear in the readout's weights, the mean
squared deviation from the original actions is a Gram matrix, and after whitening by its Cholesky factor the task is

    min |Z|^2   such that   |y_c + psi_c Z| >= r_c   for every condition c (agent row, body),

the matrix Z (F, 2) of least size for which points of the plane, each moved by a unit vector psi_c times Z, leave their
discs. A node of the tree holds for every condition the angular sector in which its point lies. The convex hull of a
sector outside the disc is bounded by its chord and its two rays, so that a node's relaxation is a quadratic program.
Its dual, a box-constrained one in as many variables as there are half-planes, goes to OSQP, and the dual objective at
the clipped multipliers bounds the node from below, however inexact the solver was. Better solutions than the best one
known lie in a ball around the relaxed point, which narrows all sectors and discards most conditions.
"""

import heapq
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular

from gnn.family import Params
from gnn.features import Scales
from repair.constraints.constraint import drifted
from repair.constraints.disc import Disc
from repair.encounters import Encounters
from repair.errors import RepairError, Status
from repair.least_distance import least_distance
from repair.network import Situations, messages_and_embedding
from repair.sectors import WIDE, away, hull, narrowed, pieces

RIDGE = 1e-6
"""Part of the Gram matrix's mean diagonal that is added to it: the price of weights that the anchors do not show."""
SAFETY = 1e-6
"""By how much more than asked incumbents keep away [m]: room for the solver and for rounding the weights to float32.
Ten times more, and again, where that shows to be too little."""
SEEN = 1e-6
"""Violations of the scaled conditions below this are not worth a branch."""
ROUNDS = 12
"""Solutions of a node's relaxation, each with the half-planes that the last one violated and with narrower sectors."""
WEIGHTS = np.array([1.0, 0.3, 0.1, 0.03])
"""Of the distances to the pieces of a split sector, nearest first, when the condition to branch on is chosen."""
DESCENT = 30
"""Convex-concave steps of one search for an incumbent."""
JOIN = 200
"""Tangents that join at a time."""
HOPELESS = 1e8
"""Objectives beyond this are taken for infeasible tangents [(m/s^2)^2]."""
TRIES = 8
"""Every so many nodes an incumbent is sought from the relaxed point."""


@dataclass(frozen=True)
class Branched:
    """Readout weights, and how good they are. Without values (`status.solved` is False) the weights are None."""

    status: Status
    kernel: Float[np.ndarray, "H 2"] | None
    """float32, as it is saved."""
    bias: Float[np.ndarray, "2"] | None
    incumbent: float
    """Mean squared deviation from the original actions [(m/s^2)^2] with the ridge, and the price of violations."""
    bound: float
    """Proven: no weights do better than this."""
    gap: float
    """(incumbent - bound) / incumbent."""
    nodes: int
    seconds: float
    rows_kept: int
    """Conditions that solutions better than the first incumbent could violate at all."""
    violated: int
    """Conditions that are violated (status elastic)."""


def branch_readout(
    params: Params,
    scales: Scales,
    anchors: Situations,
    situations: Situations,
    e: Encounters,
    disc: Disc,
    *,
    normalise: bool = True,
    **limits: Any,
) -> Branched:
    """The readout of a SwarmNet that keeps its actions on `anchors` and the disc in `situations`; see `branch`.

    `e` are the encounters of `situations`; bodies in it that are marked absent are not minded.
    """
    unit = float(scales.acceleration) if normalise else 1.0

    def features(rows: Situations) -> Float[np.ndarray, "R H"]:
        _, h = messages_and_embedding(params, scales, rows, normalise=normalise)
        return unit * np.concatenate([np.asarray(h, np.float64), np.ones((len(h), 1))], axis=1)

    layer = params["readout"]["layer0"]
    weights = np.concatenate([np.asarray(layer["kernel"]), np.asarray(layer["bias"])[None]]).astype(np.float64)
    return branch(features(anchors), features(situations), weights, e, disc, **limits)


def branch(
    anchors: Float[np.ndarray, "A F"],
    rows: Float[np.ndarray, "R F"],
    weights: Float[np.ndarray, "F 2"],
    e: Encounters,
    disc: Disc,
    *,
    gap: float = 0.01,
    nodes: int = 1_000_000,
    seconds: float = 60.0,
    price: float = np.inf,
    ceiling: float = 1e4,
) -> Branched:
    """The weights W nearest to `weights` with which the actions `rows @ W` [m/s^2] keep the disc of every encounter.

    Nearest in the mean of |anchors @ (W - weights)|^2. The raw action is meant, before its limits: rows that no action
    within the limits can help should be left out. Ends when the relative `gap` is proven, or at the limits of `nodes`
    and `seconds`. A finite `price` [(m/s^2)^2 per m] allows violations (status elastic where there are any). Solutions
    dearer than `ceiling` are not looked for: with none below it, the status is infeasible-in-box.

    Raises RepairError for numbers that are not finite.
    """
    began = time.monotonic()
    search = _Search(_problem(anchors, rows, weights, e, disc, price), gap, nodes, began + seconds, ceiling)
    search.run()
    return search.result(time.monotonic() - began)


@dataclass(frozen=True)
class _Problem:
    """C conditions, scaled so that |psi| = 1, and what weights are measured with."""

    psi: Float[np.ndarray, "C F"]
    start: Float[np.ndarray, "C 2"]
    """y: where the point is with the original weights."""
    radius: Float[np.ndarray, " C"]
    price: Float[np.ndarray, " C"]
    """Of a violation in the scaled unit."""
    spare: Float[np.ndarray, " C"]
    """`SAFETY` in the scaled unit."""
    features: Float[np.ndarray, "C F"]
    centre: Float[np.ndarray, "C 2"]
    """The allowed actions are those outside a disc around -centre [m/s^2], of radius `reach`."""
    reach: Float[np.ndarray, " C"]
    weights: Float[np.ndarray, "F 2"]
    root: Float[np.ndarray, "F F"]
    """Lower Cholesky factor of the Gram matrix."""
    cost: float
    """Price [(m/s^2)^2 per m/s^2]."""

    @property
    def solid(self) -> Float[np.ndarray, " C"]:
        """Radius within which no point can be; 0 where violations are allowed."""
        return np.where(np.isinf(self.price), self.radius, 0.0)

    def judged(self, z: Float[np.ndarray, "F 2"]) -> tuple[float, int, Float[np.ndarray, "F 2"]]:
        """Objective, violated conditions, and weights of Z, by a forward pass of the weights rounded to float32."""
        rounded = (self.weights + solve_triangular(self.root.T, z)).astype(np.float32).astype(np.float64)
        deviation = float(np.sum((self.root.T @ (rounded - self.weights)) ** 2))
        short = np.maximum(self.reach - np.linalg.norm(self.features @ rounded + self.centre, axis=1), 0)
        violated = int(np.sum(short > 0))
        return deviation + (self.cost * float(short.sum()) if violated else 0.0), violated, rounded


def _problem(
    anchors: np.ndarray, rows: np.ndarray, weights: np.ndarray, e: Encounters, disc: Disc, price: float
) -> _Problem:
    gram = anchors.T @ anchors / len(anchors)
    if not all(np.isfinite(x).all() for x in (gram, rows, weights, e.relative, e.velocity)):
        raise RepairError("weights, embeddings or states are not finite", anchors=len(anchors), rows=len(rows))
    root = cholesky(gram + RIDGE * np.mean(np.diag(gram)) * np.eye(len(gram)), lower=True)
    row, body = np.nonzero(e.present)
    features = rows[row]
    centre = np.asarray(drifted(e, disc))[row, body] / disc.push
    reach = (np.asarray(e.reach)[row, body] + disc.margin) / disc.push
    psi = solve_triangular(root, features.T, lower=True).T
    size = np.linalg.norm(psi, axis=1)
    return _Problem(
        psi=psi / size[:, None],
        start=(features @ weights + centre) / size[:, None],
        radius=reach / size,
        price=price * disc.push * size,
        spare=SAFETY / disc.push / size,
        features=features,
        centre=centre,
        reach=reach,
        weights=weights,
        root=root,
        cost=price * disc.push,
    )


@dataclass(order=True)
class _Node:
    bound: float
    number: int
    middle: Float[np.ndarray, " C"] = field(compare=False)
    """Angle of the sector's bisector."""
    half: Float[np.ndarray, " C"] = field(compare=False)
    """Half of its opening; from pi / 2 on its hull is the whole plane, pi is a full turn."""
    planes: Int[np.ndarray, " M"] = field(compare=False)
    """Half-planes in use: 3 c for the chord of condition c, 3 c + 1 and 3 c + 2 for its rays."""
    multipliers: Float[np.ndarray, " M"] = field(compare=False)
    own: float = field(default=0.0, compare=False)
    """Bound that belongs to the last relaxed point."""


class _Search:
    """Best-first branch and bound."""

    def __init__(self, problem: _Problem, gap: float, nodes: int, until: float, ceiling: float) -> None:
        self.all = self.kept = problem
        self.gap, self.most, self.until = gap, nodes, until
        self.best, self.weights, self.violated = ceiling, None, 0
        self.open: list[_Node] = []
        self.spares = 1.0
        self.nodes, self.numbers, self.lowest, self.complete = 0, 0, np.inf, False

    @property
    def origin(self) -> Float[np.ndarray, "F 2"]:
        """Z of the original weights."""
        return np.zeros((self.all.psi.shape[1], 2))

    @property
    def cutoff(self) -> float:
        """Only solutions below this are still looked for."""
        return self.best if self.weights is None else self.best * (1 - self.gap)

    def run(self) -> None:
        if time.monotonic() >= self.until:
            return
        self._descend(self.origin)
        if self.weights is None:
            # Everybody to one side: with a bias among the weights, far enough is always clear.
            for angle in np.arange(8) * np.pi / 4:
                side = np.broadcast_to([np.cos(angle), np.sin(angle)], self.all.start.shape)
                self._descend(self.origin, side)
        self._keep()
        count = len(self.kept.psi)
        self.open = [_Node(0.0, 0, np.zeros(count), np.full(count, np.pi), np.zeros(0, np.int64), np.zeros(0))]
        while self.open:
            if self.open[0].bound >= self.cutoff:
                self.open.clear()
                break
            if self.nodes >= self.most or time.monotonic() >= self.until:
                return
            self._expand(heapq.heappop(self.open))
        self.complete = True

    def result(self, seconds: float) -> Branched:
        bound = min([node.bound for node in self.open] + [self.lowest])
        bound = min(bound, self.cutoff) if self.complete or self.open else 0.0
        if self.weights is None:
            status = Status.INFEASIBLE if self.complete and self.lowest >= self.best else Status.NO_INCUMBENT
            return Branched(status, None, None, np.inf, bound, np.inf, self.nodes, seconds, len(self.kept.psi), 0)
        gap = (self.best - bound) / self.best if self.best > 0 else 0.0
        status = Status.OPTIMAL if gap <= self.gap * (1 + 1e-9) else Status.FEASIBLE
        return Branched(
            status=Status.ELASTIC if self.violated else status,
            kernel=self.weights[:-1].astype(np.float32),
            bias=self.weights[-1].astype(np.float32),
            incumbent=self.best,
            bound=bound,
            gap=gap,
            nodes=self.nodes,
            seconds=seconds,
            rows_kept=len(self.kept.psi),
            violated=self.violated,
        )

    def _keep(self) -> None:
        """Drops the conditions that nothing better than the incumbent can violate: |y| - |psi| |Z| >= r for them."""
        p = self.all
        near = np.linalg.norm(p.start, axis=1) - np.sqrt(self.cutoff) < p.radius
        rows = ("psi", "start", "radius", "price", "spare", "features", "centre", "reach")
        self.kept = replace(p, **{name: getattr(p, name)[near] for name in rows})

    def _expand(self, node: _Node) -> None:
        """Bounds a node; closes it, or splits the sector of the condition that its relaxed point violates most."""
        self.nodes += 1
        z = self._relax(node)
        if z is None:
            return
        p = self.kept
        at = p.start + p.psi @ z
        short = p.radius - np.linalg.norm(at, axis=1)
        short[node.half < 1e-6] = 0
        if short.max() < SEEN or self.nodes % TRIES == 1:
            self._descend(z)
        if short.max() < SEEN:
            self.lowest = min(self.lowest, node.bound)
            return
        rows = np.argsort(-short)[: int(np.sum(short > SEEN))]
        middle, half = pieces(node.middle[rows], node.half[rows], at[rows], p.radius[rows])
        distance = away(middle, half, at[rows], p.solid[rows])
        # All pieces should be far from the relaxed point: the nearest counts most.
        ordered = np.sort(np.minimum(distance, np.sqrt(max(self.cutoff - node.bound, 0))), axis=1)
        worst = int(np.argmax(ordered @ WEIGHTS))
        for m, h, d in zip(middle[worst], half[worst], distance[worst], strict=True):
            bound = max(node.bound, node.own + float(d) ** 2)
            if bound < self.cutoff:
                middles, halves = node.middle.copy(), node.half.copy()
                middles[rows[worst]], halves[rows[worst]] = m, h
                self.numbers += 1
                child = _Node(bound, self.numbers, middles, halves, node.planes, node.multipliers)
                heapq.heappush(self.open, child)

    def _relax(self, node: _Node) -> Float[np.ndarray, "F 2"] | None:
        """The relaxed point; the node's bound, sectors and half-planes are improved. None where nothing is left."""
        p = self.kept
        z = self.origin
        for _ in range(ROUNDS):
            before = node.bound
            direction, offset, price = _half_planes(p, node, node.planes)
            found, z, node.multipliers = least_distance(
                p.psi[node.planes // 3], direction, offset, price, node.multipliers
            )
            node.bound, node.own = max(node.bound, found), found
            if found >= self.cutoff:
                return None
            sectors = narrowed(node.middle, node.half, p.start + p.psi @ z, np.sqrt(self.cutoff - found), p.solid)
            if sectors is None:
                return None
            node.middle, node.half = sectors
            fresh = _violated(p, node, z)
            used = node.multipliers > 0
            planes = np.union1d(node.planes[used], fresh)
            multipliers = np.zeros(len(planes))
            multipliers[np.searchsorted(planes, node.planes[used])] = node.multipliers[used]
            node.planes, node.multipliers = planes, multipliers
            if not len(fresh) or (node.bound - before < 1e-3 * (self.cutoff - node.bound) and before > 0):
                break
        return z

    def _descend(self, z: Float[np.ndarray, "F 2"], normal: Float[np.ndarray, "C 2"] | None = None) -> None:
        """The convex-concave step, iterated: tangents at the last point, of those conditions that need one."""
        p, planes, value = self.all, np.zeros(0, np.int64), np.inf
        for _ in range(DESCENT):
            before = value
            if normal is None:
                at = p.start + p.psi @ z
                normal = at / np.maximum(np.linalg.norm(at, axis=1, keepdims=True), 1e-12)
            value, z, planes = self._tangent(z, planes, normal)
            if not value < 1.5 * self.best:
                return
            objective, violated, weights = p.judged(z)
            if objective < self.best:
                self.best, self.violated, self.weights = objective, violated, weights
            normal = None
            if violated and np.isinf(p.cost):
                self.spares *= 10
            elif value > before * (1 - 1e-4):
                return

    def _tangent(
        self, z: Float[np.ndarray, "F 2"], planes: Int[np.ndarray, " M"], normal: Float[np.ndarray, "C 2"]
    ) -> tuple[float, Float[np.ndarray, "F 2"], Int[np.ndarray, " K"]]:
        """Least Z on the outer side of tangents with these normals; more of them join until nothing is violated.

        Also returns its objective, infinite where there is no Z or no time, and the tangents in use.
        """
        p = self.all
        radius, value = p.radius + self.spares * p.spare, float(np.sum(z * z))
        offset = radius - np.sum(normal * p.start, axis=1)
        while True:
            if len(planes):
                start = np.zeros(len(planes))
                value, z, _ = least_distance(p.psi[planes], normal[planes], offset[planes], p.price[planes], start)
            if value > HOPELESS or time.monotonic() >= self.until:
                return np.inf, z, planes
            short = radius - np.linalg.norm(p.start + p.psi @ z, axis=1)
            short[planes] = 0
            fresh = np.flatnonzero(short > SEEN)
            if not len(fresh):
                return value, z, planes
            planes = np.union1d(planes, fresh[np.argsort(-short[fresh], kind="stable")[:JOIN]])


def _half_planes(p: _Problem, node: _Node, planes: Int[np.ndarray, " M"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals, offsets and prices of a node's half-planes, normal . (psi Z) >= offset."""
    row, kind = planes // 3, planes % 3
    normal, radii = hull(node.middle[row], node.half[row], kind)
    # A violation v of the disc is one of v cos(half) of the chord.
    price = np.where(kind == 0, p.price[row] / np.maximum(radii, 1e-9), np.inf)
    return normal, radii * p.radius[row] - np.sum(normal * p.start[row], axis=1), price


def _violated(p: _Problem, node: _Node, z: np.ndarray) -> Int[np.ndarray, " M"]:
    """Half-planes that a point is beyond, but for those whose violation has its full price already."""
    rows = np.flatnonzero(node.half < WIDE)
    every = (3 * rows[:, None] + np.arange(3)).ravel()
    normal, offset, price = _half_planes(p, node, every)
    beyond = offset - np.sum(normal * np.repeat(p.psi[rows] @ z, 3, axis=0), axis=1) > SEEN
    used = np.searchsorted(every, node.planes)
    beyond[used] &= node.multipliers < 0.999 * price[used]
    return every[beyond]
