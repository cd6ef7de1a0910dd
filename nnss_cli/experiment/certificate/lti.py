"""The exact answers for one A, B, C, D: a Lyapunov matrix and the H∞ norm, each with a proof in floating point.

The norm is bracketed: from below by the frequency response, from above by a γ whose bounded real lemma holds,

    ‖ [S⁻¹AS, S⁻¹B/γ; CS, D/γ] ‖₂ ≤ 1   for some S

γ is found by bisection on whether the symplectic pencil of the lemma's Riccati equation has eigenvalues on the unit
circle (S. Boyd, V. Balakrishnan and P. Kabamba, Math. Control Signals Systems 2, 1989, in discrete time); S follows
from the Riccati equation, and the inequality is then checked with all rounding, so that nothing rests on eigenvalues.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import FloatArray
from nnss_cli.experiment.certificate.affine import EPS
from nnss_cli.experiment.certificate.region import inverse, product

BISECTIONS = 60
ABOVE = (1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)  # what is tried on top of the bisection's γ, relative
GRID = 2000
SQUARED = 1e-100, 1e100  # norms of B, C and of the response whose squares and products neither vanish nor overflow
SCALED = (1.0, 1e-2, 1e-4, 1e-6, 1e-8)  # of Schur's basis, from one vector to the next

ComplexArray: TypeAlias = NDArray[np.complex128]


@dataclass(frozen=True)
class Norm:
    """sup over frequencies of the largest singular value of C (e^{jω} I − A)⁻¹ B + D."""

    low: float
    """Reached at `frequency`, up to rounding."""
    high: float | None
    """Proved; None where the system is not stable, or nothing could be proved."""
    frequency: float
    """ω in [0, π] where `low` is reached [rad/sample]."""


def lyapunov(A: FloatArray) -> tuple[float, FloatArray] | None:
    """r < 1 and S with ‖S⁻¹AS‖ ≤ r proved, r close to ρ(A); None without."""
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    for share in (1e-6, 1e-4, 1e-2, 0.1, 0.5):
        r = radius + share * (1 - radius)
        if not 0 < r < 1:
            if radius > 0:
                return None
            r = share
        try:
            Q = scipy.linalg.solve_discrete_lyapunov((A / r).T, np.eye(len(A)))
            S = np.linalg.inv(np.linalg.cholesky((Q + Q.T) / 2)).T
        except (np.linalg.LinAlgError, ValueError):
            continue
        bound = weighted_norm(A, S)
        if bound < 1:
            return bound, S
    return None


def spectral_radius(A: FloatArray, off: FloatArray | float = 0.0) -> tuple[float, float]:
    """ρ(A) and a margin: ρ of every matrix within `off` of A, entry by entry, is that close, rounding included.

    In a basis T, T⁻¹AT = Λ + R with Λ diagonal. Each eigenvalue lies within ‖R‖ of one of Λ (F. Bauer and C. Fike,
    Numer. Math. 2, 1960). Where the j largest |λ| are more than 2‖R‖ apart from the others, no eigenvalue of Λ + tR,
    0 ≤ t ≤ 1, crosses the circle between, so that j lie beyond it, within ‖R‖ of those j. T are the eigenvectors, and
    those of Schur with R scaled down: the former may be nearly dependent.
    """
    U, Q = scipy.linalg.schur(A, output="complex")
    bases = [np.linalg.eig(A)[1], *(Q * share ** np.arange(len(A)) for share in SCALED)]
    low, high = np.transpose([_discs(A, np.broadcast_to(off, A.shape), T) for T in bases])
    radius = float(np.abs(np.diag(U)).max())
    return radius, float(max(radius - low.max(), high.min() - radius))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # of a singular T, which bounds nothing
def _discs(A: FloatArray, off: FloatArray, T: ComplexArray) -> tuple[float, float]:
    """Least and largest ρ by the discs in a basis T."""
    n, size = len(A), np.abs(T)
    try:
        W = np.linalg.inv(T)
    except np.linalg.LinAlgError:
        return -np.inf, np.inf
    # W is T⁻¹ but for e ≥ ‖I − WT‖: (WT)⁻¹ is I but for e/(1 − e)
    e = float(np.linalg.norm(np.abs(np.eye(n) - W @ T) + 4 * (n + 8) * EPS * (np.abs(W) @ size + 1)))
    if not e < 1:
        return -np.inf, np.inf
    moved = W @ A @ T
    lost = np.abs(W) @ (off + 4 * (n + 8) * EPS * np.abs(A)) @ size
    rest = np.linalg.norm(moved - np.diag(np.diag(moved))) + np.linalg.norm(lost)
    rest = (rest + e / (1 - e) * (np.linalg.norm(moved) + np.linalg.norm(lost))) * (1 + 1e-12)
    sizes = np.sort(np.abs(np.diag(moved)))[::-1]
    rest += 4 * EPS * sizes[0]
    apart = np.append(sizes[:-1] - sizes[1:] > 2 * rest, True)
    return float(sizes[np.argmax(apart)] - rest), float(sizes[0] + rest)


def weighted_norm(blocks: FloatArray, S: FloatArray, gamma: float = 1.0) -> float:
    """Bound on ‖diag(S⁻¹, I) [A, B; C, D] diag(S, I/γ)‖₂, rounding included; A alone is [A]."""
    n = len(S)
    back = inverse(S)
    rows, cols = blocks.shape[0] - n, blocks.shape[1] - n
    right = scipy.linalg.block_diag(S, np.eye(cols) / gamma)
    c, r = scipy.linalg.block_diag(back.c, np.eye(rows)), scipy.linalg.block_diag(back.r, np.zeros((rows, rows)))
    left = type(back)(c, np.zeros((1, *c.shape)), r)
    found = product(product(left, blocks), right)
    return float(np.linalg.norm(found.c, 2) + np.linalg.norm(found.r)) * (1 + 1e-13)


def response(system: LinearStateSpace, frequencies: FloatArray) -> FloatArray:
    """Largest singular values (N,) of the frequency response."""
    s = system
    z = np.exp(1j * frequencies)[:, None, None] * np.eye(s.order)
    G = s.C @ np.linalg.solve(z - s.A, np.broadcast_to(s.B.astype(complex), (len(z), *s.B.shape))) + s.D
    return np.asarray(np.linalg.norm(G, 2, axis=(1, 2)))


def norm(system: LinearStateSpace) -> Norm:
    """The H∞ norm, bracketed; high is None where ρ(A) < 1 is not proved, or B, C or D are beyond `SQUARED`."""
    if lyapunov(system.A) is None:
        return Norm(0.0, None, 0.0)
    if not _connected(system):
        return Norm(0.0, 0.0, 0.0)
    B, C, D = (float(np.abs(M).max(initial=0.0)) for M in (system.B, system.C, system.D))
    if not all(SQUARED[0] < each < SQUARED[1] for each in (B or 1.0, C or 1.0, B * C + D)):
        return Norm(0.0, None, 0.0)  # the response, or γ² of the lemma, may be 0 by rounding alone
    angles = np.abs(np.angle(np.linalg.eigvals(system.A)))
    # close to each pole's angle, and everywhere
    grid = np.unique(np.clip(np.concatenate([
        np.linspace(0, np.pi, GRID), np.geomspace(1e-8, np.pi, GRID),
        *(angle + np.concatenate([-np.geomspace(1e-8, 1, 100), [0], np.geomspace(1e-8, 1, 100)]) for angle in angles),
    ]), 0, np.pi))  # fmt: skip
    sizes = response(system, grid)
    at = int(np.argmax(sizes))
    low, frequency = float(sizes[at]), float(grid[at])
    if low == 0.0:
        return Norm(0.0, None, 0.0)
    below, above = low, low * 1.001
    while _crosses(system, above) and above < 1e6 * low:
        below, above = above, above * 2
    for _ in range(BISECTIONS):
        middle = (below + above) / 2
        below, above = (middle, above) if _crosses(system, middle) else (below, middle)
    for share in ABOVE:
        gamma = above * (1 + share)
        if _bounded_real(system, gamma, share):
            return Norm(low * (1 - 1e-9), gamma, frequency)
    return Norm(low * (1 - 1e-9), None, frequency)


def _connected(system: LinearStateSpace) -> bool:
    """Whether entries other than 0 lead from an input to an output: the response is 0 exactly where none do."""
    A, B, C, D = (M != 0 for M in (system.A, system.B, system.C, system.D))
    driven = B.any(axis=1)
    for _ in range(len(A)):
        driven = driven | (A & driven).any(axis=1)
    return bool(D.any() or (C & driven).any())


def _crosses(system: LinearStateSpace, gamma: float) -> bool:
    """Whether γ is a singular value of the response at some frequency, as far as eigenvalues tell."""
    s = system
    R = gamma**2 * np.eye(s.B.shape[1]) - s.D.T @ s.D
    try:
        if np.linalg.eigvalsh(R).min() <= 0:
            return True
        back = np.linalg.inv(R)
    except np.linalg.LinAlgError:
        return True
    A = s.A + s.B @ back @ s.D.T @ s.C
    n = s.order
    E, F = s.B @ back @ s.B.T, s.C.T @ (np.eye(len(s.C)) + s.D @ back @ s.D.T) @ s.C
    left = np.block([[A, np.zeros((n, n))], [-F, np.eye(n)]])
    right = np.block([[np.eye(n), -E], [np.zeros((n, n)), A.T]])
    values = scipy.linalg.eigvals(left, right)
    return bool((np.abs(np.abs(values[np.isfinite(values)]) - 1) < 1e-9).any())


def _bounded_real(system: LinearStateSpace, gamma: float, share: float) -> bool:
    """Whether the lemma holds for γ with the S of a Riccati equation that has some room."""
    s = system
    blocks = np.block([[s.A, s.B], [s.C, s.D]])
    inside = gamma * (1 - share / 2)
    R = s.D.T @ s.D - inside**2 * np.eye(s.B.shape[1])
    size = float(np.linalg.norm(s.C, 2)) ** 2 + EPS
    for room in (1e-1, 1e-3, 1e-6, 1e-9):
        Q = s.C.T @ s.C + room * share * size * np.eye(s.order)
        try:
            P = scipy.linalg.solve_discrete_are(s.A, s.B, Q, R, s=s.C.T @ s.D)
            S = np.linalg.inv(np.linalg.cholesky((P + P.T) / 2)).T
        except (np.linalg.LinAlgError, ValueError):
            continue
        if weighted_norm(blocks, S, gamma) <= 1:
            return True
    return False
