"""Settings of JAX that a public function runs under, in its threads too, whatever the program around it has set.

Impact times need 64 bits. NaNs, broadcasts and transfers between host and device within a public function are intended.
A program's own settings are restored when the function returns or raises.
"""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any, ParamSpec, TypeVar

import jax
from jax.extend import backend

from vijax.runtime import forks
from vijax.runtime.cache_folder import keep_programs
from vijax.runtime.garbage import seldom_collected
from vijax.runtime.pages import see
from vijax.runtime.waiting import tell_of_compilation

P = ParamSpec("P")
T = TypeVar("T")

# The context manager of each setting, and the values that may stay as they are, the one that is set otherwise first.
_HELD: dict[str, tuple[Callable[[Any], Any], tuple[Any, ...]]] = {
    "jax_enable_x64": (jax.enable_x64, (True,)),
    "jax_debug_nans": (jax.debug_nans, (False,)),
    "jax_debug_infs": (jax.debug_infs, (False,)),
    "jax_numpy_rank_promotion": (jax.numpy_rank_promotion, ("allow",)),
    "jax_transfer_guard_host_to_device": (jax.transfer_guard_host_to_device, ("allow", None)),
    "jax_transfer_guard_device_to_device": (jax.transfer_guard_device_to_device, ("allow", None)),
    "jax_transfer_guard_device_to_host": (jax.transfer_guard_device_to_host, ("allow", None)),
}


def door(function: Callable[P, T]) -> Callable[P, T]:
    """Make a function public: it runs under the settings that vijax stands on, where JAX can run at all."""

    @functools.wraps(function)
    def through(*args: P.args, **kwargs: P.kwargs) -> T:
        if forks.Process.orphaned:
            raise RuntimeError(
                see(
                    "programs",
                    "vijax must not be called in a process that was forked after JAX had started, where it would hang; "
                    'start workers by multiprocessing\'s "spawn", as threads, or by workers= of sweep',
                )
            )
        keep_programs()
        tell_of_compilation()
        with _held(args, kwargs), seldom_collected():
            try:
                return function(*args, **kwargs)
            except (AssertionError, RuntimeError):
                _check_platform()
                raise

    return through


def pool(threads: int) -> ThreadPoolExecutor:
    """Make threads that work under these settings, and on the device that is preferred here: JAX has both by thread."""
    device = jax.default_device.value

    def begin() -> None:
        _held().__enter__()
        jax.default_device(device).__enter__()

    return ThreadPoolExecutor(threads, initializer=begin)


def beside(work: Callable[..., Any], *args: Any, **named: Any) -> None:
    """Begin a piece of work in a thread of its own, under these settings; what it returns, or raises, is dropped."""
    thread = pool(1)
    thread.submit(work, *args, **named)
    thread.shutdown(wait=False)


def _held(*given: Any) -> ExitStack:
    """Set the settings that differ from those of the program, which come back at the end."""
    stack = ExitStack()
    for name, (setting, values) in _HELD.items():
        if getattr(jax.config, name) not in values:
            if name == "jax_enable_x64":
                _check_untraced(given)
            stack.enter_context(setting(values[0]))
    return stack


def _check_untraced(given: Any) -> None:
    """Raise where 32 bits are traced: what is made of them has 32 too, whatever is set in between."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(given)):
        raise ValueError(
            see(
                "programs",
                "jax_enable_x64 must be True where a program traces vijax by jit, grad or vmap; got False; set it by "
                'jax.config.update("jax_enable_x64", True), or trace within jax.enable_x64(True)',
            )
        )


def _check_platform() -> None:
    """Raise if JAX was told of a platform that is not here."""
    asked = jax.config.values["jax_platforms"]
    if not asked:
        return
    try:
        backend.get_backend()
    except (AssertionError, RuntimeError) as error:
        cause = f" ({error})" if str(error) else ""
        raise OSError(
            f"JAX_PLATFORMS must name a platform that this machine has; got {asked!r}{cause}; unset it, or take cpu"
        ) from None
