"""A mixed-integer linear program as plain sparse data, assembled once and emitted to any solver (`repair.solve`)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from repair.errors import Unbounded

SLACK = "slack"
"""The block of variables by which elastic rows may be violated; an ordinary solution has them at 0."""


@dataclass(frozen=True)
class Linear:
    """n expressions `matrix @ x + constant` in the columns x of a program."""

    matrix: sparse.csr_array
    """(n, columns so far); columns that come later count as zeros."""
    constant: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.constant)

    def map(self, weights: sparse.sparray, constant: Float[np.ndarray, " m"] | float = 0.0) -> "Linear":
        """`weights @ self + constant`, with weights (m, n)."""
        return Linear(sparse.csr_array(weights @ self.matrix), weights @ self.constant + constant)

    def take(self, which: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "Linear":
        """Some of the expressions, by index or mask."""
        return Linear(sparse.csr_array(self.matrix[which]), self.constant[which])

    def times(self, factor: Float[np.ndarray, " n"] | float) -> "Linear":
        """Each expression times a number."""
        by = np.broadcast_to(factor, len(self))
        with np.errstate(invalid="ignore"):  # what is not finite is refused where rows are added
            return Linear(sparse.csr_array(sparse.diags_array(by) @ self.matrix), by * self.constant)

    def __add__(self, other: "Linear") -> "Linear":
        width = max(_shape(self.matrix)[1], _shape(other.matrix)[1])
        return Linear(_wide(self.matrix, width) + _wide(other.matrix, width), self.constant + other.constant)

    def __sub__(self, other: "Linear") -> "Linear":
        return self + other.times(-1.0)

    def at(self, x: Float[np.ndarray, " columns"]) -> Float[np.ndarray, " n"]:
        """The values of the expressions."""
        return self.matrix @ x[: _shape(self.matrix)[1]] + self.constant


def constant(values: Float[np.ndarray, " n"]) -> Linear:
    """Expressions without variables."""
    return Linear(sparse.csr_array((len(values), 0)), values)


def columns(index: Int[np.ndarray, "*shape"]) -> Linear:
    """The variables themselves, in C order."""
    flat = index.ravel()
    entries = (np.ones(len(flat)), flat, np.arange(len(flat) + 1))
    return Linear(sparse.csr_array(entries, shape=(len(flat), flat.max(initial=-1) + 1)), np.zeros(len(flat)))


def _wide(matrix: sparse.csr_array, width: int) -> sparse.csr_array:
    return sparse.csr_array((matrix.data, matrix.indices, matrix.indptr), shape=(_shape(matrix)[0], width))


def _shape(matrix: sparse.csr_array) -> tuple[int, int]:
    rows, columns = matrix.shape  # pyright: ignore[reportGeneralTypeIssues]
    return rows, columns


def kron(first: sparse.sparray | np.ndarray, second: sparse.sparray | np.ndarray) -> sparse.csr_array:
    """Kronecker product: `kron(eye(n), W)` applies W to each of n items, in C order."""
    return sparse.csr_array(sparse.kron(first, second, format="csr"))


def each(items: int, matrix: sparse.sparray | np.ndarray) -> sparse.csr_array:
    """A matrix applied to each of several items."""
    return kron(eye(items), matrix)


def eye(rows: int, columns: int | None = None, shift: int = 0) -> sparse.csr_array:
    """Ones on a diagonal, `shift` above the main one."""
    return sparse.csr_array(sparse.eye_array(rows, columns, k=shift))


@dataclass(frozen=True, kw_only=True)
class Program:
    """Minimise `cost @ x` over low <= matrix @ x <= high, lower <= x <= upper, x whole where `integer`."""

    cost: Float[np.ndarray, " n"]
    matrix: sparse.csr_array
    """(m, n)"""
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    lower: Float[np.ndarray, " n"]
    upper: Float[np.ndarray, " n"]
    integer: Bool[np.ndarray, " n"]
    blocks: dict[str, Int[np.ndarray, "..."]]
    """Columns by name, in the shape they were asked for."""

    @property
    def size(self) -> dict[str, int]:
        """Rows, columns, binaries that bounds leave open, and coefficients, as evidence."""
        rows, columns = _shape(self.matrix)
        binaries = int((self.integer & (self.lower < self.upper)).sum())
        return {"rows": rows, "columns": columns, "binaries": binaries, "coefficients": self.matrix.nnz}

    def objective(self, x: Float[np.ndarray, " n"]) -> float:
        """Cost of a point."""
        return float(self.cost @ x)

    def excess(self, x: Float[np.ndarray, " n"]) -> float:
        """The largest violation by a point of a row, a bound or integrality, each relative to its own magnitude:
        of a row 1 + |coefficients| @ |x|, of a bound 1 + |bound|. NaN counts as infinite."""
        rows = self.matrix @ x
        size = 1 + abs(self.matrix) @ np.abs(x)
        parts = [
            (self.low - rows) / size,
            (rows - self.high) / size,
            (self.lower - x) / (1 + np.abs(np.where(np.isfinite(self.lower), self.lower, 0))),
            (x - self.upper) / (1 + np.abs(np.where(np.isfinite(self.upper), self.upper, 0))),
            np.abs(x - np.round(x))[self.integer],
        ]
        worst = max(float(np.max(part, initial=0.0)) for part in parts)
        return worst if np.isfinite(x).all() else float("inf")


class Builder:
    """Collects named blocks of variables and blocks of rows, whole arrays at a time."""

    def __init__(self) -> None:
        self.width = 0
        self._cost: list[np.ndarray] = []
        self._lower: list[np.ndarray] = []
        self._upper: list[np.ndarray] = []
        self._integer: list[np.ndarray] = []
        self._rows: list[sparse.csr_array] = []
        self._low: list[np.ndarray] = []
        self._high: list[np.ndarray] = []
        self._blocks: dict[str, np.ndarray] = {}

    def variables(
        self,
        name: str,
        shape: tuple[int, ...],
        *,
        lower: Float[np.ndarray, "..."] | float = 0.0,
        upper: Float[np.ndarray, "..."] | float = np.inf,
        cost: float = 0.0,
        integer: bool = False,
    ) -> Int[np.ndarray, "..."]:
        """New variables of any shape; returns their columns. With `integer` they are whole, at most 1."""
        if name in self._blocks:
            raise ValueError(f"block {name} exists")
        count = int(np.prod(shape))
        index = self.width + np.arange(count).reshape(shape)
        self.width += count
        self._blocks[name] = index
        self._lower.append(np.broadcast_to(lower, shape).astype(float).ravel())
        self._upper.append(np.broadcast_to(np.minimum(upper, 1) if integer else upper, shape).astype(float).ravel())
        self._cost.append(np.full(count, cost))
        self._integer.append(np.full(count, integer))
        return index

    def rows(
        self,
        expression: Linear,
        low: Float[np.ndarray, " n"] | float = -np.inf,
        high: Float[np.ndarray, " n"] | float = np.inf,
    ) -> None:
        """low <= expression <= high. Raises Unbounded where a coefficient or a constant (a big-M) is not finite."""
        if not (np.isfinite(expression.matrix.data).all() and np.isfinite(expression.constant).all()):
            raise Unbounded("a coefficient of the program is not finite: no bound, no big-M", rows=len(expression))
        self._rows.append(expression.matrix)
        for kept, bound in ((self._low, low), (self._high, high)):
            kept.append(np.broadcast_to(bound, len(expression)) - expression.constant)

    def program(self) -> Program:
        """What was collected so far, frozen."""

        def joined(parts: list[np.ndarray], kind: type) -> np.ndarray:
            return np.concatenate([np.zeros(0, kind), *parts])

        matrices = [sparse.csr_array((0, self.width)), *(_wide(rows, self.width) for rows in self._rows)]
        matrix = sparse.csr_array(sparse.vstack(matrices, format="csr"))
        matrix.eliminate_zeros()
        return Program(
            cost=joined(self._cost, float),
            matrix=matrix,
            low=joined(self._low, float),
            high=joined(self._high, float),
            lower=joined(self._lower, float),
            upper=joined(self._upper, float),
            integer=joined(self._integer, bool),
            blocks=dict(self._blocks),
        )
