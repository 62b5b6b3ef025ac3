"""Trajectories in HDF5: compressed, checksummed slab by slab, written whole or not at all, read whole or streamed."""

import contextlib
import hashlib
import io
import json
import os
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from envs.trajectories import ARRAYS, Trajectories, TrajectoryError, concatenate

FORMAT = "swarmnet-trajectories"
VERSION = 2
SLAB = 256
"""Scenes per HDF5 chunk and per checksum: what a streaming reader holds at least."""
_SIGNATURE, _MARK = b"\x89HDF\r\n\x1a\n", b"SWARMCRC"
"""How HDF5 files begin, and what precedes the checksum (CRC-32) of all bytes before it, at the end of ours."""
_LATER = {"saturated": 2}
"""Arrays and the version of the format that brought them; files of an earlier one are read with their default."""
_SCALARS = ("dt", "substeps", "max_speed", "max_acceleration")


@dataclass(frozen=True)
class Header:
    """What a file holds, without reading its arrays."""

    path: Path
    scenes: int
    rows: int
    nodes: int
    dt: float
    substeps: int
    max_speed: float
    max_acceleration: float
    provenance: dict


def ending(file: io.RawIOBase | io.BufferedIOBase) -> bytes:
    """What ends a file: the checksum of its bytes. HDF5 ignores what follows its data. Leaves the file at its end."""
    mark = _MARK + _crc(file, file.seek(0, os.SEEK_END)).to_bytes(4, "little")
    file.seek(0, os.SEEK_END)
    return mark


def _crc(file: io.RawIOBase | io.BufferedIOBase, size: int) -> int:
    file.seek(0)
    crc = 0
    while size and (block := file.read(min(size, 1 << 22))):
        crc, size = zlib.crc32(block, crc), size - len(block)
    return crc


def _check_bytes(path: str | Path) -> None:
    """Raises TrajectoryError for a damaged file before HDF5 reads it: a flipped byte can make HDF5 loop for ever."""
    with open(path, "rb") as file:
        if file.read(len(_SIGNATURE)) != _SIGNATURE:
            raise TrajectoryError(f"{path}: not a whole HDF5 file of trajectories (it begins otherwise)")
        size = file.seek(0, os.SEEK_END) - len(_MARK) - 4
        file.seek(max(size, 0))
        last = file.read()
        if not last.startswith(_MARK):
            raise TrajectoryError(
                f"{path}: an HDF5 file, but not of trajectories or not whole (no checksum at its end)"
            )
        if last[len(_MARK) :] != _crc(file, size).to_bytes(4, "little"):
            raise TrajectoryError(f"{path}: corrupt, its bytes do not match their checksum")


class _Disk:
    """The file that HDF5 writes to.

    HDF5 cannot close a file after a write that failed: it crashes the process. So a full disk is noted here, HDF5 is
    told that all is well, and the writer raises the error.
    """

    def __init__(self, path: Path) -> None:
        self._file = open(path, "w+b", buffering=0)  # noqa: SIM115
        self.error: OSError | None = None
        self.read, self.readinto, self.seek = self._file.read, self._file.readinto, self._file.seek
        self.tell, self.close = self._file.tell, self._file.close

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        whole = len(rest)
        with self._noting():
            while len(rest):
                rest = rest[self._file.write(rest) :]
        return whole

    def truncate(self, size: int) -> None:
        with self._noting():
            self._file.truncate(size)

    def flush(self) -> None:
        """Nothing is buffered here."""

    def finish(self) -> None:
        """Adds the checksum of all bytes, which HDF5 has written by now, and flushes to disk."""
        with self._noting():
            self.write(ending(self._file))
            os.fsync(self._file.fileno())

    def check(self) -> None:
        """Raises what went wrong so far."""
        if self.error is not None:
            raise self.error

    @contextlib.contextmanager
    def _noting(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error


class TrajectoryWriter:
    """Writes trajectories part by part; the file appears under its name only when `close` has finished it.

    Use as a context manager: an exception inside leaves no file and whatever was there before untouched.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._partial = self.path.with_name(f".{self.path.name}.{os.getpid()}.partial")
        with _explained(self.path, "write"):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            _remove_abandoned(self.path)
            self._disk = _Disk(self._partial)
            self._file = h5py.File(self._disk, "w", track_order=True)
        self._pending: Trajectories | None = None
        self._digests: list[str] = []

    def __enter__(self) -> "TrajectoryWriter":
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if kind is None:
            self.close()
        else:
            self._discard()

    def append(self, part: Trajectories) -> None:
        """Adds scenes. All parts have the same rows, nodes, dt and limits, and their first's provenance."""
        with self._failing_cleanly():
            if self._pending is not None:
                self._check_like(part, self._pending)
            pending = part if self._pending is None else concatenate([self._pending, part])
            whole = len(pending) // SLAB * SLAB
            for start in range(0, whole, SLAB):
                self._write(pending.take(slice(start, start + SLAB)))
            self._pending = pending.take(slice(whole, None))

    def close(self) -> None:
        """Writes what is left and the checksums, flushes to disk, and gives the file its name."""
        with self._failing_cleanly():
            if self._pending is None:
                raise TrajectoryError(f"{self.path}: no scenes to write")
            if len(self._pending):
                self._write(self._pending)
            attrs = self._file.attrs
            attrs["format"], attrs["version"], attrs["slab"] = FORMAT, VERSION, SLAB
            for name in _SCALARS:
                attrs[name] = getattr(self._pending, name)
            attrs["provenance"] = json.dumps(self._pending.provenance)
            attrs["digests"] = json.dumps(self._digests)
            attrs["seal"] = _seal(self._file)
            self._file.close()
            self._disk.finish()
            self._disk.check()
            self._disk.close()
            os.replace(self._partial, self.path)

    def _write(self, slab: Trajectories) -> None:
        for name in ARRAYS:
            array = getattr(slab, name)
            if name not in self._file:
                self._file.create_dataset(
                    name,
                    shape=(0, *array.shape[1:]),
                    maxshape=(None, *array.shape[1:]),
                    chunks=(SLAB, *array.shape[1:]),
                    dtype=array.dtype,
                    compression="gzip",
                    compression_opts=1,
                    shuffle=True,
                    fletcher32=True,
                )
            data = _array(self._file, name)
            data.resize(data.shape[0] + len(array), axis=0)
            data[-len(array) :] = array
            self._disk.check()
        self._digests.append(_digest(slab, ARRAYS))

    def _check_like(self, part: Trajectories, earlier: Trajectories) -> None:
        for name in (*ARRAYS, *_SCALARS):
            new, old = getattr(part, name), getattr(earlier, name)
            if name in ARRAYS:
                new, old = f"{new.dtype}{new.shape[1:]}", f"{old.dtype}{old.shape[1:]}"
            if new != old:
                raise TrajectoryError(f"{self.path}: {name} is {new}, earlier scenes have {old}")

    @contextlib.contextmanager
    def _failing_cleanly(self) -> Iterator[None]:
        try:
            with _explained(self.path, "write"):
                yield
        except BaseException:
            self._discard()
            raise

    def _discard(self) -> None:
        with contextlib.suppress(Exception):
            self._file.close()
        with contextlib.suppress(Exception):
            self._disk.close()
        self._partial.unlink(missing_ok=True)


def save(path: str | Path, trajectories: Trajectories) -> None:
    """Writes a file whole or not at all."""
    with TrajectoryWriter(path) as writer:
        writer.append(trajectories)


def read_header(path: str | Path) -> Header:
    """What a file holds. Raises TrajectoryError for a missing, foreign, truncated or altered file."""
    with _opened(path) as file:
        return _header(path, file)


def _header(path: str | Path, file: h5py.File) -> Header:
    scenes, rows, nodes = _array(file, "mask").shape
    provenance = json.loads(str(file.attrs["provenance"]))
    return Header(path=Path(path), scenes=scenes, rows=rows, nodes=nodes, provenance=provenance, **_scalars(file.attrs))


def stream(path: str | Path) -> Iterator[Trajectories]:
    """Slabs of at most `SLAB` scenes, each checked against its checksum."""
    with _opened(path) as file:
        header, names = _header(path, file), _names(file)
        digests = json.loads(str(file.attrs["digests"]))
        for number, start in enumerate(range(0, header.scenes, SLAB)):
            slab = Trajectories(
                **{name: _array(file, name)[start : start + SLAB] for name in names},
                **{name: getattr(header, name) for name in _SCALARS},
                provenance=header.provenance,
            )
            if _digest(slab, names) != digests[number]:
                raise TrajectoryError(f"{path}: scenes {start} to {start + len(slab) - 1} do not match their checksum")
            yield slab


def load(path: str | Path, *, scenes: int | None = None) -> Trajectories:
    """A file's trajectories (the first `scenes` of them), checked. Raises TrajectoryError."""
    parts, have = [], 0
    for slab in stream(path):
        parts.append(slab)
        have += len(slab)
        if scenes is not None and have >= scenes:
            break
    if scenes is not None and have < scenes:
        raise TrajectoryError(f"{path}: {scenes} scenes were asked for, it holds {have}")
    whole = concatenate(parts)
    return whole if scenes is None else whole.take(slice(0, scenes))


def join(parts: Sequence[Path], path: Path, provenance: dict) -> None:
    """Writes the scenes of all parts, in this order, to one file; only a slab at a time is in memory."""
    with TrajectoryWriter(path) as writer:
        for part in parts:
            for slab in stream(part):
                writer.append(replace(slab, provenance=provenance))


def _remove_abandoned(path: Path) -> None:
    """Removes what writers of this file left that were killed while they wrote."""
    for partial in path.parent.glob(f".{path.name}.*.partial"):
        writer = partial.name.split(".")[-2]
        try:
            os.kill(int(writer), 0)  # signal 0 only asks whether the process lives
        except ProcessLookupError:
            partial.unlink(missing_ok=True)
        except (PermissionError, ValueError):
            pass


def _array(file: h5py.File, name: str) -> h5py.Dataset:
    data = file[name]
    if not isinstance(data, h5py.Dataset):
        raise TypeError(f"{name} is no array")
    return data


def _scalars(attrs: Any) -> dict[str, Any]:
    return {name: attrs[name].item() for name in _SCALARS}


def _names(file: h5py.File) -> tuple[str, ...]:
    """The arrays that a file of its version has."""
    return tuple(name for name in ARRAYS if _LATER.get(name, 1) <= _version(file))


def _version(file: h5py.File) -> int:
    return int(str(file.attrs["version"]))


def _digest(slab: Trajectories, names: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for name in names:
        digest.update(np.ascontiguousarray(getattr(slab, name)).view(np.uint8).data)
    return digest.hexdigest()


def _seal(file: h5py.File) -> str:
    """Checksum of everything that is not in a slab's checksum."""
    attrs = {name: str(file.attrs[name]) for name in ("version", "slab", *_SCALARS, "provenance", "digests")}
    arrays = {name: _array(file, name) for name in _names(file)}
    shapes = {name: [list(array.shape), str(array.dtype)] for name, array in arrays.items()}
    return hashlib.sha256(json.dumps([attrs, shapes], sort_keys=True).encode()).hexdigest()


@contextlib.contextmanager
def _opened(path: str | Path) -> Iterator[h5py.File]:
    with _explained(path, "read"):
        _check_bytes(path)
    with _explained(path, "read"), h5py.File(path, "r") as file:
        if file.attrs.get("format") != FORMAT:
            raise TrajectoryError(f"{path}: an HDF5 file, but not of trajectories (no '{FORMAT}' header)")
        if not 1 <= _version(file) <= VERSION:
            raise TrajectoryError(f"{path}: version {_version(file)} of the format, this program reads 1 to {VERSION}")
        if file.attrs.get("seal") != _seal(file):
            raise TrajectoryError(f"{path}: corrupt, its header does not match its checksum")
        yield file


@contextlib.contextmanager
def _explained(path: str | Path, verb: str) -> Iterator[None]:
    """Turns what HDF5, the file system and a corrupt header can throw into one TrajectoryError."""
    try:
        yield
    except TrajectoryError as error:
        if str(path) not in str(error):
            raise TrajectoryError(f"{path}: {error}") from error
        raise
    except FileNotFoundError as error:
        raise TrajectoryError(f"{path}: does not exist") from error
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        if verb == "read":
            raise TrajectoryError(f"{path}: not a whole HDF5 file of trajectories ({reason})") from error
        raise TrajectoryError(f"{path}: cannot be written ({reason})") from error
