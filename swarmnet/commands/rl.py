"""`swarmnet rl`."""

from dataclasses import replace

import jax

from envs.swarm_env import SwarmEnv
from gnn.checkpoint import load_model
from rl.config import MODES, PPOConfig
from rl.devices import device_mesh, initialise, leads
from rl.task import SwarmTask
from rl.train import train
from swarm_mjcf.errors import SpecError
from swarmnet.commands import evaluate
from swarmnet.config import RL, Evaluate, part_of
from swarmnet.judge import training_world
from swarmnet.progress import progress

ENDLESS = 10**9
"""Iterations where the minutes decide."""


def run(config: RL) -> int:
    """Improves, or goes on, and judges both policies on the same unseen scenes."""
    initialise(config.coordinator, config.processes, config.process)
    if config.run.resolve() == config.init.resolve():
        raise SpecError("run", str(config.run), "another folder than the one of the model it starts from")
    model = load_model(config.init / "checkpoints")
    world = training_world(model).world()
    env = SwarmEnv(
        world.scene,
        engine=config.engine,
        spawn=world.spawn,
        horizon=config.horizon,
        terminate_on_contact=config.terminate_on_contact,
    )
    how = replace(part_of(PPOConfig, config), freeze=(*MODES[config.mode], *config.freeze))
    if config.minutes is not None:
        how = replace(how, iterations=ENDLESS)
    with progress(f"rl mode {config.mode}") as update:

        def report(done: int, total: int, row: dict) -> None:
            share = total if config.minutes is None else round(done * 60 * config.minutes / max(row["spent"], 1e-9))
            update(done, max(done, share), note(row))

        improved = train(
            how,
            SwarmTask(env, config.reward),
            model,
            config.run,
            scratch=config.scratch,
            minutes=config.minutes,
            mesh=device_mesh(config.devices),
            progress=report,
        )
    if not leads():
        return 0
    steps = improved.about["step"] * config.scenes * config.steps
    print(f"{config.run}: {model.about['preset']} after {improved.about['step']} iterations, {steps} env-steps")
    if not config.test_scenes or jax.process_count() > 1:  # loading a model needs all processes
        print(f"next: swarmnet evaluate {config.run} --reference {config.init}")
        return 0
    both = {"run": config.run, "reference": str(config.init), "engine": config.engine}
    return evaluate.run(Evaluate(**both, scenes=config.test_scenes, videos=config.videos))


def note(row: dict) -> str:
    """An iteration's metrics in a few words."""
    return (
        f"reward {row['reward']:.3f}  contact events {1000 * row['contact_events']:.2f} per 1000 agent-steps  "
        f"kl {row['kl']:.3f}  {row['env_steps_per_second']:.0f} env-steps/s"
    )
