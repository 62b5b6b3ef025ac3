"""`swarmnet train`."""

from functools import partial
from pathlib import Path

from envs.storage import load
from gnn.budget import train_for
from gnn.checkpoint import load_model
from gnn.config import TrainConfig
from gnn.padding import mix
from gnn.train import split, train
from swarm_mjcf.errors import SpecError
from swarmnet.config import Train, part_of
from swarmnet.progress import progress


def run(config: Train) -> int:
    """Trains, or goes on."""
    if not 0 < config.validation < 1:  # before files are read
        raise SpecError("validation", config.validation, "a share between 0 and 1")
    parts = [split(load(path), config.validation) for path in config.data]
    learning, validation = (mix(side) for side in zip(*parts, strict=True))
    initial = None if config.init is None else load_model(Path(config.init) / "checkpoints")
    how = part_of(TrainConfig, config).scaled(config.scale)
    training = train if config.minutes is None else partial(train_for, config.minutes)
    with progress(f"train {config.model}") as update:
        model = training(
            how,
            learning,
            config.run,
            validation=validation,
            progress=lambda done, total, row: update(done, total, note(row)),
            initial=initial,
            freeze=config.freeze,
        )
    print(f"{config.run}: {model.about['preset']} trained for {model.about['step']} steps on {len(learning)} scenes")
    print(f"next: swarmnet evaluate {config.run}")
    return 0


def note(row: dict) -> str:
    """A chunk's metrics in a few words."""
    return f"horizon {row['horizon']:2d}  loss {row['loss']:.4f}  validation {row['validation_error']:.4f}"
