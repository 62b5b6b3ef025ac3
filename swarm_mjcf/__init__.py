"""What is a scene? Specification, MJCF, compiled model, addresses, pictures. Names are loaded on first use."""

from swarm_mjcf import gl  # noqa: F401  (settles MUJOCO_GL before anything imports mujoco)
from swarm_mjcf.lazy import lazy

_PUBLIC = {
    "Camera": "camera",
    "Playback": "playback",
    "SceneIndex": "index",
    "SceneSpec": "spec",
    "SpecError": "errors",
    "SwarmError": "errors",
    "check_gl": "render",
    "compile_physics": "build",
    "compile_scene": "build",
    "frames": "render",
    "scene_camera": "camera",
    "tiled": "panels",
    "to_xml": "build",
    "write_video": "video",
}
__getattr__, __dir__, __all__ = lazy(__name__, _PUBLIC)
