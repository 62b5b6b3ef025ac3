"""Anybody's trajectories: readers of common formats, and one way from what they read to `Trajectories`.

A reader turns a file into `Tracks`, rows of one run in metres and seconds, and says what was declared and what was read
from a header. `import_files` does the rest, the same for all: gaps, resampling, backward differences, hold-out, scenes.
"""

from swarm_mjcf.lazy import lazy

_PUBLIC = {
    "ImportConfig": "config",
    "ImportFailed": "tracks",
    "Imported": "importing",
    "Tracks": "tracks",
    "import_files": "importing",
    "read": "registry",
}
__getattr__, __dir__, __all__ = lazy(__name__, _PUBLIC)
