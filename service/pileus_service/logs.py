"""Structured logs: one event a line, JSON for machines, plain words on a terminal.

What a line is about (job, frame, task, worker) is bound once, in structlog's context variables, and
stands on every line of that context, those of libraries included.
"""

import logging
import sys

import structlog
from structlog.typing import Processor

_BEFORE: list[Processor] = [
    structlog.contextvars.merge_contextvars,
    structlog.stdlib.add_log_level,
    structlog.processors.TimeStamper(fmt="iso", utc=True, key="time"),
]
_JSON: list[Processor] = [
    structlog.processors.format_exc_info,
    structlog.processors.JSONRenderer(),
]


def json_formatter() -> logging.Formatter:
    """A line of JSON for each record: time, level, event, what it is about."""
    return _formatter(_JSON)


def configure(*handlers: logging.Handler, level: int = logging.INFO) -> None:
    """Sends the program's log to stderr, and to other handlers that it has."""
    structlog.configure(
        processors=[*_BEFORE, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
    )
    stream = logging.StreamHandler(sys.stderr)
    people: list[Processor] = [structlog.dev.ConsoleRenderer()]
    stream.setFormatter(_formatter(people) if sys.stderr.isatty() else json_formatter())
    logging.basicConfig(handlers=[stream, *handlers], level=level, force=True)
    # The client that delivers webhooks would tell each request, address and all.
    logging.getLogger("httpx").setLevel(logging.WARNING)


def _formatter(last: list[Processor]) -> logging.Formatter:
    return structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=_BEFORE,
        processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *last],
    )
