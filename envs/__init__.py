"""What happens in a scene? Engines, experts, contacts, environment, trajectories. Names are loaded on first use."""

import importlib
from typing import Any

_PUBLIC = {
    "BoidsConfig": "config",
    "Contacts": "state",
    "SimulateConfig": "config",
    "SpawnConfig": "config",
    "State": "state",
    "SwarmEnv": "swarm_env",
    "Trajectories": "trajectories",
    "TrajectoryError": "trajectories",
    "boids": "experts.boids",
    "collision_report": "collisions",
    "load": "storage",
    "make_engine": "engines",
    "make_rollout": "rollout",
    "make_world": "config",
    "mixed": "config",
    "save": "storage",
    "scene_keys": "swarm_env",
    "stream": "storage",
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(f"envs.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module 'envs' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
