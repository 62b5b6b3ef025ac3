"""Prints how fast videos are drawn, against MuJoCo's default quality: `python benchmarks/rendering.py`."""

from swarm_mjcf.render import check_gl
from swarm_mjcf.render_bench import run

if __name__ == "__main__":
    print(f"# {check_gl()}")
    for name, value in run():
        print(name, f"{value:.1f}")
