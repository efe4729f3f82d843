"""JAX settings for public functions, in their threads too, whatever settings the calling program uses.

Impact times need 64 bits. NaNs, broadcasts and transfers between host and device are intended within a public function.
The program's own settings are restored when the function returns or raises.
"""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any, ParamSpec, TypeVar

import jax
from jax.extend import backend

from vijax.runtime import fork_safety
from vijax.runtime.compilation.cache_folder import keep_programs
from vijax.runtime.compilation.compile_notice import notify_slow_compile
from vijax.runtime.doc_pages import see
from vijax.runtime.garbage_collection import infrequent_collection

P = ParamSpec("P")
T = TypeVar("T")

# For each JAX setting: its context manager and its permitted values. If the program uses another value, the first
# permitted value is set.
_REQUIRED_SETTINGS: dict[str, tuple[Callable[[Any], Any], tuple[Any, ...]]] = {
    "jax_enable_x64": (jax.enable_x64, (True,)),
    "jax_debug_nans": (jax.debug_nans, (False,)),
    "jax_debug_infs": (jax.debug_infs, (False,)),
    "jax_numpy_rank_promotion": (jax.numpy_rank_promotion, ("allow",)),
    "jax_transfer_guard_host_to_device": (jax.transfer_guard_host_to_device, ("allow", None)),
    "jax_transfer_guard_device_to_device": (jax.transfer_guard_device_to_device, ("allow", None)),
    "jax_transfer_guard_device_to_host": (jax.transfer_guard_device_to_host, ("allow", None)),
}


def public_api(function: Callable[P, T]) -> Callable[P, T]:
    """Make a function public (decorator): it runs under vijax's settings, in a process where JAX can run."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if fork_safety.ForkState.orphaned:
            raise RuntimeError(
                see(
                    "programs",
                    "vijax must not be called in a process that was forked after JAX had started, where it would hang; "
                    'start workers by multiprocessing\'s "spawn", as threads, or by workers= of sweep',
                )
            )
        # Both calls have an effect only the first time in a process.
        keep_programs()
        notify_slow_compile()
        with _vijax_settings(args, kwargs), infrequent_collection():
            try:
                return function(*args, **kwargs)
            # JAX raises these errors if the configured platform does not exist; `_check_platform` then raises a clear
            # error instead.
            except (AssertionError, RuntimeError):
                _check_platform()
                raise

    return call


def pool(threads: int) -> ThreadPoolExecutor:
    """Return a thread pool with vijax's settings and the caller's preferred device, as JAX stores both per thread."""
    device = jax.default_device.value

    def begin() -> None:
        # Never exited: the settings belong to the thread and end with it.
        _vijax_settings().__enter__()
        jax.default_device(device).__enter__()

    return ThreadPoolExecutor(threads, initializer=begin)


def start_in_thread(work: Callable[..., Any], *args: Any, **named: Any) -> None:
    """Start a call in a thread of its own, under vijax's settings; the call's result or exception is dropped."""
    thread = pool(1)
    thread.submit(work, *args, **named)
    thread.shutdown(wait=False)


def _vijax_settings(*arguments: Any) -> ExitStack:
    """Set the settings that differ from vijax's; they are restored when the returned stack is closed."""
    stack = ExitStack()
    for name, (setting, values) in _REQUIRED_SETTINGS.items():
        if getattr(jax.config, name) not in values:
            if name == "jax_enable_x64":
                _check_untraced(arguments)
            stack.enter_context(setting(values[0]))
    return stack


def _check_untraced(arguments: Any) -> None:
    """Raise ValueError if arguments are traced with 32 bits, as results then have 32 bits under any later setting."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments)):
        raise ValueError(
            see(
                "programs",
                "jax_enable_x64 must be True where a program traces vijax by jit, grad or vmap; got False; set it by "
                'jax.config.update("jax_enable_x64", True), or trace within jax.enable_x64(True)',
            )
        )


def _check_platform() -> None:
    """Raise OSError if JAX is configured for a platform that this machine does not have."""
    platforms = jax.config.values["jax_platforms"]
    if not platforms:
        return
    try:
        backend.get_backend()
    except (AssertionError, RuntimeError) as error:
        cause = f" ({error})" if str(error) else ""
        raise OSError(
            f"JAX_PLATFORMS must name a platform that this machine has; got {platforms!r}{cause}; "
            "unset it, or set it to cpu"
        ) from None
