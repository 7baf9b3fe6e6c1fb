"""A server that sends any bytes at any pace: what no HTTP library would send."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

Script = Callable[["Connection"], None]


@dataclass
class Connection:
    """A client's connection. request: its first bytes.  over: set when the test is over."""

    socket: socket.socket
    request: bytes
    over: threading.Event

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def drip(self, data: bytes, pause_s: float = 0.02) -> None:
        """Send byte by byte, again and again."""
        while True:
            for byte in data:
                self.socket.sendall(bytes([byte]))
                if self.over.wait(pause_s):
                    return

    def reset(self) -> None:
        """End the connection without a goodbye."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


@dataclass
class Hostile:
    """url: without a path.  connections: number of clients so far."""

    url: str = ""
    connections: int = 0
    over: threading.Event = field(default_factory=threading.Event)


@contextlib.contextmanager
def attacking(script: Script) -> Iterator[Hostile]:
    """A server on 127.0.0.1 that runs the script for each connection while the block runs."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        server = Hostile(f"http://127.0.0.1:{listening.getsockname()[1]}")

        def serve(client: socket.socket) -> None:
            with client, contextlib.suppress(OSError):
                client.settimeout(10)
                script(Connection(client, client.recv(1 << 16), server.over))

        def accept() -> None:
            while not server.over.is_set():
                try:
                    client, _ = listening.accept()
                except OSError:
                    return
                server.connections += 1
                threading.Thread(target=serve, args=(client,), daemon=True).start()

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.over.set()
            with contextlib.suppress(OSError):
                listening.shutdown(socket.SHUT_RDWR)
            thread.join(2)
