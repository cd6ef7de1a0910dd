"""Linear time-invariant state-space models in discrete time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from nnss_cli.datasets.record import FloatArray, Record, unscored
from numpy.typing import NDArray

LONG = 8192  # samples, of all runs together, from which on machine code repays its loading (0.3 s) in a few calls


def propagate(A: FloatArray, w: FloatArray, x0: FloatArray) -> FloatArray:
    """States of x(k+1) = A x(k) + w(k) for k = 0 … K, along the second-last axis.

    Long ones in machine code. Else blocks of about √K samples are run side by side from a zero state, then their
    starting states follow from the same recursion with A^b: 2√K matrix products instead of K.

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
    if w.size >= LONG * n:
        from nnss_cli.baselines.kernels import recursion

        recursion(np.ascontiguousarray(A), np.ascontiguousarray(w).reshape(-1, K, n), x.reshape(-1, K + 1, n))
        return x
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


def spectral_radius(A: FloatArray) -> float:
    """ρ(A), the largest modulus of an eigenvalue; x(k+1) = A x(k) is stable below 1."""
    return float(np.abs(np.linalg.eigvals(A)).max())


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
        for name in "ABCD":  # one memory layout, so that a model read from disk gives the same bits
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=np.float64))
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

    def state_from_outputs(self, y: FloatArray, u: FloatArray) -> FloatArray:
        """The smallest x0 (n,) that explains outputs y (w, m) under inputs u (≥ w, r) best in least squares.

        The first sample alone tells it for w = 1, and where an unstable response overflows within the window.
        """
        w = len(y)
        if w > 1:
            # rows C A^k, from their transposes
            free = propagate(self.A.T, np.zeros((len(self.C), w, self.order)), self.C)[:, :-1]
            regressor = free.swapaxes(0, 1).reshape(-1, self.order)
            forced, _ = self.simulate(u[:w], np.zeros(self.order))
            if np.isfinite(regressor).all() and np.isfinite(forced).all():
                return np.asarray(np.linalg.lstsq(regressor, (y - forced).ravel(), rcond=None)[0])
        return self.state_from_output(y[0], u[0])

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
        return spectral_radius(self.A)

    def dc_gain(self) -> FloatArray:
        """Steady-state gain C (I − A)⁻¹ B + D (m, r); inf for a system with a pole at 1."""
        try:
            return self.C @ np.linalg.solve(np.eye(self.order) - self.A, self.B) + self.D
        except np.linalg.LinAlgError:
            return np.full(self.D.shape, np.inf)

    def gramians(self) -> tuple[FloatArray, FloatArray]:
        """Controllability and observability Gramians: P = A P Aᵀ + B Bᵀ, Q = Aᵀ Q A + Cᵀ C.

        Raises:
            ValueError: the system is not stable.
        """
        if self.spectral_radius() >= 1:
            raise ValueError(f"expected a stable system, found spectral radius {self.spectral_radius():.6g}")
        P = scipy.linalg.solve_discrete_lyapunov(self.A, self.B @ self.B.T)
        Q = scipy.linalg.solve_discrete_lyapunov(self.A.T, self.C.T @ self.C)
        return P, Q

    def hankel_singular_values(self) -> FloatArray:
        """Square roots of the eigenvalues of P Q, largest first (n,): how much each state matters."""
        return balancing(*self.gramians())[2]

    def balanced_truncation(self, order: int) -> LinearStateSpace:
        """The `order` states with the largest Hankel singular values, balanced.

        Source: B. C. Moore, IEEE TAC 26(1), 1981, by the square-root method of Laub et al., 1987.
        """
        T, T_inverse, _ = balancing(*self.gramians())
        left, right = T[:order], T_inverse[:, :order]
        return LinearStateSpace(left @ self.A @ right, left @ self.B, self.C @ right, self.D, self.Ts)

    def initial_state(self, record: Record) -> FloatArray:
        """x0 (n,) that fits a record's outputs best in least squares."""
        return self.state_from_outputs(record.y, record.u)

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


def balancing(P: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """T, T⁻¹ and σ with T P Tᵀ = T⁻ᵀ Q T⁻¹ = diag(σ), from Gramians P and Q."""

    def root(M: FloatArray) -> FloatArray:
        values, vectors = np.linalg.eigh((M + M.T) / 2)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))

    R, L = root(P), root(Q)
    U, sigma, Vt = np.linalg.svd(L.T @ R)
    scale = 1 / np.sqrt(np.maximum(sigma, sigma[0] * np.finfo(float).eps ** 2 + np.finfo(float).tiny))
    return (scale[:, None] * U.T) @ L.T, R @ Vt.T * scale, sigma


def scored_residuals(model: LinearStateSpace, records: tuple[Record, ...], init_window: int = 1) -> FloatArray:
    """y − ŷ of free simulations, all records one after the other.

    Args:
        model: in the units of the records.
        records: experiments.
        init_window: w, the first samples that tell x(0): C⁺(y0 − D u0) for w = 1, else least squares.

    Returns:
        (ΣK, m); for w > 1 without the windows' samples, (Σ(K − w), m).
    """
    w = init_window
    return np.concatenate(
        [
            (record.y - model.simulate(record.u, model.state_from_outputs(record.y[:w], record.u))[0])[unscored(w) :]
            for record in records
        ]
    )


def simulation_rms(model: LinearStateSpace, records: tuple[Record, ...], init_window: int = 1) -> float:
    """Root mean square of `scored_residuals`, over all samples and outputs; inf where they overflow."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.sqrt(np.mean(np.square(scored_residuals(model, records, init_window)))))
    return error if np.isfinite(error) else float("inf")
