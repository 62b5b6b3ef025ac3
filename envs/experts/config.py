"""Plain configurations of the experts. Standard library only."""

import math
from dataclasses import dataclass

from swarm_mjcf.errors import SpecError


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

    def __post_init__(self) -> None:
        for field in ("separation_range", "obstacle_range", "arena", "slowdown_distance"):
            if not 0 < getattr(self, field) < math.inf:
                raise SpecError(field, getattr(self, field), "a finite number above 0 [m]")


ExpertConfig = BoidsConfig
"""Configuration of any expert; `envs.experts.make_expert` turns it into a policy."""
