"""SceneSpec -> MJCF -> MjSpec -> model: spheres on two slide joints, mocap obstacles, sensors that tell contacts apart.

The scene is written as MJCF text and parsed by MuJoCo: 2.5 times faster than adding the elements one by one through the
`MjSpec` bindings, and the text is what MuJoCo users read.
"""

import colorsys
import functools
import math
import types
from collections.abc import Mapping

import mujoco

from swarm_mjcf import names
from swarm_mjcf.spec import SceneSpec

# Collision bits: agents are contype 1 / conaffinity 3, obstacles and walls 2 / 0, so that no solid ever meets a solid.
# Groups: colliding spheres are hidden in MuJoCo's viewer (group 3), the discs drawn for them are shown (group 1).
_TEMPLATE = """<mujoco model="swarm">
  <compiler angle="degree" autolimits="true"/>
  <option timestep="{timestep:.17g}" gravity="0 0 0" integrator="Euler" solver="Newton" iterations="{iterations}" \
ls_iterations="{ls_iterations}">
    <flag eulerdamp="disable" contact="{contact}"/>
  </option>
  <size memory="{memory}"/>
  <statistic center="0 0 0" extent="{extent:.17g}"/>
  <visual>
    <global offwidth="1920" offheight="1440"/>
    <quality shadowsize="0" offsamples="0"/>
    <headlight ambient="0.5 0.5 0.5" diffuse="0 0 0" specular="0 0 0"/>
    <map znear="0.001"/>
  </visual>
  <default>
    <default class="body">
      <geom type="sphere" condim="1" margin="0" gap="0" solref="{solref}" group="3"/>
      <default class="agent">
        <geom size="{agent_radius:.17g}" mass="{mass:.17g}" contype="1" conaffinity="3"/>
        <joint type="slide"/>
        <general gear="{mass:.17g}"/>
      </default>
      <default class="obstacle"><geom size="{obstacle_radius:.17g}" contype="2" conaffinity="0"/></default>
      <default class="wall">
        <geom type="box" contype="2" conaffinity="0" group="1" rgba="{wall_color}"/>
      </default>
    </default>
    <default class="disc"><geom type="cylinder" contype="0" conaffinity="0" mass="0" group="1"/></default>
  </default>
  <asset><texture name="sky" type="skybox" builtin="flat" rgb1="0.93 0.94 0.96" width="8" height="8"/></asset>
  <worldbody>
    <light type="directional" pos="0 0 {extent:.17g}" dir="0 0 -1" castshadow="false" diffuse="0.5 0.5 0.5" \
specular="0 0 0"/>
    {cameras}
    <geom name="floor_disc" class="disc" type="box" size="{arena:.17g} {arena:.17g} 0.5" pos="0 0 -1" \
rgba="{floor_color}"/>
    {bodies}
  </worldbody>
  <actuator>
    {motors}
  </actuator>
  <sensor>
    {sensors}
  </sensor>
</mujoco>
"""
_FOVY = 45.0
# Red, green, blue in 0..1. The light gives faces that look up exactly these colours, in every camera.
FLOOR_COLOR = (0.985, 0.985, 0.99)
WALL_COLOR = (0.6, 0.62, 0.65)
GOAL_COLOR = (0.2, 0.75, 0.3)
OBSTACLE_COLOR = (0.55, 0.57, 0.6)


@functools.cache
def agent_color(i: int) -> tuple[float, float, float]:
    """A colour (r, g, b) in 0..1 for agent i; the golden angle keeps consecutive hues far apart, contacts own red."""
    hue = 0.07 + 0.85 * ((0.6 + 0.61803398875 * i) % 1.0)
    return colorsys.hsv_to_rgb(hue, 0.78, (0.88, 0.62, 0.76)[i // 5 % 3])


def to_xml(spec: SceneSpec) -> str:
    """The scene as MJCF text that plain `mujoco`, `dm_control` and MuJoCo's viewer load unchanged."""
    agents = range(spec.num_agents)
    obstacles = [names.obstacle(k) for k in range(spec.num_obstacles)]
    # Totals first and then pairs, so that each kind is one contiguous run of `sensordata`.
    sensors = [f'<contact name="{names.touch(i)}" geom1="{names.agent(i)}" data="found"/>' for i in agents]
    sensors += [
        f'<contact name="{names.touch_of(i, other)}" geom1="{names.agent(i)}" geom2="{other}" data="found dist" '
        'reduce="mindist"/>'
        for other in obstacles + list(names.WALLS if spec.walls else ())
        for i in agents
    ]
    motors = [
        f'<general name="{names.motor(i, axis)}" class="agent" joint="{names.joint(i, axis)}"/>'
        for i in agents
        for axis in names.AXES
    ]
    bodies = [_obstacle(spec, name, place) for name, place in zip(obstacles, spec.parking()[1], strict=True)]
    bodies += [_agent(spec, i) for i in agents]
    if spec.goal:
        disc = _disc(names.GOAL, spec.goal_radius, GOAL_COLOR)
        bodies.insert(0, f'<body name="{names.GOAL}" mocap="true">{disc}</body>')
    if spec.walls:
        bodies += _walls(spec)
    return _TEMPLATE.format(
        timestep=spec.timestep,
        iterations=spec.solver_iterations,
        ls_iterations=spec.solver_ls_iterations,
        contact="enable" if spec.contacts else "disable",
        memory=_memory(spec),
        extent=1.5 * spec.arena,
        solref=f"{spec.solref_timeconst * spec.timestep:.17g} {spec.solref_dampratio:.17g}",
        agent_radius=spec.agent_radius,
        obstacle_radius=spec.obstacle_radius,
        mass=spec.agent_mass,
        arena=spec.arena,
        floor_color=_rgba(FLOOR_COLOR),
        wall_color=_rgba(WALL_COLOR),
        cameras=_cameras(spec),
        bodies="\n    ".join(bodies),
        motors="\n    ".join(motors),
        sensors="\n    ".join(sensors),
    )


def build(spec: SceneSpec) -> mujoco.MjSpec:
    """The scene as an editable `MjSpec`; `.compile()` gives the model."""
    return mujoco.MjSpec.from_string(to_xml(spec))


def compile_scene(spec: SceneSpec) -> mujoco.MjModel:
    """The compiled model of a scene."""
    return build(spec).compile()


def compile_physics(spec: SceneSpec, numbers: Mapping[str, float] = types.MappingProxyType({})) -> mujoco.MjModel:
    """The same physics and addresses for stepping alone, a fifth faster: without what only pictures need (discs,
    cameras, light), and with the stages switched off for which a scene has no elements. `numbers` are MJCF's custom
    numbers, which engines read as their own settings."""
    scene, off = build(spec), mujoco.mjtDisableBit
    for name, number in numbers.items():
        scene.add_numeric(name=name, data=[number], size=1)
    scene.compiler.discardvisual = True
    for element in [*scene.cameras, *scene.lights]:
        scene.delete(element)
    model = scene.compile()
    for stage in (off.mjDSBL_GRAVITY, off.mjDSBL_SPRING, off.mjDSBL_DAMPER, off.mjDSBL_EQUALITY):
        model.opt.disableflags |= int(stage)
    for stage in (off.mjDSBL_FRICTIONLOSS, off.mjDSBL_LIMIT):
        model.opt.disableflags |= int(stage)
    return model


def _memory(spec: SceneSpec) -> str:
    # Room for every agent in six contacts at once and the solver's work on them; MuJoCo's own estimate is 14 MB a scene
    # of 5 and 280 MB a scene of 1000, and a persistent batch holds one arena per scene.
    return f"{max(256, 24 * spec.num_agents)}K"


def _disc(name: str, radius: float, rgb: tuple[float, float, float]) -> str:
    return f'<geom name="{names.disc(name)}" class="disc" size="{radius:.17g} 0.3" rgba="{_rgba(rgb)}"/>'


def _rgba(rgb: tuple[float, float, float]) -> str:
    return " ".join(f"{channel:.4g}" for channel in (*rgb, 1))


def _obstacle(spec: SceneSpec, name: str, place: tuple[float, float]) -> str:
    geoms = f'<geom name="{name}" class="obstacle"/>{_disc(name, spec.obstacle_radius, OBSTACLE_COLOR)}'
    return f'<body name="{name}" mocap="true" pos="{place[0]:.17g} {place[1]:.17g} 0">{geoms}</body>'


def _agent(spec: SceneSpec, i: int) -> str:
    name = names.agent(i)
    joints = "".join(
        f'<joint name="{names.joint(i, axis)}" axis="{direction}"/>'
        for axis, direction in zip(names.AXES, ("1 0 0", "0 1 0"), strict=True)
    )
    disc = _disc(name, spec.agent_radius, agent_color(i))
    return f'<body name="{name}" childclass="agent">{joints}<geom name="{name}"/>{disc}</body>'


def _walls(spec: SceneSpec) -> list[str]:
    # Boxes as thick as half the arena, not planes: a plane is infinite, so an absent body could wait nowhere outside.
    half, geoms = spec.arena / 2, []
    for side, name in enumerate(names.WALLS):
        x, y = round(math.cos(side * math.pi / 2)), round(math.sin(side * math.pi / 2))
        size = f"{half} {2 * spec.arena} 2" if x else f"{2 * spec.arena} {half} 2"
        place = f"{x * (spec.arena + half)} {y * (spec.arena + half)} 0"
        geoms.append(f'<geom name="{name}" class="wall" size="{size}" pos="{place}"/>')
    return geoms


def _cameras(spec: SceneSpec) -> str:
    height = 1.06 * spec.arena / math.tan(math.radians(_FOVY / 2))
    tilt = math.radians(50)
    far, up = 1.2 * height * math.cos(tilt), 1.2 * height * math.sin(tilt)
    return (
        f'<camera name="{names.TOP_CAMERA}" pos="0 0 {height:.6g}" xyaxes="1 0 0 0 1 0" fovy="{_FOVY}"/>\n    '
        f'<camera name="{names.TILTED_CAMERA}" pos="0 {-far:.6g} {up:.6g}" '
        f'xyaxes="1 0 0 0 {math.sin(tilt):.6g} {math.cos(tilt):.6g}" fovy="{_FOVY}"/>'
    )
