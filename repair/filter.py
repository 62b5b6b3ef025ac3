"""A run-time shield: the action nearest to the policy's that the constraint allows. Usable around any policy."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from envs.dynamics import Kinematics, limited
from envs.policy import Policy
from envs.record import Array
from envs.state import State
from gnn.graph import graph_of_state
from repair.constraints.constraint import Constraint, HalfPlanes
from repair.encounters import Bodies, Encounters, encounters, length
from repair.network import Situations

TIGHTEST = 8
"""Conditions of an agent whose lines are tried, those with the least slack; all of them are checked."""
MORE = 3
"""Times that the lines are chosen anew where there are more conditions."""
DIRECTIONS, LOOKS = 36, 24
"""Where no action is allowed: directions that are tried, and how often the way along each of them is looked at."""
SIDE = 1e-3
"""By how much one side is preferred to the other [m]."""
TOLERANCE = 1e-4
"""By how much an action may violate a condition and still count as allowed [m/s^2]."""


def nearest_allowed(
    action: Float[Array, "R 2"], planes: HalfPlanes, limit: float
) -> tuple[Float[Array, "R 2"], Bool[Array, " R"]]:
    """The nearest action [m/s^2] within the half-planes and the disc of radius `limit`, and whether there is one.

    A quadratic program in two variables, solved exactly: its solution is the action itself, its projection on one line
    or on the circle, or where two of these meet; all are tried at once. Where nothing is allowed: the one of them that
    violates the worst condition least. Of more than `TIGHTEST` conditions, those that are tightest at the action give
    the lines, and then those that are tightest there or where that led to: exact where no more than that many
    are missed by the action or nearer to it than what is allowed; what counts as allowed always satisfies all.
    """
    xp = action.__array_namespace__()
    action = _within(xp, action, limit)
    tight = xp.sum(planes.normal * action[:, None], axis=-1) - planes.offset
    found, possible = _among(action, planes, tight, limit)
    at = found
    for _ in range(MORE if planes.offset.shape[1] > TIGHTEST else 0):
        tight = xp.minimum(tight, xp.sum(planes.normal * at[:, None], axis=-1) - planes.offset)
        at, fits = _among(action, planes, tight, limit)
        nearer = xp.sum((at - action) ** 2, axis=-1) < xp.sum((found - action) ** 2, axis=-1)
        better = fits & (nearer | ~possible)
        found, possible = xp.where(better[:, None], at, found), possible | fits
    return found, possible


def _among(
    action: Float[Array, "R 2"], planes: HalfPlanes, tight: Float[Array, "R J"], limit: float
) -> tuple[Float[Array, "R 2"], Bool[Array, " R"]]:
    """The nearest of what the lines of the least `tight` give, judged by all."""
    xp = action.__array_namespace__()
    lines = min(TIGHTEST, planes.offset.shape[1])
    order = xp.argsort(tight, axis=1)[:, :lines]
    n = xp.take_along_axis(planes.normal, order[..., None], axis=1)
    b = xp.take_along_axis(planes.offset, order, axis=1)
    real = xp.isfinite(b)
    b = xp.where(real, b, -1e9)
    onto = action[:, None] + xp.maximum(b - xp.sum(n * action[:, None], axis=-1), 0)[..., None] * n
    tried = [action[:, None], onto]
    if lines > 1:
        first, second = (np.array(x) for x in zip(*combinations(range(lines), 2), strict=True))
        n1, n2, b1, b2 = n[:, first], n[:, second], b[:, first], b[:, second]
        area = n1[..., 0] * n2[..., 1] - n1[..., 1] * n2[..., 0]
        area = xp.where(xp.abs(area) < 1e-9, 1e-9, area)
        corner = xp.stack(
            [(b1 * n2[..., 1] - b2 * n1[..., 1]) / area, (b2 * n1[..., 0] - b1 * n2[..., 0]) / area], axis=-1
        )
        tried.append(corner)
    if np.isfinite(limit):
        along = xp.sqrt(xp.maximum(limit * limit - b * b, 0))[..., None]
        across = xp.stack([-n[..., 1], n[..., 0]], axis=-1)
        foot = xp.clip(b, -limit, limit)[..., None] * n
        tried += [foot + along * across, foot - along * across]
    tried = _within(xp, xp.concatenate(tried, axis=1), limit)
    missed = planes.offset[:, None] - xp.sum(planes.normal[:, None] * tried[:, :, None], axis=-1)
    worst = xp.max(missed, axis=-1, initial=-1e9)
    fits = worst <= TOLERANCE
    away = xp.sum((tried - action[:, None]) ** 2, axis=-1)
    possible = xp.any(fits, axis=1)
    best = xp.where(possible, xp.argmin(xp.where(fits, away, np.inf), axis=1), xp.argmin(worst + 1e-6 * away, axis=1))
    return xp.take_along_axis(tried, best[:, None, None], axis=1)[:, 0], possible


def _within(xp: object, vector: Array, limit: float) -> Array:
    """Shortened to the limit."""
    if np.isinf(limit):
        return vector
    size = xp.sqrt(xp.sum(vector * vector, axis=-1, keepdims=True) + 1e-18)  # type: ignore[attr-defined]
    return vector * xp.minimum(1.0, limit / size)  # type: ignore[attr-defined]


def safe_actions(
    constraint: Constraint,
    situations: Situations,
    action: Float[Array, "R 2"],
    bodies: Bodies,
    kinematics: Kinematics,
    *,
    steps: int = 2,
) -> tuple[Float[Array, "R 2"], Bool[Array, " R"]]:
    """The policy's actions [m/s^2] as the constraint allows them, and for whom that is possible.

    A constraint that is not convex is convexified `steps` times, each time at the action found before.
    """
    e = encounters(situations, bodies)
    rounds = 1 if constraint.sides(e) is not None and constraint.name == "barrier" else steps
    safe, possible = action, None
    for _ in range(rounds):
        safe, possible = nearest_allowed(action, constraint.half_planes(e, safe), kinematics.max_acceleration)
    assert possible is not None
    return safe, possible


def evasive(
    constraint: Constraint, e: Encounters, action: Float[Array, "R 2"], kinematics: Kinematics
) -> Float[Array, "R 2"]:
    """The action that, held on to, keeps the nearest body farthest away [m/s^2]: for who has no allowed one.

    Braking along the line of centres may come too late where a turn does not. Tried are `action` and the full
    acceleration in `DIRECTIONS` directions, for a little longer than a stop takes; the other agent of a pair is taken
    to do the opposite, as it finds the same by the same rule. Of many bodies the `TIGHTEST` of least slack count.
    Where nothing keeps clear, bodies meet off centre and faster than brakes alone would have let them.
    """
    xp = action.__array_namespace__()
    bodies = min(TIGHTEST, e.present.shape[1])
    slack = constraint.slack(e, action)  # a body may have several conditions
    slack = xp.min(slack.reshape(*e.present.shape, -1), axis=-1)
    order = xp.argsort(xp.where(e.present, slack, np.inf), axis=1)[:, :bodies]
    position, velocity = (xp.take_along_axis(x, order[..., None], axis=1) for x in (e.relative, e.velocity))
    reach, here, steers = (xp.take_along_axis(x, order, axis=1) for x in (e.reach, e.present, e.steers))
    angle = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    rim = kinematics.max_acceleration * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rim = xp.broadcast_to(xp.asarray(rim, dtype=action.dtype), (len(action), DIRECTIONS, 2))
    tried = xp.concatenate([action[:, None], rim], axis=1)
    push = xp.where(steers, 2.0, 1.0)[:, None, :, None] * tried[:, :, None]  # of the agent seen from the body
    nearest = xp.full(tried.shape[:2], np.inf, dtype=action.dtype)
    for time in looks(kinematics):
        away = length((position + velocity * time)[:, None] + push * (time * time / 2)) - reach[:, None]
        nearest = xp.minimum(nearest, xp.min(xp.where(here[:, None], away, np.inf), axis=-1))
    # Head-on, left is as good as right: both of a pair take the same side.
    to = position[:, :1]
    side = to[..., 0] * tried[..., 1] - to[..., 1] * tried[..., 0]
    best = xp.argmax(nearest + SIDE * side / (1e-9 + length(to) * length(tried)), axis=1)
    return xp.take_along_axis(tried, best[:, None, None], axis=1)[:, 0]


def looks(kinematics: Kinematics) -> Float[np.ndarray, " t"]:
    """When `evasive` looks [s]: `LOOKS` times in 1.2 of what a stop from the largest speed takes; where there is no
    largest speed, in 4 control steps."""
    stop = kinematics.max_speed / kinematics.max_acceleration
    return (1.2 * stop if np.isfinite(stop) else 4 * kinematics.dt) * np.arange(1, LOOKS + 1) / LOOKS


def shielded(
    constraint: Constraint,
    situations: Situations,
    action: Float[Array, "R 2"],
    bodies: Bodies,
    kinematics: Kinematics,
) -> Float[Array, "R 2"]:
    """What the filter makes of executed actions [m/s^2]: the nearest allowed one, `evasive` where there is none."""
    safe, possible = safe_actions(constraint, situations, action, bodies, kinematics)
    e = encounters(situations, bodies)
    if np.isinf(kinematics.max_acceleration) or not e.present.shape[1]:
        return safe
    # Rarely needed, and several times what comes before it.
    if isinstance(safe, np.ndarray):
        late = np.flatnonzero(~possible)
        safe = safe.copy()
        safe[late] = evasive(constraint, jax.tree.map(lambda x: x[late], e), safe[late], kinematics)
        return safe
    return jax.lax.cond(
        jnp.all(possible),
        lambda safe: safe,
        lambda safe: jnp.where(possible[:, None], safe, evasive(constraint, e, safe, kinematics)),
        safe,
    )


def _others(present: Bool[Array, "S N"]) -> Bool[Array, "S N N"]:
    return present[:, :, None] & present[:, None] & ~jnp.eye(present.shape[1], dtype=bool)


def make_filtered(
    policy: Policy, constraint: Constraint, bodies: Bodies, kinematics: Kinematics, *, goal: bool = True
) -> Policy:
    """`policy` behind the constraint: a policy of the same kind. Absent agents keep the action they were given."""

    def filtered(state: State, params: object, key: object = None) -> Float[Array, "S N 2"]:
        wanted = policy(state, params, key)
        nodes, graph = graph_of_state(state, goal=goal)
        agents = wanted.shape[1]
        _, obstacles, _ = graph.counts
        first = nodes.shape[1] - agents
        parts = {"obstacle": nodes[:, first - obstacles : first], "agent": nodes[:, first:]}
        own = nodes[:, first:].reshape(-1, 4)
        situations = Situations(
            own=own,
            senders={name: jnp.repeat(part, agents, axis=0) for name, part in parts.items()},
            present={
                "obstacle": jnp.asarray(graph.obstacle).reshape(len(own), obstacles),
                # Everybody else, also where the network hears of its target alone.
                "agent": _others(jnp.asarray(graph.present)[:, first:]).reshape(len(own), agents),
            },
        )
        flat = limited(situations.own[:, 2:], jnp.asarray(wanted).reshape(-1, 2), kinematics)
        safe = shielded(constraint, situations, flat, bodies, kinematics)
        safe = jnp.asarray(safe).reshape(wanted.shape)
        return jnp.where(jnp.asarray(state.agent_present)[..., None], safe, wanted)

    return filtered
