"""Detection of forks of a process where JAX ran: its threads do not exist in the child, and every call would hang.

The detection starts with `import vijax`, before JAX is loaded unless the program has loaded it.
"""

import os
import sys


class ForkState:
    """Fork state of this process.

    Attributes:
        started: True if JAX ran in this process when the process last forked a child.
        orphaned: True if this process was forked from one where JAX ran.
    """

    started = False
    orphaned = False


def _before_fork() -> None:
    # JAX has no public function that returns whether JAX has started without starting it.
    started = getattr(sys.modules.get("jax._src.xla_bridge"), "backends_are_initialized", None)
    ForkState.started = started is not None and started()


def _after_fork_in_child() -> None:
    ForkState.orphaned = ForkState.orphaned or ForkState.started


# Not available on systems without fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_child=_after_fork_in_child)
