"""The processes of the tests start with whatever XLA is installed."""

import pytest

from tests.xla_flags import known_flags

KNOWN = ("--xla_backend_optimization_level=0", "--xla_disable_hlo_passes=algsimp,hlo-verifier")


@pytest.mark.parametrize("unknown", [(), ("--xla_no_such_flag=1",), ("--xla_no_such_flag=1", "--xla_nor_this=a,b")])
def test_flags_that_the_installed_xla_does_not_know_are_left_out(unknown):
    assert known_flags((*unknown, *KNOWN)) == KNOWN


def test_another_failure_is_shown():
    with pytest.raises(RuntimeError, match="XLA must start with the flags of the tests"):
        known_flags(("--xla_backend_optimization_level=three",))
