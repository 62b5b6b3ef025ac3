"""`swarmnet render`."""

from swarmnet.config import Render
from swarmnet.videos import make_video


def run(config: Render) -> int:
    """Writes one video."""
    path = make_video(
        config.data,
        config.out,
        beside=config.beside,
        scene=config.scene,
        camera=config.camera,
        size=config.size,
        renderer=config.renderer,
        speed=config.speed,
    )
    print(path)
    return 0
