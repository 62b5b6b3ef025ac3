"""`swarmnet render`."""

from swarmnet.config import SHEETS, Render
from swarmnet.progress import progress


def run(config: Render) -> int:
    """Writes one video, or one sheet where the name asks for one."""
    if config.out.suffix.lower() in SHEETS:
        from swarmnet.selection import select
        from swarmnet.sheets import sheet, write_sheet

        chosen = select(config.data, scenes=config.scene, grid=config.grid, titles=config.titles)
        figure = sheet(
            chosen.panels, columns=chosen.columns, width=config.width, color=config.color, contacts=config.contacts
        )
        print(write_sheet(config.out, figure))
        return 0
    from swarmnet.film import Look
    from swarmnet.videos import make_video

    look = Look(
        camera=config.camera,
        size=config.size,
        renderer=config.renderer,
        speed=config.speed,
        contacts=config.contacts,
    )
    with progress("render") as update:
        path = make_video(
            config.data,
            config.out,
            scenes=config.scene,
            grid=config.grid,
            titles=config.titles,
            look=look,
            progress=update,
        )
    print(path)
    return 0
