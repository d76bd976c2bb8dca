"""No line of a log is repeated without a bound."""

from __future__ import annotations

import io
import logging

from onedemo.core.log_limit import AT_ONCE, EVERY_S, LONGEST, LogLimit


def test_a_line_is_written_so_often_and_then_once_a_minute():
    now = [0.0]
    written = io.StringIO()
    handler = logging.StreamHandler(written)
    handler.addFilter(LogLimit(clock=lambda: now[0]))
    log = logging.Logger("x")
    log.addHandler(handler)

    def fail(number: int) -> None:
        try:
            raise OSError(number)
        except OSError:
            log.exception("failed %d", number)

    for number in range(100_000):
        fail(number)
    log.error("another")
    lines = written.getvalue().splitlines()
    assert sum(line.startswith("failed") for line in lines) == AT_ONCE
    assert lines[-1] == "another" and len(written.getvalue()) < 20_000
    now[0] = EVERY_S + 1
    fail(7)
    fail(-8)
    assert f"failed 7 ({100_000 - AT_ONCE} more like this)" in written.getvalue()
    assert "failed -8" not in written.getvalue()
    log.error("x" * 10 * LONGEST)
    assert len(written.getvalue().splitlines()[-1]) < 2 * LONGEST


def test_a_record_that_is_wrongly_formatted_is_left_to_the_handler():
    record = logging.LogRecord("x", logging.ERROR, __file__, 1, "%d of %d", ("one",), None)
    assert LogLimit().filter(record)
    assert record.msg == "%d of %d"
