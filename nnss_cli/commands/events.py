"""What commands tell machines: one JSON object a line on stdout, in the place of what they tell people."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

import typer

_JSON: ContextVar[bool] = ContextVar("json", default=False)


@contextlib.contextmanager
def emitting(asked: bool) -> Iterator[None]:
    """Within it events are printed, if that is asked for."""
    token = _JSON.set(asked)
    try:
        yield
    finally:
        _JSON.reset(token)


def emit(event: str, **fields: Any) -> None:
    """Tell of an event, if anybody asked for JSON; numbers that are not finite are null, as JSON has none."""
    if _JSON.get():
        typer.echo(json.dumps({"event": event} | {name: _plain(value) for name, value in fields.items()}))


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return value if isinstance(value, str | int | bool | None) else str(value)
