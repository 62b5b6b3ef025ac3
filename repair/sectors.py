"""Angular sectors of points that have to lie outside a disc around 0: their convex hulls, how they narrow and split.

A sector is a bisector's angle `middle` and half of its opening, `half`, in radians. What lies in it outside the disc
has a convex hull of three half-planes, the chord's and the two rays', where it opens by less than half a turn; else the
hull is the whole plane. `half` = pi is a full turn.
"""

import numpy as np
from jaxtyping import Float, Int

WIDE = np.pi / 2
"""Half of an opening from which on a hull is the whole plane."""


def hull(
    middle: Float[np.ndarray, "*M"], half: Float[np.ndarray, "*M"], kind: Int[np.ndarray, "*M"]
) -> tuple[Float[np.ndarray, "*M 2"], Float[np.ndarray, "*M"]]:
    """Unit normals n and the offsets, in radii, of half-planes n . y >= offset: chords (kind 0) and rays (1, 2)."""
    angle = middle + np.where(kind == 0, 0, np.where(kind == 1, half - np.pi / 2, np.pi / 2 - half))
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1), np.where(kind == 0, np.cos(half), 0)


def narrowed(
    middle: Float[np.ndarray, " C"],
    half: Float[np.ndarray, " C"],
    at: Float[np.ndarray, "C 2"],
    ball: float,
    radius: Float[np.ndarray, " C"],
) -> tuple[Float[np.ndarray, " C"], Float[np.ndarray, " C"]] | None:
    """Sectors of what is within `ball` of the points `at` and outside the radius; None where one is empty."""
    far, ball = np.linalg.norm(at, axis=1), ball + 1e-9
    around = ball >= far
    # The tangents from 0 touch the ball outside the radius, or its circle meets that of the radius.
    tangent = ~around & (far * far - ball * ball >= radius * radius)
    cosine = (radius * radius + far * far - ball * ball) / np.maximum(2 * radius * far, 1e-300)
    if np.any(~tangent & (cosine > 1) & (radius > far)):
        return None
    seen = np.where(
        tangent, np.arcsin(np.minimum(ball / np.maximum(far, 1e-300), 1)), np.arccos(np.clip(cosine, -1, 1))
    )
    seen = np.where(around & (radius == 0), np.pi, seen) + 1e-9
    shift = _wrapped(np.arctan2(at[:, 1], at[:, 0]) - middle)
    whole = half >= np.pi
    low = np.where(whole, shift - seen, np.maximum(-half, shift - seen))
    high = np.where(whole, shift + seen, np.minimum(half, shift + seen))
    # Where both ends of a wide sector remain, it is left as it was.
    apart = ~whole & ((shift + seen - 2 * np.pi >= -half) | (shift - seen + 2 * np.pi <= half))
    change = ~apart & (seen < np.pi)
    if np.any(change & (low > high)):
        return None
    return np.where(change, middle + (low + high) / 2, middle), np.where(change, (high - low) / 2, half)


def pieces(
    middle: Float[np.ndarray, " K"],
    half: Float[np.ndarray, " K"],
    at: Float[np.ndarray, "K 2"],
    radius: Float[np.ndarray, " K"],
) -> tuple[Float[np.ndarray, "K 4"], Float[np.ndarray, "K 4"]]:
    """Sectors that sectors are split into, to cut off points inside their discs; padded with NaN.

    Narrow ones are cut in two in the point's direction. Of wide ones, a piece is around the point, narrow enough for
    its chord to pass halfway between point and circle, and the rest makes three.
    """
    turn = _wrapped(np.arctan2(at[:, 1], at[:, 0]) - middle)
    own = np.arccos(np.clip((1 + np.linalg.norm(at, axis=1) / radius) / 2, 0, 1))
    own = np.clip(own, 0.1, np.pi / 4)
    whole = half >= np.pi
    cut = np.where(whole, turn, np.clip(turn, own - half, half - own))
    beyond = (cut + own + half) / 2
    rest = np.linspace(cut + own, cut - own + 2 * np.pi, 4)
    wide_low = np.concatenate([[cut - own], np.where(whole, rest[:3], [-half, cut + own, beyond])])
    wide_high = np.concatenate([[cut + own], np.where(whole, rest[1:], [cut - own, beyond, half])])
    cut, none = np.clip(turn, -0.6 * half, 0.6 * half), np.full_like(half, np.nan)
    low = np.where(half > WIDE, wide_low, [-half, cut, none, none])
    high = np.where(half > WIDE, wide_high, [cut, half, none, none])
    return (middle + (low + high) / 2).T, ((high - low) / 2).T


def away(
    middle: Float[np.ndarray, "K 4"],
    half: Float[np.ndarray, "K 4"],
    at: Float[np.ndarray, "K 2"],
    radius: Float[np.ndarray, " K"],
) -> Float[np.ndarray, "K 4"]:
    """How far points are at least from the hulls of sectors; infinite for those that are NaN."""
    kinds = np.broadcast_to(np.arange(3)[:, None, None], (3, *half.shape))
    normal, offset = hull(np.broadcast_to(middle, kinds.shape), np.broadcast_to(half, kinds.shape), kinds)
    beyond = np.max(offset * radius[:, None] - np.sum(normal * at[:, None], axis=-1), axis=0)
    return np.where(np.isnan(half), np.inf, np.where(half < WIDE, np.maximum(beyond, 0), 0))


def _wrapped(angle: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    return (angle + np.pi) % (2 * np.pi) - np.pi
