"""Files that are there whole or not at all."""

import os
from contextlib import suppress
from pathlib import Path


class WholeFile:
    """`with WholeFile(path) as part`: a path beside `path` to write to, which takes its place when the block ends well
    and is gone when it does not. The name ends as the file's does. Raises OSError where nothing can be written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._part = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")

    def __enter__(self) -> Path:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._part.touch()
        return self._part

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                os.replace(self._part, self.path)
        finally:
            with suppress(OSError):
                self._part.unlink(missing_ok=True)
