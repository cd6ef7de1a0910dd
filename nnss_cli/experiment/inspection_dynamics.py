"""What ties a record's outputs to its inputs: spectra, coherence, delay, and what no linear model explains."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special
from numpy.lib.stride_tricks import sliding_window_view

from nnss_cli.baselines.subspace import triangularise
from nnss_cli.datasets.record import FloatArray

SEGMENT = 2048  # samples of the longest Welch segment
SEGMENTS = 8  # of them at least: few and long, since a memory longer than a segment passes for noise
WHITENER = 10  # order of the AR filters that flatten the channels before the segments are cut
PAST = 20  # past outputs of the high-order ARX model
LAGS = 50  # longest delay looked for
LEVEL = 2.5758293035489004  # Φ⁻¹(0.995): the bound of one lag, 99 %
WORK = 2e8  # samples × columns² of one regression: more samples are left out
LEAST = 20  # samples of a stretch that is worth a regression


@dataclass(frozen=True)
class Spectra:
    """Welch spectra S(f) of all channels (inputs first), each channel over its σ."""

    frequency: FloatArray
    """Cycles a sample, 0 … 0.5 (F,)."""
    density: FloatArray
    """Cross-spectral densities (F, c, c), one-sided, σ² a cycle a sample."""
    segment: int
    """Samples of a segment."""
    averages: float
    """Independent averages: half-overlapping Hann segments count 0.947 each."""


def welch(parts: Sequence[FloatArray], inputs: int, flatten: bool = True) -> Spectra | None:
    """Cross spectra by averaged Hann segments, half overlapping; None where there are not two segments of 8 samples.

    Each channel first passes its own AR filter A_i(q), which flattens its spectrum and shortens the memory between
    channels, and S_ij is divided by A_i A_j* afterwards: leakage falls by that much.
    Sources: P. D. Welch, IEEE Trans. Audio Electroacoust. 15(2), 1967; prewhitening: R. B. Blackman and J. W. Tukey,
    "The Measurement of Power Spectra", 1958.

    Args:
        parts: stretches without gaps (K, c), inputs first, zero mean and unit variance overall.
        inputs: number of inputs r; more of them need more segments.
        flatten: whether the channels pass those filters first. For shares of the power they must not: a filter's
            notch at a sine is far narrower than a segment's lines, so the sine's power would be lost in the division.
    """
    longest = max((len(part) for part in parts), default=0)
    if longest < 16:
        return None
    filters = _whiteners(parts, min(WHITENER, longest // 20))
    if not flatten:
        filters[:, 1:] = 0  # of the same length, so that the lines are the same
    order = filters.shape[1] - 1
    flat = [np.convolve(part[:, i], A)[order : len(part)] for part in parts for i, A in enumerate(filters)]
    c = len(filters)
    parts = [np.stack(flat[i : i + c], axis=1) for i in range(0, len(flat), c)]
    total, longest = sum(map(len, parts)), max(map(len, parts))
    length = max(8, 2 ** int(math.log2(min(SEGMENT, max(8, 2 * total / max(SEGMENTS, 4 * inputs + 4)), longest))))
    window = np.hanning(length + 1)[:-1]
    density = np.zeros((length // 2 + 1, c, c), dtype=complex)
    count = 0
    for part in parts:
        starts = np.arange(0, len(part) - length + 1, length // 2)
        for chunk in range(0, len(starts), 64):
            rows = starts[chunk : chunk + 64, None] + np.arange(length)
            F = np.fft.rfft(part[rows] * window[None, :, None], axis=1).transpose(1, 2, 0)
            density += F @ F.conj().transpose(0, 2, 1)
            count += F.shape[2]
    if count < 2:
        return None
    density *= 2 / (count * float(window @ window))
    density[[0, -1]] /= 2
    H = np.fft.rfft(filters, length, axis=1).T
    density /= H[:, :, None] * H[:, None, :].conj()
    # overlapping by half, Hann segments correlate by 1/6: K of them are worth K/(1 + 2/36 (1 − 1/K))
    return Spectra(np.fft.rfftfreq(length), density, length, count / (1 + 2 / 36 * (1 - 1 / count)))


def _whiteners(parts: Sequence[FloatArray], order: int) -> FloatArray:
    """1, a_1 … a_p of each channel's AR model by least squares (c, p + 1); a ridge keeps their zeros off the circle."""
    c = parts[0].shape[1]
    filters = np.zeros((c, order + 1))
    filters[:, 0] = 1
    for i in range(c if order else 0):
        G = np.zeros((order + 1, order + 1))
        for part in parts:
            if len(part) > order:
                rows = sliding_window_view(part[:, i], order + 1)
                G += rows.T @ rows
        G += 1e-4 * np.trace(G) / (order + 1) * np.eye(order + 1)
        if G[-1, -1] > 0:
            filters[i, 1:] = -np.linalg.solve(G[:-1, :-1], G[:-1, -1])[::-1]
    return filters


def band(frequency: FloatArray, power: FloatArray, share: float = 0.95) -> tuple[float, float]:
    """Lowest and highest frequency of the band that leaves (1 − share)/2 of the power below and above it."""
    total = np.cumsum(power)
    low, high = np.searchsorted(total, [(1 - share) / 2 * total[-1], (1 + share) / 2 * total[-1]])
    return float(frequency[low]), float(frequency[min(int(high), len(frequency) - 1)])


def multiple_coherence(spectra: Spectra, inputs: int, output: int) -> tuple[FloatArray, float | None]:
    """Share of an output's power that all inputs together explain linearly, by frequency, and what they leave.

        γ²(f) = S_yu S_uu⁻¹ S_uy / S_yy,   corrected: 1 − (1 − γ²)·q/(q − r),   q averages, r inputs
        unexplained = Σ (1 − γ²) S_yy / Σ S_yy,   f > 0

    The correction makes 1 − γ² unbiased where inputs explain nothing; without it r/q would seem explained.
    Noise, nonlinearity, unmeasured inputs and a memory longer than a segment are all "unexplained".
    Source: J. S. Bendat and A. G. Piersol, "Random Data", 4th ed., 2010, sections 7.3 and 9.3.

    Args:
        spectra: of all channels, inputs first.
        inputs: number of inputs r.
        output: index of the output among the outputs.

    Returns:
        γ² (F,), in 0 … 1, and the unexplained share; None where q ≤ 2 r + 2.
    """
    S, r, q = spectra.density, inputs, spectra.averages
    Syy = S[:, r + output, r + output].real
    if r == 0 or q <= 2 * r + 2 or not Syy[1:].sum() > 0:
        return np.zeros(len(Syy)), None
    Suu, Suy = S[:, :r, :r], S[:, :r, r + output]
    trace = np.trace(Suu, axis1=1, axis2=2).real / r
    floor = np.maximum(1e-12 * trace, np.finfo(float).tiny)  # inputs that are copies of each other
    gain = np.linalg.solve(Suu + floor[:, None, None] * np.eye(r), Suy[..., None])[..., 0]
    explained = np.einsum("fi,fi->f", Suy.conj(), gain).real
    left = np.clip(1 - explained / np.maximum(Syy, np.finfo(float).tiny), 0, 1)
    left = np.minimum(left * q / (q - r), 1)
    return 1 - left, float(np.sum((left * Syy)[1:]) / np.sum(Syy[1:]))


@dataclass(frozen=True)
class Response:
    """How an output follows one input: partial correlation by lag."""

    correlation: FloatArray
    """ρ(l), l = 0 … L: between y(k) and the part of u(k−l) that older inputs, other inputs and past outputs do not
    foretell, i.e. the cross-correlation of prewhitened input and output (L + 1,)."""
    bound: float
    """99 % of the ρ of one lag lie below it where there is no response: 2.58/√samples."""
    delay: int | None
    """First lag of the response; None where no lag exceeds the bound for all lags together, or `smooth`."""
    smooth: bool
    """Whether there is a response, but an earlier one as strong could hide, since older inputs foretell those lags."""
    samples: int
    """Samples of the regression."""


def responses(parts: Sequence[FloatArray], inputs: int, output: int) -> list[Response]:
    """Response of one output to each input, prewhitened by regression; [] where the record is too short.

        y(k) = Σ a_j y(k−j) + Σ_i Σ_l b_il u_i(k−l) + e(k),   j = 1 … p,   l = 0 … L

    With the columns of input i last, from its largest lag to lag 0, the QR decomposition of this regression
    makes of u_i(k−l) what nothing before it foretells (prewhitening by its own past and all else), and of y its
    part along that: independent, of variance σ_e², for every lag below the delay. The delay is the first lag
    above the bound for all lags together (99 %), or an earlier one that leads to it without a lag below its own
    bound. Past outputs whiten the noise, so it may be coloured, and loops may be closed.

    Args:
        parts: stretches without gaps (K, c), inputs first, zero mean and unit variance overall.
        inputs: number of inputs r.
        output: index of the output among the outputs.
    """
    size = _size(parts, inputs)
    if size is None:
        return []
    p, L = size
    columns = p + inputs * (L + 1) + 1
    parts, rows = _within(parts, max(p, L), columns)
    R = triangularise(_regression(parts, inputs, output, p, L))
    groups = [list(range(p))] + [list(range(p + i * (L + 1), p + (i + 1) * (L + 1))) for i in range(inputs)]
    freedom = rows - columns
    found = []
    for i in range(inputs):
        ordered = [k for j, group in enumerate(groups) if j != i + 1 for k in group] + groups[i + 1] + [columns - 1]
        T = np.asarray(np.linalg.qr(R[:, ordered], mode="r"))
        part = slice(columns - 1 - (L + 1), columns - 1)
        # what rounding leaves of a foretold input is no innovation
        fresh = np.abs(np.diag(T)[part]) > 1e-6 * np.linalg.norm(T[:, part], axis=0)
        noise = max(
            float(T[-1, -1]) ** 2 / freedom, 1e-10 * float(np.sum(T[:, -1] ** 2)) / rows, float(np.finfo(float).tiny)
        )
        z = np.where(fresh, T[part, -1] * np.sign(np.diag(T)[part]) / math.sqrt(noise), 0.0)[::-1]
        first, smooth = _first(z, np.abs(np.diag(T)[part])[::-1])
        found.append(
            Response(z / np.sqrt(z**2 + freedom), LEVEL / math.sqrt(freedom), None if smooth else first, smooth, rows)
        )
    return found


def _first(z: FloatArray, fresh: FloatArray) -> tuple[int | None, bool]:
    """First lag of a response, and whether an earlier one could hide.

    Args:
        z: normal scores by lag: coefficient times `fresh`.
        fresh: norm of what is new of the input by lag.
    """
    together = -float(scipy.special.ndtri(0.005 / len(z)))
    above = np.flatnonzero(np.abs(z) > together)
    if not len(above):
        return None, False
    first = int(above[0])
    while first > 0 and abs(z[first - 1]) > LEVEL:
        first -= 1
    strongest = float(np.max(np.abs(z[above]) / fresh[above]))
    return first, bool(np.any(fresh[:first] * strongest < together))


def _size(parts: Sequence[FloatArray], inputs: int) -> tuple[int, int] | None:
    """Past outputs p and largest lag L that leave four samples a column; None where p would be 0."""
    total, longest = sum(len(part) for part in parts), max((len(part) for part in parts), default=0)
    room = total // 4 - 1
    p = min(PAST, room // 3, longest // 4)
    L = min(LAGS, (room - p) // max(inputs, 1) - 1, longest // 4)
    return (p, L) if p >= 1 and L >= 1 else None


def _within(parts: Sequence[FloatArray], depth: int, columns: int) -> tuple[list[FloatArray], int]:
    """As many samples as the work allows, from the stretches longer than `depth`, and the rows that they give."""
    left = int(max(WORK / columns**2, 20 * columns))
    kept = []
    for part in parts:
        part = part[: left + depth] if left > 0 else part[:0]
        if len(part) > depth:
            kept.append(part)
            left -= len(part) - depth
    return kept, sum(len(part) - depth for part in kept)


def _regression(
    parts: Sequence[FloatArray], r: int, output: int, p: int, L: int, extra: Sequence[int] | None = None
) -> Iterator[FloatArray]:
    """Rows [y(k−1) … y(k−p), u_1(k−L) … u_1(k), …, (products), y(k)]; products where `extra` gives a lag per input."""
    depth = max(p, L + 1 if extra is not None else L)
    for part in parts:
        for start in range(depth, len(part), 4096):
            stop = min(start + 4096, len(part))

            def at(channel: int, lag: int, rows: FloatArray = part, start: int = start, stop: int = stop) -> FloatArray:
                return rows[start - lag : stop - lag, channel]

            y = r + output
            block = [at(y, j) for j in range(1, p + 1)]
            block += [at(i, lag) for i in range(r) for lag in range(L, -1, -1)]
            if extra is not None:
                bases = [at(y, 1), at(y, 2)] + [at(i, extra[i] + j) for i in range(r) for j in (0, 1)]
                block = [np.ones(stop - start), *block]
                block += [base**power for base in bases for power in (2, 3)]
                block += [at(y, 1) * at(i, extra[i]) for i in range(r)]
            yield np.stack([*block, at(y, 0)], axis=1)


@dataclass(frozen=True)
class Products:
    """Whether squares, cubes and products foretell what a linear model leaves."""

    gain: float
    """Share of the one-step residual's power that they explain, beyond what as many random columns would."""
    p_value: float
    """Of the F test that they explain nothing."""
    samples: int
    """Samples of the regression."""


def products(parts: Sequence[FloatArray], inputs: int, output: int, delays: Sequence[int]) -> Products | None:
    """F test of y²(k−1), y³(k−1), …, u²(k−d), u³(k−d), …, y(k−1)u(k−d) in a high-order ARX model.

    Under the null, a linear system with any Gaussian noise, the ARX model's residual is white and the statistic
    follows F; so noise and nonlinearity, which coherence mixes, come apart. A nonlinearity that these terms do not see
    stays hidden. Source: R. S. Tsay, "Nonlinearity tests for time series", Biometrika 73(2), 1986, with inputs.

    Args:
        parts: as in `responses`.
        inputs: number of inputs r.
        output: index of the output among the outputs.
        delays: lag d of each input whose powers enter.

    Returns:
        None where the record is too short, or a linear model leaves nothing.
    """
    total = sum(map(len, parts))
    p = min(PAST, total // 50)
    L = max([p // 2 + 1, *(d + 2 for d in delays)])
    lags = list(delays)
    if p < 2:
        return None
    linear = 1 + p + inputs * (L + 1)
    columns = linear + 4 + 5 * inputs + 1
    parts, rows = _within(parts, max(p, L + 1), columns)
    if rows < 16 * columns:  # on 13 rows a column, two-level inputs gave 10 % false alarms at 5 %
        return None
    R = triangularise(_regression(parts, inputs, output, p, L, lags))
    found = _f_test(R, linear, rows)
    return None if found is None else Products(*found, rows)


def _f_test(R: FloatArray, first: int, rows: int) -> tuple[float, float] | None:
    """Whether columns from `first` on explain what those before them leave of the last one.

    Args:
        R: triangle of the regression, what is explained last.
        first: column that the tested ones begin with.
        rows: of the regression.

    Returns:
        Share that they explain of it, beyond what as many random columns would, and the p-value of the F test that
        they explain nothing; None where nothing is left to explain, or nothing new to explain it.
    """
    kept = np.abs(np.diag(R)[first:-1]) > 1e-6 * np.linalg.norm(R[:, first:-1], axis=0)
    part = R[first:-1, -1] ** 2
    freedom, tested = rows - first - int(kept.sum()), int(kept.sum())
    left = float(R[-1, -1] ** 2 + part[~kept].sum())
    if tested == 0 or left + part.sum() <= 1e-12 * np.sum(R[:, -1] ** 2):
        return None
    if not left > 0:
        return 1.0, 0.0
    F = float(part[kept].sum()) / tested / (left / freedom)
    gain = 1 - (left / freedom) / ((left + float(part[kept].sum())) / (freedom + tested))
    return max(0.0, gain), float(scipy.special.fdtrc(tested, freedom, F))


@dataclass(frozen=True)
class Feedback:
    """Whether past outputs foretell an input."""

    gain: float
    """Share of what is new of the input that they foretell, beyond what as many random columns would."""
    p_value: float
    """Of the F test that they foretell nothing."""
    samples: int
    """Samples of the regression."""


def feedback(parts: Sequence[FloatArray], inputs: int, which: int) -> Feedback | None:
    """F test of f = 0: whether the last J outputs foretell an input, beyond past inputs and older outputs.

        u_i(k) = c + Σ b_jl u_j(k−l) + Σ a_jl y_j(k−l) + Σ f_jl y_j(k−l) + e(k)
                     l = 1 … J + p     l = J + 1 … J + p   l = 1 … J

    In open loop, older outputs and the inputs since then tell all of the last outputs but their noise, which knows
    nothing of the input: f = 0, whatever the input and the plant's memory, with feedthrough, too. Where an input is
    held, only the samples at which it changes count: in between it foretells itself. A controller that answers the
    output of the same sample to a reference that is new at each sample, without memory, stays hidden: it cannot be
    told from a feedthrough. Source: C. W. J. Granger, Econometrica 37(3), 1969, with older outputs given.

    Args:
        parts: as in `responses`.
        inputs: number of inputs r.
        which: index of the input.

    Returns:
        None where it changes too seldom, or its past or nothing foretells it.
    """
    c = parts[0].shape[1] if parts else 1
    depth = min(PAST + PAST // 2, _moves(parts, which, 1) // (16 * c), max(map(len, parts), default=0) // 4)
    if depth < 3 or c == inputs:
        return None
    last, columns = depth // 3, c * depth + 2
    parts, _ = _within(parts, depth, columns)
    rows = _moves(parts, which, depth)
    if rows < 8 * columns:
        return None
    R = triangularise(_last_outputs(parts, inputs, which, depth, last))
    found = _f_test(R, columns - 1 - (c - inputs) * last, rows)
    return None if found is None else Feedback(*found, rows)


def _moves(parts: Sequence[FloatArray], which: int, first: int) -> int:
    """Samples from `first` on of each part whose channel is another than the one before."""
    return sum(int(np.count_nonzero(np.diff(part[first - 1 :, which]))) for part in parts)


def _last_outputs(parts: Sequence[FloatArray], r: int, which: int, depth: int, last: int) -> Iterator[FloatArray]:
    """Rows [1, u(k−depth … k−1), y(k−depth … k−last−1), y(k−last … k−1), u_i(k)] where u_i(k) differs from u_i(k−1)."""
    for part in parts:
        moves = np.flatnonzero(np.diff(part[depth - 1 :, which]))
        windows = sliding_window_view(part, depth + 1, axis=0)  # (K − depth, c, depth + 1)
        for start in range(0, len(moves), 4096):
            rows = windows[moves[start : start + 4096]]
            groups = rows[:, :r, :depth], rows[:, r:, : depth - last], rows[:, r:, depth - last : depth]
            flat = [group.reshape(len(rows), -1) for group in groups]
            yield np.column_stack([np.ones(len(rows)), *flat, rows[:, which, depth]])


def excerpt(parts: Sequence[FloatArray], limit: int, inputs: int) -> list[FloatArray]:
    """Up to `limit` samples of stretches (K, c), in time order: where the inputs (or, without, outputs) vary most.

    Long records often begin or end at rest. Stretches under 20 samples are left out.
    """
    parts = [part for part in parts if len(part) >= LEAST]
    if sum(map(len, parts)) <= limit:
        return parts
    pieces = [part[start : start + limit] for part in parts for start in range(0, len(part), limit)]
    pieces = [piece for piece in pieces if len(piece) >= LEAST]
    life = [float(np.sum(np.var(piece[:, : inputs or None], axis=0))) * len(piece) for piece in pieces]
    kept, left = {}, limit
    for index in np.argsort(life)[::-1]:
        if left >= LEAST:
            kept[int(index)] = pieces[index][:left]
            left -= len(kept[int(index)])
    return [kept[index] for index in sorted(kept)]
