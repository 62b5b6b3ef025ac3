"""What a safety constraint is: conditions on an agent's action, one or more for each body that it could touch."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float

from envs.dynamics import Kinematics
from envs.record import Array, record
from repair.encounters import Encounters


@record
class HalfPlanes:
    """Conditions `normal . action >= offset` that must all hold; of what is absent, the offset is -inf."""

    normal: Float[Array, "R C 2"]
    """Unit vectors."""
    offset: Float[Array, "R C"]
    """[m/s^2]"""


@record
class Sides:
    """For each of C conditions a choice of D half-planes of which one must hold."""

    normal: Float[Array, "R C D 2"]
    offset: Float[Array, "R C D"]


@runtime_checkable
class Constraint(Protocol):
    """A condition on the action [m/s^2] in a situation. Works on NumPy and on JAX arrays."""

    @property
    def name(self) -> str: ...

    @property
    def unit(self) -> str:
        """Of `slack`."""
        ...

    def slack(self, e: Encounters, action: Float[Array, "R 2"]) -> Float[Array, "R C"]:
        """By how much each condition holds for an action that is executed as it is; negative where it is violated.

        Infinite for what is absent.
        """
        ...

    def half_planes(self, e: Encounters, action: Float[Array, "R 2"]) -> HalfPlanes:
        """One half-plane of allowed actions for each condition: all of them where the condition is convex, else the
        side that `action` is on or nearest to (the convex-concave step)."""
        ...

    def sides(self, e: Encounters) -> Sides | None:
        """The allowed actions exactly, as choices of half-planes; None where no finite number of them will do."""
        ...


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Limits and control step, and how much of them a constraint counts on."""

    kinematics: Kinematics
    margin: float = 0.0
    """Kept between surfaces beyond touching [m]."""

    @property
    def push(self) -> float:
        """Displacement by a constant acceleration over one control step [m per m/s^2]: dt^2 (k + 1) / (2 k)."""
        dt, k = self.kinematics.dt, self.kinematics.substeps
        return dt * dt * (k + 1) / (2 * k)


def drifted(e: Encounters, motion: Motion) -> Float[Array, "R J 2"]:
    """Relative position after a control step without acceleration of either [m]."""
    return e.relative + e.velocity * motion.kinematics.dt


def absent(e: Encounters, values: Float[Array, "R J"], instead: float) -> Float[Array, "R J"]:
    """The values with `instead` where there is nobody to meet."""
    xp = e.relative.__array_namespace__()
    return xp.where(e.present, values, instead)
