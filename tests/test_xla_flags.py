"""The processes of the tests start with any installed version of XLA."""

import pytest

from tests.xla_flags import supported_flags

SUPPORTED = ("--xla_backend_optimization_level=0", "--xla_disable_hlo_passes=algsimp,hlo-verifier")


@pytest.mark.parametrize("unknown", [(), ("--xla_no_such_flag=1",), ("--xla_no_such_flag=1", "--xla_nor_this=a,b")])
def test_flags_that_the_installed_xla_does_not_support_are_omitted(unknown):
    assert supported_flags((*unknown, *SUPPORTED)) == SUPPORTED


def test_another_failure_is_raised():
    with pytest.raises(RuntimeError, match="XLA must start with the flags of the tests"):
        supported_flags(("--xla_backend_optimization_level=three",))
