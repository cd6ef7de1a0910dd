"""What every method must obey, whatever it is: adding one to the package adds it here."""

import pytest
from conftest import marks_of

from nnss_cli.methods import METHODS
from nnss_cli.testing import MethodLaws

SUBJECTS = [pytest.param(method, id=name, marks=marks_of(name)) for name, method in METHODS.built_in.items()]


@pytest.mark.parametrize("subject", SUBJECTS)
class TestBuiltIn(MethodLaws):
    """Every method of nnss itself, as plug-ins are tested."""

    overrides = {  # noqa: RUF012 - never changed
        "hidden": (6,), "encoder": (3,), "window": 12, "stride": 4, "batch": 4, "epochs": 3, "dtype": "float64",
    }  # fmt: skip
