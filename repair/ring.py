"""The ring of states around an obstacle, cut into cells in polar coordinates.

A cell is a box in distance d of the centres [m], angle theta of the outward normal n [rad], radial and tangential
velocity s and t [m/s], then the goal's position (2) and, where there is one, a neighbour's position and velocity (4):
p = o + d n(theta), v = s n(theta) + t n'(theta). Cells are rows `low`, `high` of these D coordinates.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from envs.record import Array
from repair.constraints.barrier import Barrier
from repair.encounters import Bodies, Encounters
from repair.network import Situations
from swarm_mjcf.errors import SpecError

Values = np.ndarray

SKIN = 2e-6
"""Of the ring, what is nearer than this to touching, or to the margin, is left out [m]: there the barrier turns from
braking to leaving."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """What else an agent senses, wherever it may be in a box."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        ordered = len(self.low) == len(self.high) and all(
            -np.inf < a <= b < np.inf for a, b in zip(self.low, self.high, strict=True)
        )
        if not ordered:
            raise SpecError("box", f"{self.low} to {self.high}", "finite, as many low as high ends, each low <= high")

    @classmethod
    def around(cls, centre: tuple[float, ...], half: tuple[float, ...]) -> "Box":
        """`centre` +- `half`."""
        return cls(
            low=tuple(c - h for c, h in zip(centre, half, strict=True)),
            high=tuple(c + h for c, h in zip(centre, half, strict=True)),
        )


@dataclass(frozen=True, kw_only=True)
class Region:
    """All states of an agent in a ring around one obstacle that stands still, at any velocity up to the limit."""

    obstacle: tuple[float, float] = (0.0, 0.0)
    """Its centre [m]."""
    depth: float = 15.0
    """Distances of the centres from the sum of radii to this much more [m]."""
    goal: Box | None = Box(low=(39.0, -1.0), high=(41.0, 1.0))
    """Where the goal may be [m]; None for a network without one."""
    neighbour: Box | None = None
    """Where one other agent may be and how it may move: x, y [m], velocity [m/s]. It is not kept clear of here."""

    def __post_init__(self) -> None:
        if not 0 < self.depth < np.inf:
            raise SpecError("depth", self.depth, "a finite length above 0 [m]")
        for field, box, size in (("goal", self.goal, 2), ("neighbour", self.neighbour, 4)):
            if box is not None and len(box.low) != size:
                raise SpecError(field, box.low, f"{size} coordinates")

    @property
    def kinds(self) -> tuple[str, ...]:
        """The senders' edge functions, in the order of `Ring.sets`."""
        return ("goal",) * (self.goal is not None) + ("obstacle",) + ("agent",) * (self.neighbour is not None)


@dataclass(frozen=True, kw_only=True)
class Ring:
    """A region, cut for a barrier between bodies."""

    region: Region
    barrier: Barrier
    bodies: Bodies

    def __post_init__(self) -> None:
        if not np.isfinite(self.barrier.kinematics.max_speed):
            raise SpecError("max_speed", self.barrier.kinematics.max_speed, "finite: all velocities are looked at")
        if self.barrier.margin + SKIN >= self.region.depth:
            raise SpecError("margin", self.barrier.margin, f"less than the depth of the ring, {self.region.depth} m")

    @property
    def reach(self) -> float:
        """Distance of the centres at which they touch [m]."""
        return self.bodies.agent_radius + self.bodies.obstacle_radius

    @cached_property
    def boxes(self) -> list[Box]:
        """Of the senders that may be in several places."""
        return [box for box in (self.region.goal, self.region.neighbour) if box is not None]

    @cached_property
    def range(self) -> Float[Values, "2 D"]:
        """The whole ring."""
        v = self.barrier.kinematics.max_speed
        low, high = [self.reach + SKIN, 0.0, -v, -v], [self.reach + self.region.depth, 2 * np.pi, v, v]
        return np.array([low + [x for b in self.boxes for x in b.low], high + [x for b in self.boxes for x in b.high]])

    def start(self, parts: tuple[int, ...] = (1, 8, 1, 1)) -> tuple[Float[Values, "C D"], Float[Values, "C D"]]:
        """The ring cut into cells, with a cut where the margin ends; sectors of less than a quarter turn."""
        ends = [np.linspace(self.range[0, i], self.range[1, i], n + 1) for i, n in enumerate(parts)]
        distances = [ends[0][:-1], ends[0][1:]]
        if self.barrier.margin:
            edge = self.reach + self.barrier.margin
            outer = np.linspace(edge + SKIN, self.range[1, 0], parts[0] + 1)
            distances = [np.r_[ends[0][0], outer[:-1]], np.r_[edge, outer[1:]]]
        sides = [distances, *([end[:-1], end[1:]] for end in ends[1:])]
        sides += [[self.range[:1, i], self.range[1:, i]] for i in range(4, self.range.shape[1])]
        low, high = (np.stack(np.meshgrid(*(side[i] for side in sides), indexing="ij"), -1) for i in (0, 1))
        return self.within(low.reshape(-1, low.shape[-1]), high.reshape(-1, high.shape[-1]))

    def within(
        self, low: Float[Values, "C D"], high: Float[Values, "C D"]
    ) -> tuple[Float[Values, "K D"], Float[Values, "K D"]]:
        """Cells cut down to what may be slower than the limit; those that cannot be are left out."""
        low, high = low.copy(), high.copy()
        square = self.barrier.kinematics.max_speed**2
        keep = np.ones(len(low), bool)
        for one, other in ((2, 3), (3, 2)):
            nearest = np.maximum(np.maximum(low[:, other], -high[:, other]), 0)
            most = np.sqrt(np.maximum(square - nearest**2, 0))
            low[:, one], high[:, one] = np.maximum(low[:, one], -most), np.minimum(high[:, one], most)
            keep &= low[:, one] < high[:, one]
        return low[keep], high[keep]

    def volume(self, low: Float[Values, "C D"], high: Float[Values, "C D"]) -> Float[Values, " C"]:
        """Volumes in the space of positions and velocities [m^4/s^2], of what is within the limit of the speed, times
        the shares of the other boxes that they hold. Exact."""
        v = self.barrier.kinematics.max_speed
        s0, t0, s1, t1 = low[:, 2], low[:, 3], high[:, 2], high[:, 3]
        velocity = sum(sign * _corner(s, t, v) for sign, s, t in ((1, s1, t1), (-1, s0, t1), (-1, s1, t0), (1, s0, t0)))
        place = (high[:, 0] ** 2 - low[:, 0] ** 2) / 2 * (high[:, 1] - low[:, 1])
        whole = self.range[1, 4:] - self.range[0, 4:]
        real = whole > 0
        share = np.prod((high[:, 4:] - low[:, 4:])[:, real] / whole[real], axis=1)
        return place * np.maximum(velocity, 0) * share

    def sets(
        self, low: Float[Values, "C D"], high: Float[Values, "C D"]
    ) -> tuple[Float[Values, "C I"], Float[Values, "C K I"]]:
        """Affine images of cubes that hold the cells' states: own, goal, obstacle, neighbour.

        First order in the half angle: what is left over are four generators more (K = D + 4), of second order.
        """
        c, r = (low + high) / 2, (high - low) / 2
        d, angle, s, t = c[:, :4].T
        rd, h, rs, rt = r[:, :4].T
        sine, versine = np.sin(h), 1 - np.cos(h)
        lag = h - sine  # of sin(x) behind x, for |x| <= h
        far = high[:, 0]
        fastest = np.maximum(np.abs(low[:, 2:4]), np.abs(high[:, 2:4]))
        n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        across = np.stack([-n[:, 1], n[:, 0]], axis=1)
        kinds, coordinates = self.region.kinds, low.shape[1]
        inputs = 4 + 4 * len(kinds)
        centre = np.zeros((len(low), inputs))
        generators = np.zeros((len(low), coordinates + 4, inputs))
        place, motion = slice(0, 2), slice(2, 4)
        centre[:, place] = np.asarray(self.region.obstacle) + (d - far * versine / 2)[:, None] * n
        centre[:, motion] = s[:, None] * n + t[:, None] * across
        generators[:, 0, place] = rd[:, None] * n
        generators[:, 1, place] = (d * h)[:, None] * across
        generators[:, 1, motion] = h[:, None] * (s[:, None] * across - t[:, None] * n)
        generators[:, 2, motion] = rs[:, None] * n
        generators[:, 3, motion] = rt[:, None] * across
        rest = generators[:, coordinates:]
        rest[:, 0, place] = (far * versine / 2)[:, None] * n
        rest[:, 1, place] = (rd * sine + d * lag)[:, None] * across
        rest[:, 2, motion] = (fastest[:, 0] * versine + rt * sine + np.abs(t) * lag)[:, None] * n
        rest[:, 3, motion] = (fastest[:, 1] * versine + rs * sine + np.abs(s) * lag)[:, None] * across
        at = 4
        for column, kind in zip(range(4, inputs, 4), kinds, strict=True):
            if kind == "obstacle":
                centre[:, column : column + 2] = self.region.obstacle
            else:
                size = 2 if kind == "goal" else 4
                centre[:, column : column + size] = c[:, at : at + size]
                for i in range(size):
                    generators[:, at + i, column + i] = r[:, at + i]
                at += size
        return centre, generators

    def situations(self, points: Float[Values, "P D"]) -> Situations:
        """The states of points of cells."""
        d, angle, s, t = points[:, :4, None].swapaxes(0, 1)
        n = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        across = np.stack([-n[:, 1], n[:, 0]], axis=1)
        own = np.concatenate([np.asarray(self.region.obstacle) + d * n, s * n + t * across], axis=1)
        still = np.zeros((len(points), 2))
        obstacle = np.concatenate([np.tile(self.region.obstacle, (len(points), 1)), still], axis=1)
        senders = {
            "goal": np.zeros((len(points), 0, 4)),
            "obstacle": obstacle[:, None],
            "agent": np.zeros((len(points), 0, 4)),
        }
        if self.region.goal is not None:
            senders["goal"] = np.concatenate([points[:, 4:6], still], axis=1)[:, None]
        if self.region.neighbour is not None:
            senders["agent"] = points[:, None, -4:]
        present: dict[str, Array] = {name: np.ones(x.shape[:2], bool) for name, x in senders.items()}
        return Situations(own=own, senders=senders, present=present)

    def least(self, d: Float[Values, " P"], s: Float[Values, " P"]) -> Float[Values, " P"]:
        """The barrier's w_min [m/s^2] at distances and radial velocities. It falls in both, where the distance does not
        cross the end of the margin; and it is convex in both, where it is of one kind (`kind`)."""
        zero = np.zeros_like(d)
        there = np.ones((len(d), 1), bool)
        encounters = Encounters(
            relative=np.stack([d, zero], axis=1)[:, None],
            velocity=np.stack([s, zero], axis=1)[:, None],
            own_velocity=np.stack([s, zero], axis=1),
            reach=np.full((len(d), 1), self.reach),
            present=there,
            steers=~there,
        )
        return np.asarray(self.barrier.least(encounters))[:, 0]

    def kind(self, d: Float[Values, " P"], s: Float[Values, " P"]) -> Float[Values, " P"]:
        """0 within the margin, 1 where it brakes, 2 where it stops on the way (see `Barrier.least`).

        The last two are separated by a line, h = -s dt (k - 1) / (2 k), so what is at all corners of a box is all over.
        """
        h, dt, k = d - self.reach - self.barrier.margin, self.barrier.kinematics.dt, self.barrier.kinematics.substeps
        brakes = (s >= 0) | (h + s * dt * (k - 1) / (2 * k) >= 0)
        return np.where(h <= SKIN / 2, 0.0, np.where(brakes, 1.0, 2.0))


def _corner(x: Values, y: Values, radius: float) -> Values:
    """Signed area of the part of a disc around 0 between 0 and x, 0 and y."""
    a, b = np.minimum(np.abs(x), radius), np.minimum(np.abs(y), radius)
    start = np.minimum(np.sqrt(radius**2 - b**2), a)

    def under(z: Values) -> Values:
        return (z * np.sqrt(np.maximum(radius**2 - z**2, 0)) + radius**2 * np.arcsin(np.minimum(z / radius, 1))) / 2

    return np.sign(x) * np.sign(y) * (b * start + under(a) - under(start))
