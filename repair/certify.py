"""Does the policy keep the barrier in every state of a ring? Branch and bound: proof, counter-example, or neither.

What is judged is the action as executed: the network's, clipped to the largest acceleration, then so that the speed
stays in its limit. Cells (`repair.ring`) are bounded by `repair.propagate` and halved until they are decided.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from gnn.family import Params
from gnn.features import Scales
from repair.encounters import encounters
from repair.limits import executed
from repair.network import Situations, actions
from repair.propagate import Chain, chain_of, lower_forms
from repair.ring import Ring
from swarm_mjcf.errors import SpecError

Values = np.ndarray

TOLERANCE = 1e-6
"""A cell is proven where the bound of its slack is above this, a state violates where its slack is below minus this
[m/s^2]: far more than float64 rounds off."""
COARSE = 8
"""Parts of the ring's range in distance and in radial velocity down to which harmless states are cut from others."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much work to spend."""

    seconds: float = 120.0
    """Wall time after which what is left is undecided; 0 does nothing."""
    cells: int | None = None
    """Cells after which what is left is undecided; None for no limit. Unlike the time, the same on every machine."""
    finest: int = 256
    """No cell is halved along a coordinate of which it holds less than 2 parts in this many."""
    batch: int = 2048
    """Cells looked at together."""
    examples: int = 1000
    """Counter-examples kept at most, spread over all that were found."""
    seed: int = 0
    """Of the states that are tried in undecided cells."""

    def __post_init__(self) -> None:
        if not self.seconds >= 0:
            raise SpecError("seconds", self.seconds, "at least 0 [s]")
        for field, least in (("cells", 0), ("finest", 1), ("batch", 1), ("examples", 0), ("seed", 0)):
            value = getattr(self, field)
            if value is not None and value < least:
                raise SpecError(field, value, f"at least {least}")


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """What is known of a ring, in shares of its volume (positions x velocities) that sum to 1."""

    proven: float
    """In every state the executed action keeps the barrier."""
    refuted: float
    """In every state it does not, or the cell is of the smallest size and holds one in which it does not."""
    undecided: float
    unavoidable: float
    """In every state the least outward acceleration is above the limit: no action keeps the barrier."""
    harmless: float
    """Share of states in which every action keeps it, by quadrature; proven where the cells are fine enough."""
    contested: float
    """Share of states in which it is up to the policy: neither harmless nor unavoidable, by quadrature."""
    counter_examples: Situations
    """States in which an action would keep the barrier and the policy's does not, verified one by one in float64."""
    slack: Float[Values, " X"]
    """Theirs [m/s^2], negative, the worst first."""
    found: int
    """States of that kind that were come by; `counter_examples` are the worst and a sample of the others."""
    worst: float | None
    """Least slack of all [m/s^2]; None where there is none."""
    seconds: float
    cells: int
    """Cells looked at."""

    @property
    def kept(self) -> float:
        """Proven part of the contested states, at least: as if all that is open or refuted were contested."""
        return max(0.0, 1 - (self.refuted + self.undecided) / self.contested) if self.contested else 1.0


@dataclass(frozen=True, kw_only=True)
class _Needs:
    """The barrier in C cells, at their corners (d, s): low low, low high, high low, high high."""

    least: Float[Values, "C 4"]
    """w_min [m/s^2]."""
    asked: Float[Values, "C 4"]
    """Of the acceleration after the first clip, so that w_min is left after the second."""
    after: Float[Values, "C 4"]
    """Radial velocity after the step at w_min [m/s]."""
    convex: Bool[Values, " C"]
    """Whether both are convex in the cell."""
    fastest: Float[Values, " C"]
    """[m/s]"""


def _needs(ring: Ring, low: Values, high: Values) -> _Needs:
    motion = ring.barrier.kinematics
    d = np.stack([low[:, 0], low[:, 0], high[:, 0], high[:, 0]], axis=1)
    s = np.stack([low[:, 2], high[:, 2], low[:, 2], high[:, 2]], axis=1)
    least = ring.least(d.ravel(), s.ravel()).reshape(d.shape)
    kind = ring.kind(d.ravel(), s.ravel()).reshape(d.shape)
    fastest = np.minimum(np.hypot(*np.maximum(np.abs(low[:, 2:4]), np.abs(high[:, 2:4])).T), motion.max_speed)
    after = s + motion.dt * least
    # The speed's clip shortens the velocity after the step: what opens does so more slowly, what closes too.
    shortened = np.minimum(1, motion.max_speed / (fastest + motion.dt * motion.max_acceleration))
    asked = (np.maximum(after, after / shortened[:, None]) - s) / motion.dt
    return _Needs(least=least, asked=asked, after=after, convex=(kind == kind[:, :1]).all(axis=1), fastest=fastest)


def _plane(corners: Float[Values, "C 4"], convex: Bool[Values, " C"]) -> tuple[Values, Values]:
    """Slopes (C, 2) along (d, s) on the cube and an offset: a plane above a function that falls in both."""
    ll, lh, hl, hh = corners.T
    slopes = np.stack([hl - ll + hh - lh, lh - ll + hh - hl], axis=1) / 4
    slopes = np.where(convex[:, None], slopes, 0)
    on = slopes[:, :1] * np.array([-1, -1, 1, 1]) + slopes[:, 1:] * np.array([-1, 1, -1, 1])
    return slopes, np.max(corners - on, axis=1)


@dataclass(frozen=True, kw_only=True)
class _Verdict:
    """Of C cells."""

    proven: Bool[Values, " C"]
    violated: Bool[Values, " C"]
    effect: Float[Values, "C D"]
    """Of each coordinate on the bounds [m/s^2]."""
    worst: Float[Values, "C D"]
    """Corner of the cube at which the least slack is bounded."""


def _judged(chain: Chain, ring: Ring, low: Values, high: Values, needs: _Needs) -> _Verdict:
    """Bounds n(theta) . u and n'(theta) . u by linear forms, and what is left beyond the barrier."""
    motion = ring.barrier.kinematics
    limit, coordinates = motion.max_acceleration, low.shape[1]
    angle, h = (low[:, 1] + high[:, 1]) / 2, (high[:, 1] - low[:, 1]) / 2
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = np.stack([-n[:, 1], n[:, 0]], axis=1)
    forms = lower_forms(chain, *ring.sets(low, high), np.stack([n, -n, across, -across], axis=1))
    least = forms.least
    # At the centre's angle: n . u and n' . u lie within middle +- radius.
    middle, radius = (least[:, ::2] - least[:, 1::2]) / 2, -(least[:, ::2] + least[:, 1::2]) / 2
    most = np.abs(middle) + radius
    # n(theta) = n cos + n' sin and n'(theta) = n' cos - n sin of the angle from the centre's, to first order linear.
    turn = np.stack([middle[:, 1], -middle[:, 1], -middle[:, 0], middle[:, 0]], axis=1) * h[:, None]
    second = (1 - np.cos(h))[:, None] * most + (h - np.sin(h))[:, None] * most[:, ::-1]
    loss = np.repeat(h[:, None] * radius[:, ::-1] + second, 2, axis=1)
    slope, offset = forms.coefficients.copy(), forms.constant - loss
    slope[:, :, 1] += turn

    def lowest(slope: Values, offset: Values) -> Values:
        return offset - np.abs(slope).sum(axis=-1)

    def cones(along: int, cosine: Values) -> tuple[Values, Values]:
        """Forms that are positive where u is within a half angle of n (`along` 0) or -n (1), both sides of it."""
        c, s = cosine[:, None, None], np.sqrt(1 - cosine**2)[:, None, None]
        return s * slope[:, [along]] + c * slope[:, 2:], (s * offset[:, [along], None] + c * offset[:, 2:, None])[
            ..., 0
        ]

    # Proof. Clipped to `limit`, u still has n . u >= need where it is in the cone beside it (`repair.limits`).
    size = np.hypot(*most.T)
    steep, above = _plane(needs.asked, needs.convex)
    holds = slope[:, :1].copy()
    holds[:, 0, [0, 2]] -= steep
    need = needs.asked.max(axis=1)
    sides, base = cones(0, np.clip(need / limit, 0, 1))
    tried, base = np.concatenate([holds, sides], axis=1), np.concatenate([offset[:, :1] - above[:, None], base], axis=1)
    margin = lowest(tried, base)
    margin[:, 1:][(need <= 0) | (size <= limit)] = np.inf
    deciding = np.take_along_axis(tried, np.argmin(margin, axis=1)[:, None, None], axis=1)[:, 0]
    proven = (margin.min(axis=1) >= TOLERANCE) & (need <= limit)

    # Refutation. A function that is convex lies above its plane mirrored at the centre's value.
    steep, above = _plane(needs.least, needs.convex)
    centre = (low + high) / 2
    below = np.where(needs.convex, 2 * ring.least(centre[:, 0], centre[:, 2]) - above, needs.least.min(axis=1))
    fails = slope[:, 1].copy()
    fails[:, [0, 2]] += steep
    # The speed's clip can help what closes, by no more than the velocity after the step is too long.
    ends = [np.stack([low[:, 2], high[:, 2]]), np.stack([low[:, 3], high[:, 3]])]
    for end, lower, upper in ((ends[0], 0, 1), (ends[1], 2, 3)):
        end[0] += motion.dt * np.clip(lowest(slope[:, lower], offset[:, lower]), -limit, 0)
        end[1] += motion.dt * np.clip(-lowest(slope[:, upper], offset[:, upper]), 0, limit)
    speed = np.hypot(*(np.abs(end).max(axis=0) for end in ends))
    shortened = np.minimum(1, motion.max_speed / np.maximum(speed, 1e-9))
    help_ = (1 - shortened) * np.maximum(-ends[0][0], 0) / motion.dt + TOLERANCE
    # The acceleration's clip helps too, unless it leaves u in the cone around -n.
    need = help_ - needs.least.min(axis=1)
    clipped = (need <= limit) & (lowest(*cones(1, np.clip(need / limit, 0, 1))) > TOLERANCE).all(axis=1)
    violated = (lowest(fails, offset[:, 1] + below) > help_) & (clipped | (size <= limit))

    effect = np.abs(deciding) + np.abs(fails) + forms.blame
    effect[:, 1] += effect[:, coordinates:].sum(axis=1)  # what is of second order is so in the angle
    return _Verdict(
        proven=proven, violated=violated, effect=effect[:, :coordinates], worst=-np.sign(deciding[:, :coordinates])
    )


def certify(
    params: Params,
    scales: Scales,
    ring: Ring,
    *,
    normalise: bool = True,
    effort: Effort | None = None,
    update: Callable[[int, int, str], None] | None = None,
) -> Certificate:
    """What the network's executed action does to the barrier in every state of a ring; see `Certificate`.

    The same result for the same weights, ring and number of cells. `update(done, total, note)` tells the share of the
    ring that is decided, in thousandths.

    Raises:
      RepairError: a weight is NaN or infinite.
      NotEncodable: the network has no edge function for what is in the region.
    """
    effort = effort or Effort()
    started = time.monotonic()
    chain = chain_of(params, scales, ring.region.kinds, normalise=normalise)

    def slack(points: Values) -> Values:
        return _slack(params, scales, ring, points, normalise=normalise)

    rng = np.random.default_rng(effort.seed)
    queue = deque([ring.start()])
    whole = float(ring.volume(*queue[0]).sum())
    volume: dict[str, float] = dict.fromkeys(("proven", "refuted", "undecided", "unavoidable"), 0.0)
    found = _Found(effort.examples)
    seen = 0
    while queue:
        low, high = queue.popleft()
        room = effort.batch if effort.cells is None else min(effort.batch, effort.cells - seen)
        if room <= 0 or time.monotonic() - started >= effort.seconds:
            volume["undecided"] += float(ring.volume(low, high).sum())
            continue
        if len(low) > room:
            queue.appendleft((low[room:], high[room:]))
            low, high = low[:room], high[:room]
        seen += len(low)
        decided, (low, high) = _looked_at(chain, ring, low, high, slack, found, rng, effort.finest)
        for name, amount in decided.items():
            volume[name] += amount
        if len(low):
            if queue and len(queue[-1][0]) < effort.batch:
                last = queue.pop()
                low, high = np.concatenate([last[0], low]), np.concatenate([last[1], high])
            queue.append((low, high))
        if update is not None:
            done = sum(volume.values()) / whole
            update(int(1000 * done), 1000, f"{volume['proven'] / whole:.1%} proven, {len(found)} counter-examples")
    harmless, hopeless = _without_policy(ring)
    points, worst = found.taken(ring.range.shape[1])
    return Certificate(
        **{name: amount / whole for name, amount in volume.items()},
        harmless=harmless,
        contested=1 - harmless - hopeless,
        counter_examples=ring.situations(points),
        slack=worst,
        found=len(found),
        worst=found.worst,
        seconds=time.monotonic() - started,
        cells=seen,
    )


def _looked_at(
    chain: Chain,
    ring: Ring,
    low: Values,
    high: Values,
    slack: Callable[[Values], Values],
    found: "_Found",
    rng: np.random.Generator,
    finest: int,
) -> tuple[dict[str, float], tuple[Values, Values]]:
    """The volumes of what is decided of some cells, and the halves of what is not."""
    motion = ring.barrier.kinematics
    limit = motion.max_acceleration
    needs = _needs(ring, low, high)
    unavoidable = needs.least.min(axis=1) > limit
    free = (needs.asked <= -limit) | (needs.after <= -motion.max_speed - TOLERANCE)
    harmless = ~unavoidable & free.all(axis=1)
    # What w_min alone decides is cut along (d, s) first: the unavoidable to the end, the harmless coarsely.
    whole = ring.range[1] - ring.range[0]
    wide = (whole > 0) & ((high - low) * finest >= (2 - 1e-9) * whole)
    coarse = ((high - low)[:, [0, 2]] * COARSE >= (2 - 1e-9) * whole[[0, 2]]).any(axis=1)
    partly = needs.least.max(axis=1) > limit
    partly |= free.any(axis=1) & coarse
    partly &= ~(unavoidable | harmless)
    judged = np.flatnonzero(~(unavoidable | harmless | partly))
    proven, violated = harmless.copy(), np.zeros_like(harmless)
    effect, worst = (high - low) / np.where(whole > 0, whole, 1), np.zeros_like(low)
    wide[partly, 1] = wide[partly, 3:] = False
    if len(judged):
        some = _Needs(**{name: value[judged] for name, value in vars(needs).items()})
        verdict = _judged(chain, ring, low[judged], high[judged], some)
        proven[judged], violated[judged] = verdict.proven, verdict.violated
        effect[judged], worst[judged] = verdict.effect, verdict.worst

    left = ~(unavoidable | proven)
    bad = np.zeros_like(left)
    bad[left] = found.add(*_tried(slack, low[left], high[left], worst[left], rng))
    split = left & ~violated & wide.any(axis=1)
    end = left & ~split
    amount = ring.volume(low, high)
    decided = {
        "proven": proven,
        "unavoidable": unavoidable,
        "refuted": end & (violated | bad),
        "undecided": end & ~(violated | bad),
    }
    axis = np.argmax(np.where(wide, effect, -1), axis=1)[split]
    low, high = low[split], high[split]
    rows, middle = np.arange(len(axis)), (low + high) / 2
    first, second = high.copy(), low.copy()
    first[rows, axis] = second[rows, axis] = middle[rows, axis]
    halves = ring.within(np.concatenate([low, second]), np.concatenate([first, high]))
    return {name: float(amount[mask].sum()) for name, mask in decided.items()}, halves


def _without_policy(ring: Ring, parts: int = 1000) -> tuple[float, float]:
    """Shares of the ring in which every action keeps the barrier and in which none does, by the midpoint rule."""
    motion, (near, far) = ring.barrier.kinematics, ring.range[:, 0]
    middles = (np.arange(parts) + 0.5) / parts
    d = np.repeat(near + middles * (far - near), parts)
    s = np.tile(motion.max_speed * (2 * middles - 1), parts)
    weight = d * np.sqrt(motion.max_speed**2 - s**2)
    least = ring.least(d, s)
    harmless = (least <= -motion.max_acceleration) | (s + motion.dt * least <= -motion.max_speed)
    weight /= weight.sum()
    return float(weight[harmless].sum()), float(weight[least > motion.max_acceleration].sum())


def _slack(params: Params, scales: Scales, ring: Ring, points: Values, *, normalise: bool) -> Float[Values, " P"]:
    """Of the executed action at points of cells [m/s^2]; infinite beyond the limit of the speed and where it is
    unavoidable. By the forward pass, the clips and the barrier themselves, not by bounds."""
    situations, motion = ring.situations(points), ring.barrier.kinematics
    around = encounters(situations, ring.bodies)
    action = executed(situations.own[:, 2:], actions(params, scales, situations, normalise=normalise), motion)
    slack = ring.barrier.slack(around, action)[:, 0]
    possible = ring.barrier.least(around)[:, 0] <= motion.max_acceleration
    slow = np.hypot(points[:, 2], points[:, 3]) <= motion.max_speed
    return np.where(possible & slow, slack, np.inf)


def _tried(
    slack: Callable[[Values], Values], low: Values, high: Values, worst: Values, rng: np.random.Generator
) -> tuple[Values, Values]:
    """The worst of some states of each cell and its slack: the centre, the corner where the bound is lowest, and one
    at random."""
    z = np.stack([np.zeros_like(low), worst, *rng.uniform(-1, 1, (1, *low.shape))], axis=1)
    points = (low + high)[:, None] / 2 + z * (high - low)[:, None] / 2
    values = slack(points.reshape(-1, low.shape[1])).reshape(points.shape[:2])
    best = np.argmin(values, axis=1)
    rows = np.arange(len(best))
    return points[rows, best], values[rows, best]


class _Found:
    """Counter-examples, of which in the end some are taken, spread over all."""

    def __init__(self, most: int) -> None:
        self.most, self.points, self.slack = most, [], []

    def __len__(self) -> int:
        return sum(map(len, self.slack))

    def add(self, points: Values, slack: Values) -> Bool[Values, " C"]:
        """Takes those that violate; says which."""
        bad = slack < -TOLERANCE
        self.points.append(points[bad])
        self.slack.append(slack[bad])
        return bad

    def taken(self, coordinates: int) -> tuple[Values, Values]:
        """At most `most` of them, worst first."""
        points = np.concatenate([np.zeros((0, coordinates)), *self.points])
        slack = np.concatenate([np.zeros(0), *self.slack])
        spread = np.linspace(0, len(slack) - 1, min(self.most, len(slack))).astype(int)
        if len(spread):
            spread[np.argmin(np.abs(spread - np.argmin(slack)))] = np.argmin(slack)
        chosen = np.unique(spread)
        chosen = chosen[np.argsort(slack[chosen], kind="stable")]
        return points[chosen], slack[chosen]

    @property
    def worst(self) -> float | None:
        """Least slack of all."""
        return min((float(part.min()) for part in self.slack if len(part)), default=None)
