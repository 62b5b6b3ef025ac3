"""`swarmnet import`."""

import shlex
import sys

from envs.importers.card import echo
from envs.importers.config import ImportConfig
from envs.importers.importing import card_path, holdout_path, import_files
from swarmnet.config import Import, part_of
from swarmnet.progress import progress


def run(config: Import) -> int:
    """Writes the file, its card, and the hold-out; says what a wrong unit or frame rate would show in."""
    command = shlex.join(["swarmnet", *sys.argv[1:]])
    with progress("import") as update:
        found = import_files(config.files, part_of(ImportConfig, config), config.out, command=command, update=update)
    print(echo(found.card))
    outs = [(config.out, found.header)]
    if found.holdout is not None:
        outs.append((holdout_path(config.out), found.holdout))
    for path, header in outs:
        about = header.provenance["import"]
        print(
            f"{path}: {about['part']}, {about['part_agents']} agents in {header.scenes} scenes of {header.rows} rows, "
            f"{header.nodes} nodes, dt {header.dt:g} s, {path.stat().st_size / 1e6:.1f} MB"
            + (" (was there already)" if found.existed else "")
        )
    print(f"card: {card_path(config.out)}")
    return 0
