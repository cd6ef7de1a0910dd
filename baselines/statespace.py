"""Linear time-invariant state-space models in discrete time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from nnss_cli.datasets.record import FloatArray
from numpy.typing import NDArray


def propagate(A: FloatArray, w: FloatArray, x0: FloatArray) -> FloatArray:
    """States of x(k+1) = A x(k) + w(k) for k = 0 … K, along the second-last axis.

    Blocks of about √K samples are run side by side from a zero state, then their starting
    states follow from the same recursion with A^b: 2√K matrix products instead of K.

    Args:
        A: state matrix (n, n).
        w: driving terms (…, K, n).
        x0: initial states (…, n).

    Returns:
        x(0) … x(K), shape (…, K + 1, n). An unstable A overflows to inf without a warning.
    """
    *batch, K, n = w.shape
    x = np.empty((*batch, K + 1, n))
    x[..., 0, :] = x0
    with np.errstate(over="ignore", invalid="ignore"):
        if K <= 64:
            for k in range(K):
                x[..., k + 1, :] = x[..., k, :] @ A.T + w[..., k, :]
            return x
        b = int(np.sqrt(K))
        blocks = K // b
        # zero-state response inside each block, all blocks at once
        inside = np.zeros((*batch, blocks, b + 1, n))
        driven = w[..., : blocks * b, :].reshape(*batch, blocks, b, n)
        for i in range(b):
            inside[..., i + 1, :] = inside[..., i, :] @ A.T + driven[..., i, :]
        starts = propagate(np.linalg.matrix_power(A, b), inside[..., b, :], x[..., 0, :])
        # x(jb + i) = A^i x(jb) + inside(j, i)
        free = starts[..., :-1, :]
        for i in range(1, b + 1):
            free = free @ A.T
            inside[..., i, :] += free
        x[..., 1 : blocks * b + 1, :] = inside[..., 1:, :].reshape(*batch, blocks * b, n)
        for k in range(blocks * b, K):
            x[..., k + 1, :] = x[..., k, :] @ A.T + w[..., k, :]
    return x


@dataclass(frozen=True, eq=False)
class LinearStateSpace:
    """x(k+1) = A x(k) + B u(k),  y(k) = C x(k) + D u(k)."""

    A: FloatArray
    """State matrix (n, n)."""
    B: FloatArray
    """Input matrix (n, r)."""
    C: FloatArray
    """Output matrix (m, n)."""
    D: FloatArray
    """Feed-through (m, r)."""
    Ts: float
    """Sampling time [s]."""

    def __post_init__(self) -> None:
        n, r, m = self.order, self.B.shape[1], self.C.shape[0]
        shapes = (self.A.shape, self.B.shape, self.C.shape, self.D.shape)
        if shapes != ((n, n), (n, r), (m, n), (m, r)):
            raise ValueError(f"A, B, C, D: expected shapes (n, n), (n, r), (m, n), (m, r), found {shapes}")

    @property
    def order(self) -> int:
        """Number of states n."""
        return self.A.shape[0]

    def simulate(self, u: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Free simulation.

        Args:
            u: inputs (K, r).
            x0: initial state (n,).

        Returns:
            Outputs (K, m) and states (K, n).
        """
        x = propagate(self.A, u @ self.B.T, x0)[..., :-1, :]
        with np.errstate(over="ignore", invalid="ignore"):
            return x @ self.C.T + u @ self.D.T, x

    def state_from_output(self, y0: FloatArray, u0: FloatArray) -> FloatArray:
        """x0 = C⁺ (y0 − D u0): the smallest state that explains one output sample.

        The smallest state depends on the basis, so a change of basis changes the simulation.
        """
        return np.linalg.pinv(self.C) @ (y0 - self.D @ u0)

    def markov(self, count: int) -> FloatArray:
        """D, CB, CAB, … (count, m, r): the same in every basis."""
        parameters = [self.D]
        column = self.B
        for _ in range(count - 1):
            parameters.append(self.C @ column)
            column = self.A @ column
        return np.array(parameters[:count])

    def transform(self, T: FloatArray) -> LinearStateSpace:
        """The same system with the state T x."""
        inverse = np.linalg.inv(T)
        return LinearStateSpace(T @ self.A @ inverse, T @ self.B, self.C @ inverse, self.D, self.Ts)

    def poles(self) -> NDArray[Any]:
        """Eigenvalues of A (n,), complex."""
        return np.linalg.eigvals(self.A)

    def spectral_radius(self) -> float:
        """Largest modulus of a pole; the system is stable below 1."""
        return float(np.abs(self.poles()).max())

    def to_control(self) -> Any:
        """The model as a python-control StateSpace."""
        import control

        return control.ss(self.A, self.B, self.C, self.D, self.Ts)

    @classmethod
    def from_control(cls, system: Any) -> LinearStateSpace:
        """From a discrete-time python-control StateSpace.

        Raises:
            ValueError: the system is in continuous time.
        """
        if not system.isdtime(strict=True):
            raise ValueError("expected a discrete-time system, found continuous time: sample it first")
        A, B, C, D = (np.asarray(M, dtype=np.float64) for M in (system.A, system.B, system.C, system.D))
        return cls(A, B, C, D, float(system.dt))
