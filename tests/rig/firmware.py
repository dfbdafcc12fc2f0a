"""The board on a pseudo-terminal, in real time: what a driver that knows only a port's name can be tested against.

The side channel (`eat`, `say`, `freeze`, `unplug`, and the board's own levers) injects faults while it runs.
"""

import os
import pty
import select
import threading
import time
import tty

from reflectsep.rig.board import Board

TICK_S = 0.0005


class Firmware:
    """A board behind a pseudo-terminal; opening it does not reset the board, as over a cable without DTR."""

    def __init__(self, settings=None, *, homing_s=1.0):
        self.board = Board(settings, homing_s=homing_s)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.eat = []
        self.frozen = False
        self.late_s = 0.0
        """By how much, at worst, it was kept from running: a board in earnest has its processor for itself."""
        self._plugged = True
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self.board.power_on(time.monotonic())
        self._thread.start()
        return self

    def __exit__(self, *error):
        self.unplug()

    def unplug(self):
        """Pull the cable: the board goes on by itself."""
        if self._plugged:
            self._plugged = False
            self._thread.join()
            os.close(self._master)
            os.close(self._slave)

    def say(self, data):
        """Bytes to the host, out of turn."""
        os.write(self._master, data)

    def true_position(self, time_s):
        """Where the carriage really was, by the host's monotonic clock."""
        with self._lock:
            self.board.advance(time.monotonic())
            return self.board.position(time_s)

    def _run(self):
        awake_s = time.monotonic()
        while self._plugged:
            self.late_s = max(self.late_s, time.monotonic() - awake_s - TICK_S)
            awake_s = time.monotonic()
            ready, _, _ = select.select([self._master], [], [], TICK_S)
            data = os.read(self._master, 4096) if ready else b""
            now = time.monotonic()
            with self._lock:
                if data:
                    self.board.receive(data, now)
                out = self.board.transmit(now)
            for word in list(self.eat):
                if word in out:
                    out = out.replace(word, b"", 1)
                    self.eat.remove(word)
            if out and not self.frozen:
                os.write(self._master, out)
