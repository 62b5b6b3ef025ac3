"""Plain configurations of worlds: scene, start and expert, with published and tuned presets. Standard library only."""

import math
from dataclasses import dataclass, replace
from typing import Literal

from envs.experts.config import (
    BoidsConfig,
    ChaserConfig,
    ExpertConfig,
    HelbingConfig,
    Interaction,
    VicsekConfig,
    expert_name,
)
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

FAMILIES = ("published", "circle", "corridor", "crossing")
"""Families of starting states."""
ASSIGNMENTS = ("fixed", "scene", "agent")
"""How many targets a chaser has: `targets`, or uniform in 1..targets, drawn for the scene or for each agent."""
RULES: dict[type, tuple[str, ...]] = {
    BoidsConfig: ("cohesion", "separation", "alignment", "obstacle", "goal"),
    HelbingConfig: ("repulsion", "body", "friction", "goal"),
}
"""The weights of an expert's rules, for those that have more than one."""


@dataclass(frozen=True, kw_only=True)
class SpawnConfig:
    """Where scenes start; the families are in `envs.starts`."""

    family: str = "published"
    """`published`: uniform, obstacles about the line from the goal to the mean agent. `circle`: the same, but agents
    on a circle (chasers). `corridor`: obstacles in two rows with a corridor between, on the way to the goal.
    `crossing`: two groups whose ways cross at the goal."""
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
    start_range: float = 30.0
    """corridor, crossing: half-width of the square in which a group starts [m]; circle: its radius."""
    corridor_width: float = 15.0
    """corridor: between the surfaces of the two rows [m]."""
    obstacle_gap: float | None = None
    """Least distance between surfaces of obstacles [m]; None: they lie as they fall, inside each other too (as
    published). A corridor's rows are always shut."""
    obstacle_speed: float = 0.0
    """Speed of every obstacle [m/s], in a random direction; above 0 the scene needs `moving_obstacles`."""
    targets: int = 0
    """How many others a chaser chases at most (`State.target`)."""
    assignment: Literal["fixed", "scene", "agent"] = "fixed"
    """`fixed`: exactly `targets`; `scene`, `agent`: uniform in 1..targets, drawn for each scene or each agent."""
    overlap: bool = False
    """Whether bodies may start inside each other (as published)."""
    clearance: float = 0.0
    """Least distance between surfaces at the start [m], when bodies may not overlap."""

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise SpecError("family", self.family, "one of " + ", ".join(FAMILIES))
        if self.assignment not in ASSIGNMENTS:
            raise SpecError("assignment", self.assignment, "one of " + ", ".join(ASSIGNMENTS))
        lengths = ("goal_range", "agent_range", "clearance", "start_range", "corridor_width", "obstacle_gap")
        for field, unit in (*((name, "m") for name in lengths), ("speed_range", "m/s"), ("obstacle_speed", "m/s")):
            if field == "obstacle_gap" and self.obstacle_gap is None:
                continue
            if not 0 <= getattr(self, field) < math.inf:
                raise SpecError(field, getattr(self, field), f"a finite number of at least 0 [{unit}]")
        for field, low in (("min_agents", 1), ("min_obstacles", 0), ("targets", 0)):
            value = getattr(self, field)
            if value is not None and value < low:
                raise SpecError(field, value, f"at least {low}")


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Coefficients of the thesis's reward (eq. 5.26-5.27, `envs.reward`); the defaults are the published code's."""

    goal_gain: float = 20.0
    """gamma in the goal term gamma / (d + alpha) + beta [m]."""
    goal_softening: float = 10.0
    """alpha: how close to the goal the term levels off [m]."""
    goal_offset: float = -0.16
    """beta: paid per control step whatever the distance [1]."""
    formation: float = 5e-4
    """rho: cost of the distance to every other agent [1/m]."""
    collision: float = 10.0
    """c: cost of a collision, with agents and with solids each [1]."""

    def __post_init__(self) -> None:
        if not 0 < self.goal_softening < math.inf:
            raise SpecError("goal_softening", self.goal_softening, "a finite number above 0 [m]")
        if not -math.inf < self.goal_offset < math.inf:
            raise SpecError("goal_offset", self.goal_offset, "a finite number")
        for field in ("goal_gain", "formation", "collision"):
            if not 0 <= getattr(self, field) < math.inf:
                raise SpecError(field, getattr(self, field), "a finite number of at least 0")


@dataclass(frozen=True)
class World:
    """A preset: the scene, how it starts, and the expert that belongs to it."""

    scene: SceneSpec
    spawn: SpawnConfig
    expert: ExpertConfig

    def __post_init__(self) -> None:
        if isinstance(self.expert, VicsekConfig) and self.expert.dt != self.scene.dt:
            raise SpecError("dt", self.expert.dt, f"the scene's dt of {self.scene.dt} s, or the speed is not constant")


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
    # An agent turns away from what it would pass within 5 m of the avoided radius: it goes between two obstacles
    # undisturbed where 2 (9 - 7 + 5) = 14 m are free.
    return World(scene, SpawnConfig(obstacle_radius=9.0, clearance=4.0, obstacle_gap=14.0), expert)


def helbing(*, num_agents: int = 5, num_obstacles: int = 1, dt: float = 0.3) -> World:
    """The author's world with the Helbing expert: contacts off, one substep. For parity."""
    return replace(published(num_agents=num_agents, num_obstacles=num_obstacles, dt=dt), expert=HelbingConfig())


def chaser(*, num_agents: int = 5, num_obstacles: int = 0, dt: float = 0.3) -> World:
    """The author's chasers on a circle of 20 m, one target each, no goal; limits 10 m/s and 10 m/s^2. For parity."""
    scene = SceneSpec(
        num_agents=num_agents,
        num_obstacles=_no_obstacles("chaser", num_obstacles),
        max_speed=10.0,
        max_acceleration=10.0,
        goal=False,
        dt=dt,
        substeps=1,
        contacts=False,
    )
    spawn = SpawnConfig(family="circle", start_range=20.0, speed_range=2.0, targets=1, overlap=True)
    return World(scene, spawn, ChaserConfig())


def vicsek(*, num_agents: int = 40, num_obstacles: int = 0, dt: float = 0.3) -> World:
    """Vicsek's particles from a square of 80 m, no goal, no limits. The plane has no periodic border."""
    expert = VicsekConfig(dt=dt)
    scene = SceneSpec(
        num_agents=num_agents,
        num_obstacles=_no_obstacles("vicsek", num_obstacles),
        max_speed=math.inf,
        max_acceleration=math.inf,
        goal=False,
        dt=dt,
        substeps=1,
        contacts=False,
    )
    return World(scene, SpawnConfig(agent_range=40.0, speed_range=expert.speed, overlap=True), expert)


def _no_obstacles(preset: str, given: int) -> int:
    """Raises SpecError where obstacles are asked for that the expert would not see."""
    if given:
        raise SpecError("num_obstacles", given, f"0 with preset {preset}, whose expert knows no obstacles")
    return 0


PRESETS = {"published": published, "clear": clear, "helbing": helbing, "chaser": chaser, "vicsek": vicsek}


def make_world(preset: str, *, num_agents: int = 5, num_obstacles: int | None = None) -> World:
    """A preset by name, with its own number of obstacles by default. Raises SpecError for an unknown name."""
    if preset not in PRESETS:
        raise SpecError("preset", preset, "one of " + ", ".join(PRESETS))
    if num_obstacles is None:
        return PRESETS[preset](num_agents=num_agents)
    return PRESETS[preset](num_agents=num_agents, num_obstacles=num_obstacles)


def mixed(world: World, *, min_agents: int = 1, min_obstacles: int = 0) -> World:
    """The same world with 1..N agents and 0..K obstacles in one batch."""
    return replace(world, spawn=replace(world.spawn, min_agents=min_agents, min_obstacles=min_obstacles))


SEEDS = 2**32
"""Seeds are below: a key is made of 32 bits, and a larger seed would be the alias of a smaller one."""


@dataclass(frozen=True, kw_only=True)
class SimulateConfig:
    """What to simulate: a preset world, how many scenes, and by which engine."""

    preset: str = "clear"
    """`clear`: real bodies, contacts on, an expert that keeps clear. `published`: the author's world, contacts off;
    `helbing`, `chaser`: the same with his other experts. `vicsek`: Vicsek's particles."""
    scenes: int = 1000
    """Number of scenes."""
    steps: int = 50
    """Control steps per scene; a trajectory has one row more."""
    num_agents: int = 5
    """Largest number of agents per scene."""
    num_obstacles: int | None = None
    """Largest number of obstacles per scene; by default the preset's own: 1, for `chaser` and `vicsek` 0."""
    mixed: bool = False
    """Draw 1..num_agents agents and 0..num_obstacles obstacles for each scene."""
    seed: int = 0
    """Scene i is drawn from (seed, i), whatever the chunk, engine or number of threads."""
    start: str | None = None
    """Where scenes start: published, circle, corridor, crossing (`SpawnConfig.family`); the preset's own by default."""
    dt: float | None = None
    """Control step [s], its physics steps as long as the preset's; the preset's own by default."""
    rules: tuple[str, ...] = ()
    """The expert's rules that are switched on, by name; all by default. Boids: cohesion, separation, alignment,
    obstacle, goal. Helbing: repulsion, body, friction, goal."""
    interaction_radius: float | None = None
    """Agents see others up to this distance [m]; with `nearest`, both hold."""
    nearest: int | None = None
    """Agents see only this many others, the nearest."""
    obstacle_speed: float = 0.0
    """Speed of the obstacles [m/s], each in a random direction."""
    perception_noise: float = 0.0
    """Standard deviation of what is added to everything the expert sees [m and m/s]; 1 in the thesis."""
    actuation_noise: float = 0.0
    """Standard deviation of what is added to its accelerations [m/s^2]."""
    targets: int | None = None
    """Chasers: how many others each one chases; the preset's own by default, 1."""
    assignment: str | None = None
    """Chasers: `fixed`, exactly `targets`; `scene` or `agent`, uniform in 1..targets for each scene or each agent."""
    average: bool = False
    """Chasers: go for the targets' average position (the thesis's text), not the sum of displacements (its code)."""
    engine: str = "auto"
    """`native` (C on threads), `mjx` (XLA), `mjx-warp` (CUDA), or `auto`: mjx on a GPU or TPU, else native."""
    threads: int = 0
    """Threads of the native engine; 0 takes every CPU."""
    chunk: int = 1024
    """Scenes per saved chunk, rounded up to whole blocks (`envs.shards`): what an interruption can lose."""

    def __post_init__(self) -> None:
        for field in ("scenes", "steps", "num_agents", "chunk"):
            if getattr(self, field) < 1:
                raise SpecError(field, getattr(self, field), "at least 1")
        for field in ("num_obstacles", "threads"):
            if (getattr(self, field) or 0) < 0:
                raise SpecError(field, getattr(self, field), "at least 0")
        if not 0 <= self.seed < SEEDS:
            raise SpecError("seed", self.seed, f"a whole number in 0..{SEEDS - 1}")
        for field, unit in (("perception_noise", "m and m/s"), ("actuation_noise", "m/s^2")):
            if not 0 <= getattr(self, field) < math.inf:
                raise SpecError(field, getattr(self, field), f"a finite number of at least 0 [{unit}]")
        if self.start not in (None, *FAMILIES):
            raise SpecError("start", self.start, "one of " + ", ".join(FAMILIES))
        self.world()

    def world(self) -> World:
        """The preset with this many agents and obstacles, and with everything that was set beside it."""
        world = make_world(self.preset, num_agents=self.num_agents, num_obstacles=self.num_obstacles)
        world = mixed(world) if self.mixed else world
        scene, start, expert = world.scene, world.spawn, world.expert
        if self.dt is not None:
            scene, expert = _stepping(scene, expert, self.dt)
        if self.start is not None:
            start = replace(start, family=self.start)
        if self.obstacle_speed:
            start = replace(start, obstacle_speed=self.obstacle_speed)
            scene = replace(scene, moving_obstacles=True)
        if self.rules:
            expert = only(expert, self.rules)
        if self.interaction_radius is not None or self.nearest is not None:
            seen = Interaction(radius=self.interaction_radius, nearest=self.nearest)
            expert = replace(expert, interaction=seen)
        if self.targets is not None or self.assignment is not None or self.average:
            start, expert = self._chase(start, expert)
        return World(scene, start, expert)

    def _chase(self, start: SpawnConfig, expert: ExpertConfig) -> tuple[SpawnConfig, ExpertConfig]:
        if not isinstance(expert, ChaserConfig):
            given = {"targets": self.targets, "assignment": self.assignment, "average": self.average}
            field, value = next((name, value) for name, value in given.items() if value not in (None, False))
            raise SpecError(field, value, "nothing: it is for preset chaser")
        if self.targets is not None:
            if not 1 <= self.targets < max(self.num_agents, 2):
                raise SpecError("targets", self.targets, f"from 1 to num_agents - 1 = {self.num_agents - 1}")
            start = replace(start, targets=self.targets)
        if self.assignment is not None:
            if self.assignment not in ASSIGNMENTS:
                raise SpecError("assignment", self.assignment, "one of " + ", ".join(ASSIGNMENTS))
            start = replace(start, assignment=self.assignment)
        return start, replace(expert, average=self.average)


def only(expert: ExpertConfig, rules: tuple[str, ...]) -> ExpertConfig:
    """The expert with these of its rules; the weights of the others are 0. Raises SpecError for an unknown rule."""
    known = RULES.get(type(expert), ())
    for rule in rules:
        if rule not in known:
            allowed = "some of " + ", ".join(known) if known else f"none: {expert_name(expert)} has a single rule"
            raise SpecError("rules", rule, allowed)
    return replace(expert, **{rule: 0.0 for rule in known if rule not in rules})


def _stepping(scene: SceneSpec, expert: ExpertConfig, dt: float) -> tuple[SceneSpec, ExpertConfig]:
    """The world at another control step; a physics step is at most as long as before."""
    if not 0 < dt < math.inf:
        raise SpecError("dt", dt, "a finite number above 0 [s]")
    substeps = math.ceil(dt / scene.timestep - 1e-9) if scene.contacts else scene.substeps
    if isinstance(expert, VicsekConfig):
        expert = replace(expert, dt=dt)
    return replace(scene, dt=dt, substeps=substeps), expert
