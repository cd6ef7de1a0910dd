"""Options of methods as a command line changes them: for all methods that have them, or for one."""

from collections.abc import Mapping
from typing import Any

import pytest

from nnss_cli.errors import InputError
from nnss_cli.experiment.changes import gathered

FLAGS = {"hidden": "--hidden", "horizon": "--horizon", "kernel": "--kernel", "window": "--window"}


def found(flags: Mapping[str, Any], assignments: list[str], *names: str) -> dict[str, Any]:
    return gathered(flags, assignments, names, FLAGS)


def test_flags_and_assignments_are_gathered_by_name() -> None:
    assert found({}, [], "nnss") == {}
    assert found({"hidden": (3,)}, ["simba.window=40", "n4sid.horizon=matlab"], "nnss", "simba", "n4sid") == {
        "hidden": (3,), "simba.window": 40, "n4sid.horizon": "matlab",
    }  # fmt: skip
    assert found({}, ["nnss.hidden=3,4"], "nnss-ensemble") == {"nnss.hidden": (3, 4)}  # its members run
    assert found({"window": 9}, ["n4sid.horizon=matlab"], "simba", "n4sid") == {"window": 9, "n4sid.horizon": "matlab"}
    assert found({"kernel": "tc"}, []) == {"kernel": "tc"}  # the usual methods run where none is named


@pytest.mark.parametrize(
    ("flags", "assignments", "names", "message"),
    [
        ({"kernel": "tc"}, [], ("nnss", "n4sid"),
         "--kernel: no chosen method (nnss, n4sid) has the option 'kernel'; ssregest has it"),
        ({"horizon": "auto"}, [], ("nnss-ensemble",),
         "--horizon: no chosen method (nnss-ensemble, nnss) has the option 'horizon'; simba, n4sid have it"),
        ({}, ["nnss.epochs=1", "nnss.epochs=2"], ("nnss",), "--set nnss.epochs is given twice: give it once"),
        ({"window": 3}, ["nnss.window=2"], ("nnss",),
         "--window and --set nnss.window are the same option: give one of them"),
        ({}, ["nnss.epochs"], ("nnss",),
         "--set: expected METHOD.OPTION=VALUE, such as nnss.OPTION=VALUE, found 'nnss.epochs'"),
        ({}, ["epochs=1"], ("simba", "nnss"),
         "--set: expected METHOD.OPTION=VALUE, such as simba.OPTION=VALUE, found 'epochs=1'"),
        ({}, ["nnss.=1"], ("nnss",), "--set: expected METHOD.OPTION=VALUE, such as nnss.OPTION=VALUE, found 'nnss.=1'"),
        ({}, ["nnsss.epochs=1"], ("nnss",),
         "--set nnsss.epochs: unknown method 'nnsss': did you mean 'nnss'? choose from nnss, nnss-ensemble, "
         "nnss-clipped, nnss-paper, simba, n4sid, ssest, ssregest"),
        ({}, ["zzz.epochs=1"], ("nnss",), "--set zzz.epochs: unknown method 'zzz': choose from nnss, nnss-ensemble, "
         "nnss-clipped, nnss-paper, simba, n4sid, ssest, ssregest"),
        ({}, ["nnss-ensemble.epochs=1"], ("nnss-ensemble",),
         "--set nnss-ensemble.epochs: nnss-ensemble combines runs of nnss: --set nnss.epochs=1"),
        ({}, ["n4sid.horizn=1"], ("n4sid",),
         "--set n4sid.horizn: unknown option 'horizn' of n4sid: did you mean 'horizon'? choose from horizon"),
        ({}, ["n4sid.horizon=matlab"], ("nnss", "simba"),
         "--set n4sid.horizon: n4sid is not among the methods that run (nnss, simba)"),
        ({}, ["nnss.epochs=many"], ("nnss",), "--set nnss.epochs: expected a whole number, found 'many'"),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused_in_one_line(
    flags: dict[str, Any], assignments: list[str], names: tuple[str, ...], message: str
) -> None:
    with pytest.raises(InputError) as refused:
        found(flags, assignments, *names)
    assert str(refused.value) == message
