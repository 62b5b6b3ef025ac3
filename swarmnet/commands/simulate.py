"""`swarmnet simulate`."""

from envs.config import SimulateConfig
from envs.shards import Shard
from envs.simulate import simulate
from swarm_mjcf.build import to_xml
from swarmnet.config import Simulate, part_of
from swarmnet.progress import progress
from swarmnet.results import write_whole


def run(config: Simulate) -> int:
    """Writes the file, or keeps it if it already holds exactly this; with `export_xml`, the MJCF and nothing else."""
    if config.export_xml is not None:
        scene = config.world().scene
        write_whole(config.export_xml, to_xml(scene))
        print(f"{config.export_xml}: MJCF of {scene.num_agents} agents and {scene.num_obstacles} obstacles")
        return 0
    shard = Shard.parse(config.shard)
    out = shard.path(config.out)
    existed = out.exists()
    with progress(f"simulate {config.preset}") as update:
        header = simulate(part_of(SimulateConfig, config), out, shard=shard, progress=update)
    size = out.stat().st_size / 1e6
    print(
        f"{out}: {header.scenes} scenes of {header.rows} rows, {header.nodes} nodes, dt {header.dt} s, "
        f"{size:.1f} MB" + (" (was there already)" if existed else "")
    )
    return 0
