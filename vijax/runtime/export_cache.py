"""Programs that are traced once: what tracing makes of them is kept on disk, beside what JAX keeps of compiling it.

Tracing and lowering the program of a plane takes two seconds of every process, more than running a small plane, and the
small programs that find an orbit take one together. What comes of it depends on the program, on the shapes of its
arguments, on these sources, on JAX, on the platform that programs are made for (`xla.platform`), and on whether kernels
are wanted (`xla.KERNELS`), alone.
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

from vijax.runtime import cache_folder, structures, xla
from vijax.runtime.files import replacing

# Distributions whose code a trace goes through, down to those that jax and diffrax stand on.
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
_PACKAGE = Path(__file__).parents[1]
_DIGEST = hashlib.sha256
_LENGTH = 4  # bytes that hold how long the text of a structure is
# Kernels of `registers` may be kept, though no other JAX is sure to read them: a program is kept for one alone.
KERNEL = export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.triton")


class _Traced(NamedTuple):
    """A traced program of lists of arrays, and a pytree of the structure of its results."""

    program: export.Exported
    results: Any


class TracedProgram:
    """A function of pytrees of arrays to such a one, compiled for every shape of its arguments, as `jax.jit` does.

    Where JAX keeps compiled programs (`jax_compilation_cache_dir`), its traced form is kept, too.

    Args:
        work: The function.
        name: What it depends on besides its arguments, as text that is the same in every process.
    """

    def __init__(self, work: Callable[..., Any], name: str):
        self._work, self._name = work, name
        self._compiled: dict[Any, Callable[..., Any]] = {}
        self._lock = Lock()

    def __call__(self, *args: Any, brief: bool = False) -> Any:
        """Call the function, by the program for arguments of these shapes.

        Args:
            args: Pytrees of arrays.
            brief: Whether the program runs so briefly that its compilation is what it costs.
        """
        leaves, tree = jax.tree.flatten(args)
        platform = _platform(leaves)
        key = platform, tree, tuple((x.shape, x.dtype) for x in leaves)
        with self._lock:
            if key not in self._compiled:
                self._compiled[key] = self._jitted(platform, tree, leaves, brief)
        return self._compiled[key](*leaves)

    def _jitted(self, platform: str, tree: Any, leaves: list[Any], brief: bool) -> Callable[..., Any]:
        def flat(*leaves):
            return self._work(*jax.tree.unflatten(tree, leaves))

        options, folder = xla.compiler_options(brief=brief), cache_folder.kept()
        if folder is None or not _ours(tree):
            return jax.jit(flat, compiler_options=options)
        shapes = tuple((x.shape, str(x.dtype)) for x in leaves)
        name = f"{self._name} {(platform, tree, shapes)} {xla.platform()} {xla.KERNELS} {source_digest()}"
        path = folder / f"{cache_folder.TRACED}{_DIGEST(name.encode()).hexdigest()}"
        known = _read(path)
        if known is None:
            known = _trace(flat, platform, leaves)
            _write(path, known)
        call, results = jax.jit(known.program.call, compiler_options=options), jax.tree.structure(known.results)
        return lambda *leaves: jax.tree.unflatten(results, call(*leaves))


def _platform(leaves: list[Any]) -> str:
    """Say where the arguments of a program are; NumPy's arrays are wherever JAX computes by default.

    A device calls itself a GPU, where a program that is exported asks for the maker's platform.
    """
    devices = (device for x in leaves if isinstance(x, jax.Array) for device in x.devices())
    platform = next((device.platform for device in devices), xla.platform())
    return export.default_export_platform() if platform == jax.default_backend() else platform


def _trace(flat: Callable[..., Any], platform: str, leaves: list[Any]) -> _Traced:
    trees = []

    def listed(*leaves):
        results, tree = jax.tree.flatten(flat(*leaves))
        trees.append(tree)
        return results

    program = export.export(jax.jit(listed), platforms=[platform], disabled_checks=[KERNEL])(*leaves)
    return _Traced(program, jax.tree.unflatten(trees[0], range(trees[0].num_leaves)))


def _ours(tree: Any) -> bool:
    """Say whether no record in a tree of arguments is somebody else's, whose sources the digest does not see."""
    node = tree.node_data()
    known = node is None or node[0].__module__.split(".")[0] in ("builtins", _PACKAGE.name)
    return known and all(map(_ours, tree.children()))


@lru_cache(maxsize=1)
def source_digest(package: Path = _PACKAGE) -> str:
    """Digest what tracing depends on: this package with all its folders, and those that trace it."""
    digest = _DIGEST(" ".join(map(version, TRACED_BY)).encode())
    for path in sorted(package.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _read(path: Path) -> _Traced | None:
    """Read the program there; None if it is missing, not trusted, damaged, or the program of another key."""
    content = cache_folder.read(path)
    if content is None:
        return None
    digest, body = content[: _DIGEST().digest_size], content[_DIGEST().digest_size :]
    if _signed(path, body) != digest:
        return None
    length = int.from_bytes(body[:_LENGTH], "little")
    structure, program = body[_LENGTH : _LENGTH + length], body[_LENGTH + length :]
    try:
        return _Traced(export.deserialize(bytearray(program)), structures.from_json(structure))
    except Exception:  # flatbuffers raises errors of many kinds
        return None


def _write(path: Path, known: _Traced) -> None:
    """Keep a program if its results can be rebuilt; where nothing can be written, the next process traces it again."""
    structure = structures.to_json(known.results)
    if structure is None:
        return
    text = structure.encode()
    body = len(text).to_bytes(_LENGTH, "little") + text + known.program.serialize()
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with replacing(path) as part:
            descriptor = os.open(part, os.O_WRONLY | os.O_NOFOLLOW)
            with open(descriptor, "wb") as file:
                os.fchmod(descriptor, 0o600)
                file.write(_signed(path, body) + body)
    except OSError:
        return


def _signed(path: Path, body: bytes) -> bytes:
    """Digest the content of a file together with its name, which is the digest of what the program depends on."""
    return _DIGEST(path.name.encode() + body).digest()
