"""Where the milliseconds of one estimate go."""

from __future__ import annotations

from time import perf_counter


class Stopwatch:
    """Adds up milliseconds under names: each lap is charged to the name it ends with."""

    __slots__ = ("_last", "laps")

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, name: str) -> None:
        """Charge the time since the last lap to ``name``."""
        now = perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now
