"""The laws that agents follow when nothing is learned: one file each, chosen by their configuration."""

from swarm_mjcf.lazy import lazy

_PUBLIC = {
    "BoidsConfig": "config",
    "ChaserConfig": "config",
    "EXPERTS": "config",
    "ExpertConfig": "config",
    "HelbingConfig": "config",
    "Interaction": "config",
    "VicsekConfig": "config",
    "make_expert": "registry",
}
__getattr__, __dir__, __all__ = lazy(__name__, _PUBLIC)
