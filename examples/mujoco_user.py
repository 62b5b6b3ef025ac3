# %% [markdown]
# # The scene as plain MJCF
#
# A scene is ordinary MuJoCo: two slide joints and two acceleration motors per agent, mocap obstacles, contact sensors
# by name. The text loads in `mujoco`, in `dm_control` and in MuJoCo's viewer (`swarmnet simulate --export-xml` writes
# it from the command line).

# %%
import sys
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import mujoco
import numpy as np

from envs.adapters import SwarmPhysics, control_environment, make_core
from envs.state import make_state
from envs.swarm_env import SwarmEnv
from swarm_mjcf.build import to_xml
from swarm_mjcf.spec import SceneSpec

STEPS = int(sys.argv[1]) if __name__ == "__main__" and len(sys.argv) == 2 else 20

spec = SceneSpec(num_agents=2, num_obstacles=1, agent_radius=1.0, obstacle_radius=7.0, dt=0.3, substeps=30)
Path("scene.xml").write_text(to_xml(spec))
model = mujoco.MjModel.from_xml_path("scene.xml")
print(model.njnt, "joints,", model.nu, "motors,", model.nsensor, "sensors")
print([model.sensor(i).name for i in range(model.nsensor)])

# %% [markdown]
# Two agents head for each other. The sensor `agent0_touch` counts contacts of agent 0; after `mj_step` sensors describe
# the state before, so it is read after `mj_forward`.

# %%
position = np.array([[-3.0, 0.0], [3.0, 0.3]])
velocity = np.array([[9.0, 0.0], [-9.0, 0.0]])
obstacle = np.array([[0.0, 40.0]])

data = mujoco.MjData(model)
data.qpos[:], data.qvel[:] = position.ravel(), velocity.ravel()
data.mocap_pos[model.body("obstacle0").mocapid[0], :2] = obstacle[0]
times, paths, touched = [], [], []
for _ in range(spec.substeps):
    mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    times.append(data.time)
    paths.append(data.qpos[[0, 2]].copy())
    touched.append(data.sensor("agent0_touch").data[0] > 0)
print("plain MuJoCo: agent 0 touches at", sum(touched), "of", spec.substeps, "states")

# %% [markdown]
# The project's engine counts the same states, for thousands of scenes at once.

# %%
env = SwarmEnv(spec, engine="native")
start = make_state(
    position=position[None].astype(np.float32),
    velocity=velocity[None].astype(np.float32),
    goal=np.zeros((1, 2), np.float32),
    obstacle=obstacle[None].astype(np.float32),
)
transition = jax.jit(env.step)(start, np.zeros((1, 2, 2), np.float32))
print("native engine: agent 0 touches at", int(transition.contacts.agent_states[0, 0]), "states,")
print("in", int(transition.contacts.agent_events[0, 0]), "contact, at most", end=" ")
print(f"{float(transition.contacts.agent_depth[0, 0]):.3f} m deep")
assert int(transition.contacts.agent_states[0, 0]) == sum(touched)

# %%
figure, axes = plt.subplots(figsize=(5, 2.6), layout="constrained")
axes.plot(times, paths)
axes.fill_between(times, -5, 5, where=touched, color="red", alpha=0.15, label="in contact")
axes.set(xlabel="time [s]", ylabel="x [m]", ylim=(-4, 4))
axes.legend()
figure.savefig("mujoco_user.png", dpi=80)

# %% [markdown]
# In dm_control the same text is a `Physics` with named access; `SwarmPhysics.of(spec)` reads it with
# `from_xml_string(to_xml(spec))` and keeps the sensors of every substep. Scenes come as a `control.Environment`.

# %%
physics = SwarmPhysics.of(spec)
with physics.reset_context():
    physics.named.data.qpos["agent0_x"] = -0.9
    physics.named.data.qpos["agent1_x"] = 0.9
print("overlapping by 0.2 m, agent0_touch =", physics.named.data.sensordata["agent0_touch"])

control = control_environment(make_core(num_agents=2, num_obstacles=1, horizon=STEPS, terminate_on_contact=False))
step = control.reset()
earned = 0.0
while not step.last():
    toward = control.task.state.goal[0] - control.task.state.position[0]
    step = control.step(np.clip(toward / 50, -1, 1))
    earned += step.reward
print(f"{STEPS} control steps of {control.control_timestep():.2f} s, return {earned:.2f}, discount {step.discount}")
