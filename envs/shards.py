"""Which scenes are computed together and by whom: blocks of one fixed shape, and shards of whole blocks.

XLA rounds the last bit of a number differently in programs of different shapes, so scenes are always computed in blocks
whose size depends on the world and the device alone: block b holds the scenes [b B, (b + 1) B) of a seed, the last one
is filled up. A scene thus lies in the same row of the same compiled program, and its bytes depend neither on how many
scenes are asked for, nor on chunks, threads and shards. (Another kind of CPU may have other vector instructions.)
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

from swarm_mjcf.errors import SpecError


def block_size(num_agents: int, *, accelerator: bool = False) -> int:
    """Scenes per block: enough to keep two CPU cores, or an accelerator, busy; fewer of many agents.

    Measured on 2 cores with the native engine: 256 scenes of 5 agents are as fast as 1024, 64 are half as fast.
    """
    if accelerator:
        return min(max(2**16 // num_agents, 64), 8192)
    return min(max(20480 // num_agents, 16), 256)


@dataclass(frozen=True)
class Shard:
    """Part `number` of `of`, from 1."""

    number: int = 1
    of: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.of:
            raise SpecError("shard", f"{self.number}/{self.of}", "i/n with 1 <= i <= n, such as 2/4")

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """From `i/n`. Raises SpecError."""
        found = re.fullmatch(r"(\d+)/(\d+)", text)
        if not found:
            raise SpecError("shard", text, "i/n with 1 <= i <= n, such as 2/4")
        return cls(int(found[1]), int(found[2]))

    def scenes(self, total: int, block: int) -> range:
        """Its scenes by global index, in whole blocks. Raises SpecError where there are more shards than blocks."""
        blocks = math.ceil(total / block)
        if self.of > blocks:
            allowed = f"n of at most {blocks}: {total} scenes are computed in {blocks} x {block}"
            raise SpecError("shard", f"{self.number}/{self.of}", allowed)
        first, last = ((self.number - 1) * blocks // self.of, self.number * blocks // self.of)
        return range(first * block, min(last * block, total))

    def path(self, out: Path) -> Path:
        """Where it is written: `runs/swarm.h5` becomes `runs/swarm.shard-2-of-4.h5`; the whole keeps its name."""
        return out if self.of == 1 else out.with_name(f"{out.stem}.shard-{self.number}-of-{self.of}{out.suffix}")


WHOLE = Shard()
"""All scenes."""
