"""Who could touch whom: every agent beside every obstacle and every other agent, in relative coordinates."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from envs.record import Array, record
from repair.network import Situations


@runtime_checkable
class Bodies(Protocol):
    """Radii; `SceneSpec` has them."""

    @property
    def agent_radius(self) -> float: ...
    @property
    def obstacle_radius(self) -> float: ...


@record
class Encounters:
    """R agents, each beside J bodies: its obstacles, then the other agents."""

    relative: Float[Array, "R J 2"]
    """Position of the agent seen from the body [m]."""
    velocity: Float[Array, "R J 2"]
    """Velocity of the agent seen from the body [m/s]."""
    own_velocity: Float[Array, "R 2"]
    """[m/s]"""
    reach: Float[Array, "R J"]
    """Distance of the centres at which they touch: the sum of the radii [m]."""
    present: Bool[Array, "R J"]
    steers: Bool[Array, "R J"]
    """Whether the body is an agent, which brakes too and under the same constraint."""


def encounters(situations: Situations, bodies: Bodies) -> Encounters:
    """Of every row with every place of an obstacle or another agent, filled (`present`) or not.

    What is absent is far away and still, so that nothing divides by zero.
    """
    own = situations.own
    xp = own.__array_namespace__()
    parts = []
    for name, radius in (("obstacle", bodies.obstacle_radius), ("agent", bodies.agent_radius)):
        of, here = situations.senders[name], situations.present[name]
        apart = own[:, None, :2] - of[..., :2]
        parts.append(
            (
                xp.where(here[..., None], apart, xp.asarray([1e6, 0.0], dtype=own.dtype)),
                xp.where(here[..., None], own[:, None, 2:] - of[..., 2:], 0),
                xp.full(here.shape, bodies.agent_radius + radius, dtype=own.dtype),
                here,
                xp.full(here.shape, name == "agent", dtype=bool),
            )
        )
    relative, velocity, reach, present, steers = (xp.concatenate(x, axis=1) for x in zip(*parts, strict=True))
    return Encounters(
        relative=relative, velocity=velocity, own_velocity=own[:, 2:], reach=reach, present=present, steers=steers
    )


def gap(e: Encounters) -> Float[Array, "R J"]:
    """Distance between surfaces [m], negative inside; infinite for what is absent."""
    xp = e.relative.__array_namespace__()
    return xp.where(e.present, length(e.relative) - e.reach, np.inf)


def length(vector: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """Euclidean norm, differentiable everywhere but at 0, where it is 1e-9."""
    xp = vector.__array_namespace__()
    return xp.sqrt(xp.sum(vector * vector, axis=-1) + 1e-18)


def outward(e: Encounters) -> Float[Array, "R J 2"]:
    """Unit vectors from the bodies' centres to the agent."""
    return e.relative / length(e.relative)[..., None]
