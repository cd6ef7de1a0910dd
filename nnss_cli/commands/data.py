"""Getting a dataset ready for a command, with its options in messages and a bar for downloads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nnss_cli.commands.display import DownloadProgress
from nnss_cli.commands.record_options import RECORD_OPTIONS, option_of
from nnss_cli.datasets.description import Description
from nnss_cli.experiment import source


def ready(names: Sequence[str], protocol: str, mirror: str | None, offline: bool, own: dict[str, Any]) -> source.Ready:
    """`nnss_cli.experiment.source.ready`, for the command line.

    Raises:
        InputError: neither a benchmark nor a file, or whatever is wrong with it.
    """
    return source.ready(names, protocol, mirror, offline, own, option_of, DownloadProgress)


assert set(RECORD_OPTIONS) <= set(Description.__dataclass_fields__)
