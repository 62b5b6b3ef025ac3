"""What happens in a scene? Engines, experts, contacts, environment, trajectories. Names are loaded on first use."""

from swarm_mjcf.lazy import lazy

_PUBLIC = {
    "BoidsConfig": "experts.config",
    "ChaserConfig": "experts.config",
    "Contacts": "state",
    "EXPERTS": "experts.config",
    "HelbingConfig": "experts.config",
    "Interaction": "experts.config",
    "SimulateConfig": "config",
    "SpawnConfig": "config",
    "State": "state",
    "SwarmEnv": "swarm_env",
    "Trajectories": "trajectories",
    "TrajectoryError": "trajectories",
    "VicsekConfig": "experts.config",
    "boids": "experts.boids",
    "make_expert": "experts",
    "collision_report": "collisions",
    "worst_scenes": "collisions",
    "touching_pairs": "replay",
    "save_log": "contact_log",
    "physics_touches": "contact_forces",
    "load_log": "contact_log",
    "collective_report": "collective",
    "collective_measures": "collective",
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
