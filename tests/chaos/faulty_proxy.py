"""A TCP proxy on 127.0.0.1 that can be told to cut, to hang, to be slow, or to answer 503 in the server's place."""

import contextlib
import socket
import threading
import time

CHUNK = 1 << 16
SLOW_S = 0.2
"""Before each piece that is forwarded while slow."""
UNAVAILABLE = b"HTTP/1.1 503 Slow Down\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class FaultyProxy:
    """Forwards to one port; `mode` is pass, cut, hang, slow or 503, and holds for open connections too."""

    def __init__(self, target: int) -> None:
        self._target, self._mode = target, "pass"
        self._open: set[socket.socket] = set()
        self._listening = socket.create_server(("127.0.0.1", 0), backlog=128)
        self.port: int = self._listening.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def mode(self) -> str:
        return self._mode

    @mode.setter
    def mode(self, mode: str) -> None:
        before, self._mode = self._mode, mode
        # What hung has lost its place; a cut ends what is open.
        if mode in ("cut", "503") or before == "hang":
            for connection in list(self._open):
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Take no more connections and end those that are open."""
        self._listening.close()
        self.mode = "cut"

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listening.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with client:
            if self._mode == "cut":
                return
            if self._mode == "503":
                with contextlib.suppress(OSError):
                    client.recv(CHUNK)
                    client.sendall(UNAVAILABLE)
                return
            try:
                server = socket.create_connection(("127.0.0.1", self._target), timeout=10)
            except OSError:
                return
            with server:
                server.settimeout(None)
                self._open |= {client, server}
                back = threading.Thread(target=self._pump, args=(server, client), daemon=True)
                back.start()
                self._pump(client, server)
                back.join()
                self._open -= {client, server}

    def _pump(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(CHUNK):
                while self._mode == "hang":
                    time.sleep(0.05)
                if self._mode == "slow":
                    time.sleep(SLOW_S)
                target.sendall(data)
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
