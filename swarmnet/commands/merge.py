"""`swarmnet merge`."""

from envs.merge import merge
from swarmnet.config import Merge


def run(config: Merge) -> int:
    """Writes the file, or keeps it if it already holds exactly this."""
    header = merge(config.parts, config.out)
    print(f"{config.out}: {header.scenes} scenes from {len(config.parts)} shards")
    return 0
