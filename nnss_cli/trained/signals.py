"""Signals as a user has them (numbers, lists, arrays, pandas) as the arrays that a model takes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.errors import InputError


def as_samples(what: str, values: Any, names: Sequence[str]) -> FloatArray:
    """Samples × channels (K, c), float64, of what may be a number, a list, an array or a pandas object.

    A table with columns is taken by the channels' names. One dimension is K samples of the only channel, or one
    sample of c channels where that is the only reading.

    Args:
        what: name of the argument, for messages.
        values: the samples.
        names: of the c channels.

    Raises:
        InputError: other columns or another number of channels, no samples, or one that is no finite number.
    """
    columns = getattr(values, "columns", None)
    if columns is not None:
        found = [str(column) for column in columns]
        missing = [name for name in names if name not in found]
        if missing:
            raise InputError(
                f"{what}: expected the columns {', '.join(names)}, found {', '.join(found)}: rename them as the "
                "model's channels, or give an array, samples × channels"
            )
        values = values[list(columns[[found.index(name) for name in names]])]
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: expected numbers, samples × channels: {error}") from error
    c = len(names)
    if array.ndim == 0:
        array = array[None]
    if array.ndim == 1 and c == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] != c or not len(array):
        across = " (transposed?)" if array.ndim == 2 and array.shape[0] == c else ""
        raise InputError(
            f"{what}: expected samples × {c} for {', '.join(names)}, found an array of shape {np.shape(values)}{across}"
        )
    if not np.isfinite(array).all():
        k, i = np.argwhere(~np.isfinite(array))[0]
        raise InputError(
            f"{what}: sample {k} of '{names[i]}' is {array[k, i]}; expected finite numbers, so cut or repair it there"
        )
    return array


def as_values(what: str, values: Any, names: Sequence[str]) -> FloatArray:
    """One value for each of c channels (c,): a number where there is one, else a list or an array.

    A pandas Series, such as a row of a table, is taken by the channels' names where its index holds them.

    Raises:
        InputError: another number of values, or one that is no finite number.
    """
    index = [str(label) for label in getattr(values, "axes", [()])[0]]
    if set(names) <= set(index):
        values = [values.iloc[index.index(name)] for name in names]
    try:
        array = np.array(values, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: expected a number for each of {', '.join(names)}: {error}") from error
    if array.shape != (len(names),) or not np.isfinite(array).all():
        raise InputError(f"{what}: expected a finite number for each of {', '.join(names)}, found {values!r:.80}")
    return array
