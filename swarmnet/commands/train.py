"""`swarmnet train`."""

from envs.storage import load
from gnn.config import TrainConfig
from gnn.train import train
from swarm_mjcf.errors import SpecError
from swarmnet.config import Train, part_of
from swarmnet.progress import progress


def run(config: Train) -> int:
    """Trains, or goes on."""
    if not 0 < config.validation < 1:
        raise SpecError("validation", config.validation, "a share between 0 and 1")
    data = load(config.data)
    kept = max(1, round(config.validation * len(data)))
    if kept >= len(data):
        raise SpecError("validation", config.validation, f"a share that leaves some of {len(data)} scenes to train on")
    with progress(f"train {config.model}") as update:
        model = train(
            part_of(TrainConfig, config).scaled(config.scale),
            data.take(slice(kept, None)),
            config.run,
            validation=data.take(slice(0, kept)),
            progress=lambda done, total, row: update(done, total, note(row)),
        )
    print(f"{config.run}: {model.about['preset']} trained for {model.about['step']} steps on {len(data) - kept} scenes")
    print(f"next: swarmnet evaluate {config.run}")
    return 0


def note(row: dict) -> str:
    """A chunk's metrics in a few words."""
    return f"horizon {row['horizon']:2d}  loss {row['loss']:.4f}  validation {row['validation_error']:.4f}"
