"""What is a scene? Specification, MJCF, compiled model, addresses, pictures. Names are loaded on first use."""

import importlib
from typing import Any

from swarm_mjcf import gl  # noqa: F401  (settles MUJOCO_GL before anything imports mujoco)

_PUBLIC = {
    "Playback": "playback",
    "SceneIndex": "index",
    "SceneSpec": "spec",
    "SpecError": "errors",
    "SwarmError": "errors",
    "check_gl": "render",
    "compile_scene": "build",
    "frames": "render",
    "side_by_side": "render",
    "to_xml": "build",
    "write_video": "video",
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(f"swarm_mjcf.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module 'swarm_mjcf' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
