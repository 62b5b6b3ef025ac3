# %% [markdown]
# # Collective motion: simulate, measure, compare
#
# Two laws of collective motion in the same laboratory: Vicsek et al. (1995), where headings align with the neighbours',
# and Reynolds' Boids in a world of real bodies. Order is measured over time: polarisation (1: all move one way),
# milling (1: all turn about their middle) and spread. `docs/definitions.md` has the formulas.

# %%
import sys

import matplotlib.pyplot as plt
import numpy as np

from envs.collective import collective_measures, collective_report
from envs.collisions import collision_report
from envs.config import SimulateConfig
from envs.simulate import simulate_in_memory

SCENES = int(sys.argv[1]) if __name__ == "__main__" and len(sys.argv) == 2 else 40
STEPS = 60

# %%
runs = {
    "vicsek": simulate_in_memory(SimulateConfig(preset="vicsek", scenes=SCENES, steps=STEPS, num_agents=30)),
    "boids": simulate_in_memory(SimulateConfig(preset="clear", scenes=SCENES, steps=STEPS, num_agents=8)),
}
for name, run in runs.items():
    print(name, run.position.shape, "(scenes, times, nodes, 2), nodes: goals, obstacles, agents =", run.counts)

# %%
measures = {name: collective_measures(run) for name, run in runs.items()}
for name, values in measures.items():
    report = collective_report(values)
    print(name, {key: str(report[f"{key}_final"]) for key in ("polarisation", "milling", "spread")})

# %% [markdown]
# Each curve is the mean over scenes, the band one standard deviation.

# %%
figure, panels = plt.subplots(1, 3, figsize=(9, 2.6), layout="constrained")
for axes, key in zip(panels, ("polarisation", "milling", "spread"), strict=True):
    for name, values in measures.items():
        time = np.arange(values[key].shape[1]) * runs[name].dt
        mean, deviation = np.nanmean(values[key], axis=0), np.nanstd(values[key], axis=0)
        axes.plot(time, mean, label=name)
        axes.fill_between(time, mean - deviation, mean + deviation, alpha=0.2)
    axes.set(xlabel="time [s]", ylabel=key + (" [m]" if key == "spread" else ""))
panels[0].legend()
figure.savefig("collective_user.png", dpi=80)

# %% [markdown]
# Boids here have bodies: contacts are counted by physics, with intervals over scenes.

# %%
for key in ("ever_touching_trajectories_any", "contact_steps_any", "minimum_clearance", "final_goal_distance"):
    print(key, collision_report(runs["boids"])[key])

# %% [markdown]
# To learn such a law from trajectories (these, or your own recordings) and to judge what was learned:
#
#     swarmnet simulate --preset clear --scenes 2000 --out runs/clear.h5
#     swarmnet train runs/clear.h5 --run runs/clear
#     swarmnet evaluate runs/clear
