"""Smooth lines on a picture without OpenGL's multisampling: soft dots, one per pixel of length, blended in one go."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Dots:
    """P soft dots to be painted. Dots that overlap do not darken each other, so a row of them is a smooth line."""

    xy: np.ndarray
    """Centres [pixels], (P, 2) as (column, row)."""
    color: np.ndarray
    """Red, green, blue in 0..255, float (P, 3)."""
    opacity: np.ndarray
    """0..1, (P,)."""
    width: np.ndarray
    """Diameter [pixels], (P,)."""

    @classmethod
    def of(cls, xy: np.ndarray, *, color: np.ndarray, opacity: float | np.ndarray = 1.0, width: float = 1.6) -> "Dots":
        """Dots at xy (..., 2), with colour and opacity broadcast to them."""
        shape = xy.shape[:-1]
        return cls(
            xy=xy.reshape(-1, 2),
            color=np.broadcast_to(color, (*shape, 3)).reshape(-1, 3),
            opacity=np.broadcast_to(opacity, shape).reshape(-1),
            width=np.full(math.prod(shape), width),
        )

    @classmethod
    def join(cls, parts: list["Dots"]) -> "Dots":
        """All dots of several sets; where they overlap the most opaque wins."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


@dataclass(frozen=True)
class Stamp:
    """Pixels of a picture (flat, each once) and what is blended into them: computed once, pressed many times."""

    pixel: np.ndarray
    cover: np.ndarray
    color: np.ndarray

    def press(self, canvas: np.ndarray, *, brighter: int = 0) -> None:
        """Blends into those pixels of `canvas`, contiguous uint8 (H, W, 3), whose channels all are at least `brighter`:
        what lies on a bright floor passes below dark bodies."""
        flat = canvas.reshape(-1, 3)
        below = flat[self.pixel]
        if brighter:
            keep = below.min(axis=1) >= brighter
            Stamp(self.pixel[keep], self.cover[keep], self.color[keep]).press(canvas)
            return
        flat[self.pixel] = (below + self.cover[:, None] * (self.color - below) + 0.5).astype(np.uint8)


def stamp(dots: Dots, height: int, width: int) -> Stamp:
    """Turns dots into pixels of a picture of that size; what falls outside is dropped."""
    reach = math.ceil(float(dots.width.max(initial=1.0)) / 2)
    with np.errstate(invalid="ignore"):  # NaN (behind the camera) is outside, too
        inside = (dots.xy > -reach).all(axis=1) & (dots.xy < (width + reach, height + reach)).all(axis=1)
    xy = dots.xy[inside].astype(np.float32)
    step = np.arange(-reach, reach + 1)
    corner = np.floor(xy).astype(np.int32)
    column = corner[:, 0, None, None] + step[None, None, :]
    row = corner[:, 1, None, None] + step[None, :, None]
    across = (column + np.float32(0.5) - xy[:, 0, None, None]) ** 2
    distance = np.sqrt(across + (row + np.float32(0.5) - xy[:, 1, None, None]) ** 2)
    edge = (dots.width[inside].astype(np.float32) / 2 + np.float32(0.5))[:, None, None]
    cover = np.clip(edge - distance, 0, 1) * dots.opacity[inside].astype(np.float32)[:, None, None]
    keep = (cover > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = (row * width + column)[keep]
    cover = cover[keep]
    owner = np.broadcast_to(np.flatnonzero(inside)[:, None, None], keep.shape)[keep]
    # One winner per pixel, the most opaque: sorted by pixel, then by cover, the last of each run of equal pixels.
    key = np.argsort(pixel.astype(np.int64) * 256 + (255 * cover).astype(np.int64))
    last = key[np.append(np.diff(pixel[key]) > 0, True)] if len(key) else key
    return Stamp(pixel[last], cover[last], dots.color[owner[last]].astype(np.float32))


def circles(xy: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Points (M, R, 2) around centres (R, 2), radius (R,), in the centres' unit; M grows with the largest radius."""
    count = int(np.clip(math.ceil(2 * math.pi * float(np.max(radius, initial=1.0))), 12, 4096))
    angle = np.linspace(0, 2 * math.pi, count, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return xy[None] + radius[None, :, None] * unit[:, None]


@dataclass(frozen=True)
class Paths:
    """Trajectories as dots one pixel apart, in order of time, so that a stretch of time is a slice."""

    xy: np.ndarray
    """(P, 2), in the unit of the trajectories."""
    time: np.ndarray
    """(P,) [rows]."""
    agent: np.ndarray
    """(P,)."""
    along: np.ndarray
    """Length of the path so far, (P,) [pixels]."""
    start: np.ndarray
    """(T,): the first dot of the segment that begins at each row."""

    @classmethod
    def of(cls, xy: np.ndarray, pixels: np.ndarray, present: np.ndarray) -> "Paths":
        """Lays dots along xy (T, N, 2), where an agent is present at both ends of a segment.

        Args:
          xy: the trajectories, in any unit.
          pixels: the same in a picture, (T, N, 2) [pixels]: says how far apart the dots are.
          present: bool (T, N).
        """
        rows, agents, _ = xy.shape
        usable = present & np.isfinite(pixels).all(-1)
        drawn = (usable[1:] & usable[:-1])[..., None]
        step = np.where(drawn, np.diff(xy, axis=0), 0.0)
        length = np.hypot(*np.moveaxis(np.where(drawn, np.diff(pixels, axis=0), 0.0), -1, 0))
        count = np.where(drawn[..., 0], np.clip(np.ceil(length), 1, 4096), 0).astype(int)
        segment = np.repeat(np.arange(count.size), count.ravel())
        first = np.concatenate([[0], np.cumsum(count.ravel())])
        part = (np.arange(len(segment)) - first[segment]) / count.ravel()[segment]
        before = np.cumsum(length, axis=0) - length
        return cls(
            xy=xy[:-1].reshape(-1, 2)[segment] + part[:, None] * step.reshape(-1, 2)[segment],
            time=segment // agents + part,
            agent=segment % agents,
            along=before.ravel()[segment] + part * length.ravel()[segment],
            start=first[::agents][:rows],
        )

    def between(self, low: int, high: int) -> slice:
        """The dots of the rows low..high."""
        return slice(int(self.start[max(low, 0)]), int(self.start[high]))
