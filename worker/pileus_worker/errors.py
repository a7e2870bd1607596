"""Turns the renderer's errors into the two that a command ends with."""

import contextlib
from collections.abc import Iterator

import pileus_core as core

from pileus_service.errors import FarmError, InputError


@contextlib.contextmanager
def plain_errors(source: str) -> Iterator[None]:
    """Wrong input names the file it came from; a disk that is full is no input."""
    try:
        yield
    except core.InputError as error:
        raise InputError(_named(source, error)) from None
    except FarmError:
        raise
    except (OSError, RuntimeError) as error:
        raise FarmError(_named(source, error)) from None


def _named(source: str, error: Exception) -> str:
    line = str(error)
    return line if line.startswith(source) else f"{source}: {line}"
