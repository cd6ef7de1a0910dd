"""Files of named arrays (MAT v5 and v7.3, NPZ, HDF5) as tables. Nothing in them is unpickled or followed elsewhere.

Time runs along the first axis. An array of K, K×1 or MATLAB's 1×K is the column of its name; K×c, c ≤ K, gives the
columns name1 … namec. What is no array of real numbers (structs, iddata, cells, text, objects) nor, in NPZ, of times is
left out, and so is every array of another length than the others: `Left out` says why, should such a one be asked for.
"""

from __future__ import annotations

import math
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from nnss_cli.datasets.textfile import LARGEST, check_names
from numpy.typing import NDArray

from nnss_cli.errors import InputError

_HDF5 = b"\x89HDF\r\n\x1a\n"
_MATLAB_NUMBERS = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}


@dataclass(frozen=True)
class Variable:
    """One array of a file, not yet read."""

    name: str
    """Its name in the file."""
    shape: tuple[int, ...]
    """Its shape, time first."""
    load: Callable[[], NDArray[Any]] | None
    """Reads it; None where it cannot be a column."""
    reason: str = ""
    """Why it cannot."""

    def columns(self) -> list[str]:
        """Names of the columns it gives."""
        count = 1 if len(self.shape) == 1 or 1 in self.shape else self.shape[1]
        return [self.name] if count == 1 else [f"{self.name}{i + 1}" for i in range(count)]

    @property
    def length(self) -> int:
        """Samples K."""
        return max(self.shape) if 1 in self.shape else self.shape[0]


def as_table(variables: Sequence[Variable], path: Path, wanted: Sequence[str | int] | None) -> pd.DataFrame:
    """The columns of one length as a table, index 1 … K; `attrs["left out"]` tells of each other array why.

    The length is that of the `wanted` columns if they are given by name, else the longest that two columns
    share, else the longest; scalars are columns where there is nothing else.

    Raises:
        InputError: no array of numbers, two columns of one name, wanted columns of different lengths, or
            more data than fits.
    """
    source = f"'{path.name}'"
    found = [variable if variable.reason else _shaped(variable) for variable in variables]
    left_out = {variable.name: variable.reason for variable in found if variable.reason}
    usable = [variable for variable in found if not variable.reason]
    if not usable:
        told = "; ".join(f"'{name}': {reason}" for name, reason in left_out.items()) or "it is empty"
        raise InputError(f"{source} holds no array of numbers to take as a signal: {told}")
    lengths = {name: variable.length for variable in usable for name in variable.columns()}
    check_names([name for variable in usable for name in variable.columns()], source)
    length = _length(lengths, wanted or (), source)
    chosen = [variable for variable in usable if variable.length == length]
    for variable in usable:
        if variable.length != length:
            left_out |= dict.fromkeys(variable.columns(), f"{variable.length} samples, where the others have {length}")
    if sum(math.prod(variable.shape) for variable in chosen) * 8 > LARGEST:
        raise InputError(f"{source}: its arrays take more than {LARGEST >> 30} GiB: cut the file into parts")
    data: dict[str, NDArray[Any]] = {}
    for variable in chosen:
        assert variable.load is not None
        values = variable.load()
        if values.dtype.kind == "c":  # MAT v5 tells only with the values
            left_out[variable.name] = "complex numbers"
            continue
        values = values if values.dtype.kind in "mM" else values.astype(np.float64)
        data |= zip(variable.columns(), values.reshape(length, -1).T, strict=True)
    table = pd.DataFrame(data, index=pd.RangeIndex(1, length + 1))
    table.attrs["left out"] = left_out
    return table


def _shaped(variable: Variable) -> Variable:
    shape = variable.shape
    reason = ""
    if math.prod(shape) == 0:
        reason = "empty"
    elif len(shape) not in (1, 2):
        reason = f"{len(shape)} dimensions" if shape else "a single number"
    elif len(shape) == 2 and 1 < shape[0] < shape[1]:
        reason = f"{shape[0]}×{shape[1]}, and time must run along the first axis: transpose it"
    return Variable(variable.name, shape, variable.load, reason)


def _length(lengths: dict[str, int], wanted: Sequence[str | int], source: str) -> int:
    asked = [name for name in wanted if isinstance(name, str) and name in lengths]
    for name in asked:
        if lengths[name] != lengths[asked[0]]:
            raise InputError(
                f"{source}: columns differ in length: '{asked[0]}' has {lengths[asked[0]]} samples, "
                f"'{name}' has {lengths[name]}: take columns of one length"
            )
    if asked:
        return lengths[asked[0]]
    signals = [length for length in lengths.values() if length > 1] or [1]  # scalars beside them are settings
    shared = [length for length, count in Counter(signals).items() if count > 1]
    return max(shared or signals)


def npz_variables(path: Path) -> Iterator[Variable]:
    """The arrays of a NumPy archive, from their headers."""
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            with archive.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                if version == (1, 0):
                    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
                elif version == (2, 0):
                    shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
                else:
                    yield Variable(name, (), None, f"format {version[0]}.{version[1]} is of records, not numbers")
                    continue
                start = stream.tell()
            if dtype.kind not in "fiubM" and not _elapsed(dtype):
                kind = (
                    "Python objects, which are never loaded" if dtype.hasobject else f"type {dtype}, not real numbers"
                )
                yield Variable(name, shape, None, kind)
                continue
            if member.file_size != start + math.prod(shape) * dtype.itemsize:
                raise InputError(
                    f"'{path.name}': array '{name}' announces {shape} numbers of {dtype.itemsize} bytes "
                    f"and holds {member.file_size - start} bytes: the file is damaged"
                )
            yield Variable(name, shape, lambda member=member: _npy(path, member))  # type: ignore[misc]


def _elapsed(dtype: np.dtype[Any]) -> bool:
    """Whether an array holds elapsed times in a unit of so many nanoseconds, as a month is not."""
    return dtype.kind == "m" and np.datetime_data(dtype)[0] in ("W", "D", "h", "m", "s", "ms", "us", "ns")


def _npy(path: Path, member: zipfile.ZipInfo) -> NDArray[Any]:
    with zipfile.ZipFile(path) as archive, archive.open(member) as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def is_hdf5(path: Path) -> bool:
    """Whether the file is HDF5, as MAT v7.3 is behind a header of 512 bytes."""
    with path.open("rb") as stream:
        start = stream.read(520)
    return start.startswith(_HDF5) or start[512:] == _HDF5


def mat_variables(path: Path) -> Iterator[Variable]:
    """The variables of a MAT file up to v7, from their headers."""
    from scipy.io import loadmat, whosmat

    for name, shape, kind in whosmat(path, appendmat=False):
        if kind in _MATLAB_NUMBERS:
            yield Variable(
                name, shape, lambda name=name: loadmat(path, variable_names=[name], appendmat=False)[name]  # type: ignore[misc]
            )  # fmt: skip
        else:
            yield Variable(name, shape, None, _matlab_kind(kind))


def _matlab_kind(kind: str) -> str:
    if kind in ("opaque", "object"):
        return "a MATLAB object (iddata, timetable, …): save its fields as plain arrays"
    return f"MATLAB class {kind}, not an array of numbers"


def hdf5_variables(file: Any, matlab: bool) -> list[Variable]:
    """The data sets of an open HDF5 file, those in groups as group/name; links to other files are not followed."""
    found: list[Variable] = []

    def visit(name: str, item: Any) -> None:
        if matlab and (name.startswith("#") or "/" in name):
            return  # MATLAB keeps the parts of cells and structs there
        kind = item.attrs.get("MATLAB_class", b"double")
        kind = kind.decode() if isinstance(kind, bytes) else str(kind)
        if not hasattr(item, "shape"):  # a group
            if matlab:
                found.append(Variable(name, (), None, _matlab_kind(kind if "MATLAB_class" in item.attrs else "struct")))
        elif matlab and kind not in _MATLAB_NUMBERS:
            found.append(Variable(name, (), None, _matlab_kind(kind)))
        elif matlab and "MATLAB_empty" in item.attrs:
            found.append(Variable(name, (), None, "empty"))
        elif item.dtype.kind not in "fiub" or item.shape is None:
            found.append(Variable(name, (), None, f"type {item.dtype}, not real numbers"))
        elif item.external or item.is_virtual:
            found.append(Variable(name, (), None, "its samples are in another file"))
        elif matlab:  # stored by columns
            found.append(Variable(name, item.shape[::-1], lambda: item[()].T))
        else:
            found.append(Variable(name, item.shape, lambda: item[()]))

    file.visititems(visit)
    return found
