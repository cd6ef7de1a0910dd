"""Regularised estimation: a high-order ARX model with a stable-spline prior, reduced to order n.

    y(k) = Σ_l A_l y(k−l) + Σ_l B_l u(k−l) + e(k),   l = 1 … p

Each impulse response (of A and of B, per output) has a Gaussian prior with a kernel that makes it
smooth and decaying; the hyper-parameters maximise the marginal likelihood. The model is brought
to state space, truncated in balanced coordinates, and B and x0 are refitted on the simulation.

Sources: T. Chen, H. Ohlsson and L. Ljung, "On the estimation of transfer functions,
regularizations and Gaussian processes — revisited", Automatica 48(8), 2012 (kernels);
T. Chen and L. Ljung, "Implementation of algorithms for tuning parameters in regularized least
squares problems", Automatica 49(7), 2013 (the likelihood from QR factors).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, TypeAlias, get_args

import numpy as np
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.baselines.subspace import BLOCK, fit_input_matrix, reflect_unstable, triangularise
from nnss_cli.datasets.record import FloatArray, Record

from nnss_cli.errors import InputError

Kernel: TypeAlias = Literal["tc", "dc", "ss"]
KERNELS: tuple[str, ...] = get_args(Kernel)


def kernel_matrix(kernel: Kernel, length: int, scale: float, decay: float, correlation: float = 0.0) -> FloatArray:
    """Prior covariance of an impulse response g_1 … g_p.

        tc:  c λ^max(i,j)
        dc:  c λ^((i+j)/2) ρ^|i−j|
        ss:  c (λ^(i+j+max(i,j))/2 − λ^(3 max(i,j))/6)

    Args:
        kernel: tc, dc or ss.
        length: p.
        scale: c > 0.
        decay: λ, 0 < λ < 1.
        correlation: ρ of dc, |ρ| < 1.
    """
    i = np.arange(1, length + 1)
    largest = np.maximum.outer(i, i)
    if kernel == "tc":
        return np.asarray(scale * decay**largest)
    total = np.add.outer(i, i)
    if kernel == "dc":
        return np.asarray(scale * decay ** (total / 2) * correlation ** np.abs(np.subtract.outer(i, i)))
    return np.asarray(scale * (decay ** (total + largest) / 2 - decay ** (3 * largest) / 6))


def default_lags(samples: int, channels: int) -> int:
    """Lags p of the ARX model: 30 where the data allow, so that p (r + m) stays below twice the samples."""
    return max(2, min(30, 2 * samples // channels))


def ssregest(records: tuple[Record, ...], order: int, kernel: Kernel = "tc") -> LinearStateSpace:
    """Identify a linear model by a regularised ARX model and its reduction.

    Args:
        records: experiments, in normalised units.
        order: number of states n.
        kernel: prior of the impulse responses.

    Raises:
        InputError: the records are too short for the order.
    """
    full = high_order_model(records, order, kernel)
    reduced = full.balanced_truncation(order)
    B, _ = fit_input_matrix(reduced.A, reduced.C, records)
    return LinearStateSpace(reduced.A, B, reduced.C, reduced.D, reduced.Ts)


def high_order_model(
    records: tuple[Record, ...], order: int = 1, kernel: Kernel = "tc", lags: int | None = None
) -> LinearStateSpace:
    """The regularised ARX model of order p·m in state space, before reduction.

    Its Hankel singular values tell how many states the data call for. Arguments and errors as in `ssregest`; `lags`
    is p, that of `default_lags` where it is None.
    """
    r, m = records[0].input_count, records[0].output_count
    samples, shortest = sum(len(record) for record in records), min(len(record) for record in records)
    p = lags or max(min(default_lags(samples, r + m), shortest - 1), -(-order // m) + 1)
    if shortest <= p or order > p * m:
        raise InputError(
            f"order {order} is too large for ssregest on these records: {p} lags and {m} outputs "
            f"need records of more than {p} samples, found one of {shortest}, and allow order {p * m}; "
            "use a lower order or longer records"
        )
    # per output the rows are the same: regressors first, all outputs behind
    R = triangularise(_regression(records, p))
    theta = np.stack([_posterior_mean(R, output, m, p, r, kernel, samples - p * len(records)) for output in range(m)])
    return _arx_to_state_space(theta, m, r, p, records[0].Ts)


def _regression(records: tuple[Record, ...], p: int) -> Iterator[FloatArray]:
    """Rows [y1(k−1) … y1(k−p) … um(k−1) … um(k−p), y(k)]."""
    for record in records:
        signals = np.concatenate([record.y, record.u], axis=1)
        for start in range(p, len(record), BLOCK):
            stop = min(start + BLOCK, len(record))
            lagged = [
                signals[start - lag : stop - lag, channel]
                for channel in range(signals.shape[1])
                for lag in range(1, p + 1)
            ]
            yield np.concatenate([np.stack(lagged, axis=1), record.y[start:stop]], axis=1)


def _posterior_mean(R: FloatArray, output: int, m: int, p: int, r: int, kernel: Kernel, samples: int) -> FloatArray:
    """Coefficients (p·(m + r),) of one output, hyper-parameters by marginal likelihood."""
    P = p * (m + r)
    # a record shorter than P rows gives fewer rows in R
    R11, r12 = R[:P, :P], R[:P, P + output]
    below = float(np.sum(R[P:, P + output] ** 2))

    def prior_root(theta: FloatArray) -> FloatArray:
        roots = []
        for group, count in ((0, m), (1, r)):
            log_scale, logit = theta[2 * group], theta[2 * group + 1]
            decay = 1 / (1 + np.exp(-logit))
            K = kernel_matrix(kernel, p, np.exp(log_scale), decay, 0.99 * np.tanh(theta[5]) if kernel == "dc" else 0.0)
            # the kernels of far lags underflow: a relative jitter keeps the factor real
            root = np.linalg.cholesky(K + 1e-10 * np.trace(K) / p * np.eye(p))
            roots += [root] * count
        return np.asarray(scipy.linalg.block_diag(*roots))

    def factors(theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        sigma = np.exp(theta[4])
        root = prior_root(theta)
        top = np.concatenate([R11 @ root, r12[:, None]], axis=1)
        stacked = np.concatenate([top, np.concatenate([sigma * np.eye(P), np.zeros((P, 1))], axis=1)])
        F = np.asarray(np.linalg.qr(stacked, mode="r"))
        return root, F[:P, :P], F[:P, P], float(F[P, P] ** 2) if len(F) > P else 0.0

    def minus_log_likelihood(theta: FloatArray) -> float:
        _, F, _, rest = factors(theta)
        sigma = np.exp(theta[4])
        log_det = 2 * float(np.sum(np.log(np.abs(np.diag(F))))) + 2 * (samples - P) * theta[4]
        return (below + rest) / sigma**2 + log_det

    variance = (below + float(np.sum(r12**2))) / samples
    start = np.array([0.0, 2.0, 0.0, 2.0, 0.5 * np.log(0.01 * variance + 1e-12), 1.0])[: 6 if kernel == "dc" else 5]
    bounds = [(-20.0, 10.0), (-3.0, 6.0), (-20.0, 10.0), (-3.0, 6.0), (start[4] - 10, start[4] + 6), (-4.0, 4.0)]
    import scipy.optimize  # at need: it takes a third of a second, and `nnss report` comes by here

    best = scipy.optimize.minimize(minus_log_likelihood, start, method="L-BFGS-B", bounds=bounds[: len(start)])
    root, F, f, _ = factors(best.x)
    return np.asarray(root @ np.linalg.solve(F, f))


def _arx_to_state_space(theta: FloatArray, m: int, r: int, p: int, Ts: float) -> LinearStateSpace:
    """Observer form of order p·m, its unstable poles reflected.

    x_l(k+1) = A_l y(k) + x_{l+1}(k) + B_l u(k),   y = x_1
    """
    coefficients = theta.reshape(m, m + r, p)
    n = p * m
    A, B, C = np.eye(n, k=m), np.zeros((n, r)), np.zeros((m, n))
    for lag in range(p):
        A[lag * m : (lag + 1) * m, :m] += coefficients[:, :m, lag]
        B[lag * m : (lag + 1) * m] = coefficients[:, m:, lag]
    C[:, :m] = np.eye(m)
    stable = reflect_unstable(A)
    # a pole on the circle has no Gramian
    radius = np.abs(np.linalg.eigvals(stable)).max()
    inside = min(1.0, (1 - 1e-9) / radius) if radius > 0 else 1.0
    return LinearStateSpace(stable * inside, B, C, np.zeros((m, r)), Ts)
