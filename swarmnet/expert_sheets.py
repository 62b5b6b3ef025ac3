"""`python -m swarmnet.expert_sheets FOLDER`: trajectories of each expert on a sheet, simulated from fixed seeds."""

import sys
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from envs.config import SimulateConfig
from envs.experts.config import expert_name
from envs.simulate import simulate_in_memory
from swarmnet.film import Panel
from swarmnet.sheets import sheet, write_sheet


@dataclass(frozen=True)
class Sheet:
    """What is drawn of an expert: scenes of these simulations, one panel each."""

    simulations: tuple[SimulateConfig, ...]
    titles: tuple[str, ...]
    color: str = "agent"


def _of(preset: str, seed: int, steps: int, **where) -> SimulateConfig:
    return SimulateConfig(preset=preset, scenes=1, seed=seed, steps=steps, engine="native", threads=1, **where)


SHEETS = (
    Sheet(
        (_of("published", 2, 50), _of("published", 2, 50, num_agents=10, num_obstacles=3), _of("clear", 2, 50)),
        ("boids, preset published", "10 agents, 3 obstacles", "preset clear, in physics"),
    ),
    Sheet(
        (_of("helbing", 1, 50), _of("helbing", 1, 50, num_agents=10, num_obstacles=2), _of("helbing", 4, 50)),
        ("helbing, 5 agents", "10 agents, 2 obstacles", "5 agents"),
    ),
    Sheet(
        tuple(_of("chaser", 3, 20, num_agents=n) for n in (3, 5, 10)),
        ("chaser, 3 agents, 1 target each", "5 agents", "10 agents"),
    ),
    Sheet(
        tuple(_of("vicsek", 0, steps, num_agents=60) for steps in (6, 30)),
        ("vicsek, 60 agents, first 1.8 s", "first 9 s"),
        color="time",
    ),
)


def write_sheets(folder: str | Path) -> list[Path]:
    """Writes FOLDER/expert-NAME.png for every expert and returns the paths."""
    written = []
    for item in SHEETS:
        panels = [
            Panel(recording=simulate_in_memory(config), title=title)
            for config, title in zip(item.simulations, item.titles, strict=True)
        ]
        path = Path(folder) / f"expert-{expert_name(item.simulations[0].world().expert)}.png"
        figure = sheet(panels, columns=len(panels), width="page", color=item.color, contacts=False)
        written.append(_smaller(write_sheet(path, figure)))
    return written


def _smaller(path: Path) -> Path:
    """The same picture with a palette: a third of the bytes, for a page on the web."""
    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(255)
    few.save(path, optimize=True)
    return path


if __name__ == "__main__":
    for path in write_sheets(sys.argv[1]):
        print(path)
