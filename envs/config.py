"""Plain configurations of worlds: scene, start and expert, with published and tuned presets. Standard library only."""

import math
from dataclasses import dataclass, replace

from envs.experts.config import BoidsConfig, ExpertConfig
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec


@dataclass(frozen=True, kw_only=True)
class SpawnConfig:
    """Where scenes start, uniform as published; obstacles lie about the line from the goal to the mean agent."""

    goal_range: float = 40.0
    """Goal in [-goal_range, goal_range]^2 [m]."""
    agent_range: float = 80.0
    """Agents in [-agent_range, agent_range]^2 [m]."""
    speed_range: float = 15.0
    """Velocities in [-speed_range, speed_range]^2 [m/s], then clipped to the scene's speed limit."""
    obstacle_radius: float = 8.0
    """Radius r in the published placement [m]: along the line U(2 + r, L - r) from the goal, across it U(-2r, 2r)."""
    min_agents: int | None = None
    """Fewest agents in a scene; None: every scene has all of them. Mixed batches draw uniformly up to the maximum."""
    min_obstacles: int | None = None
    """Fewest obstacles in a scene; None: all."""
    overlap: bool = False
    """Whether bodies may start inside each other (as published)."""
    clearance: float = 0.0
    """Least distance between surfaces at the start [m], when bodies may not overlap."""

    def __post_init__(self) -> None:
        for field, unit in (("goal_range", "m"), ("agent_range", "m"), ("speed_range", "m/s"), ("clearance", "m")):
            if not 0 <= getattr(self, field) < math.inf:
                raise SpecError(field, getattr(self, field), f"a finite number of at least 0 [{unit}]")
        for field, low in (("min_agents", 1), ("min_obstacles", 0)):
            value = getattr(self, field)
            if value is not None and value < low:
                raise SpecError(field, value, f"None or at least {low}")


@dataclass(frozen=True)
class World:
    """A preset: the scene, how it starts, and the expert that belongs to it."""

    scene: SceneSpec
    spawn: SpawnConfig
    expert: ExpertConfig


def published(*, num_agents: int = 5, num_obstacles: int = 1, dt: float = 0.3) -> World:
    """The author's world: contacts off, one substep, averaged separation, limits 10 m/s and 5 m/s^2. For parity."""
    scene = SceneSpec(
        num_agents=num_agents,
        num_obstacles=num_obstacles,
        agent_radius=1.0,
        obstacle_radius=7.0,
        max_speed=10.0,
        max_acceleration=5.0,
        dt=dt,
        substeps=1,
        contacts=False,
    )
    return World(scene, SpawnConfig(overlap=True), BoidsConfig())


def clear(*, num_agents: int = 5, num_obstacles: int = 1) -> World:
    """A world of real bodies whose expert keeps clear of them: contacts in under 0.1% of control steps (tested)."""
    scene = SceneSpec(num_agents=num_agents, num_obstacles=num_obstacles)
    expert = BoidsConfig(
        cohesion=0.02,
        separation=80.0,
        obstacle=6.0,
        separation_range=10.0,
        separation_summed=True,
        obstacle_range=5.0,
        avoided_radius=9.0,
    )
    return World(scene, SpawnConfig(obstacle_radius=9.0, clearance=4.0), expert)


PRESETS = {"published": published, "clear": clear}


def make_world(preset: str, *, num_agents: int = 5, num_obstacles: int = 1) -> World:
    """A preset by name. Raises SpecError for a name that does not exist."""
    if preset not in PRESETS:
        raise SpecError("preset", preset, "one of " + ", ".join(PRESETS))
    return PRESETS[preset](num_agents=num_agents, num_obstacles=num_obstacles)


def mixed(world: World, *, min_agents: int = 1, min_obstacles: int = 0) -> World:
    """The same world with 1..N agents and 0..K obstacles in one batch."""
    return replace(world, spawn=replace(world.spawn, min_agents=min_agents, min_obstacles=min_obstacles))


@dataclass(frozen=True, kw_only=True)
class SimulateConfig:
    """What to simulate: a preset world, how many scenes, and by which engine."""

    preset: str = "clear"
    """`clear`: real bodies, contacts on, an expert that keeps clear. `published`: the author's world, contacts off."""
    scenes: int = 1000
    """Number of scenes."""
    steps: int = 50
    """Control steps per scene; a trajectory has one row more."""
    num_agents: int = 5
    """Largest number of agents per scene."""
    num_obstacles: int = 1
    """Largest number of obstacles per scene."""
    mixed: bool = False
    """Draw 1..num_agents agents and 0..num_obstacles obstacles for each scene."""
    seed: int = 0
    """Scene i is drawn from (seed, i), whatever the chunk, engine or number of threads."""
    engine: str = "auto"
    """`native` (C on threads), `mjx` (XLA), or `auto`: mjx on a GPU or TPU, native elsewhere."""
    threads: int = 0
    """Threads of the native engine; 0 takes every CPU."""
    chunk: int = 1024
    """Scenes per batch and per saved chunk: what an interruption can lose."""

    def __post_init__(self) -> None:
        for field in ("scenes", "steps", "num_agents", "chunk"):
            if getattr(self, field) < 1:
                raise SpecError(field, getattr(self, field), "at least 1")
        for field in ("num_obstacles", "seed", "threads"):
            if getattr(self, field) < 0:
                raise SpecError(field, getattr(self, field), "at least 0")
        self.world()

    def world(self) -> World:
        """The preset with this many agents and obstacles."""
        world = make_world(self.preset, num_agents=self.num_agents, num_obstacles=self.num_obstacles)
        return mixed(world) if self.mixed else world
