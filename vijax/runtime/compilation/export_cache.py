"""Programs that are traced once: the traced form is kept on disk, beside JAX's compiled programs.

To trace and lower the program of a plane takes two seconds per process, more than to run a small plane; the small
programs that solve for an orbit take one second together. The traced form depends only on the program, the shapes of
its arguments, the sources of this package, JAX, the platform of the programs (`xla.platform`), and whether kernels are
enabled (`xla.KERNELS`).
"""

import hashlib
import os
from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import jax
from jax import export

from vijax.runtime.compilation import cache_folder, structures, xla
from vijax.runtime.files import replacing

# Python distributions with code that runs during a trace, including the dependencies of jax and diffrax.
TRACED_BY = (
    "diffrax",
    "equinox",
    "jax",
    "jaxlib",
    "jaxtyping",
    "lineax",
    "ml_dtypes",
    "numpy",
    "opt_einsum",
    "optimistix",
)
_PACKAGE = Path(__file__).parents[2]
_DIGEST = hashlib.sha256
_LENGTH = 4  # bytes that store the length of the text of a structure
# Kernels of `register_kernels` may be kept although only this version of JAX is certain to read them, because the name
# of a kept program depends on the version of JAX.
KERNEL = export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.triton")


class _Traced(NamedTuple):
    """A traced program of lists of arrays, and a pytree with the structure of its results."""

    program: export.Exported
    results: Any


class TracedProgram:
    """A function of pytrees of arrays, compiled for every shape of its arguments like `jax.jit`.

    If JAX keeps compiled programs (`jax_compilation_cache_dir`), the traced form is kept, too.

    Args:
        work: The function.
        name: Everything other than its arguments that the function depends on, as text that is the same in every
            process.
    """

    def __init__(self, work: Callable[..., Any], name: str):
        self._work, self._name = work, name
        self._compiled: dict[Any, Callable[..., Any]] = {}
        self._lock = Lock()

    def __call__(self, *args: Any, brief: bool = False) -> Any:
        """Call the function with the program for arguments of these shapes.

        Args:
            args: Pytrees of arrays.
            brief: True if the program runs so briefly that its cost is its compilation.
        """
        leaves, tree = jax.tree.flatten(args)
        platform = _platform(leaves)
        key = platform, tree, tuple((x.shape, x.dtype) for x in leaves)
        # If several threads call at the same time, the program is compiled once.
        with self._lock:
            if key not in self._compiled:
                self._compiled[key] = self._jitted(platform, tree, leaves, brief)
        return self._compiled[key](*leaves)

    def _jitted(self, platform: str, tree: Any, leaves: list[Any], brief: bool) -> Callable[..., Any]:
        def flat(*leaves):
            return self._work(*jax.tree.unflatten(tree, leaves))

        options, folder = xla.compiler_options(brief=brief), cache_folder.program_folder()
        if folder is None or not _ours(tree):
            return jax.jit(flat, compiler_options=options)
        shapes = tuple((x.shape, str(x.dtype)) for x in leaves)
        name = f"{self._name} {(platform, tree, shapes)} {xla.platform()} {xla.KERNELS} {source_digest()}"
        path = folder / f"{cache_folder.TRACED}{_DIGEST(name.encode()).hexdigest()}"
        traced = _read(path)
        if traced is None:
            traced = _trace(flat, platform, leaves)
            _write(path, traced)
        call, results = jax.jit(traced.program.call, compiler_options=options), jax.tree.structure(traced.results)
        return lambda *leaves: jax.tree.unflatten(results, call(*leaves))


def _platform(leaves: list[Any]) -> str:
    """Return the platform of a program's arguments; for NumPy's arrays, JAX's default platform.

    A device names its platform "gpu", but an exported program needs the vendor's platform.
    """
    devices = (device for x in leaves if isinstance(x, jax.Array) for device in x.devices())
    platform = next((device.platform for device in devices), xla.platform())
    return export.default_export_platform() if platform == jax.default_backend() else platform


def _trace(flat: Callable[..., Any], platform: str, leaves: list[Any]) -> _Traced:
    trees = []

    def listed(*leaves):
        results, tree = jax.tree.flatten(flat(*leaves))
        # Executed while JAX traces: stores the structure of the results, which the exported program does not contain.
        trees.append(tree)
        return results

    program = export.export(jax.jit(listed), platforms=[platform], disabled_checks=[KERNEL])(*leaves)
    return _Traced(program, jax.tree.unflatten(trees[0], range(trees[0].num_leaves)))


def _ours(tree: Any) -> bool:
    """Return True if all records in a tree are vijax's, because the digest covers no sources of other packages."""
    node = tree.node_data()
    is_ours = node is None or node[0].__module__.split(".")[0] in ("builtins", _PACKAGE.name)
    return is_ours and all(map(_ours, tree.children()))


@lru_cache(maxsize=1)
def source_digest(package: Path = _PACKAGE) -> str:
    """Return a digest of the dependencies of a trace: this package's sources, and the versions of `TRACED_BY`."""
    digest = _DIGEST(" ".join(map(version, TRACED_BY)).encode())
    for path in sorted(package.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _read(path: Path) -> _Traced | None:
    """Return the stored program; None if it is missing, not trusted, damaged, or stored under another key."""
    content = cache_folder.read(path)
    if content is None:
        return None
    # A file is the digest of the rest, the length of the structure's text, that text, and the program.
    digest, body = content[: _DIGEST().digest_size], content[_DIGEST().digest_size :]
    if _signed(path, body) != digest:
        return None
    length = int.from_bytes(body[:_LENGTH], "little")
    structure, program = body[_LENGTH : _LENGTH + length], body[_LENGTH + length :]
    try:
        return _Traced(export.deserialize(bytearray(program)), structures.from_json(structure))
    except Exception:  # flatbuffers raises errors of many kinds
        return None


def _write(path: Path, traced: _Traced) -> None:
    """Store a program if its results can be rebuilt; a folder that cannot be written is ignored."""
    structure = structures.to_json(traced.results)
    if structure is None:
        return
    text = structure.encode()
    body = len(text).to_bytes(_LENGTH, "little") + text + traced.program.serialize()
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with replacing(path) as part:
            # Another user could have replaced the part by a link: it is not followed.
            descriptor = os.open(part, os.O_WRONLY | os.O_NOFOLLOW)
            with open(descriptor, "wb") as file:
                os.fchmod(descriptor, 0o600)
                file.write(_signed(path, body) + body)
    except OSError:
        return


def _signed(path: Path, body: bytes) -> bytes:
    """Return a digest of the file's content and name; the name is the digest of the program's dependencies."""
    return _DIGEST(path.name.encode() + body).digest()
