"""Element names -> addresses in a compiled model's state, controls, sensors and mocap bodies: one index, made once."""

from dataclasses import dataclass

import mujoco
import numpy as np

from swarm_mjcf import names
from swarm_mjcf.spec import SceneSpec

Address = np.ndarray | slice


@dataclass(frozen=True)
class SceneIndex:
    """Addresses by role. Each is a slice when contiguous (a view, no copy), else an integer array.

    qpos, dof, control: flat, agent-major (x0, y0, x1, y1, ...), length 2N.
    obstacle_mocap: K rows of `mocap_pos`; goal_mocap: its row, or None without a goal.
    touch: N sensors, contacts of an agent with anything.
    obstacle_touch: K*N pairs (found, dist) flat, obstacle-major; wall_touch: 4*N pairs (found, dist), wall-major.
    """

    qpos: Address
    dof: Address
    control: Address
    obstacle_mocap: Address
    goal_mocap: int | None
    touch: Address
    obstacle_touch: Address
    wall_touch: Address

    @classmethod
    def of(cls, model: mujoco.MjModel, spec: SceneSpec) -> "SceneIndex":
        """Looks every element of `spec` up in `model`; raises KeyError for a model that was not built from it."""
        agents, solids = range(spec.num_agents), [names.obstacle(k) for k in range(spec.num_obstacles)]
        joints = [names.joint(i, axis) for i in agents for axis in names.AXES]
        walls = names.WALLS if spec.walls else ()

        def pairs(others: list[str] | tuple[str, ...]) -> list[int]:
            starts = [int(model.sensor(names.touch_of(i, other)).adr[0]) for other in others for i in agents]
            return [adr + field for adr in starts for field in (0, 1)]

        return cls(
            qpos=_compact([int(model.joint(name).qposadr[0]) for name in joints]),
            dof=_compact([int(model.joint(name).dofadr[0]) for name in joints]),
            control=_compact([model.actuator(names.motor(i, axis)).id for i in agents for axis in names.AXES]),
            obstacle_mocap=_compact([int(model.body(name).mocapid[0]) for name in solids]),
            goal_mocap=int(model.body(names.GOAL).mocapid[0]) if spec.goal else None,
            touch=_compact([int(model.sensor(names.touch(i)).adr[0]) for i in agents]),
            obstacle_touch=_compact(pairs(solids)),
            wall_touch=_compact(pairs(walls)),
        )


def _compact(addresses: list[int]) -> Address:
    start = addresses[0] if addresses else 0
    if addresses == list(range(start, start + len(addresses))):
        return slice(start, start + len(addresses))
    return np.asarray(addresses)
