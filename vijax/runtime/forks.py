"""Whether this process was forked from one where JAX ran: its threads are not here, and every call would hang.

Forks are watched from `import vijax` on, which is before JAX is loaded where nobody else loads it.
"""

import os
import sys


class Process:
    """What the doors know of this process.

    Attributes:
        started: Whether JAX ran here when a fork was last made.
        orphaned: Whether it was forked from one where JAX ran.
    """

    started = False
    orphaned = False


def _forks() -> None:
    # JAX has no public way to ask without starting it.
    started = getattr(sys.modules.get("jax._src.xla_bridge"), "backends_are_initialized", None)
    Process.started = started is not None and started()


def _forked() -> None:
    Process.orphaned = Process.orphaned or Process.started


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_forks, after_in_child=_forked)
