"""How is the law made safe? Constraints on weights: solved, verified, certified. Names are loaded on first use.

Functions that are named as their file are imported from it: `from repair.certify import certify`, say.
"""

from swarm_mjcf.lazy import lazy

_PUBLIC = {
    "Barrier": "constraints.barrier",
    "Box": "ring",
    "ConstraintConfig": "config",
    "DescentConfig": "config",
    "Diamond": "constraints.diamond",
    "Disc": "constraints.disc",
    "Effort": "certify",
    "LoopConfig": "config",
    "NotEncodable": "errors",
    "Polygon": "constraints.polygon",
    "Region": "ring",
    "RepairError": "errors",
    "Ring": "ring",
    "RollOut": "constraints.roll_out",
    "Situations": "network",
    "SolverMissing": "errors",
    "Status": "errors",
    "Unbounded": "errors",
    "actions": "network",
    "branch_readout": "branch",
    "check_encodable": "network",
    "clopper_pearson": "verify",
    "executed": "limits",
    "make_constraint": "constraints.registry",
    "make_filtered": "filter",
    "repair": "loop",
    "safe_actions": "filter",
    "situations_of_state": "network",
}
__getattr__, __dir__, __all__ = lazy(__name__, _PUBLIC)
