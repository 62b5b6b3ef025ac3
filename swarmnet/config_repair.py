"""The command line of repair; see `swarmnet.config`. Standard library only."""

import math
from dataclasses import dataclass
from pathlib import Path

from repair.config import ConstraintConfig, LoopConfig
from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class Certify:
    """Prove that a policy keeps the braking barrier around an obstacle in every state of a ring, or show where not.

    One agent, one obstacle that stands still, all velocities up to the limit, the action as executed (with its limits).
    States in which no action would do are counted apart. RUN gets certificate.json and counter-examples.npz, which a
    repair can take. Of preset thesis-ch5 and its like.

    Example:
      swarmnet certify runs/first
      swarmnet certify runs/first --distance 5 --goal 0 40 --neighbour 12 6 0 0 --time-limit 600
    """

    run: Path
    """Run folder with a trained model."""
    distance: float = 15.0
    """The ring's width: distances of the centres from the sum of radii to this much more [m]."""
    obstacle: tuple[float, float] = (0.0, 0.0)
    """Where the obstacle stands [m]."""
    goal: tuple[float, float] = (40.0, 0.0)
    """Where the goal is [m]; not used of a model without one."""
    goal_half: float = 1.0
    """The goal may be anywhere up to this far from there in x and y [m]."""
    neighbour: tuple[float, float, float, float] | None = None
    """Another agent: its position [m] and velocity [m/s]; nobody by default."""
    neighbour_half: tuple[float, float] = (1.0, 1.0)
    """It may be up to this far from there in x and y [m], and as much faster or slower in x and y [m/s]."""
    margin: float = 0.0
    """Kept between surfaces beyond touching [m]."""
    share: float = 0.7
    """Part of the largest acceleration counted on for braking."""
    time_limit: float = 120.0
    """Wall time [s], after which what is left is undecided."""
    cells: int | None = None
    """Cells after which what is left is undecided: a limit that means the same on every machine."""
    finest: int = 256
    """Cells are halved along a coordinate until they hold 1 part in this many of it."""
    examples: int = 1000
    """Counter-examples to keep at most."""

    def __post_init__(self) -> None:
        ConstraintConfig(margin=self.margin, share=self.share)
        if not self.margin < self.distance < math.inf:
            raise SpecError("distance", self.distance, f"a finite length above the margin, {self.margin} [m]")
        if not self.time_limit >= 0:
            raise SpecError("time_limit", self.time_limit, "at least 0 [s]")
        for field in ("obstacle", "goal", "neighbour"):
            if not all(map(math.isfinite, getattr(self, field) or ())):
                raise SpecError(field, getattr(self, field), "finite numbers")
        for field, half in (("goal_half", (self.goal_half,)), ("neighbour_half", self.neighbour_half)):
            if not all(0 <= x < math.inf for x in half):
                raise SpecError(field, getattr(self, field), "finite lengths of at least 0")
        for field, least in (("cells", 0), ("finest", 1), ("examples", 0)):
            value = getattr(self, field)
            if value is not None and value < least:
                raise SpecError(field, value, f"at least {least}")


@dataclass(frozen=True, kw_only=True)
class Repair(LoopConfig):
    """Change a trained SwarmNet's weights as little as it takes so that a safety constraint holds, and say what holds.

    The policy acts in physics; where it breaks the constraint without need, it learns what a filter would have done,
    round after round; quadratic programs mend the counter-examples that are left. All is then checked again in float64
    by the weights that are saved. RUN gets checkpoints/ (a model like any other), repair.json, rounds/ (a repair that
    was stopped goes on), and both policies judged on the same unseen scenes, with videos and report.html.

    Example:
      swarmnet simulate --preset clear --mixed --num-obstacles 3 --scenes 2000 --out runs/few.h5
      swarmnet train runs/few.h5 --run runs/few --model thesis-ch5-small
      swarmnet repair runs/few --run runs/few-repaired
    """

    init: Path
    """Run folder with the trained model: preset thesis-ch5 or thesis-ch5-small."""
    run: Path = Path("runs/repaired")
    """Run folder."""
    num_agents: int | None = None
    """Agents of the scenes it acts in; those of the training data by default."""
    num_obstacles: int | None = None
    """Obstacles of the scenes it acts in; those of the training data by default."""
    min_agents: int | None = None
    """Fewest agents of a scene; as in the training data by default."""
    min_obstacles: int | None = None
    """Fewest obstacles of a scene; as in the training data by default. Scenes that have one teach more."""
    examples: tuple[Path, ...] = ()
    """Files counter-examples.npz of `swarmnet certify`: states to learn from and to constrain besides its own."""
    engine: str = "auto"
    """Physics engine: auto, native, mjx, mjx-warp."""
    test_scenes: int = 1000
    """Unseen scenes that both policies are judged on in the end; 0: none."""
    videos: int = 3
    """Worst scenes to make videos of."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("test_scenes", "videos"):
            if getattr(self, name) < 0:
                raise SpecError(name, getattr(self, name), "at least 0")
