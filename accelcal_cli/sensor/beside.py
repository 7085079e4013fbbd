"""One call at a time in a thread beside the caller, for work that releases the interpreter lock."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread


class Beside:
    """Runs calls in order, each beside what the caller does next."""

    def __init__(self) -> None:
        """Start with nothing under way."""
        self._thread: Thread | None = None
        self._fault: BaseException | None = None

    def start(self, call: Callable[[], object]) -> None:
        """Wait for the call under way, then start the next."""
        self.wait()
        self._thread = Thread(target=self._run, args=(call,), daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Wait for the call under way; raise what it raised."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._fault is not None:
            fault, self._fault = self._fault, None
            raise fault

    def _run(self, call: Callable[[], object]) -> None:
        try:
            call()
        except BaseException as fault:
            self._fault = fault
