"""What an import declares: units, rates, columns, and what to do with gaps. Standard library only."""

import math
from dataclasses import dataclass
from typing import Literal

from swarm_mjcf.errors import SpecError

LENGTHS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "in": 0.0254}
"""Metres in a unit of length."""
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
"""Seconds in a unit of time."""
FORMATS = ("auto", "csv", "parquet", "published", "juelich", "jupedsim", "eth", "trajnet", "matlab")
FIELDS = ("t", "frame", "id", "x", "y", "z", "type", "run", "vx", "vy")
"""Columns that a long table may have; `t` or `frame`, `id`, `x` and `y` it must."""
KINDS = ("goal", "obstacle", "agent")
"""Types of a row, in the order of `envs.trajectories`."""


@dataclass(frozen=True, kw_only=True)
class ImportConfig:
    """How recorded trajectories become ours. Nothing is guessed: what a file does not say is declared here."""

    format: Literal["auto", "csv", "parquet", "published", "juelich", "jupedsim", "eth", "trajnet", "matlab"] = "auto"
    """Format of the files; auto goes by the name."""
    columns: tuple[str, ...] = ()
    """csv, parquet, matlab: our name = theirs, such as `t=time id=ped`; in matlab columns are numbers from 1."""
    types: tuple[str, ...] = ()
    """Values of the type column = goal, obstacle or agent, such as `pedestrian=agent pillar=obstacle`."""
    variable: str | None = None
    """matlab: name of the table, where the file holds several."""
    unit: Literal["m", "dm", "cm", "mm", "km", "ft", "in"] | None = None
    """Unit of positions, where the file does not say; velocities are per second."""
    time_unit: Literal["s", "ms", "us", "ns", "min", "frame"] | None = None
    """Unit of the column t, where the file does not say; `frame` needs --fps."""
    fps: float | None = None
    """Frame numbers per second, where the file does not say."""
    dt: float | None = None
    """Time between rows of the result [s]; the recording's own by default. Positions between rows are interpolated
    linearly, only inside a stay."""
    velocity: Literal["auto", "difference", "file"] = "auto"
    """`difference`: backward differences of positions. `file`: the file's own (vx, vy), where a simulator wrote its
    state. auto: the file's own for the published arrays, differences elsewhere."""
    substeps: int = 1
    """Physics steps per row of the simulator that wrote the velocities; 1 for recordings."""
    gap: Literal["error", "split", "interpolate"] = "error"
    """When rows of somebody are missing: refuse, let it leave and come back, or bridge linearly up to --max-gap."""
    max_gap: float = 0.0
    """Longest gap to bridge [s]; longer ones are split."""
    segment: float | None = None
    """Length of a scene [s], whose nodes are those present in it; 0: whole runs. 10 by default; the published arrays
    stay whole."""
    holdout: float = 0.0
    """Share kept out, written to NAME_holdout.h5; see --holdout-by."""
    holdout_by: Literal["auto", "run", "people", "time"] = "auto"
    """`run`: the last whole runs. `people`: of each run those who leave last; their file begins when the others are
    gone. `time`: the last part of each run, the same people. auto: run if there are several, else people."""
    radius: float = 0.0
    """Radius of an agent's body [m]; 0: contacts cannot be judged."""
    obstacle_radius: float = 0.0
    """Radius of an obstacle [m]."""
    max_speed: float = math.inf
    """Speed limit of the agents [m/s], where there is one; models may use it."""
    max_acceleration: float = math.inf
    """Limit of acceleration [m/s^2]."""
    origin: tuple[float, float] = (0.0, 0.0)
    """Subtracted from all positions [m]; for coordinates so large that single precision would blur them."""
    outlier_speed: float | None = None
    """Speeds above this [m/s] are listed, not removed; 10 times the median by default."""
    outlier_acceleration: float | None = None
    """Accelerations above this [m/s^2] are listed, not removed; 10 times the median by default."""
    source: str = ""
    """Where the data come from: a citation or DOI, for the dataset card."""
    licence: str = ""
    """Licence of the data, for the dataset card."""

    def __post_init__(self) -> None:
        for field in ("fps", "dt", "outlier_speed", "outlier_acceleration"):
            value = getattr(self, field)
            if value is not None and not 0 < value < math.inf:
                raise SpecError(field, value, "a finite number above 0")
        for field in ("max_speed", "max_acceleration"):
            if not getattr(self, field) > 0:
                raise SpecError(field, getattr(self, field), "above 0")
        for field in ("max_gap", "radius", "obstacle_radius", *(("segment",) if self.segment is not None else ())):
            if not 0 <= getattr(self, field) < math.inf:
                raise SpecError(field, getattr(self, field), "a finite number of at least 0")
        if self.gap == "interpolate" and not self.max_gap:
            raise SpecError("max_gap", self.max_gap, "above 0 [s]: the longest gap that gap = interpolate may bridge")
        if self.gap != "interpolate" and self.max_gap:
            raise SpecError("max_gap", self.max_gap, "nothing: it belongs to gap = interpolate")
        if not 0 <= self.holdout < 1:
            raise SpecError("holdout", self.holdout, "a share of at least 0 and below 1")
        if self.substeps < 1:
            raise SpecError("substeps", self.substeps, "at least 1")
        if self.substeps > 1 and self.velocity != "file":
            raise SpecError(
                "substeps", self.substeps, "1 unless velocity = file: differences are one-substep velocities"
            )
        self.named_columns()
        self.kind_names()

    def named_columns(self) -> dict[str, str]:
        """Our column name -> theirs. Raises SpecError for a pair that is none, or a name that does not exist."""
        return _pairs("columns", self.columns, FIELDS, ours_first=True)

    def kind_names(self) -> dict[str, str]:
        """Their type -> goal, obstacle or agent; those three mean themselves."""
        return {name: name for name in KINDS} | _pairs("types", self.types, KINDS, ours_first=False)


def _pairs(field: str, given: tuple[str, ...], ours: tuple[str, ...], *, ours_first: bool) -> dict[str, str]:
    pairs = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not (key and equals and value) or (key if ours_first else value) not in ours:
            shape = "OURS=THEIRS" if ours_first else "THEIRS=OURS"
            raise SpecError(field, text, f"{shape}, where OURS is one of {', '.join(ours)}")
        if key in pairs:
            raise SpecError(field, text, f"{key} once only")
        pairs[key] = value
    return pairs
