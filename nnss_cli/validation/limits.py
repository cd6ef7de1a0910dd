"""A band around the outputs of a record: its limits, how many measured outputs it held, and what is told of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import Channels, FloatArray
from nnss_cli.datasets.units import has_unit
from nnss_cli.validation.adaptive import AdaptiveBand
from nnss_cli.validation.bands import Band


@dataclass(frozen=True, eq=False)
class Limits:
    """A band around outputs, and how many measured ones it held."""

    band: Band
    """How wide, and from how many blocks."""
    low: FloatArray
    """Lower limits (K, m), physical units."""
    high: FloatArray
    """Upper limits (K, m), physical units."""
    held: FloatArray | None
    """Share of the measured outputs within (m,), the init window left out, NaN of one of which there is none; None
    where nothing was measured."""
    adaptive: AdaptiveBand | None = None
    """What moves the width of `band` as errors are seen; None where it is fixed beforehand."""

    @classmethod
    def of(
        cls, band: Band, y: FloatArray, spread: FloatArray | None, measured: FloatArray | None, init_window: int
    ) -> Limits:
        """Around outputs y (K, m), with an ensemble's spread where the band follows it."""
        low, high = band.limits(y, spread)
        return cls(band, low, high, _share_held(low, high, measured, init_window))

    @classmethod
    def of_experiments(
        cls, band: Band, y: Sequence[FloatArray], measured: Sequence[FloatArray], init_window: int
    ) -> Limits:
        """Around the first of several experiments' outputs (K, m); the share held is of the samples of all of them."""
        pairs = [band.limits(each) for each in y]
        low, high, seen = (
            np.concatenate([part[init_window:] for part in parts]) for parts in (*zip(*pairs, strict=True), measured)
        )
        return cls(band, *pairs[0], _share_held(low, high, seen, 0))

    @classmethod
    def following(cls, band: AdaptiveBand, y: FloatArray, measured: FloatArray, init_window: int) -> Limits:
        """Around predictions y (K, m), as wide as the errors up to k − h say."""
        half = band.half_widths(measured - y, init_window)
        low, high = y - half, y + half
        return cls(band.start, low, high, _share_held(low, high, measured, init_window), band)

    @property
    def pair(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limits."""
        return self.low, self.high

    @property
    def name(self) -> str:
        """For legends."""
        return f"band of {100 * self.band.level:g} %"

    def told(self, channels: Channels) -> list[str]:
        """A line for each output."""
        lines = []
        for i, (name, unit) in enumerate(zip(channels.outputs, channels.output_units, strict=True)):
            of = "× the members' spread" if self.band.floor is not None else unit * has_unit(unit)
            half = f"{self.band.half_width[i]:.4g} {of}".strip()
            if self.adaptive is not None:
                widths = (self.high - self.low)[:, i] / 2
                half += (
                    f" at first, then {widths.min():.4g} to {widths.max():.4g} by the coverage seen (step "
                    f"{self.adaptive.steps[i]:g}); the first"
                )
            seen = "" if self.held is None or np.isnan(self.held[i]) else f"; it holds {100 * self.held[i]:.1f} % here"
            lines.append(
                f"{self.name}, {name}: ± {half}, from {self.band.blocks[i]} blocks of {self.band.length[i]} samples of "
                f"the validation record{self._doubt(i)}{seen}"
            )
        return lines

    def _doubt(self, output: int) -> str:
        if self.band.assured(output):
            return ""
        return (
            f", whose errors remember {self.band.memory[output]}: it is too short to assure {100 * self.band.level:g} %"
        )


def _share_held(low: FloatArray, high: FloatArray, measured: FloatArray | None, init_window: int) -> FloatArray | None:
    if measured is None or len(measured) <= init_window:
        return None
    held, there = (low <= measured) & (measured <= high), np.isfinite(measured)
    with np.errstate(invalid="ignore"):
        return np.asarray(held[init_window:].sum(axis=0) / there[init_window:].sum(axis=0))
