"""Order selection: what the data say before a model is trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nnss_cli.baselines.ssregest import high_order_model
from nnss_cli.baselines.statespace import simulation_rms
from nnss_cli.datasets.record import FittingData
from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import NUMERICAL
from nnss_cli.methods.linear import subspace_model

MARGIN = 1.05  # an order is good enough when its validation error is within 5 % of the lowest


@dataclass(frozen=True)
class OrderRow:
    """What is known about one order."""

    order: int
    """Number of states n."""
    hankel: float
    """n-th Hankel singular value of a regularised high-order model, relative to the first."""
    train: float | None
    """Training error of N4SID: RMS over samples and outputs, normalised units."""
    val: float | None
    """Validation error, likewise; None where the data allow no model of the order."""


def order_table(data: FittingData, largest: int, horizon: str) -> list[OrderRow]:
    """Hankel singular values and errors for the orders 1 … `largest`, of the same N4SID that is compared.

    Args:
        data: train and validation records.
        largest: order at most.
        horizon: how N4SID's horizons are chosen, as `nnss_cli.methods.chosen_horizon` says.

    Raises:
        InputError: the records allow no model of any order.
    """
    (train, val), window = data.normalised(), data.init_window
    full = high_order_model(train)
    sigma = full.hankel_singular_values()
    relative = sigma / (sigma[0] or 1.0)
    rows = []
    reason = ""
    for order in range(1, min(largest, len(sigma)) + 1):
        try:
            model = subspace_model(data, order, horizon)
            errors: tuple[float | None, ...] = tuple(simulation_rms(model, part, window) for part in (train, val))
        except NUMERICAL as error:
            errors, reason = (None, None), reason or str(error)
        rows.append(OrderRow(order, float(relative[order - 1]), *errors))
    if all(row.val is None for row in rows):
        raise InputError(f"{data.dataset}: no order up to {largest} gives a model; of order 1: {reason}")
    return rows


def suggest_order(rows: Sequence[OrderRow]) -> int:
    """The lowest order whose validation error is within 5 % of the lowest of all."""
    valid = [(row.order, row.val) for row in rows if row.val is not None]
    lowest = min(val for _, val in valid)
    return next(order for order, val in valid if val <= MARGIN * lowest)
