"""Checked again, by nobody who has an interest: a float64 pass of the very float32 weights that are saved."""

from dataclasses import asdict, dataclass

import numpy as np
import scipy.stats

from envs.dynamics import Kinematics
from gnn.family import Params
from gnn.features import Scales
from repair.constraints.constraint import Constraint
from repair.encounters import Bodies
from repair.network import Situations, actions
from repair.screen import TOLERANCE, screen


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What a policy does to a constraint, row by row; a row is an agent that decides."""

    rows: int
    violated: int
    """Rows whose executed action breaks a condition."""
    avoidable: int
    """Of these, those for whom an admissible action would not have."""
    violated_before_clip: int
    """Rows whose action as the network gives it breaks one, before limits shorten it."""
    introduced: int | None
    """Rows that break a condition now and did not with the weights compared with; None without any."""
    mended: int | None
    """The other way round."""
    worst: float
    """Least slack of an executed action among avoidable rows, in the constraint's unit; infinite without any row."""
    deviation: float | None
    """Root mean square change of the network's own outputs [m/s^2]."""

    @property
    def holds_before_clip(self) -> bool:
        """Whether no row's own output breaks a condition."""
        return self.violated_before_clip == 0

    @property
    def holds_as_executed(self) -> bool:
        """Whether no row breaks a condition that it need not break."""
        return self.avoidable == 0

    def plain(self) -> dict:
        """Plain JSON values."""
        found = asdict(self) | {
            "holds_before_clip": self.holds_before_clip,
            "holds_as_executed": self.holds_as_executed,
        }
        return found | {
            name: value if value is not None and np.isfinite(value) else None
            for name, value in (("worst", self.worst), ("deviation", self.deviation))
        }


def verify(
    params: Params,
    scales: Scales,
    situations: Situations,
    constraint: Constraint,
    bodies: Bodies,
    kinematics: Kinematics,
    *,
    normalise: bool = True,
    before: Params | None = None,
    possible: bool = False,
) -> Verification:
    """Puts every row through network, clips and integrator in float64. `before`: weights to compare with.
    `possible`: of all rows it is known that some action satisfies them, so that every violation is one without need;
    otherwise that is looked for (`repair.screen`).

    An action that is not finite breaks everything.
    """
    action = actions(params, scales, situations, normalise=normalise)
    now = screen(constraint, situations, action, bodies, kinematics)
    needless = now.violated if possible else now.avoidable
    introduced = mended = deviation = None
    if before is not None:
        old_action = actions(before, scales, situations, normalise=normalise)
        old = screen(constraint, situations, old_action, bodies, kinematics)
        introduced = int((now.violated & ~old.violated).sum())
        mended = int((old.violated & ~now.violated).sum())
        deviation = float(np.sqrt(np.mean(np.sum((action - old_action) ** 2, axis=1)))) if len(action) else 0.0
    return Verification(
        rows=len(situations),
        violated=int(now.violated.sum()),
        avoidable=int(needless.sum()),
        violated_before_clip=int((now.before_clip < -TOLERANCE).sum()),
        introduced=introduced,
        mended=mended,
        worst=float(now.slack[needless | ~now.violated].min(initial=np.inf)),
        deviation=deviation,
    )


def clopper_pearson(hits: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact two-sided interval of a probability of which `hits` of `trials` came up (Clopper and Pearson 1934).

    Without hits, the upper end is one-sided: with 0 of 1000 the probability is at most 0.3% with 95% confidence.
    """
    if not 0 <= hits <= trials or trials < 1:
        raise ValueError(f"{hits} hits of {trials} trials")
    rest = 1 - confidence
    low = 0.0 if hits == 0 else float(scipy.stats.beta.ppf(rest / 2, hits, trials - hits + 1))
    one_sided = rest if hits == 0 else rest / 2
    high = 1.0 if hits == trials else float(scipy.stats.beta.ppf(1 - one_sided, hits + 1, trials - hits))
    return low, high
