"""Where a model comes from: kept in its folder, so that a copy of model.json and model.safetensors has it too."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nnss_cli.errors import InputError
from nnss_cli.experiment.run import FORBID, RunSpec
from nnss_cli.experiment.schema import parse_result, validated
from nnss_cli.modelfile import read_training, trained_as


@dataclass(frozen=True)
class Origin:
    """What a model was trained on and how."""

    __pydantic_config__ = FORBID

    dataset: str
    """Name of the dataset."""
    protocol: str
    """Split and statistics."""
    method: str
    """Name of the method."""
    version: str
    """Version of the method."""
    order: int
    """Number of states n."""
    seed: int
    """Seed."""
    settings: dict[str, Any]
    """Every option of the fit, resolved."""
    data: str
    """Fingerprint of all samples and statistics, tests included (`Dataset.fingerprint`)."""
    init_window: int | None
    """Output samples w from which x(0) is found; None where the folder is older than format 2 and does not tell."""
    provenance: dict[str, str]
    """Versions and machine. Times and the command are the run's, so that equal trainings give equal folders; models of
    earlier versions have them here."""
    notes: tuple[str, ...] = ()
    """What a user of the records must know, such as that a mean was taken off them."""
    remarks: tuple[str, ...] = ()
    """What the fit had to tell."""


def with_origin(
    spec: RunSpec, init_window: int, provenance: dict[str, str], notes: tuple[str, ...], remarks: tuple[str, ...]
) -> AbstractContextManager[None]:
    """Models that are saved meanwhile keep it with them."""
    origin = Origin(
        spec.dataset, spec.protocol, spec.method, spec.version, spec.order, spec.seed, spec.settings, spec.data,
        init_window, provenance, notes, remarks,
    )  # fmt: skip
    return trained_as(asdict(origin))


def read_origin(folder: Path) -> Origin | None:
    """Where the model of a folder comes from; from the run.json beside it where it is older than format 2.

    Returns:
        None where neither tells.

    Raises:
        InputError: what is there is damaged.
    """
    kept = read_training(folder)
    if kept is not None:
        try:
            origin: Origin = validated(Origin, kept)
        except ValueError as error:
            raise InputError(f"'{folder / 'model.json'}': training: {error}; train it again") from error
        return origin
    path = folder / "run.json"
    if not path.exists():
        return None
    try:
        result = parse_result(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"'{path}' is not a finished run of this version ({error}); train it again") from error
    spec = result.spec
    return Origin(
        spec.dataset, spec.protocol, spec.method, spec.version, spec.order, spec.seed, spec.settings, spec.data,
        None, result.provenance, result.notes, result.remarks,
    )  # fmt: skip
