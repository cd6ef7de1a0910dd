"""Signals as a user has them (numbers, lists, arrays, pandas) as the arrays that a model takes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nnss_cli.datasets.record import FloatArray, as_floats
from nnss_cli.errors import InputError


def as_samples(what: str, values: Any, names: Sequence[str]) -> FloatArray:
    """Samples × channels (K, c), float64, of what may be a number, a list, an array or a pandas object.

    A table with columns is taken by the channels' names, and so is a row of it, a Series that holds them all, which
    is one sample. Else one dimension is K samples of the only channel, or one sample of c channels where that is the
    only reading.

    Args:
        what: name of the argument, for messages.
        values: the samples.
        names: of the c channels.

    Raises:
        InputError: other columns or another number of channels, no samples, or one that is no finite number.
    """
    columns = getattr(values, "columns", None)
    if columns is not None:
        # a label that is a number is a place, counted from 0, and not the channel '1' of a file without a header
        found = [column for column in columns if isinstance(column, str)]
        missing = [name for name in names if name not in found]
        if missing:
            numbered = " (numbers, not names)" if len(found) < len(columns) else ""
            raise InputError(
                f"{what}: expected the columns {', '.join(names)}, found {', '.join(map(str, columns))}{numbered}: "
                "rename them as the model's channels, or give an array, samples × channels"
            )
        values = values[list(names)]
    elif (row := _by_name(values, names)) is not None:
        values = [row]
    array = as_floats(what, values)
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
    named = _by_name(values, names)
    array = as_floats(what, values if named is None else named).reshape(-1)
    if array.shape != (len(names),) or not np.isfinite(array).all():
        found = " ".join(repr(values).split())  # an array's may have lines
        raise InputError(f"{what}: expected a finite number for each of {', '.join(names)}, found {found:.80}")
    return array


def _by_name(values: Any, names: Sequence[str]) -> list[Any] | None:
    """What a pandas Series holds under the channels' names; None for anything else."""
    labels = list(getattr(values, "axes", [()])[0])
    return [values.iloc[labels.index(name)] for name in names] if set(names) <= set(labels) else None
