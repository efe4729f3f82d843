"""Where a server listens: what a port is, which addresses are of this machine alone."""

import socket

PORT, MOST_PORT = 5006, 65535
LOCAL = ("127.0.0.1", "localhost", "::1")


def free_port(address: str) -> int:
    """Find a port that nobody listens on."""
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as one:
        one.bind((address, 0))
        return int(one.getsockname()[1])
