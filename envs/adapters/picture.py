"""A picture of a scene as it is now, in a view of the whole arena that never moves: what `render()` shows."""

import math

import numpy as np

from envs.state import State
from swarm_mjcf.camera import Camera
from swarm_mjcf.draw import MatplotlibPainter
from swarm_mjcf.errors import SpecError
from swarm_mjcf.overlay import CONTACT, Overlay, agent_colors
from swarm_mjcf.playback import Playback
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.view import ELEVATION, FOVY


def picture(spec: SceneSpec, state: State, scene: int, *, size: int = 480) -> np.ndarray:
    """Scene number `scene` of the batch from above, uint8 (size, size, 3); agents in contact are red.

    Drawn by the renderer that needs no OpenGL: for single pictures it is also the faster one.

    Raises:
      SpecError: the size is below 64 pixels.
    """
    if size < 64:
        raise SpecError("size", size, "at least 64 [pixels]")
    camera = _whole_arena(spec, size)
    present = np.asarray(state.agent_present[scene])
    solid = np.asarray(state.touching_wall[scene]) | np.asarray(state.touching_obstacle[scene]).any(axis=-1)
    playback = Playback(
        position=np.where(present[:, None], np.asarray(state.position[scene], float), 0.0)[None],
        agent_present=present,
        obstacle=np.asarray(state.obstacle[scene], float),
        obstacle_present=np.asarray(state.obstacle_present[scene]),
        goal=np.asarray(state.goal[scene], float) if spec.goal else None,
        touching=np.asarray(state.touching_agent[scene])[None],
        touching_solid=solid[None],
        dt=spec.dt,
    )
    overlay = Overlay(spec, playback, camera=camera, trail=0.0, every=1, contacts=True)
    painter = MatplotlibPainter(spec, playback, camera=camera)
    canvas = np.empty((size, size, 3), np.uint8)
    painter.paint(canvas, 0, np.where(overlay.hit[0][:, None], CONTACT, agent_colors(len(present))))
    overlay.paint(canvas, 0)
    painter.close()
    return canvas


def _whole_arena(spec: SceneSpec, size: int) -> Camera:
    """From above, with a margin of 6% around the arena."""
    distance = 1.06 * spec.arena / math.tan(math.radians(FOVY / 2))
    return Camera(np.zeros((1, 2)), np.array([distance]), ELEVATION["top"], size, size)
