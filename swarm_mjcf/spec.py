"""What a scene is, before any physics: a frozen record, every field with its unit, refused when it makes no sense."""

import math
from dataclasses import dataclass

from swarm_mjcf.errors import SpecError

MAX_TIMESTEP = 0.02
"""Longest physics step [s] at which a contact still looks like one."""


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """Planar agents among obstacles, with a goal. Counts are maxima: a batch may mix smaller scenes (see `envs.state`).

    Two regimes. `contacts=False` with one substep is the published code's world: bodies pass through each other.
    `contacts=True` is for everything judged by contacts; its physics timestep `dt / substeps` must be at most
    `min(radius) / (4 max_speed)` and 0.02 s, or fast bodies would cross between two states.

    Raises:
      SpecError: a value is out of range; says which field, what was given, what is allowed.
    """

    num_agents: int = 5
    """Largest number of agents in a scene."""
    num_obstacles: int = 1
    """Largest number of obstacles in a scene."""
    agent_radius: float = 1.0
    """Radius of an agent's body [m]; the experts' comfort distances are separate."""
    obstacle_radius: float = 7.0
    """Radius of an obstacle's body [m]."""
    agent_mass: float = 1.0
    """Mass of an agent [kg]; shared momentum in a crash, nothing else, because controls are accelerations."""
    max_speed: float = 10.0
    """Commanded speed limit [m/s], a clip in norm before physics; inf for none (contacts need a finite one)."""
    max_acceleration: float = 10.0
    """Acceleration limit [m/s^2], a clip in norm before physics; inf for none."""
    goal: bool = True
    """Whether the scene has a goal, which never collides."""
    goal_radius: float = 2.0
    """Radius of the drawn goal [m]."""
    arena: float = 100.0
    """Half-width of the arena [m]: positions lie in [-arena, arena]^2."""
    walls: bool = False
    """Whether solid walls stand at the arena's border (an expert's virtual walls are no bodies)."""
    moving_obstacles: bool = False
    """Whether obstacles move, each at the constant velocity of its state: at most `max_speed` where contacts are on, so
    that the rule for the timestep holds for them too. Nothing stops or deflects them, walls included. Whom they push
    sinks into them by what they move in 4 physics steps (0.4 m at 10 m/s and 0.01 s): MuJoCo gives such bodies no
    velocity."""
    dt: float = 0.3
    """Control step [s]."""
    substeps: int = 30
    """Physics steps per control step; 30 keep a crash of 1 m bodies at 20 m/s below a quarter radius (tested)."""
    contacts: bool = True
    """Whether bodies collide."""
    solver_iterations: int = 4
    """Newton iterations of the contact solver per physics step."""
    solver_ls_iterations: int = 8
    """Line-search iterations of the contact solver."""
    solref_timeconst: float = 2.0
    """Contact stiffness: time constant of MuJoCo's `solref` in physics timesteps (MuJoCo's own floor is 2)."""
    solref_dampratio: float = 1.0
    """Contact damping ratio of MuJoCo's `solref`; 1 is critical."""

    def __post_init__(self) -> None:
        least = {"num_agents": 1, "num_obstacles": 0, "substeps": 1, "solver_iterations": 1, "solver_ls_iterations": 1}
        for field, low in least.items():
            value = getattr(self, field)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                raise SpecError(field, value, f"a whole number of at least {low}")
        for field in ("goal", "walls", "moving_obstacles", "contacts"):
            if not isinstance(getattr(self, field), bool):
                raise SpecError(field, getattr(self, field), "True or False")
        for field, unit in (
            ("agent_radius", "m"),
            ("obstacle_radius", "m"),
            ("agent_mass", "kg"),
            ("goal_radius", "m"),
            ("arena", "m"),
            ("dt", "s"),
            ("solref_dampratio", "1"),
        ):
            value = getattr(self, field)
            if not _is_number(value) or not 0 < value < math.inf:
                raise SpecError(field, value, f"a finite number above 0 [{unit}]")
        for field, unit in (("max_speed", "m/s"), ("max_acceleration", "m/s^2")):
            value = getattr(self, field)
            if not _is_number(value) or not value > 0:
                raise SpecError(field, value, f"a number above 0 [{unit}], or inf for no limit")
        if not _is_number(self.solref_timeconst) or not 2 <= self.solref_timeconst < math.inf:
            raise SpecError("solref_timeconst", self.solref_timeconst, "at least 2 [physics timesteps]")
        for field in ("agent_radius", "obstacle_radius") if self.num_obstacles else ("agent_radius",):
            if getattr(self, field) >= self.arena:
                raise SpecError(field, getattr(self, field), f"below the arena's half-width of {self.arena} m")
        if self.contacts and self.timestep > self.max_timestep * (1 + 1e-9):
            if not math.isfinite(self.max_speed):
                raise SpecError("max_speed", self.max_speed, "finite when contacts are on: inf would need inf substeps")
            needed = math.ceil(self.dt / self.max_timestep - 1e-9)
            raise SpecError(
                "substeps",
                self.substeps,
                f"at least {needed} with contacts on, so that no body moves more than a quarter of the smallest radius "
                f"({self.smallest_radius} m) at {self.max_speed} m/s in one physics step of at most {MAX_TIMESTEP} s",
            )

    @property
    def timestep(self) -> float:
        """Physics timestep [s]."""
        return self.dt / self.substeps

    @property
    def smallest_radius(self) -> float:
        """Smallest radius of a body that can collide [m]."""
        return min(self.agent_radius, self.obstacle_radius) if self.num_obstacles else self.agent_radius

    @property
    def max_timestep(self) -> float:
        """Longest physics timestep [s] that contacts allow."""
        return min(MAX_TIMESTEP, self.smallest_radius / (4 * self.max_speed))

    def parking(self) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
        """Where absent agents and absent obstacles wait [m]: far outside the arena, far from each other."""
        pitch = 4 * max(self.agent_radius, self.obstacle_radius)
        agents = [(-10 * self.arena - pitch * i, -10 * self.arena) for i in range(self.num_agents)]
        obstacles = [(-10 * self.arena - pitch * k, 10 * self.arena) for k in range(self.num_obstacles)]
        return agents, obstacles


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
