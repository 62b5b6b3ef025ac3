"""What is the law? Graph, SwarmNet, imitation, evaluation. Names are loaded on first use."""

import importlib
from typing import Any

_PUBLIC = {
    "Checkpoints": "checkpoint",
    "Integrator": "decode",
    "Model": "checkpoint",
    "ModelConfig": "config",
    "SwarmNet": "swarmnet",
    "TrainConfig": "config",
    "load_model": "checkpoint",
    "make_policy": "decode",
    "make_predict": "decode",
    "model_preset": "config",
    "prediction_error": "evaluate",
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(f"gnn.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module 'gnn' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
