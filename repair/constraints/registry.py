"""Constraints by name."""

from envs.dynamics import Kinematics
from repair.config import CONSTRAINTS, ConstraintConfig
from repair.constraints.barrier import Barrier
from repair.constraints.constraint import Constraint
from repair.constraints.diamond import Diamond
from repair.constraints.disc import Disc
from repair.constraints.polygon import Polygon
from repair.constraints.roll_out import RollOut
from swarm_mjcf.errors import SpecError


def make_constraint(config: ConstraintConfig, kinematics: Kinematics) -> Constraint:
    """The constraint that a configuration names. Raises SpecError for a name that does not exist."""
    both = {"kinematics": kinematics, "margin": config.margin}
    match config.name:
        case "barrier":
            return Barrier(**both, share=config.share)
        case "disc":
            return Disc(**both)
        case "polygon":
            return Polygon(**both, edges=config.edges)
        case "diamond":
            return Diamond(**both)
        case "roll-out":
            return RollOut(**both, horizon=config.horizon)
    raise SpecError("constraint", config.name, "one of " + ", ".join(CONSTRAINTS))
