"""The bodies, drawn by MuJoCo: the compiled scene, positions set through the index, one OpenGL context per painter."""

from dataclasses import replace

import mujoco
import numpy as np

from swarm_mjcf import gl, names
from swarm_mjcf.build import compile_scene
from swarm_mjcf.camera import Camera
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.playback import Playback
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.view import DISC_TOP, FOVY


class MujocoPainter:
    """Fills a picture with the bodies of one playback.

    `quality` is "fast" (no shadows, no multisampling, no reflections, no sky, coarse discs: the overlay draws smooth
    outlines around them) or "default", which is what `mujoco.Renderer` draws when nothing is set.
    """

    def __init__(self, spec: SceneSpec, playback: Playback, *, camera: Camera, quality: str) -> None:
        count, solids = playback.position.shape[1], playback.obstacle.shape[1]
        scene = replace(
            spec, num_agents=count, num_obstacles=solids, goal=playback.goal is not None, contacts=False, substeps=1
        )
        self._model = model = compile_scene(scene)
        self._data = data = mujoco.MjData(model)
        self._playback, self._views, index = playback, camera, SceneIndex.of(model, scene)
        self._qpos = np.arange(model.nq)[index.qpos].reshape(count, 2)
        self._discs = np.array([model.geom(names.disc(names.agent(i))).id for i in range(count)])
        model.vis.global_.offwidth, model.vis.global_.offheight = camera.width, camera.height
        model.vis.global_.fovy = FOVY
        _set_quality(model, quality)

        self._solids = np.arange(model.nmocap)[index.obstacle_mocap]
        self._solid_discs = [model.geom(names.disc(names.obstacle(k))).id for k in range(solids)]
        if playback.goal is not None:
            data.mocap_pos[index.goal_mocap, :2] = playback.goal
        mujoco.mj_forward(model, data)

        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.azimuth, self._camera.elevation = 90.0, camera.elevation
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 100)
        if quality == "fast":
            for flag in ("SHADOW", "REFLECTION", "SKYBOX", "HAZE", "FOG"):
                self._scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = False
        self._pixels = np.empty((camera.height, camera.width, 3), np.uint8)
        self._rectangle = mujoco.MjrRect(0, 0, camera.width, camera.height)
        self._context = gl.new_context(camera.width, camera.height)
        try:
            self._context.make_current()
            self._drawer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawer)
        except Exception:
            self._context.free()
            raise

    def paint(self, canvas: np.ndarray, row: int, colors: np.ndarray) -> None:
        """Fills `canvas`, uint8 (height, width, 3), with row `row`; colors (N, 3) in 0..255."""
        model, data, present = self._model, self._data, self._playback.agent_present[row]
        view, standing = self._views.at(row), self._playback.obstacle_present[row]
        self._camera.lookat[:2], self._camera.distance = view.center, view.distance
        data.mocap_pos[self._solids[standing], :2] = self._playback.obstacle[row, standing]
        model.geom_rgba[self._solid_discs, 3] = standing
        data.qpos[self._qpos[present]] = self._playback.position[row, present]
        model.geom_rgba[self._discs, :3] = colors / 255
        model.geom_rgba[self._discs, 3] = present  # MuJoCo leaves out what is wholly transparent
        mujoco.mj_kinematics(model, data)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, everything, self._scene)
        self._context.make_current()  # another painter may have drawn in between
        mujoco.mjr_render(self._rectangle, self._scene, self._drawer)
        mujoco.mjr_readPixels(self._pixels, None, self._rectangle, self._drawer)
        canvas[:] = self._pixels[::-1]

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._context.make_current()
        self._drawer.free()
        self._context.free()


def _set_quality(model: mujoco.MjModel, quality: str) -> None:
    wanted = model.vis.quality
    if quality == "default":  # MuJoCo's own, undoing what `build` writes
        wanted.shadowsize, wanted.offsamples = 4096, 4
        model.light_castshadow[:] = True
        return
    # Flat discs end where the overlay draws their outline; a rim below would be jagged without multisampling.
    flat = [i for i in range(model.ngeom) if model.geom(i).name.endswith("_disc") and model.geom_bodyid[i] > 0]
    model.geom_size[flat, 1], model.geom_pos[flat, 2] = 0.01, DISC_TOP - 0.01
    model.geom_sameframe[flat] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE  # or kinematics passes over geom_pos
    wanted.shadowsize, wanted.offsamples = 0, 0
    # Cylinders are drawn from slices x stacks; the sides of discs need no stacks.
    wanted.numslices, wanted.numstacks = (32, 2) if model.ngeom < 60 else (16, 2)
    # A floor that fills the view stands in for the sky, which costs as much as all bodies together.
    floor = model.geom("floor_disc").id
    model.geom_size[floor, :2] *= 30
