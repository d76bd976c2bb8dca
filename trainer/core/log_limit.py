"""No line of a log is repeated without a bound, however often what it tells of happens.

Each place in the code has a few lines at once, and then one a minute, which says how many were left out.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

AT_ONCE = 20
"""Lines of one place in the code, until it has to wait."""
EVERY_S = 60.0
"""Then one line in that time."""
LONGEST = 4000
"""Characters of a message; what it quotes may be as long as somebody likes."""


class LogLimit(logging.Filter):
    """To be added to a handler: lets through what is within the limits.

    Args:
        clock: Seconds that only go forward.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._places: dict[tuple, tuple[float, float, int]] = {}
        """Of each place in the code: lines left, as of when, and how many were left out since."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a line is written; one after a pause says what was left out meanwhile."""
        kind = record.exc_info[0] if record.exc_info else None
        place, now = (record.pathname, record.lineno, kind), self._clock()
        left, at, out = self._places.get(place, (float(AT_ONCE), now, 0))
        left = min(AT_ONCE, left + (now - at) / EVERY_S)
        written = left >= 1
        self._places[place] = (left - written, now, 0 if written else out + 1)
        if written:
            try:
                text = record.getMessage()
            except Exception:  # wrongly formatted: the handler tells of it
                return True
            shown = text if len(text) <= LONGEST else f"{text[:LONGEST]} (and so on)"
            record.msg, record.args = f"{shown} ({out} more like this)" if out else shown, None
        return written


def limit_logs() -> None:
    """Limits what goes to standard error where nobody has set up logging otherwise; for a whole process."""
    if logging.lastResort is not None and not any(
        isinstance(each, LogLimit) for each in logging.lastResort.filters
    ):
        logging.lastResort.addFilter(LogLimit())
