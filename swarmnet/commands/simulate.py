"""`swarmnet simulate`."""

from envs.config import SimulateConfig
from envs.simulate import simulate
from swarmnet.config import Simulate, part_of
from swarmnet.progress import progress


def run(config: Simulate) -> int:
    """Writes the file, or keeps it if it already holds exactly this."""
    existed = config.out.exists()
    with progress(f"simulate {config.preset}") as update:
        header = simulate(part_of(SimulateConfig, config), config.out, progress=update)
    size = config.out.stat().st_size / 1e6
    print(
        f"{config.out}: {header.scenes} scenes of {header.rows} rows, {header.nodes} nodes, dt {header.dt} s, "
        f"{size:.1f} MB" + (" (was there already)" if existed else "")
    )
    return 0
