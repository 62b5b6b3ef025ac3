"""What a repair ends with, and the errors that end it without one."""

from enum import StrEnum
from typing import Any

from swarm_mjcf.errors import SwarmError


class Status(StrEnum):
    """How a problem was solved. Only the first three come with values."""

    OPTIMAL = "optimal"
    """Every row holds and no better solution exists, within the gap asked for."""
    FEASIBLE = "feasible"
    """Every row holds; how far from the best is what `gap` says, or unknown."""
    ELASTIC = "elastic"
    """Some rows are violated, by as little as the price of violation made worth while."""
    INFEASIBLE = "infeasible-in-box"
    """Proven: no weights within the box satisfy all rows."""
    NO_INCUMBENT = "no-incumbent"
    """The limits of time or nodes were reached without any solution; what a solver returns then is not one."""
    NUMERICAL = "numerical"
    """The solver failed, or its values do not satisfy its own rows when put into the network."""

    @property
    def solved(self) -> bool:
        """Whether there are values."""
        return self in (Status.OPTIMAL, Status.FEASIBLE, Status.ELASTIC)


class RepairError(SwarmError):
    """A repair cannot be done; nothing was changed.

    Attributes: `status`; `evidence`: what the problem was (rows, columns, binaries), its bounds, what the solver said.
    """

    def __init__(self, message: str, status: Status = Status.NUMERICAL, **evidence: Any) -> None:
        told = ", ".join(f"{name} {value}" for name, value in evidence.items())
        super().__init__(f"{message} ({told})" if told else message)
        self.status, self.evidence = status, evidence


class NotEncodable(RepairError):
    """The network is not one of ReLU layers with inputs linear in the state."""


class Unbounded(RepairError):
    """A big-M cannot be computed, because the inputs or weights that it follows from have no finite bounds."""


class SolverMissing(RepairError):
    """The solver that was asked for is not installed."""
