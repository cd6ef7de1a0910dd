"""What every method must obey, whatever it is: adding one to the package adds it here."""

import pytest

from nnss_cli.methods import METHODS
from nnss_cli.testing import MethodLaws


@pytest.mark.parametrize("subject", METHODS.built_in.values(), ids=METHODS.built_in)
class TestBuiltIn(MethodLaws):
    """Every method of nnss itself, as plug-ins are tested."""

    overrides = {  # noqa: RUF012 - never changed
        "hidden": (6,), "encoder": (3,), "window": 12, "stride": 4, "batch": 4, "epochs": 3, "dtype": "float64",
    }  # fmt: skip
