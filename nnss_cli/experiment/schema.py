"""What a run on disk must be: its run.json by itself, beside the folder that it lies in, and beside its signals."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from nnss_cli.datasets.record import Channels
from nnss_cli.experiment.run import RunResult
from nnss_cli.methods import METHODS
from nnss_cli.modelfile import Tensors

if TYPE_CHECKING:
    from pydantic import TypeAdapter

SAME_SCORE = 1e-9  # relative: sums may be taken in another order elsewhere


def parse_result(text: bytes) -> RunResult:
    """A finished run from the content of its run.json.

    Raises:
        ValueError: no JSON, a field is missing, unknown or of another type, or the fields contradict each other.
    """
    with _one_line():
        result = _adapter(RunResult).validate_json(text, strict=True)
        channels = _adapter(Channels).validate_python(result.channels)
    _require(isinstance(result, RunResult) and isinstance(channels, Channels), "it is no run")
    method = METHODS.built_in.get(result.spec.method)
    if method is not None:
        result = replace(result, spec=replace(result.spec, settings=method.current(result.spec.settings)))
    _require(result.spec.order >= 1 and result.spec.seed >= 0, "order and seed: expected at least 1 and 0")
    _require(
        bool(result.reason) != (result.status == "ok"),
        "reason: expected one where the status is not ok, and only there",
    )
    _require(
        bool(result.scores) == (result.status == "ok"), "scores: expected some where the status is ok, and only there"
    )
    counts = {len(channels.outputs), len(channels.output_units)}
    _require(len(counts) == 1 and len(channels.inputs) == len(channels.input_units), "channels: a unit each")
    outputs = {f"y{index + 1}" for index in range(len(channels.outputs))}
    for split in dict.fromkeys(score.split for score in result.scores):
        own = [score for score in result.scores if score.split == split]
        _require(
            sorted(score.output for score in own) == sorted(outputs),
            f"scores of '{split}': expected one for each output",
        )
    for score in result.scores:
        values = (score.rmse, score.nrmse, score.fit_percent)
        _require(
            all(map(math.isfinite, values)) and min(values[:2]) >= 0,
            "scores: expected finite errors, not negative, found "
            f"rmse {score.rmse}, nrmse {score.nrmse}, fit_percent {score.fit_percent} ({score.split}, {score.output})",
        )
    return result


def validated(kind: type, content: Any) -> Any:
    """A dataclass from plain data that was read from disk.

    Raises:
        ValueError: a field is missing, unknown or of another type.
    """
    with _one_line():
        return _adapter(kind).validate_json(json.dumps(content), strict=True)


@contextmanager
def _one_line() -> Iterator[None]:
    from pydantic import ValidationError

    try:
        yield
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        found = first["input"]
        if isinstance(found, bytes):  # all of a file that is no JSON
            found = " ".join(found[:200].decode(errors="replace").split())
        where, what = ".".join(map(str, first["loc"])), " ".join(first["msg"].split())
        raise ValueError(f"{f'{where}: ' if where else ''}{what}, found {found!r:.80}") from error


def check_place(result: RunResult, dataset: str, protocol: str, label: str) -> None:
    """Refuse a run that lies in another one's folder.

    Raises:
        ValueError: its spec disagrees with where it lies.
    """
    found, expected = (result.spec.dataset, result.spec.protocol, result.spec.label), (dataset, protocol, label)
    _require(found == expected, f"spec: expected {'/'.join(expected)} in this folder, found {'/'.join(found)}")


def check_signals(result: RunResult, signals: Tensors) -> None:
    """Refuse signals that are not those that were scored.

    The first samples are not scored where several of them tell x(0); how many that were is not kept, so that
    any number of them may explain a score.

    Raises:
        ValueError: one is missing, of another shape or type, or gives another score.
    """
    Ts = signals.get("Ts")
    _require(
        Ts is not None and Ts.shape == (1,) and Ts.dtype.kind == "f" and bool(Ts[0] > 0), "Ts: expected one number"
    )
    for split in dict.fromkeys(score.split for score in result.scores):
        errors = []
        for index in range(sum(name.startswith(f"{split}/") and name.endswith("/y") for name in signals)):
            parts = [signals.get(f"{split}/{index}/{name}") for name in ("u", "y", "y_sim", "x")]
            shaped = all(part is not None and part.ndim == 2 and part.dtype.kind == "f" for part in parts)
            _require(shaped, f"{split}/{index}: expected u, y, y_sim and x, (K, ·) each")
            u, y, y_sim, x = (part for part in parts if part is not None)
            _require(len(u) == len(y) == len(x) and y.shape == y_sim.shape, f"{split}/{index}: of different lengths")
            with np.errstate(over="ignore", invalid="ignore"):
                errors.append(y_sim - y)
        _require(bool(errors) and all(len(error) for error in errors), f"{split}: no signals")
        for score in (score for score in result.scores if score.split == split):
            column = int(score.output[1:]) - 1
            _require(column < errors[0].shape[1], f"{split}: no output {score.output}")
            _require(
                _explained(score.rmse, [error[:, column] for error in errors]), f"{split} {score.output}: another score"
            )


def _explained(rmse: float, errors: list[np.ndarray[Any, Any]]) -> bool:
    """Whether it is the root mean square of the errors from some sample on."""
    shortest = min(map(len, errors))
    with np.errstate(over="ignore", invalid="ignore"):  # of signals that were tampered with: they explain nothing
        squares = sum(np.cumsum(error[::-1] ** 2)[::-1][:shortest] for error in errors)
    counts = sum(len(error) - np.arange(shortest) for error in errors)
    return bool(np.isclose(np.sqrt(squares / counts), rmse, rtol=SAME_SCORE, atol=0.0).any())


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ValueError(message)


@cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)
