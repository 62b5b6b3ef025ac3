"""`swarmnet export`."""

from pathlib import Path

from envs.exporters import export
from envs.storage import load
from swarmnet.config import Export

_ENDINGS = {"csv": ".csv", "parquet": ".parquet", "published": "", "nri": "_nri", "gns": "_gns"}


def run(config: Export) -> int:
    """Writes the files and names them."""
    out = config.out or Path(config.data.stem + _ENDINGS[config.format])
    written = export(
        load(config.data),
        out,
        config.format,
        partial=config.partial,
        split=config.split,
        suffix=config.suffix,
        connectivity_radius=config.connectivity_radius,
    )
    for path in written:
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    return 0
