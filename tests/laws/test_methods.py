"""What every method must obey, whatever it is: adding one to the package adds it here."""

import pytest

from nnss_cli.methods import METHODS
from nnss_cli.testing import MethodLaws

OF_MEMBERS = [name for name, method in METHODS.built_in.items() if method.members]
# those that are made of others' runs differ in a rule alone: one of them will do, and its fits are those of its member
MARKS = dict(zip(OF_MEMBERS, [pytest.mark.system, *[pytest.mark.slow] * len(OF_MEMBERS)], strict=False))
SUBJECTS = [
    pytest.param(method, id=name, marks=[MARKS[name]] if name in MARKS else [])
    for name, method in METHODS.built_in.items()
]


@pytest.mark.parametrize("subject", SUBJECTS)
class TestBuiltIn(MethodLaws):
    """Every method of nnss itself, as plug-ins are tested."""

    overrides = {  # noqa: RUF012 - never changed
        "hidden": (6,), "encoder": (3,), "window": 12, "stride": 4, "batch": 4, "epochs": 3, "dtype": "float64",
    }  # fmt: skip
