"""Address, port and allowed origins of the explorer's server, with their validation."""

import errno
import re
import socket
from typing import Any

# Port that the server binds by default, and largest port number of TCP.
PORT, MOST_PORT = 5006, 65535
# Addresses that only programs on this machine can reach.
LOCAL = ("127.0.0.1", "localhost", "::1")

# A host name, an IPv4 number or an IPv6 number in brackets, then optionally a port. The pattern has no nested
# repetition over the same characters, so that matching takes linear time even on a text made to slow it down.
_ORIGIN = re.compile(r"([A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?|\[[0-9A-Fa-f:.]+\])(:(?P<port>[0-9]{1,5}))?")


def check_listener(address: Any, port: Any, allow_origin: Any) -> tuple[str, ...]:
    """Return the validated origins of the pages that may connect to a server at this address and port.

    Raises:
        ValueError: The port or an origin is invalid, the address is no text, or other machines can reach the address
            and no origin is specified.
    """
    from vijax.runtime import validation  # imported here, because it imports NumPy, which would slow down --help

    validation.validate_integer("port", port, 0, MOST_PORT)
    specified = [allow_origin] if isinstance(allow_origin, str) else allow_origin
    origins = validation.validate_records("allow_origin", specified, str, "HOST:PORT, one or several")
    for origin in origins:
        match = _ORIGIN.fullmatch(origin)
        if match is None or int(match["port"] or 0) > MOST_PORT:
            requirement = "HOST or HOST:PORT, as the browsers of the permitted users show it"
            raise ValueError(f"allow_origin must be {requirement}; got {validation.value_text(origin)}")
    if not isinstance(address, str) or not address:
        raise ValueError(f"address must be a text, such as 127.0.0.1; got {validation.value_text(address)}")
    if address not in LOCAL and not origins:
        raise ValueError(
            f"address must come with allow_origin where others can reach it; got {address} alone; "
            f"add --allow-origin HOST:PORT, as it stands in the browser"
        )
    return tuple(origins)


def host_of(origin: str) -> str:
    """Return the host of HOST or HOST:PORT, in lower case and without brackets."""
    host, colon, port = origin.rpartition(":")
    return (host if colon and port.isdecimal() else origin).strip("[]").lower()


def bound_port(address: str, port: int) -> int:
    """Return the specified port if it is free, or any free port if `port` is 0.

    Raises:
        OSError: This machine does not have the address, or the port is in use.
    """
    try:
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as listener:
            # As in Bokeh's server: with this option, a port is free as soon as the server that used it has ended.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((address, port))
            return int(listener.getsockname()[1])
    except socket.gaierror:
        raise OSError(f"address must be one that this machine has; got {address}") from None
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise OSError(f"address must be one that this machine has; got {address}") from None
        raise OSError(f"port must be free at {address}; got {port}: {error.strerror}; 0 is any that is free") from None
