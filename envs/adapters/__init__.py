"""The environment as other libraries expect it. Names are loaded on first use, and each needs its own library."""

from typing import Any

from swarm_mjcf.errors import SwarmError
from swarm_mjcf.lazy import lazy

_PUBLIC = {
    "Observation": "observation",
    "SwarmCore": "core",
    "SwarmDmEnv": "deepmind",
    "SwarmGymEnv": "gym_single",
    "SwarmParallelEnv": "zoo",
    "SwarmPhysics": "control",
    "SwarmTask": "control",
    "SwarmVectorEnv": "gym_vector",
    "control_environment": "control",
    "make_core": "core",
    "nearest": "observation",
    "register": "registration",
}
_EXTRAS = ("gymnasium", "pettingzoo")
_get, __dir__, __all__ = lazy(__name__, _PUBLIC)


def __getattr__(name: str) -> Any:
    try:
        return _get(name)
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library not in _EXTRAS:
            raise
        raise SwarmError(f"{name} needs {library}, which is not installed: .venv/bin/pip install {library}") from error
