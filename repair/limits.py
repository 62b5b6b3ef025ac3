"""The executed action: limits are clips after the network, so what must hold is a condition on the clipped action."""

import numpy as np
from jaxtyping import Float

from envs.dynamics import Kinematics
from envs.record import Array
from repair.constraints.constraint import HalfPlanes


def as_executed(planes: HalfPlanes, limit: float) -> HalfPlanes:
    """Conditions on the network's output u under which `planes` hold for `u` clipped in norm to `limit` [m/s^2].

    For an offset b > 0 exactly those: n . clip(u) >= b where n . u >= b and n . u >= (b / limit) |u|, and in the plane
    that cone is two half-planes more. For b <= 0, n . u >= b is enough. An offset beyond the limit leaves no action; it
    is taken as the limit, and no slack of `planes` themselves will then be positive. C conditions become 3 C.

    The speed limit shortens the velocity after the step: it never speeds up an approach, so where an agent is still
    closing after the step, a barrier that holds for the clipped acceleration holds for the executed one; the rest is
    checked after the fact (`repair.verify`).
    """
    n, b = planes.normal, planes.offset
    xp = n.__array_namespace__()
    if np.isinf(limit):
        return planes
    cosine = xp.clip(b / limit, 0, 1)
    sine = xp.sqrt(1 - cosine * cosine)
    across = xp.stack([-n[..., 1], n[..., 0]], axis=-1)
    # |t . u| cosine <= n . u sine: within the cone of half angle acos(cosine) around n.
    cones = [n * sine[..., None] + side * across * cosine[..., None] for side in (1, -1)]
    needed = b > 0
    none = xp.where(needed, 0.0, -np.inf)
    return HalfPlanes(
        normal=xp.concatenate([n, *cones], axis=1), offset=xp.concatenate([xp.minimum(b, limit), none, none], axis=1)
    )


def executed(velocity: Float[Array, "R 2"], action: Float[Array, "R 2"], kinematics: Kinematics) -> Float[Array, "R 2"]:
    """The constant acceleration [m/s^2] that an action becomes (`envs.dynamics.limited`), in the inputs' precision."""
    action = _clipped(action, kinematics.max_acceleration)
    after = velocity + action * kinematics.dt
    return action + (_clipped(after, kinematics.max_speed) - after) / kinematics.dt


def _clipped(vector: Float[Array, "R 2"], limit: float) -> Float[Array, "R 2"]:
    xp = vector.__array_namespace__()
    size = xp.sqrt(xp.sum(vector * vector, axis=-1, keepdims=True))
    return vector * xp.where(size > limit, limit / xp.where(size > limit, size, 1), 1)
