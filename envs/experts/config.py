"""Plain configurations of the experts. Standard library only."""

import math
from dataclasses import dataclass

from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class Interaction:
    """Which other agents an agent sees: all, those in a radius, the k nearest, or the k nearest in a radius."""

    radius: float | None = None
    """Others closer than this [m]; None: at any distance."""
    nearest: int | None = None
    """Only this many of them, the nearest; None: all."""

    def __post_init__(self) -> None:
        if self.radius is not None and not 0 < self.radius < math.inf:
            raise SpecError("radius", self.radius, "None (no limit) or a finite number above 0 [m]")
        k = self.nearest
        if k is not None and (isinstance(k, bool) or not isinstance(k, int) or k < 1):
            raise SpecError("nearest", k, "None (no limit) or a whole number of at least 1")

    @property
    def full(self) -> bool:
        """Whether everyone sees everyone."""
        return self.radius is None and self.nearest is None


@dataclass(frozen=True, kw_only=True)
class BoidsConfig:
    """Reynolds' Boids as the thesis's author coded them; a weight of 0 switches a rule off."""

    cohesion: float = 0.2
    """Weight of: mean position of the others - own position [1/s^2]."""
    separation: float = 2.0
    """Weight of: sum (or mean) over others closer than `separation_range` of (p_i - p_j) / d^2 [m^2/s^2]."""
    alignment: float = 0.2
    """Weight of: mean velocity of the others - own velocity [1/s]."""
    obstacle: float = 2.0
    """Weight of the turn away from the nearest obstacle ahead [1/(m s^2)]."""
    goal: float = 0.5
    """Weight of: velocity wanted toward the goal - own velocity [1/s]."""
    separation_range: float = 3.0
    """Comfort distance between centres [m], not a body's size."""
    separation_summed: bool = False
    """Whether separation is the sum over close others; otherwise it is divided by the number of others."""
    obstacle_range: float = 3.0
    """An obstacle that would be missed by less than this [m] is avoided."""
    avoided_radius: float = 8.0
    """Radius of obstacles in the rule [m], not the body's."""
    walls: bool = True
    """Whether the arena's border is avoided like an obstacle of radius 0 (virtual walls, no bodies)."""
    arena: float = 100.0
    """Half-width of the walled arena [m]."""
    cruise_speed: float = 10.0
    """Speed wanted far from the goal [m/s]."""
    slowdown_distance: float = 20.0
    """Distance to the goal [m] below which the wanted speed falls linearly."""
    interaction: Interaction = Interaction()
    """Whom cohesion, separation and alignment see; "the others" of these rules are the others seen."""

    def __post_init__(self) -> None:
        _weights(self, "cohesion", "separation", "alignment", "obstacle", "goal")
        _above_zero(self, "m", "separation_range", "obstacle_range", "arena", "slowdown_distance")
        _at_least_zero(self, "m", "avoided_radius")
        _at_least_zero(self, "m/s", "cruise_speed")


@dataclass(frozen=True, kw_only=True)
class HelbingConfig:
    """Helbing et al. (2000) as the thesis's author coded it; a weight of 0 switches a term off."""

    repulsion: float = 1.0
    """Weight A of: exp((r - d) / B) away from the other [m/s^2]; r is the contact distance, d the distance."""
    repulsion_range: float = 2.0
    """Range B of the repulsion [m]."""
    body: float = 2.0
    """Weight k of: (r - d) away from the other, where they overlap (d < r) [1/s^2]."""
    friction: float = 1.0
    """Weight kappa of: (r - d) times the other's sideways velocity relative to own, where they overlap [1/(m s)]."""
    goal: float = 1.0
    """Weight of: velocity wanted toward the goal - own velocity [1/s]."""
    agent_size: float = 3.0
    """Radius of an agent in the rule [m], not the body's: r is twice this between agents."""
    avoided_radius: float = 8.0
    """Radius of obstacles in the rule [m], not the body's: r is `agent_size` plus this."""
    agents: bool = True
    """Whether other agents are felt."""
    obstacles: bool = True
    """Whether obstacles are felt."""
    cruise_speed: float = 10.0
    """Speed wanted far from the goal [m/s]."""
    slowdown_distance: float = 20.0
    """Distance to the goal [m] below which the wanted speed falls linearly."""
    interaction: Interaction = Interaction()
    """Which other agents are felt; obstacles always are."""

    def __post_init__(self) -> None:
        _weights(self, "repulsion", "body", "friction", "goal")
        _above_zero(self, "m", "repulsion_range", "slowdown_distance")
        _at_least_zero(self, "m", "agent_size", "avoided_radius")
        _at_least_zero(self, "m/s", "cruise_speed")


@dataclass(frozen=True, kw_only=True)
class ChaserConfig:
    """Chasers (chapter 4): every agent accelerates toward its targets (`State.target`)."""

    gain: float = 1.0
    """Weight of the displacement to the targets [1/s^2]."""
    average: bool = False
    """Whether to chase the targets' average position (the thesis's text); otherwise displacements add up (its code)."""
    interaction: Interaction = Interaction()
    """Which agents are seen; a target that is not seen is not chased."""

    def __post_init__(self) -> None:
        _weights(self, "gain")


@dataclass(frozen=True, kw_only=True)
class VicsekConfig:
    """Vicsek et al. (1995): constant speed, heading = mean heading of the neighbours and oneself, plus noise."""

    speed: float = 5.0
    """Constant speed [m/s]."""
    noise: float = 0.5
    """Width eta of the uniform noise on the heading [rad]: it lies in [-eta/2, eta/2]."""
    dt: float = 0.3
    """Control step in which the heading is reached [s]; must be that of the scene."""
    interaction: Interaction = Interaction(radius=20.0)
    """Whose headings are averaged."""

    def __post_init__(self) -> None:
        _above_zero(self, "m/s", "speed")
        _above_zero(self, "s", "dt")
        if not 0 <= self.noise <= 2 * math.pi:
            raise SpecError("noise", self.noise, "from 0 to 2 pi [rad]")


ExpertConfig = BoidsConfig | HelbingConfig | ChaserConfig | VicsekConfig
"""Configuration of any expert; `envs.experts.make_expert` turns it into a policy."""

EXPERTS: dict[str, type[ExpertConfig]] = {
    "boids": BoidsConfig,
    "helbing": HelbingConfig,
    "chaser": ChaserConfig,
    "vicsek": VicsekConfig,
}
"""The configuration of each expert by name."""


def expert_name(config: ExpertConfig) -> str:
    """The name under which a configuration stands in `EXPERTS`."""
    return next(name for name, kind in EXPERTS.items() if type(config) is kind)


def _weights(config: ExpertConfig, *fields: str) -> None:
    for field in fields:
        if not math.isfinite(getattr(config, field)):
            raise SpecError(field, getattr(config, field), "a finite number; 0 switches the rule off")


def _above_zero(config: ExpertConfig, unit: str, *fields: str) -> None:
    for field in fields:
        if not 0 < getattr(config, field) < math.inf:
            raise SpecError(field, getattr(config, field), f"a finite number above 0 [{unit}]")


def _at_least_zero(config: ExpertConfig, unit: str, *fields: str) -> None:
    for field in fields:
        if not 0 <= getattr(config, field) < math.inf:
            raise SpecError(field, getattr(config, field), f"a finite number of at least 0 [{unit}]")
