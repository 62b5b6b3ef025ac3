"""What is the law? Graph, SwarmNet, imitation, evaluation. Names are loaded on first use."""

from swarm_mjcf.lazy import lazy

_PUBLIC = {
    "Checkpoints": "checkpoint",
    "Integrator": "decode",
    "Model": "checkpoint",
    "ModelConfig": "config",
    "SwarmNet": "swarmnet",
    "TrainConfig": "config",
    "load_model": "checkpoint",
    "make_decentralised": "decentral",
    "make_policy": "decode",
    "make_predict": "decode",
    "model_preset": "config",
    "prediction_error": "evaluate",
}
__getattr__, __dir__, __all__ = lazy(__name__, _PUBLIC)
