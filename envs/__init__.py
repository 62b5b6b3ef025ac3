"""What happens in a scene? Engines, experts, contacts, environment, trajectories. Names are loaded on first use."""

from swarm_mjcf.lazy import lazy

_PUBLIC = {
    "BoidsConfig": "experts.config",
    "Contacts": "state",
    "SimulateConfig": "config",
    "SpawnConfig": "config",
    "State": "state",
    "SwarmEnv": "swarm_env",
    "Trajectories": "trajectories",
    "TrajectoryError": "trajectories",
    "boids": "experts.boids",
    "make_expert": "experts",
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
__getattr__, __dir__, __all__ = lazy(__name__, _PUBLIC)
