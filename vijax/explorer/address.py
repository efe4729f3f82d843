"""Where a server listens: what a port is, which addresses are of this machine alone, what an origin may be."""

import errno
import re
import socket
from typing import Any

PORT, MOST_PORT = 5006, 65535
LOCAL = ("127.0.0.1", "localhost", "::1")

# A name or a number of a machine, in brackets if it has colons, and a port: no pattern that many would fit.
_ORIGIN = re.compile(r"([A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?|\[[0-9A-Fa-f:.]+\])(:(?P<port>[0-9]{1,5}))?")


def check_listener(address: Any, port: Any, allow_origin: Any) -> tuple[str, ...]:
    """Give the origins of who may ask, if a server may listen there for them.

    Raises:
        ValueError: No port, no origin, no address, or one that others can reach without an origin.
    """
    from vijax.runtime import checks  # here, as help is written without NumPy

    checks.whole("port", port, 0, MOST_PORT)
    given = [allow_origin] if isinstance(allow_origin, str) else allow_origin
    origins = checks.sequence("allow_origin", given, str, "HOST:PORT, one or several")
    for one in origins:
        found = _ORIGIN.fullmatch(one)
        if found is None or int(found["port"] or 0) > MOST_PORT:
            must = "HOST or HOST:PORT, as it stands in the browser of who may ask"
            raise ValueError(f"allow_origin must be {must}; got {checks.shown(one)}")
    if not isinstance(address, str) or not address:
        raise ValueError(f"address must be a text, such as 127.0.0.1; got {checks.shown(address)}")
    if address not in LOCAL and not origins:
        raise ValueError(
            f"address must come with allow_origin where others can reach it; got {address} alone; "
            f"add --allow-origin HOST:PORT, as it stands in the browser"
        )
    return tuple(origins)


def host_of(origin: str) -> str:
    """Return the host of HOST or HOST:PORT, in small letters and without brackets."""
    host, colon, port = origin.rpartition(":")
    return (host if colon and port.isdecimal() else origin).strip("[]").lower()


def bound_port(address: str, port: int) -> int:
    """Find a port that nobody listens on, unless one is given, which has to be such.

    Raises:
        OSError: An address that is none of this machine's, or a port that is taken.
    """
    try:
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as one:
            # As the server does: a port whose last server has just ended is free.
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            one.bind((address, port))
            return int(one.getsockname()[1])
    except socket.gaierror:
        raise OSError(f"address must be one that this machine has; got {address}") from None
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise OSError(f"address must be one that this machine has; got {address}") from None
        raise OSError(f"port must be free at {address}; got {port}: {error.strerror}; 0 is any that is free") from None
