"""How fast frames come, against MuJoCo's default quality on the same scene, view and size, in one run."""

import time
from collections.abc import Iterator

import numpy as np

from swarm_mjcf.camera import scene_camera
from swarm_mjcf.playback import Playback
from swarm_mjcf.render import check_gl, frames, picture_height
from swarm_mjcf.spec import SceneSpec


def run(seconds: float = 2.0, size: int = 480) -> list[tuple[str, float]]:
    """Frames per second, by name.

    fast: `frames` as videos use it, with trails, outlines and caption. default: the bodies alone, drawn with what
    `mujoco.Renderer` has when nothing is set: shadow maps of 4096 pixels from a light that casts shadows, 4 samples per
    pixel, reflections, sky. The scene is 5 agents around an obstacle. The two take turns, so that a machine that slows
    down slows both. Without OpenGL only matplotlib's figure is there.
    """
    spec, playback = SceneSpec(), _circling(SceneSpec())
    drawn: dict[str, Iterator[object]] = {
        "matplotlib_fps": frames(spec, playback, width=size, height=size, backend="matplotlib")
    }
    if check_gl().problem is None:
        drawn["fast_fps"] = frames(spec, playback, width=size, height=size, backend="mujoco")
        drawn["default_fps"] = _plain(spec, playback, size)
    spent, count = dict.fromkeys(drawn, 0.0), dict.fromkeys(drawn, 0)
    for stream in drawn.values():
        next(stream)  # contexts and caches are made with the first frame
    while min(spent.values()) < seconds / len(drawn):
        for name, stream in drawn.items():
            start = time.perf_counter()
            for _ in range(2 if name == "default_fps" else 10):
                next(stream)
                count[name] += 1
            spent[name] += time.perf_counter() - start
    result = [(f"render.{name}", count[name] / spent[name]) for name in drawn]
    rates = dict(result)
    if "render.fast_fps" in rates:
        result.append(("render.ratio", rates["render.fast_fps"] / rates["render.default_fps"]))
    return result


def _plain(spec: SceneSpec, playback: Playback, size: int) -> Iterator[None]:
    from swarm_mjcf.overlay import agent_colors
    from swarm_mjcf.scene_gl import MujocoPainter

    camera = scene_camera(spec, [playback], camera="top", width=size, height=picture_height(size))
    painter = MujocoPainter(spec, playback, camera=camera, quality="default")
    colors, canvas = agent_colors(spec.num_agents), np.empty((camera.height, camera.width, 3), np.uint8)
    try:
        for row in range(len(playback.position)):
            painter.paint(canvas, row, colors)
            yield
    finally:
        painter.close()


def _circling(spec: SceneSpec) -> Playback:
    """Agents on circles around the obstacle, long enough never to run out."""
    rows = 100_000
    angle = 0.02 * np.arange(rows)[:, None] + 1.2 * np.arange(spec.num_agents)
    radius = 20 + 6 * np.arange(spec.num_agents)
    still = np.zeros((rows, spec.num_agents), bool)
    return Playback(
        position=np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1),
        agent_present=np.ones(spec.num_agents, bool),
        obstacle=np.zeros((1, 2)),
        obstacle_present=np.ones(1, bool),
        goal=np.array([60.0, 45.0]),
        touching=still,
        touching_solid=still,
        dt=0.1,
        title="5 agents, 1 obstacle",
    )
